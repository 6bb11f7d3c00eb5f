// Times evaluations apart from kernels/cost.cpp, with a kernel, geometry, directions and clock of its own, and
// compares. Prints a line for each model and precision; exits with 1 where they differ by more than 20 % and 0.1 ns.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <string>
#include <vector>

#include "kernels/cost.h"
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
        for (int t = 0; t < TERMS; ++t) sum += c[t] * ((const real *)&terms)[term_value[t]];
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

/// Nanoseconds of an evaluation: of each set of parameters the least of 9 launches, the mean over the sets.
template <class Scalar>
double check_ns(const kernels::Model& model, kernels::Precision precision, unsigned lanes) {
    const cl::Device device = cl::Device::getDefault();
    const cl::Context context(device);
    const cl::CommandQueue queue(context, device);
    const cl::Program program(context, kernels::hemisphere_text(model, precision, lanes) + kKernel);
    program.build({device}, precision == kernels::Precision::double_precision
                                ? "-cl-std=CL1.2"
                                : "-cl-std=CL1.2 -cl-single-precision-constant -cl-fp32-correctly-rounded-divide-sqrt");
    cl::Kernel kernel(program, "check");
    const std::vector<kernels::Direction> directions = tests::scan_directions({15, 30, 45, 60, 75}, 2);
    const std::size_t n = directions.size() / lanes * lanes;
    std::vector<double> u(2 * n), v(3 * n);
    for (std::size_t i = 0; i < n; ++i) {
        const double in = directions[i].theta_i_deg * M_PI / 180, out = directions[i].theta_r_deg * M_PI / 180;
        u[i] = -std::sin(in);
        u[n + i] = std::cos(in);
        v[i] = std::sin(out);
        v[2 * n + i] = std::cos(out);
    }
    const auto u_buffer = buffer<Scalar>(context, u), v_buffer = buffer<Scalar>(context, v);
    const cl::Buffer out(context, CL_MEM_READ_WRITE, sizeof(Scalar));
    constexpr std::size_t kSets = 256;
    const cl_int kRounds = 32;  // so that the launch is little of it
    const std::size_t count = model.parameters.size();
    const std::vector<double> all = kernels::typical_candidates(model, kSets, 99);
    double sum = 0;
    for (std::size_t i = 0; i < kSets; ++i) {
        const auto begin = all.begin() + static_cast<std::ptrdiff_t>(i * count);
        const std::vector<double> p(begin, begin + static_cast<std::ptrdiff_t>(count));
        kernel.setArg(0, u_buffer);
        kernel.setArg(1, v_buffer);
        kernel.setArg(2, static_cast<cl_int>(n));
        const auto p_buffer = buffer<Scalar>(context, p), c_buffer = buffer<Scalar>(context, model.coefficients(p));
        kernel.setArg(3, p_buffer);
        kernel.setArg(4, c_buffer);
        kernel.setArg(5, out);
        kernel.setArg(6, kRounds);
        double least = HUGE_VAL;
        for (int k = 0; k < 9; ++k) {
            const double start = processor_s();
            queue.enqueueNDRangeKernel(kernel, cl::NullRange, cl::NDRange(1), cl::NDRange(1));
            queue.finish();
            least = std::min(least, (processor_s() - start) / kRounds);
        }
        sum += least;
    }
    return 1e9 * sum / static_cast<double>(kSets * n);
}

}  // namespace

int main() {
    kernels::Engine& engine = tests::engine();  // chooses the device before anything else asks for one
    kernels::CostBook book(engine);
    bool agree = true;
    for (const kernels::Model* model : tests::variants()) {
        const kernels::Cost cost = book.cost(*model);
        for (const bool is_double : {true, false}) {
            const auto precision =
                is_double ? kernels::Precision::double_precision : kernels::Precision::single_precision;
            const double reported = (is_double ? cost.double_ns : cost.single_ns).value_or(0);
            const double checked = is_double ? check_ns<double>(*model, precision, engine.lanes(precision))
                                             : check_ns<float>(*model, precision, engine.lanes(precision));
            std::printf("%-12s %-6s %8.3f ns, checked %8.3f ns, ratio %.3f\n", tests::label(*model).c_str(),
                        is_double ? "double" : "single", reported, checked, reported / checked);
            const bool close = std::abs(reported - checked) < 0.1;  // nearly nothing to do: Lambert's product
            agree = agree && (close || (reported / checked < 1.2 && checked / reported < 1.2));
        }
    }
    return agree ? 0 : 1;
}
