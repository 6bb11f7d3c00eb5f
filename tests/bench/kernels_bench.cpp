// The kernels in OpenCL and the same text as C++, side by side: two threads, 500 samples, a batch split between them.
// An iteration runs both, without and with gradient, one after the other; what counts are medians of its ratios.
// Times are the threads' own processor time, which what else runs on the machine does not touch.

#include <benchmark/benchmark.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <span>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <vector>

#include "kernels/evaluator.h"
#include "kernels/throughput.h"
#include "tests/numerics/host_kernel.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Model;
using kernels::Precision;

constexpr double kMostOverCpp = 1.1;
constexpr double kMostOverValue = 1.35;
constexpr std::size_t kThreads = 2;

/// Numbers of a kernel's precision, aligned as OpenCL's are.
class Buffer {
public:
    Buffer(Precision precision, std::span<const double> values) {
        reserve(values.size());
        for (std::size_t i = 0; i < values.size(); ++i) {
            if (precision == Precision::double_precision) static_cast<double*>(data())[i] = values[i];
            else static_cast<float*>(data())[i] = static_cast<float>(values[i]);
        }
    }
    explicit Buffer(std::size_t count) { reserve(count); }
    [[nodiscard]] void* data() { return lines_.data(); }

private:
    struct alignas(128) Line {
        std::array<std::byte, 128> bytes;
    };
    void reserve(std::size_t count) { lines_.resize(count * sizeof(double) / sizeof(Line) + 1); }
    std::vector<Line> lines_;
};

/// A thread's share of a batch.
struct Inputs {
    Inputs(const Model& model, std::size_t candidates, std::uint64_t seed)
        : directions(kernels::goniometer_scan(kernels::kLaunchSamples)),
          weights(directions.size(), 1.0),
          parameters(kernels::typical_candidates(model, candidates, seed)),
          lower(candidates * model.terms.size(), 0.0),
          upper(candidates * model.terms.size(), 1e6) {
        for (const kernels::Direction& d : directions)
            measured.push_back(0.1 +
                               std::exp(-0.01 * (d.theta_i_deg - d.theta_r_deg) * (d.theta_i_deg - d.theta_r_deg)));
    }
    std::vector<kernels::Direction> directions;
    std::vector<double> measured, weights, parameters, lower, upper;
};

/// The kernel as C++ behind Evaluator's call: candidates in, a Batch out. Its buffers are ready.
class Twin {
public:
    Twin(const HostKernel& kernel, const Model& model, const Inputs& in)
        : kernel_(kernel),
          parameters_(model.parameters.size()),
          terms_(model.terms.size()),
          normals_(normals(model)),
          candidates_(in.parameters.size() / parameters_),
          padded_((in.directions.size() + 15) / 16 * 16),
          columns_(kernel.precision, columns_of(in.directions)),
          measured_(kernel.precision, padded(in.measured)),
          weights_(kernel.precision, padded(in.weights)),
          in_(candidates_ * (parameters_ + 2 * terms_)),
          scratch_(padded_ * model.term_values()),
          out_(candidates_ * (1 + 2 * terms_ + parameters_ + normals_)) {}

    void project(const Inputs& in, bool gradient, kernels::Batch& out) {
        if (kernel_.precision == Precision::double_precision) project<double>(in, gradient, out);
        else project<float>(in, gradient, out);
    }

private:
    static std::size_t normals(const Model& model) {
        const std::size_t unknowns = model.terms.size() + model.nonlinear().size();
        return unknowns * (unknowns + 1) / 2;
    }
    template <class Scalar>
    void project(const Inputs& in, bool gradient, kernels::Batch& out) {
        const auto copy = [](std::size_t count, const auto*& from, auto*& to) {
            for (std::size_t i = 0; i < count; ++i)
                to[i] = static_cast<std::remove_reference_t<decltype(*to)>>(from[i]);
            from += count;
            to += count;
        };
        const double* parameters = in.parameters.data();
        const double* lower = in.lower.data();
        const double* upper = in.upper.data();
        auto* row = static_cast<Scalar*>(in_.data());
        for (std::size_t i = 0; i < candidates_; ++i) {
            copy(parameters_, parameters, row);
            copy(terms_, lower, row);
            copy(terms_, upper, row);
        }
        kernel_.project_in_place(gradient, columns_.data(), measured_.data(), weights_.data(),
                                 static_cast<int>(padded_), static_cast<int>(candidates_), in_.data(), scratch_.data(),
                                 out_.data());
        out.loss.resize(candidates_);
        out.coefficients.resize(candidates_ * terms_);
        out.by_coefficient.resize(gradient ? candidates_ * terms_ : 0);
        out.by_parameter.resize(gradient ? candidates_ * parameters_ : 0);
        out.normal.resize(gradient ? candidates_ * normals_ : 0);
        const auto* result = static_cast<const Scalar*>(out_.data());
        double* loss = out.loss.data();
        double* coefficients = out.coefficients.data();
        double* by_coefficient = out.by_coefficient.data();
        double* by_parameter = out.by_parameter.data();
        double* normal = out.normal.data();
        for (std::size_t i = 0; i < candidates_; ++i) {
            copy(1, result, loss);
            copy(terms_, result, coefficients);
            if (!gradient) {
                result += terms_ + parameters_ + normals_;
                continue;
            }
            copy(terms_, result, by_coefficient);
            copy(parameters_, result, by_parameter);
            copy(normals_, result, normal);
        }
    }
    [[nodiscard]] std::vector<double> padded(std::vector<double> values) const {
        values.resize(padded_, 0.0);
        return values;
    }
    [[nodiscard]] std::vector<double> columns_of(const std::vector<kernels::Direction>& directions) const {
        std::vector<double> columns;
        for (const kernels::GeometryColumn& column : kernels::geometry_columns())
            for (std::size_t j = 0; j < padded_; ++j)
                columns.push_back(column.read(
                    kernels::Angles(canonical(directions[std::min(j, directions.size() - 1)])), kernel_.precision));
        return columns;
    }
    const HostKernel& kernel_;
    std::size_t parameters_, terms_, normals_, candidates_, padded_;
    Buffer columns_, measured_, weights_, in_, scratch_, out_;
};

