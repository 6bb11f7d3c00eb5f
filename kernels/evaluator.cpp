#include "kernels/evaluator.h"

#include <algorithm>
#include <limits>

#include "kernels/engine_impl.h"

namespace brdfit::kernels {
namespace {

/// The most bytes of scratch a launch may take; larger batches go in several launches.
constexpr std::size_t kScratchBytes = std::size_t{64} << 20;

}  // namespace

/// Buffers hold `scalar`s; the host side is double. One conversion each way, here.
struct Evaluator::Impl {
    Impl(Engine& engine, const Model& model_in, Precision precision_in, std::span<const Direction> directions,
         std::span<const double> y, std::span<const double> w, Accuracy accuracy)
        : shared(engine.impl()),
          model(model_in),
          precision(precision_in),
          lanes(shared.lanes(precision)),
          count(directions.size()),
          padded((count + lanes - 1) / lanes * lanes),
          queue(shared.context, shared.device) {
        const cl::Program program = shared.program(model, precision, accuracy);
        project = cl::Kernel(program, "project");
        project_value = cl::Kernel(program, "project_value");
        loss = cl::Kernel(program, "loss");
        terms = cl::Kernel(program, "terms");

        std::vector<double> columns(geometry_columns().size() * padded);
        for (std::size_t j = 0; j < padded; ++j) {
            const Angles angles(canonical(count == 0 ? Direction{} : directions[std::min(j, count - 1)]));
            for (std::size_t i = 0; i < geometry_columns().size(); ++i)
                columns[i * padded + j] = geometry_columns()[i].read(angles, precision);
        }
        const auto pad = [&](std::span<const double> values) {
            std::vector<double> result(values.begin(), values.end());
            result.resize(padded, 0.0);
            return result;
        };
        upload(columns_buffer, columns);
        upload(y_buffer, pad(y));
        upload(w_buffer, pad(w));
    }

    [[nodiscard]] std::size_t scalar_size() const {
        return precision == Precision::double_precision ? sizeof(double) : sizeof(float);
    }

