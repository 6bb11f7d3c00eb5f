#include "kernels/evaluator.h"

#include <algorithm>
#include <limits>
#include <map>
#include <mutex>
#include <tuple>

#include <boost/geometry.hpp>  // the convex hull of the samples' columns
#include <boost/geometry/geometries/multi_point.hpp>
#include <boost/geometry/geometries/point_xy.hpp>
#include <boost/geometry/geometries/polygon.hpp>

#include "kernels/engine_impl.h"

namespace brdfit::kernels {
namespace {

/// The most bytes of scratch that a launch may take.
constexpr std::size_t kScratchBytes = std::size_t{64} << 20;

std::size_t size_of(Precision precision) {
    return precision == Precision::double_precision ? sizeof(double) : sizeof(float);
}

}  // namespace

struct DirectionSet::Impl {
    explicit Impl(std::vector<Direction> list) : directions(std::move(list)) {}

    /// The columns on the device, samples padded by copies of the last.
    cl::Buffer columns(const Engine::Impl& shared, const cl::CommandQueue& queue, Precision precision,
                       std::size_t padded) {
        const std::lock_guard lock(mutex);
        cl::Buffer& buffer = buffers[{shared.context(), precision, padded}];
        if (buffer() != nullptr) return buffer;
        const auto table = geometry_columns();
        const std::vector<long double>& unrounded = exact_columns();
        const std::size_t n = unrounded.size() / table.size();
        std::vector<double> values;
        for (std::size_t i = 0; i < table.size(); ++i)
            for (std::size_t j = 0; j < padded; ++j)
                values.push_back(table[i].rounded(unrounded[i * n + std::min(j, n - 1)], precision));
        cl::Buffer made(shared.context, CL_MEM_READ_ONLY, std::max<std::size_t>(1, values.size()) * size_of(precision));
        if (!values.empty()) {
            if (precision == Precision::double_precision) {
                queue.enqueueWriteBuffer(made, CL_TRUE, 0, values.size() * sizeof(double), values.data());
            } else {
                const std::vector<float> single(values.begin(), values.end());
                queue.enqueueWriteBuffer(made, CL_TRUE, 0, single.size() * sizeof(float), single.data());
            }
        }
        return buffer = made;
    }

    std::vector<std::pair<double, double>> hull(std::size_t a, std::size_t b) {
        const std::lock_guard lock(mutex);
        std::vector<std::pair<double, double>>& corners = hulls[{a, b}];
        if (!corners.empty()) return corners;
        constexpr std::size_t kEnough = 4000;
        const std::vector<long double>& unrounded = exact_columns();
        const std::size_t n = unrounded.size() / geometry_columns().size();
        using Point = boost::geometry::model::d2::point_xy<double>;
        boost::geometry::model::multi_point<Point> points;
        for (std::size_t j = 0; j < n; j += 1 + n / kEnough)
            points.emplace_back(static_cast<double>(unrounded[a * n + j]), static_cast<double>(unrounded[b * n + j]));
        boost::geometry::model::polygon<Point> polygon;
        boost::geometry::convex_hull(points, polygon);
        for (const Point& point : polygon.outer()) corners.emplace_back(point.x(), point.y());
        return corners;
    }

    std::vector<Direction> directions;

private:
    /// Every column's exact value at every direction, or at one of no interest where there is none. With the lock held.
    const std::vector<long double>& exact_columns() {
        if (!exact.empty()) return exact;
        const auto table = geometry_columns();
        const std::size_t n = std::max<std::size_t>(1, directions.size());
        exact.resize(table.size() * n);
        for (std::size_t j = 0; j < n; ++j) {
            const Angles angles(canonical(directions.empty() ? Direction{} : directions[j]));
            for (std::size_t i = 0; i < table.size(); ++i) exact[i * n + j] = table[i].value(angles);
        }
        return exact;
    }