/// Processor time of a call [s].
template <class Work>
double seconds_of(std::size_t times, Work work) {
    const auto now = [] {
        timespec t{};
        clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
        return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
    };
    const double start = now();
    for (std::size_t i = 0; i < times; ++i) work();
    return (now() - start) / static_cast<double>(times);
}

double median(std::vector<double> values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

/// Counters: nanoseconds an evaluation takes a core, the ratios to C++, and that of value and gradient to value.
void compare(benchmark::State& state, const Model& model, const HostKernel& host) {
    const auto batch = static_cast<std::size_t>(state.range(0));
    const std::size_t candidates = (batch + kThreads - 1) / kThreads;  // of a batch of one, each thread has one
    const std::size_t times = std::max<std::size_t>(256 / candidates, 1);
    const Inputs in(model, candidates, 1 + static_cast<std::uint64_t>(state.thread_index()));
    kernels::Evaluator evaluator(engine(), model, host.precision, in.directions, in.measured, in.weights);
    Twin twin(host, model, in);
    kernels::Batch out, twin_out;
    const auto opencl = [&](bool gradient) {
        return seconds_of(times, [&] { evaluator.project(in.parameters, in.lower, in.upper, gradient, out); });
    };
    const auto cpp = [&](bool gradient) { return seconds_of(times, [&] { twin.project(in, gradient, twin_out); }); };
    opencl(false);  // a kernel's first launch is slow
    opencl(true);
    cpp(true);
    const double allowed = host.precision == Precision::double_precision ? 1e-9 : 1e-3;
    for (std::size_t i = 0; i < candidates; ++i)
        if (!(std::abs(twin_out.loss[i] - out.loss[i]) <= allowed * out.loss[i]))
            throw std::runtime_error(label(model) + ": C++ and OpenCL do not do the same work");

    std::vector<double> value, gradient, value_ratio, gradient_ratio, gradient_over_value;
    for ([[maybe_unused]] auto unused : state) {
        const std::array<double, 4> t{opencl(false), cpp(false), opencl(true), cpp(true)};
        value.push_back(t[0]);
        gradient.push_back(t[2]);
        value_ratio.push_back(t[0] / t[1]);
        gradient_ratio.push_back(t[2] / t[3]);
        gradient_over_value.push_back(t[2] / t[0]);
    }
    const auto count = [&](const char* name, double counted) {
        state.counters[name] = benchmark::Counter(counted, benchmark::Counter::kAvgThreads);
    };
    const double evaluations = static_cast<double>(candidates * in.directions.size());
    count("value_ns", 1e9 * median(value) / evaluations);
    count("gradient_ns", 1e9 * median(gradient) / evaluations);
    count("value_ratio", median(value_ratio));
    count("gradient_ratio", median(gradient_ratio));
    count("gradient_over_value", median(gradient_over_value));
}

/// Google's table, and a list of what is above its bar for batches of 256 and more.
class Reporter : public benchmark::ConsoleReporter {
public:
    Reporter() : ConsoleReporter(OO_Tabular) {}
    void ReportRuns(const std::vector<Run>& runs) override {
        ConsoleReporter::ReportRuns(runs);
        for (const Run& run : runs) {
            if (std::stoul(run.run_name.args) < 256) continue;
            check(run, "value_ratio", kMostOverCpp);
            check(run, "gradient_ratio", kMostOverCpp);
            check(run, "gradient_over_value", kMostOverValue);
        }
    }
    void Finalize() override {
        std::printf("%zu of %zu ratios are above their bars (%g to C++, %g of gradient to value)\n", above_.size(),
                    checked_, kMostOverCpp, kMostOverValue);
        for (const std::string& line : above_) std::puts(line.c_str());
    }

private:
    void check(const Run& run, const char* name, double most) {
        const double ratio = run.counters.at(name);
        ++checked_;
        if (!(ratio <= most))
            above_.push_back("  " + run.run_name.function_name + "/" + run.run_name.args + " " + name + " " +
                             std::to_string(ratio));
    }
    std::size_t checked_ = 0;
    std::vector<std::string> above_;
};

}  // namespace
}  // namespace brdfit::tests

int main(int argc, char** argv) {
    using namespace brdfit::tests;
    benchmark::Initialize(&argc, argv);
    if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 1;
    engine();  // before there are threads
    for (const auto& [precision, kernels] :
         {std::pair("double", host_kernels_double()), {"single", host_kernels_single()}})
        for (const HostKernel& kernel : kernels)
            benchmark::RegisterBenchmark((std::string(kernel.label) + "/" + precision).c_str(), compare,
                                         std::cref(variant(std::string(kernel.label))), std::cref(kernel))
                ->Arg(1)
                ->Arg(16)
                ->Arg(256)
                ->Arg(1024)
                ->Threads(kThreads)
                ->UseRealTime()
                ->Unit(benchmark::kMicrosecond);
    Reporter reporter;
    benchmark::RunSpecifiedBenchmarks(&reporter);
    return 0;
}