    /// Makes the buffer at least that many scalars large.
    void reserve(cl::Buffer& buffer, std::size_t scalars) const {
        const std::size_t bytes = std::max<std::size_t>(scalars, 1) * scalar_size();
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

    [[nodiscard]] std::size_t out_stride() const { return 1 + 2 * model.terms.size() + model.parameters.size(); }

    /// Candidates that fit into one launch's scratch.
    [[nodiscard]] std::size_t launch_limit() const {
        const std::size_t bytes = padded * model.term_values() * scalar_size();
        return std::max<std::size_t>(1, kScratchBytes / std::max<std::size_t>(bytes, 1));
    }

    /// On a CPU one work-item takes everything: it runs in this thread, other threads run other launches. And PoCL 3.1
    /// keeps a loaded kernel for each width of grid but looks only at the kernel when it lets go of one: two widths in
    /// two threads end the process ("found->ref_count > 0").
    void launch(const cl::Kernel& kernel, std::size_t items) {
        const std::size_t width = shared.info.type == "cpu" ? 1 : items;
        queue.enqueueNDRangeKernel(kernel, cl::NullRange, cl::NDRange(width), cl::NDRange(1));
    }

    void read_batch(std::size_t first, std::size_t candidates, Batch& out) {
        const std::size_t t = model.terms.size();
        const std::size_t p = model.parameters.size();
        rows.resize(candidates * out_stride());
        download(out_buffer, rows);
        for (std::size_t i = 0; i < candidates; ++i) {
            const double* row = rows.data() + i * out_stride();
            const std::size_t to = first + i;
            out.loss[to] = row[0];
            std::copy_n(row + 1, t, out.coefficients.begin() + static_cast<std::ptrdiff_t>(to * t));
            std::copy_n(row + 1 + t, t, out.by_coefficient.begin() + static_cast<std::ptrdiff_t>(to * t));
            std::copy_n(row + 1 + 2 * t, p, out.by_parameter.begin() + static_cast<std::ptrdiff_t>(to * p));
        }
    }

    void resize(std::size_t candidates, Batch& out) const {
        out.loss.resize(candidates);
        out.coefficients.resize(candidates * model.terms.size());
        out.by_coefficient.resize(candidates * model.terms.size());
        out.by_parameter.resize(candidates * model.parameters.size());
    }

    Engine::Impl& shared;
    const Model& model;
    Precision precision;
    unsigned lanes;
    std::size_t count;
    std::size_t padded;
    cl::CommandQueue queue;
    cl::Kernel project, project_value, loss, terms;
    cl::Buffer columns_buffer, y_buffer, w_buffer;
    cl::Buffer parameters_buffer, lower_buffer, upper_buffer, scratch_buffer, out_buffer;
    std::vector<float> single;  // staging for conversions
    std::vector<double> rows;
};

Evaluator::Evaluator(Engine& engine, const Model& model, Precision precision, std::span<const Direction> directions,
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
    const std::size_t p = m.model.parameters.size();
    const std::size_t t = m.model.terms.size();
    const std::size_t candidates = parameters.size() / p;
    m.resize(candidates, out);
    cl::Kernel& kernel = gradient ? m.project : m.project_value;
    for (std::size_t first = 0; first < candidates; first += m.launch_limit()) {
        const std::size_t n = std::min(m.launch_limit(), candidates - first);
        m.upload(m.parameters_buffer, parameters.subspan(first * p, n * p));
        m.upload(m.lower_buffer, lower.subspan(first * t, n * t));
        m.upload(m.upper_buffer, upper.subspan(first * t, n * t));
        m.reserve(m.scratch_buffer, n * m.padded * (gradient ? m.model.term_values() : t));
        m.reserve(m.out_buffer, n * m.out_stride());
        cl_uint arg = 0;
        for (const cl::Buffer* buffer : {&m.columns_buffer, &m.y_buffer, &m.w_buffer}) kernel.setArg(arg++, *buffer);
        kernel.setArg(arg++, static_cast<cl_int>(m.padded));
        kernel.setArg(arg++, static_cast<cl_int>(n));
        for (const cl::Buffer* buffer :
             {&m.parameters_buffer, &m.lower_buffer, &m.upper_buffer, &m.scratch_buffer, &m.out_buffer})
            kernel.setArg(arg++, *buffer);
        m.launch(kernel, n);
        m.read_batch(first, n, out);
    }
} catch (const cl::Error& error) {
    throw device_error(error);
}

void Evaluator::loss(std::span<const double> parameters, std::span<const double> coefficients, bool logarithmic,
                     Batch& out) try {
    Impl& m = *impl_;
    const std::size_t candidates = parameters.size() / m.model.parameters.size();
    m.resize(candidates, out);
    m.upload(m.parameters_buffer, parameters);
    m.upload(m.lower_buffer, coefficients);
    m.reserve(m.out_buffer, candidates * m.out_stride());
    cl_uint arg = 0;
    for (const cl::Buffer* buffer : {&m.columns_buffer, &m.y_buffer, &m.w_buffer}) m.loss.setArg(arg++, *buffer);
    m.loss.setArg(arg++, static_cast<cl_int>(m.padded));
    m.loss.setArg(arg++, static_cast<cl_int>(candidates));
    m.loss.setArg(arg++, m.parameters_buffer);
    m.loss.setArg(arg++, m.lower_buffer);
    m.loss.setArg(arg++, static_cast<cl_int>(logarithmic));
    m.loss.setArg(arg++, m.out_buffer);
    m.launch(m.loss, candidates);
    m.read_batch(0, candidates, out);
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
        m.upload(m.parameters_buffer, parameters.subspan(first * p, n * p));
        m.reserve(m.scratch_buffer, n * values * m.padded);
        cl_uint arg = 0;
        m.terms.setArg(arg++, m.columns_buffer);
        m.terms.setArg(arg++, static_cast<cl_int>(m.padded));
        m.terms.setArg(arg++, static_cast<cl_int>(n));
        m.terms.setArg(arg++, m.parameters_buffer);
        m.terms.setArg(arg++, m.scratch_buffer);
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
                std::span<const Direction> directions, bool gradient) {
    Values values;
    if (directions.empty()) return values;
    Evaluator evaluator(engine, model, precision, directions, {}, {});
    const std::vector<double> rows = evaluator.terms(parameters);
    const std::vector<double> c = model.coefficients(parameters);
    const std::size_t n = directions.size();
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