    std::mutex mutex;  // guards what follows
    std::vector<long double> exact;
    std::map<std::pair<std::size_t, std::size_t>, std::vector<std::pair<double, double>>> hulls;
    std::map<std::tuple<cl_context, Precision, std::size_t>, cl::Buffer> buffers;
};

DirectionSet::DirectionSet(std::vector<Direction> directions) : impl_(std::make_shared<Impl>(std::move(directions))) {}

std::span<const Direction> DirectionSet::directions() const { return impl_->directions; }

std::vector<std::pair<double, double>> DirectionSet::hull(std::size_t a, std::size_t b) const {
    return impl_->hull(a, b);
}

/// Buffers hold `scalar`s; the host side is double. One conversion each way, here.
struct Evaluator::Impl {
    Impl(Engine& engine, const Model& model_in, Precision precision_in, const DirectionSet& directions,
         std::span<const double> y, std::span<const double> w, Accuracy accuracy)
        : shared(engine.impl()),
          model(model_in),
          precision(precision_in),
          lanes(shared.lanes(precision)),
          count(directions.directions().size()),
          padded((count + lanes - 1) / lanes * lanes),
          nonlinear(model.nonlinear().size()),
          queue(shared.context, shared.device) {
        const cl::Program program = shared.program(model, precision, accuracy);
        project = cl::Kernel(program, "project");
        project_value = cl::Kernel(program, "project_value");
        loss = cl::Kernel(program, "loss");
        terms = cl::Kernel(program, "terms");

        columns_buffer = directions.impl().columns(shared, queue, precision, padded);
        const auto pad = [&](std::span<const double> values) {
            std::vector<double> result(values.begin(), values.end());
            result.resize(padded, 0.0);
            return result;
        };
        upload(y_buffer, pad(y));
        upload(w_buffer, pad(w));
        for (cl::Kernel* kernel : {&project, &project_value, &loss}) {
            kernel->setArg(0, columns_buffer);
            kernel->setArg(1, y_buffer);
            kernel->setArg(2, w_buffer);
            kernel->setArg(3, static_cast<cl_int>(padded));
        }
        terms.setArg(0, columns_buffer);
        terms.setArg(1, static_cast<cl_int>(padded));
    }

    /// Makes the buffer at least that many scalars large.
    void reserve(cl::Buffer& buffer, std::size_t scalars) const {
        const std::size_t bytes = std::max<std::size_t>(scalars, 1) * size_of(precision);
        if (buffer() == nullptr || buffer.getInfo<CL_MEM_SIZE>() < bytes)
            buffer = cl::Buffer(shared.context, CL_MEM_READ_WRITE, bytes);
    }

    void upload(cl::Buffer& buffer, std::span<const double> values) {
        reserve(buffer, values.size());
        if (values.empty()) return;
        if (precision == Precision::double_precision) {
            queue.enqueueWriteBuffer(buffer, CL_TRUE, 0, values.size_bytes(), values.data());
        } else {
            single.assign(values.begin(), values.end());
            queue.enqueueWriteBuffer(buffer, CL_TRUE, 0, single.size() * sizeof(float), single.data());
        }
    }

    void download(const cl::Buffer& buffer, std::span<double> values) {
        if (precision == Precision::double_precision) {
            queue.enqueueReadBuffer(buffer, CL_TRUE, 0, values.size_bytes(), values.data());
        } else {
            single.resize(values.size());
            queue.enqueueReadBuffer(buffer, CL_TRUE, 0, single.size() * sizeof(float), single.data());
            std::copy(single.begin(), single.end(), values.begin());
        }
    }

    [[nodiscard]] std::size_t in_stride() const { return model.parameters.size() + 2 * model.terms.size(); }
    [[nodiscard]] std::size_t normals() const {
        const std::size_t unknowns = model.terms.size() + nonlinear;
        return unknowns * (unknowns + 1) / 2;
    }
    [[nodiscard]] std::size_t out_stride() const {
        return 1 + 2 * model.terms.size() + model.parameters.size() + normals();
    }

    /// Candidates whose terms fit into one launch's scratch.
    [[nodiscard]] std::size_t launch_limit() const {
        const std::size_t bytes = padded * model.term_values() * size_of(precision);
        return std::max<std::size_t>(1, kScratchBytes / std::max<std::size_t>(bytes, 1));
    }

    /// On a CPU one work-item takes everything: it runs in this thread, other threads run other launches. And PoCL 3.1
    /// keeps a loaded kernel for each width of grid but looks only at the kernel when it lets go of one: two widths in
    /// two threads end the process ("found->ref_count > 0").
    [[nodiscard]] std::size_t width(std::size_t items) const {
        return shared.info.type == "cpu" ? 1 : std::min(items, launch_limit());
    }

    void launch(const cl::Kernel& kernel, std::size_t items) {
        queue.enqueueNDRangeKernel(kernel, cl::NullRange, cl::NDRange(width(items)), cl::NDRange(1));
    }

