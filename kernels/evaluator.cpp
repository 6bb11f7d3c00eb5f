#include "kernels/evaluator.h"

#include <sys/mman.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <limits>
#include <map>
#include <mutex>
#include <new>
#include <tuple>

#include <boost/geometry.hpp>  // the convex hull of the samples' columns
#include <boost/geometry/geometries/multi_point.hpp>
#include <boost/geometry/geometries/point_xy.hpp>
#include <boost/geometry/geometries/polygon.hpp>

#include "kernels/transfers.h"

namespace brdfit::kernels {
namespace {

/// The most bytes of scratch that a launch may take.
constexpr std::size_t kScratchBytes = std::size_t{64} << 20;
/// Samples of a slice: few, as a batch of ten candidates shall fill a GPU.
constexpr std::size_t kSlice = 16;
/// Work-items of a work-group of a GPU.
constexpr std::size_t kGroup = 64;

/// Memory for a large table. Its pages are large as well where the system has such: faulting small ones in takes longer
/// than filling them.
struct LargeMemory {
    explicit LargeMemory(std::size_t bytes) {
        constexpr std::size_t kPage = std::size_t{2} << 20;
        const std::size_t whole = (bytes + kPage - 1) / kPage * kPage;
        memory.reset(std::aligned_alloc(kPage, whole));
        if (!memory) throw std::bad_alloc();
        (void)::madvise(memory.get(), whole, MADV_HUGEPAGE);  // a wish
    }
    struct Free {
        void operator()(void* pointer) const { std::free(pointer); }  // NOLINT(cppcoreguidelines-no-malloc)
    };
    std::unique_ptr<void, Free> memory;
};

/// The geometry columns of a set of directions in one precision, on one device. On a CPU the device reads the host's
/// memory where the table is large.
class ColumnTable {
public:
    ColumnTable(const Engine::Impl& shared, Precision precision, std::size_t padded)
        : context_(shared.context), precision_(precision), padded_(padded) {
        const std::size_t bytes = geometry_columns().size() * padded * size_of(precision);
        if (shared.info.type == "cpu" && bytes >= kLarge) large_.emplace(bytes);
        else small_.resize(geometry_columns().size() * padded);
    }

    /// Returns when the table is formed, by this thread and those that ask for it at the same time.
    void form(const std::vector<Direction>& directions) {
        for (std::size_t first = next_.fetch_add(kShare); first < padded_; first = next_.fetch_add(kShare)) {
            const std::size_t end = std::min(padded_, first + kShare);
            if (!large_) fill(directions, first, end, small_.data());
            else if (precision_ == Precision::double_precision)
                fill(directions, first, end, static_cast<double*>(large_->memory.get()));
            else fill(directions, first, end, static_cast<float*>(large_->memory.get()));
            const std::lock_guard lock(mutex_);
            formed_ += end - first;
        }
        std::unique_lock lock(mutex_);
        if (formed_ == padded_) all_formed_.notify_all();
        all_formed_.wait(lock, [&] { return formed_ == padded_; });
        if (buffer_() == nullptr) make_buffer();
    }

    [[nodiscard]] const cl::Buffer& buffer() const { return buffer_; }

private:
    static constexpr std::size_t kLarge = std::size_t{1} << 20;  // bytes
    static constexpr std::size_t kShare = 4096;                  // samples that a thread takes at a time

    template <typename Scalar>
    void fill(const std::vector<Direction>& directions, std::size_t first, std::size_t end, Scalar* values) const {
        const auto columns = geometry_columns();
        Angles angles{Direction{}};
        if (!directions.empty()) angles.turn(canonical(directions[std::min(first, directions.size() - 1)]));
        for (std::size_t j = first; j < end; ++j) {
            if (j < directions.size()) angles.turn(canonical(directions[j]));
            for (std::size_t i = 0; i < columns.size(); ++i)
                values[i * padded_ + j] = static_cast<Scalar>(columns[i].read(angles, precision_));
        }
    }

    void make_buffer() {
        if (large_)
            buffer_ = cl::Buffer(context_, CL_MEM_READ_ONLY | CL_MEM_USE_HOST_PTR,
                                 geometry_columns().size() * padded_ * size_of(precision_), large_->memory.get());
        else buffer_ = constant_buffer(context_, precision_, small_);
        small_ = {};
    }

