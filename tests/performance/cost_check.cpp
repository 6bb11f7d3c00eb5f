// Times evaluations apart from kernels/cost.cpp, with a kernel, geometry, directions, parameters and clock of its own,
// in turns with it, so that other work on this machine slows both. Prints a line for each text and precision; exits
// with 1 where the two differ by more than 20 % and 0.1 ns, or where a figure in the cache folder does that was not
// measured under load, and with 77 where other work disturbs too much to tell.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <string>
#include <vector>

#include "kernels/cost.h"
#include "kernels/load.h"
#include "kernels/opencl.h"
#include "kernels/throughput.h"
#include "tests/support.h"

namespace {

using namespace brdfit;

/// A direction pair a lane, a launch for each set of parameters.
constexpr const char* kKernel = R"(
kernel void check(global const scalar *u, global const scalar *v, int n, global const scalar *parameters,
                  global const scalar *c, global scalar *out, int rounds) {
    const Params p = broadcast_parameters(parameters);
    real sum = 0.0;
    for (int round = 0; round < rounds; ++round)
    for (int i = 0; i < n; i += LANES) {
        const real ux = load_lanes(u + i), uz = load_lanes(u + n + i);
        const real vx = load_lanes(v + i), vy = load_lanes(v + n + i), vz = load_lanes(v + 2 * n + i);
        Geometry g;
        g.ci = uz;
        g.cr = vz;
        g.cs = uz + vz;
        g.ti = -ux / uz;
        g.tr = sqrt(vx * vx + vy * vy) / vz;
        g.w = (ux + vx) * (ux + vx) + vy * vy;
        const real cosine = uz * vz - ux * vx;
        g.log_cos_alpha = sel(cosine > TINY, log_plain(fmax(cosine, (real)TINY)), -1e30);
        g.tan2 = g.w / (g.cs * g.cs);
        const real product = ux * vx + uz * vz;
        g.cd2 = 0.5 + 0.5 * product;
        g.sd2 = 0.5 - 0.5 * product;
        g.G = 16.0 * g.cd2 * g.cd2 / (g.cs * g.cs);
        g.hxy = ux * vx;
        g.hxy_low = 0.0;
        g.hz = uz * vz;
        g.hz_low = 0.0;
        Terms terms;
        brdf(p, g, &terms);
        UNROLLED for (int t = 0; t < TERMS; ++t) sum += c[t] * ((const real *)&terms)[term_value[t]];
    }
    out[0] = sum_lanes(sum);
}
)";

template <class Scalar>
cl::Buffer buffer(const cl::Context& context, const std::vector<double>& values) {
    std::vector<Scalar> copy(values.begin(), values.end());
    return {context, CL_MEM_READ_ONLY | CL_MEM_COPY_HOST_PTR, copy.size() * sizeof(Scalar), copy.data()};
}