    /// Runs `kernel` over the candidates; its arguments are set but for their number, in and out.
    void run(cl::Kernel& kernel, std::span<const double> parameters, std::span<const double> lower,
             std::span<const double> upper, cl_uint out_argument, bool gradient, Batch& out) {
        const std::size_t p = model.parameters.size();
        const std::size_t t = model.terms.size();
        const std::size_t candidates = parameters.size() / p;
        if (candidates == 0) {
            out = {};
            return;
        }
        rows.resize(candidates * in_stride());
        for (std::size_t i = 0; i < candidates; ++i) {
            double* row = rows.data() + i * in_stride();
            std::copy_n(parameters.data() + i * p, p, row);
            std::copy_n(lower.data() + i * t, t, row + p);
            std::copy_n(upper.data() + i * t, t, row + p + t);
        }
        upload(in_buffer, rows);
        reserve(out_buffer, candidates * out_stride());
        kernel.setArg(4, static_cast<cl_int>(candidates));
        kernel.setArg(5, in_buffer);
        kernel.setArg(out_argument, out_buffer);
        launch(kernel, candidates);
        rows.resize(candidates * out_stride());
        download(out_buffer, rows);

        out.loss.resize(candidates);
        out.coefficients.resize(candidates * t);
        out.by_coefficient.resize(gradient ? candidates * t : 0);
        out.by_parameter.resize(gradient ? candidates * p : 0);
        out.normal.resize(gradient ? candidates * normals() : 0);
        for (std::size_t i = 0; i < candidates; ++i) {
            const double* row = rows.data() + i * out_stride();
            out.loss[i] = *row++;
            std::copy_n(row, t, out.coefficients.data() + i * t);
            if (!gradient) continue;
            row += t;
            std::copy_n(row, t, out.by_coefficient.data() + i * t);
            std::copy_n(row + t, p, out.by_parameter.data() + i * p);
            std::copy_n(row + t + p, normals(), out.normal.data() + i * normals());
        }
    }

    Engine::Impl& shared;
    const Model& model;
    Precision precision;
    unsigned lanes;
    std::size_t count;
    std::size_t padded;
    std::size_t nonlinear;
    cl::CommandQueue queue;
    cl::Kernel project, project_value, loss, terms;
    cl::Buffer columns_buffer, y_buffer, w_buffer;
    cl::Buffer in_buffer, scratch_buffer, out_buffer;
    std::vector<float> single;  // staging for conversions
    std::vector<double> rows;
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
    cl::Kernel& kernel = gradient ? m.project : m.project_value;
    m.reserve(m.scratch_buffer,
              m.width(parameters.size() / m.model.parameters.size()) * m.padded * m.model.term_values());
    kernel.setArg(6, m.scratch_buffer);
    m.run(kernel, parameters, lower, upper, 7, gradient, out);
} catch (const cl::Error& error) {
    throw device_error(error);
}

void Evaluator::loss(std::span<const double> parameters, std::span<const double> coefficients, bool logarithmic,
                     Batch& out) try {
    Impl& m = *impl_;
    m.loss.setArg(6, static_cast<cl_int>(logarithmic));
    m.run(m.loss, parameters, coefficients, coefficients, 7, true, out);
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
        m.upload(m.in_buffer, parameters.subspan(first * p, n * p));
        m.reserve(m.scratch_buffer, n * values * m.padded);
        m.terms.setArg(2, static_cast<cl_int>(n));
        m.terms.setArg(3, m.in_buffer);
        m.terms.setArg(4, m.scratch_buffer);
        m.launch(m.terms, n * m.padded / m.lanes);
        m.rows.resize(n * values * m.padded);
        m.download(m.scratch_buffer, m.rows);
        for (std::size_t row = 0; row < n * values; ++row) {
            const auto begin = m.rows.begin() + static_cast<std::ptrdiff_t>(row * m.padded);
            result.insert(result.end(), begin, begin + static_cast<std::ptrdiff_t>(m.count));
        }
    }
    return result;
} catch (const cl::Error& error) {
    throw device_error(error);
}

Values evaluate(Engine& engine, const Model& model, Precision precision, const std::vector<double>& parameters,
                const DirectionSet& directions, bool gradient) {
    Values values;
    const std::size_t n = directions.directions().size();
    if (n == 0) return values;
    Evaluator evaluator(engine, model, precision, directions, {}, {});
    const std::vector<double> rows = evaluator.terms(parameters);
    const std::vector<double> c = model.coefficients(parameters);
    values.f.assign(n, 0.0);
    if (gradient) values.by_parameter.assign(model.parameters.size() * n, 0.0);
    std::size_t row = 0;
    const auto add = [&](double* to, double factor, std::size_t from) {
        constexpr double kMost = std::numeric_limits<double>::max();  // where saturated lobes add up
        for (std::size_t i = 0; i < n; ++i) to[i] = std::clamp(to[i] + factor * rows[from * n + i], -kMost, kMost);
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
}

}  // namespace brdfit::kernels