    cl::Context context_;
    Precision precision_;
    std::size_t padded_;
    std::optional<LargeMemory> large_;  // outlives the buffer
    std::vector<double> small_;
    std::atomic<std::size_t> next_ = 0;
    std::mutex mutex_;  // guards what follows, until all is formed
    std::condition_variable all_formed_;
    std::size_t formed_ = 0;
    cl::Buffer buffer_;
};

}  // namespace

struct DirectionSet::Impl {
    explicit Impl(std::vector<Direction> list) : directions(std::move(list)) {}

    /// The columns on the device, samples padded by copies of the last. Threads that ask for them meanwhile form their
    /// part of them.
    std::shared_ptr<const ColumnTable> columns(const Engine::Impl& shared, Precision precision, std::size_t padded) {
        std::shared_ptr<ColumnTable> table;
        {
            const std::lock_guard lock(mutex);
            std::shared_ptr<ColumnTable>& known = tables[{shared.context(), precision, padded}];
            if (!known) known = std::make_shared<ColumnTable>(shared, precision, padded);
            table = known;
        }
        table->form(directions);
        return table;
    }

    std::vector<std::pair<double, double>> points(std::size_t a, std::size_t b) {
        const std::lock_guard lock(mutex);
        return locked_points(a, b);
    }

    const std::vector<std::pair<double, double>>& locked_points(std::size_t a, std::size_t b) {
        constexpr std::size_t kEnough = 4000;
        std::vector<std::pair<double, double>>& result = seen[{a, b}];
        if (!result.empty()) return result;
        const auto table = geometry_columns();
        Angles angles{Direction{}};
        for (std::size_t j = 0; j < std::max<std::size_t>(1, directions.size()); j += 1 + directions.size() / kEnough) {
            if (j < directions.size()) angles.turn(canonical(directions[j]));
            result.emplace_back(static_cast<double>(table[a].value(angles)),
                                static_cast<double>(table[b].value(angles)));
        }
        return result;
    }

    std::vector<std::pair<double, double>> hull(std::size_t a, std::size_t b) {
        const std::lock_guard lock(mutex);
        std::vector<std::pair<double, double>>& corners = hulls[{a, b}];
        if (!corners.empty()) return corners;
        using Point = boost::geometry::model::d2::point_xy<double>;
        boost::geometry::model::multi_point<Point> all;
        for (const auto& [x, y] : locked_points(a, b)) all.emplace_back(x, y);
        boost::geometry::model::polygon<Point> polygon;
        boost::geometry::convex_hull(all, polygon);
        for (const Point& point : polygon.outer()) corners.emplace_back(point.x(), point.y());
        return corners;
    }

    std::vector<Direction> directions;

private:
    std::mutex mutex;  // guards what follows
    std::map<std::pair<std::size_t, std::size_t>, std::vector<std::pair<double, double>>> seen, hulls;
    std::map<std::tuple<cl_context, Precision, std::size_t>, std::shared_ptr<ColumnTable>> tables;
};

DirectionSet::DirectionSet(std::vector<Direction> directions) : impl_(std::make_shared<Impl>(std::move(directions))) {}

std::span<const Direction> DirectionSet::directions() const { return impl_->directions; }

std::vector<std::pair<double, double>> DirectionSet::points(std::size_t a, std::size_t b) const {
    return impl_->points(a, b);
}

std::vector<std::pair<double, double>> DirectionSet::hull(std::size_t a, std::size_t b) const {
    return impl_->hull(a, b);
}

namespace {

/// What an evaluator needs of its program and of no other: it takes longer to make than to launch.
struct Gear {
    Gear(const Engine::Impl& shared, cl::Program program_in)
        : program(std::move(program_in)), queue(shared.context, shared.device) {
        const bool sliced = shared.sliced();
        project = cl::Kernel(program, sliced ? "keep_terms" : "project");
        project_value = cl::Kernel(program, sliced ? "keep_values" : "project_value");
        loss = cl::Kernel(program, sliced ? "loss_slices" : "loss");
        terms = cl::Kernel(program, "terms");
        if (!sliced) return;
        solve = cl::Kernel(program, "solve_slices");
        sum = cl::Kernel(program, "sum_slices");
        add = cl::Kernel(program, "add_slices");
    }