double processor_s() {
    timespec time{};
    ::clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

/// Nanoseconds of an evaluation: of each set of parameters the shortest launch, the mean over the sets.
template <class Scalar>
class Check {
public:
    Check(const kernels::Model& model, kernels::Precision precision, unsigned lanes)
        : context_(cl::Device::getDefault()), queue_(context_, cl::Device::getDefault()) {
        const cl::Program program(context_, kernels::hemisphere_text(model, precision, lanes) + kKernel);
        program.build({cl::Device::getDefault()},
                      precision == kernels::Precision::double_precision
                          ? "-cl-std=CL1.2"
                          : "-cl-std=CL1.2 -cl-single-precision-constant -cl-fp32-correctly-rounded-divide-sqrt");
        kernel_ = cl::Kernel(program, "check");
        const std::vector<kernels::Direction> directions = tests::scan_directions({15, 30, 45, 60, 75}, 2);
        n_ = directions.size() / lanes * lanes;
        std::vector<double> u(2 * n_), v(3 * n_);
        for (std::size_t i = 0; i < n_; ++i) {
            const double in = directions[i].theta_i_deg * M_PI / 180, out = directions[i].theta_r_deg * M_PI / 180;
            u[i] = -std::sin(in);
            u[n_ + i] = std::cos(in);
            v[i] = std::sin(out);
            v[2 * n_ + i] = std::cos(out);
        }
        u_ = buffer<Scalar>(context_, u);
        v_ = buffer<Scalar>(context_, v);
        out_ = cl::Buffer(context_, CL_MEM_READ_WRITE, sizeof(Scalar));
        const std::size_t count = model.parameters.size();
        const std::vector<double> all = kernels::typical_candidates(model, kSets, 99);
        for (std::size_t i = 0; i < kSets; ++i) {
            const auto begin = all.begin() + static_cast<std::ptrdiff_t>(i * count);
            const std::vector<double> p(begin, begin + static_cast<std::ptrdiff_t>(count));
            sets_.push_back({buffer<Scalar>(context_, p), buffer<Scalar>(context_, model.coefficients(p)), HUGE_VAL});
        }
        kernel_.setArg(0, u_);
        kernel_.setArg(1, v_);
        kernel_.setArg(2, static_cast<cl_int>(n_));
        kernel_.setArg(5, out_);
        kernel_.setArg(6, cl_int{1});
        (void)launch_s(sets_.front());  // the first one compiles
        // So that the launch itself is little of it.
        for (rounds_ = 1; rounds_ < 4096; rounds_ *= 2) {
            kernel_.setArg(6, rounds_);
            if (launch_s(sets_.front()) > 1e-4) break;
        }
        kernel_.setArg(6, rounds_);
    }

    void repeat() {
        for (Set& set : sets_) set.shortest_s = std::min(set.shortest_s, launch_s(set) / rounds_);
    }
    [[nodiscard]] double ns() const {
        double sum = 0;
        for (const Set& set : sets_) sum += set.shortest_s;
        return 1e9 * sum / static_cast<double>(kSets * n_);
    }

private:
    static constexpr std::size_t kSets = 256;
    struct Set {
        cl::Buffer parameters, coefficients;
        double shortest_s;
    };

    double launch_s(const Set& set) {
        kernel_.setArg(3, set.parameters);
        kernel_.setArg(4, set.coefficients);
        const double start = processor_s();
        queue_.enqueueNDRangeKernel(kernel_, cl::NullRange, cl::NDRange(1), cl::NDRange(1));
        queue_.finish();
        return processor_s() - start;
    }

    cl::Context context_;
    cl::CommandQueue queue_;
    cl::Kernel kernel_;
    cl::Buffer u_, v_, out_;
    std::vector<Set> sets_;
    std::size_t n_ = 0;
    cl_int rounds_ = 1;
};

bool agree(double a, double b) {
    return std::abs(a - b) < 0.1 /* nearly nothing to do: Lambert's product */ || std::max(a, b) < 1.2 * std::min(a, b);
}

enum class Verdict { agrees, differs, cannot_tell };

template <class Scalar>
Verdict compare(kernels::Engine& engine, const kernels::Model& model, kernels::Precision precision, bool has_folder) {
    constexpr int kFew = 8;
    constexpr int kMany = 80;  // where they differ and it may be other work's fault
    constexpr double kIdle = 0.1;
    kernels::CostMeter meter(engine, model, precision);
    Check<Scalar> check(model, precision, engine.lanes(precision));
    meter.repeat();
    check.repeat();
    const kernels::LoadWatch watch(engine.device());
    for (int i = 0; i < kMany && (i < kFew || (!agree(meter.ns(), check.ns()) && watch.others() > kIdle)); ++i) {
        meter.repeat();
        check.repeat();
    }
    const bool loaded = watch.others() > kIdle;
    std::printf("%-32s %-6s %8.3f ns, checked %8.3f ns, ratio %.3f", tests::label(model).c_str(),
                precision == kernels::Precision::double_precision ? "double" : "single", meter.ns(), check.ns(),
                meter.ns() / check.ns());
    bool good = agree(meter.ns(), check.ns());
    if (has_folder) {
        const kernels::Cost cost = kernels::CostBook(engine).cost(model);
        const double kept =
            (precision == kernels::Precision::double_precision ? cost.double_ns : cost.single_ns).value_or(0);
        std::printf(", kept %8.3f ns%s", kept, cost.under_load ? " under load" : "");
        good = good && (cost.under_load || agree(kept, check.ns()));
    }
    std::puts(loaded ? ", beside other work" : "");
    return good ? Verdict::agrees : loaded ? Verdict::cannot_tell : Verdict::differs;
}

}  // namespace

/// Argument: a cache folder, whose figures are checked as well.
int main(int count, char** arguments) {
    kernels::EngineOptions options;
    if (count > 1) options.cache = arguments[1];
    kernels::Engine engine(options);  // chooses the device before anything else asks for one
    bool differs = false, unknown = false;
    for (const kernels::Model* model : tests::variants())
        for (const bool is_double : {true, false}) {
            const Verdict verdict =
                is_double ? compare<double>(engine, *model, kernels::Precision::double_precision, count > 1)
                          : compare<float>(engine, *model, kernels::Precision::single_precision, count > 1);
            differs = differs || verdict == Verdict::differs;
            unknown = unknown || verdict == Verdict::cannot_tell;
        }
    if (differs) return 1;
    if (unknown) std::puts("other work disturbs too much: no verdict");
    return unknown ? 77 : 0;
}