    cl::Program program;
    cl::CommandQueue queue;
    cl::Kernel project, project_value, loss, terms;
    cl::Kernel solve, sum, add;  // sliced only
    cl::Buffer in_buffer, scratch_buffer, out_buffer;
    cl::Buffer products_buffer, sums_buffer;  // sliced only

    [[nodiscard]] std::array<cl::Buffer*, 5> buffers() {
        return {&in_buffer, &scratch_buffer, &out_buffer, &products_buffer, &sums_buffer};
    }
};

std::size_t bytes_of(const cl::Buffer& buffer) {
    return buffer() != nullptr ? buffer.getInfo<CL_MEM_SIZE>() : std::size_t{0};
}

/// Another's that has ended, or a new one.
std::shared_ptr<Gear> take_gear(Engine::Impl& shared, const cl::Program& program) {
    {
        const std::lock_guard lock(shared.spare_mutex);
        auto& spare = shared.spare[program()];
        if (!spare.empty()) {
            std::shared_ptr<Gear> gear = std::static_pointer_cast<Gear>(std::move(spare.back()));
            spare.pop_back();
            for (cl::Buffer* buffer : gear->buffers()) shared.spare_bytes -= bytes_of(*buffer);
            return gear;
        }
    }
    return std::make_shared<Gear>(shared, program);
}

/// Keeps some of what nobody needs any more: of large buffers, which take long to fault in, not many.
void leave_gear(Engine::Impl& shared, std::shared_ptr<Gear> gear) {
    constexpr std::size_t kMostSpare = 16;
    constexpr std::size_t kSmall = std::size_t{1} << 20;  // bytes
    constexpr std::size_t kMostBytes = std::size_t{32} << 20;
    const std::lock_guard lock(shared.spare_mutex);
    auto& spare = shared.spare[gear->program()];
    if (spare.size() >= kMostSpare) return;
    for (cl::Buffer* buffer : gear->buffers()) {
        const std::size_t bytes = bytes_of(*buffer);
        if (bytes > kSmall && shared.spare_bytes + bytes > kMostBytes) *buffer = {};
        else shared.spare_bytes += bytes;
    }
    spare.push_back(std::move(gear));
}

}  // namespace

struct Evaluator::Impl : Transfers {
    Impl(Engine& engine, const Model& model_in, Precision precision_in, const DirectionSet& directions,
         std::span<const double> y, std::span<const double> w, Accuracy accuracy)
        : Impl(engine, take_gear(engine.impl(), engine.impl().program(model_in, precision_in, accuracy)), model_in,
               precision_in, directions, y, w) {}

    Impl(Engine& engine, std::shared_ptr<Gear> gear, const Model& model_in, Precision precision_in,
         const DirectionSet& directions, std::span<const double> y, std::span<const double> w)
        : Transfers(engine, precision_in, gear->queue),
          gear_(std::move(gear)),
          model(model_in),
          lanes(shared.lanes(precision)),
          count(directions.directions().size()),
          padded((count + lanes - 1) / lanes * lanes),
          nonlinear(model.nonlinear().size()) {
        columns = directions.impl().columns(shared, precision, padded);
        for (cl::Kernel* kernel : {&project, &project_value, &loss}) {
            kernel->setArg(0, columns->buffer());
            kernel->setArg(3, static_cast<cl_int>(padded));
        }
        if (sliced) sum.setArg(3, static_cast<cl_int>(padded));
        assign(y, w);
        terms.setArg(0, columns->buffer());
        terms.setArg(1, static_cast<cl_int>(padded));
    }

    Impl(const Impl&) = delete;
    Impl& operator=(const Impl&) = delete;
    ~Impl() {
        if (failed) return;
        try {
            leave_gear(shared, std::move(gear_));
        } catch (...) {  // then the next makes its own
        }
    }

    void assign(std::span<const double> y, std::span<const double> w) {
        const auto pad = [&](std::span<const double> values) {
            std::vector<double> result(values.begin(), values.end());
            result.resize(padded, 0.0);
            return result;
        };
        y_buffer = constant_buffer(shared.context, precision, pad(y));
        w_buffer = constant_buffer(shared.context, precision, pad(w));
        for (cl::Kernel* kernel : {&project, &project_value, &loss}) {
            kernel->setArg(1, y_buffer);
            kernel->setArg(2, w_buffer);
        }
        if (!sliced) return;
        sum.setArg(1, y_buffer);
        sum.setArg(2, w_buffer);
    }

    [[nodiscard]] std::size_t in_stride() const { return model.parameters.size() + 2 * model.terms.size(); }
    [[nodiscard]] std::size_t normals() const {
        const std::size_t unknowns = model.terms.size() + nonlinear;
        return unknowns * (unknowns + 1) / 2;
    }
    [[nodiscard]] std::size_t out_stride() const {
        return 1 + 2 * model.terms.size() + model.parameters.size() + normals();
    }

    /// Scalars of scratch for a work-item's candidate; sliced: for a candidate of a launch.
    [[nodiscard]] std::size_t terms_stride() const { return padded * model.term_values(); }
    [[nodiscard]] std::size_t slices() const {
        const std::size_t apart = std::max<std::size_t>(kSlice, lanes);
        return std::max<std::size_t>(1, (padded + apart - 1) / apart);
    }
    [[nodiscard]] std::size_t products_stride() const {
        const std::size_t t = model.terms.size();
        return slices() * (t * (t + 1) / 2 + t);
    }
    [[nodiscard]] std::size_t sums_stride() const {
        return slices() * (1 + model.terms.size() + nonlinear + normals());
    }

    /// Candidates whose terms fit into one launch's scratch.
    [[nodiscard]] std::size_t launch_limit() const {
        const std::size_t scalars = terms_stride() + (sliced ? products_stride() + sums_stride() : 0);
        return std::max<std::size_t>(1, kScratchBytes / std::max<std::size_t>(scalars * size_of(precision), 1));
    }

    /// Work-items of a launch.
    [[nodiscard]] std::size_t width(std::size_t items) const {
        return shared.info.type == "cpu" ? cpu_width() : std::min(items, launch_limit());
    }

    void launch(const cl::Kernel& kernel, std::size_t items) {
        if (sliced && shared.info.type != "cpu") {
            const std::size_t groups = (items + kGroup - 1) / kGroup;
            queue.enqueueNDRangeKernel(kernel, cl::NullRange, cl::NDRange(groups * kGroup), cl::NDRange(kGroup));
        } else {
            queue.enqueueNDRangeKernel(kernel, cl::NullRange, cl::NDRange(width(items)), cl::NDRange(1));
        }
    }

    /// Slices of the candidates in in_buffer, added up in out_buffer. `first` is keep_terms or keep_values, or loss.
    void launch_slices(cl::Kernel& first, std::size_t candidates, bool gradient, std::optional<bool> logarithmic) {
        const auto n = static_cast<cl_int>(candidates);
        const auto per_candidate = static_cast<cl_int>(slices());
        reserve(sums_buffer, candidates * sums_stride());
        first.setArg(6, per_candidate);
        if (logarithmic) {
            first.setArg(7, static_cast<cl_int>(*logarithmic));
            first.setArg(8, sums_buffer);
            first.setArg(9, out_buffer);
            launch(first, candidates * slices());
        } else {
            reserve(scratch_buffer, candidates * terms_stride());
            reserve(products_buffer, candidates * products_stride());
            first.setArg(7, scratch_buffer);
            first.setArg(8, products_buffer);
            launch(first, candidates * slices());
            solve.setArg(0, n);
            solve.setArg(1, in_buffer);
            solve.setArg(2, per_candidate);
            solve.setArg(3, products_buffer);
            solve.setArg(4, out_buffer);
            launch(solve, candidates);
            sum.setArg(0, static_cast<cl_int>(gradient));
            sum.setArg(4, n);
            sum.setArg(5, per_candidate);
            sum.setArg(6, scratch_buffer);
            sum.setArg(7, out_buffer);
            sum.setArg(8, sums_buffer);
            launch(sum, candidates * slices());
        }
        add.setArg(0, static_cast<cl_int>(gradient));
        add.setArg(1, n);
        add.setArg(2, per_candidate);
        add.setArg(3, sums_buffer);
        add.setArg(4, out_buffer);
        launch(add, candidates * (gradient ? sums_stride() / slices() : 1));
    }

    /// Runs `kernel` over the candidates, in as many launches as it takes. logarithmic: the kernel is `loss`.
    void run(cl::Kernel& kernel, std::span<const double> parameters, std::span<const double> lower,
             std::span<const double> upper, bool gradient, std::optional<bool> logarithmic, Batch& out) {
        const std::size_t p = model.parameters.size();
        const std::size_t t = model.terms.size();
        const std::size_t candidates = parameters.size() / p;
        if (candidates == 0) {
            out = {};
            return;
        }
        const std::size_t most = shared.options.one_by_one ? 1
                                 : sliced                  ? std::min(launch_limit(), candidates)
                                                           : candidates;
        rows.resize(candidates * in_stride());
        for (std::size_t i = 0; i < candidates; ++i) {
            double* row = rows.data() + i * in_stride();
            std::copy_n(parameters.data() + i * p, p, row);
            std::copy_n(lower.data() + i * t, t, row + p);
            std::copy_n(upper.data() + i * t, t, row + p + t);
        }
        results.resize(candidates * out_stride());
        reserve(out_buffer, most * out_stride());
        for (std::size_t first = 0; first < candidates; first += most) {
            const std::size_t n = std::min(most, candidates - first);
            guarded([&] {
                upload(in_buffer, std::span(rows).subspan(first * in_stride(), n * in_stride()));
                kernel.setArg(4, static_cast<cl_int>(n));
                kernel.setArg(5, in_buffer);
                if (sliced) {
                    launch_slices(kernel, n, gradient, logarithmic);
                } else {
                    if (logarithmic) {
                        kernel.setArg(6, static_cast<cl_int>(*logarithmic));
                    } else {
                        reserve(scratch_buffer, width(n) * terms_stride());
                        kernel.setArg(6, scratch_buffer);
                    }
                    kernel.setArg(7, out_buffer);
                    launch(kernel, n);
                }
                download(out_buffer, std::span(results).subspan(first * out_stride(), n * out_stride()));
            });
        }

        out.loss.resize(candidates);
        out.coefficients.resize(candidates * t);
        out.by_coefficient.resize(gradient ? candidates * t : 0);
        out.by_parameter.resize(gradient ? candidates * p : 0);
        out.normal.resize(gradient ? candidates * normals() : 0);
        for (std::size_t i = 0; i < candidates; ++i) {
            const double* row = results.data() + i * out_stride();
            out.loss[i] = *row++;
            std::copy_n(row, t, out.coefficients.data() + i * t);
            if (!gradient) continue;
            row += t;
            std::copy_n(row, t, out.by_coefficient.data() + i * t);
            std::copy_n(row + t, p, out.by_parameter.data() + i * p);
            std::copy_n(row + t + p, normals(), out.normal.data() + i * normals());
        }
    }

    std::shared_ptr<Gear> gear_;
    /// Terms and slopes of candidates that fit into one launch, into `results`; rows are `padded` long.
    void find_terms(std::span<const double> parameters) {
        const std::size_t n = parameters.size() / model.parameters.size();
        results.resize(n * model.term_values() * padded);
        guarded([&] {
            upload(in_buffer, parameters);
            reserve(scratch_buffer, results.size());
            terms.setArg(2, static_cast<cl_int>(n));
            terms.setArg(3, in_buffer);
            terms.setArg(4, scratch_buffer);
            launch(terms, n * padded / lanes);
            download(scratch_buffer, results);
        });
    }

    const Model& model;
    unsigned lanes;
    std::size_t count;
    std::size_t padded;
    std::size_t nonlinear;
    bool sliced = shared.sliced();
    cl::Kernel &project = gear_->project, &project_value = gear_->project_value, &loss = gear_->loss,
               &terms = gear_->terms;
    cl::Kernel &solve = gear_->solve, &sum = gear_->sum, &add = gear_->add;
    std::shared_ptr<const ColumnTable> columns;
    cl::Buffer y_buffer, w_buffer;
    cl::Buffer &in_buffer = gear_->in_buffer, &scratch_buffer = gear_->scratch_buffer, &out_buffer = gear_->out_buffer;
    cl::Buffer &products_buffer = gear_->products_buffer, &sums_buffer = gear_->sums_buffer;
    std::vector<double> rows, results;
};

Evaluator::Evaluator(Engine& engine, const Model& model, Precision precision, const DirectionSet& directions,
                     std::span<const double> y, std::span<const double> w, Accuracy accuracy) try
    : impl_(std::make_unique<Impl>(engine, model, precision, directions, y, w, accuracy)) {
} catch (const cl::Error& error) {
    throw device_error(error);
}

Evaluator::~Evaluator() = default;
Evaluator::Evaluator(Evaluator&&) noexcept = default;
Evaluator& Evaluator::operator=(Evaluator&&) noexcept = default;

const Model& Evaluator::model() const { return impl_->model; }
std::size_t Evaluator::samples() const { return impl_->count; }

void Evaluator::project(std::span<const double> parameters, std::span<const double> lower,
                        std::span<const double> upper, bool gradient, Batch& out) try {
    Impl& m = *impl_;
    m.run(gradient ? m.project : m.project_value, parameters, lower, upper, gradient, {}, out);
} catch (const cl::Error& error) {
    throw device_error(error);
}

void Evaluator::loss(std::span<const double> parameters, std::span<const double> coefficients, bool logarithmic,
                     Batch& out) try {
    impl_->run(impl_->loss, parameters, coefficients, coefficients, true, logarithmic, out);
} catch (const cl::Error& error) {
    throw device_error(error);
}

std::vector<double> Evaluator::terms(std::span<const double> parameters) try {
    Impl& m = *impl_;
    const std::size_t p = m.model.parameters.size();
    const std::size_t values = m.model.term_values();
    const std::size_t candidates = parameters.size() / p;
    std::vector<double> result;
    result.reserve(candidates * values * m.count);
    for (std::size_t first = 0; first < candidates; first += m.launch_limit()) {
        const std::size_t n = std::min(m.launch_limit(), candidates - first);
        m.find_terms(parameters.subspan(first * p, n * p));
        for (std::size_t row = 0; row < n * values; ++row) {
            const auto begin = m.results.begin() + static_cast<std::ptrdiff_t>(row * m.padded);
            result.insert(result.end(), begin, begin + static_cast<std::ptrdiff_t>(m.count));
        }
    }
    return result;
} catch (const cl::Error& error) {
    throw device_error(error);
}

void Evaluator::assign(std::span<const double> y, std::span<const double> w) try {
    impl_->assign(y, w);
} catch (const cl::Error& error) {
    throw device_error(error);
}

Values Evaluator::values(const std::vector<double>& parameters, bool gradient) try {
    const Model& model = impl_->model;
    const std::size_t n = impl_->count;
    Values values;
    impl_->find_terms(parameters);
    const std::vector<double> c = model.coefficients(parameters);
    values.f.assign(n, 0.0);
    if (gradient) values.by_parameter.assign(model.parameters.size() * n, 0.0);
    std::size_t row = 0;
    const auto add = [&](double* to, double factor, std::size_t from) {
        constexpr double kMost = std::numeric_limits<double>::max();  // where saturated lobes add up
        const double* const terms = impl_->results.data() + from * impl_->padded;
        for (std::size_t i = 0; i < n; ++i) to[i] = std::clamp(to[i] + factor * terms[i], -kMost, kMost);
    };
    for (std::size_t t = 0; t < model.terms.size(); ++t) {
        const Term& term = model.terms[t];
        add(values.f.data(), c[t], row);
        if (gradient && term.factor) add(values.by_parameter.data() + *term.factor * n, 1.0, row);
        ++row;
        for (const std::size_t parameter : term.of) {
            if (gradient) add(values.by_parameter.data() + parameter * n, c[t], row);
            ++row;
        }
    }
    return values;
} catch (const cl::Error& error) {
    throw device_error(error);
}

Values evaluate(Engine& engine, const Model& model, Precision precision, const std::vector<double>& parameters,
                const DirectionSet& directions, bool gradient) {
    if (directions.directions().empty()) return {};
    return Evaluator(engine, model, precision, directions, {}, {}).values(parameters, gradient);
}

}  // namespace brdfit::kernels
