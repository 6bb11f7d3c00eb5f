#include "kernels/throughput.h"

#include <algorithm>
#include <cmath>
#include <random>

#include "kernels/embedded.h"
#include "kernels/engine_impl.h"
#include "kernels/evaluator.h"
#include "kernels/stopwatch.h"

namespace brdfit::kernels {
namespace {

/// Several chains a work-item, so that none waits for its own last result.
constexpr const char* kExpsText = R"(
#define CHAINS 8
kernel void exps(int rounds, global scalar *out) {
    real x[CHAINS];
    for (int i = 0; i < CHAINS; ++i) x[i] = (real)((scalar)i / CHAINS + (scalar)get_global_id(0));
    for (int round = 0; round < rounds; ++round) {
#pragma unroll
        for (int i = 0; i < CHAINS; ++i) x[i] = exp(-x[i]);
    }
    real sum = 0.0;
    for (int i = 0; i < CHAINS; ++i) sum += x[i];
    out[get_global_id(0)] = sum_lanes(sum);
}
)";
constexpr double kChains = 8;

double exps_per_s(Engine::Impl& shared, Precision precision, std::chrono::duration<double> each) try {
    const unsigned lanes = shared.lanes(precision);
    cl::Program program(shared.context,
                        "#define REAL_IS_DOUBLE " + std::to_string(precision == Precision::double_precision) +
                            "\n#define LANES " + std::to_string(lanes) + "\n" + std::string(kPreludeText) + kExpsText);
    program.build({shared.device}, ("-cl-std=CL1.2 " + shared.options.build_options).c_str());
    cl::Kernel kernel(program, "exps");
    const std::size_t items = shared.info.type == "cpu" ? 1 : shared.info.compute_units * std::size_t{2048};
    const int rounds = 16384;
    const cl::CommandQueue queue(shared.context, shared.device);
    const cl::Buffer out(shared.context, CL_MEM_READ_WRITE, items * sizeof(double));
    kernel.setArg(0, rounds);
    kernel.setArg(1, out);
    const double seconds = shortest_s(shared.info, each, [&] {
        queue.enqueueNDRangeKernel(kernel, cl::NullRange, cl::NDRange(items), cl::NullRange);
        queue.finish();
    });
    return static_cast<double>(items) * lanes * kChains * rounds / seconds;
} catch (const cl::BuildError& error) {
    throw BuildError("a kernel of exponentials does not build for " + shared.info.name);
} catch (const cl::Error& error) {
    throw device_error(error);
}

ModelRate rate_of(Engine& engine, const Model& model, Precision precision, std::chrono::duration<double> each) {
    const std::vector<Direction> directions = goniometer_scan(kLaunchSamples);
    const std::vector<double> ones(directions.size(), 1.0);
    Evaluator evaluator(engine, model, precision, directions, ones, ones);
    ModelRate rate{model.name, model.repeats, {}, 0};
    const std::size_t p = model.parameters.size();
    const std::size_t t = model.terms.size();
    for (const std::size_t launch : kLaunches) {
        // Small launches go through many candidates too, as their costs differ.
        const std::size_t candidates = std::max<std::size_t>(launch, 1024);
        const std::vector<double> parameters = typical_candidates(model, candidates, 1);
        const std::vector<double> lower(launch * t, 0.0);
        const std::vector<double> upper(launch * t, 1e6);
        Batch batch;
        const double seconds = shortest_s(engine.device(), each, [&] {
            for (std::size_t first = 0; first < candidates; first += launch)
                evaluator.project(std::span(parameters).subspan(first * p, launch * p), lower, upper, true, batch);
        });
        rate.evaluations_per_s.push_back(static_cast<double>(candidates * directions.size()) / seconds);
    }
    return rate;
}

}  // namespace

std::vector<Direction> goniometer_scan(std::size_t samples) {
    const std::size_t planes = std::max<std::size_t>(samples / 500, 1);
    const std::size_t angles = std::min<std::size_t>(samples / 5, 100);
    std::vector<Direction> directions;
    for (std::size_t plane = 0; plane < planes; ++plane)
        for (const double theta_i : {15.0, 30.0, 45.0, 60.0, 75.0})
            for (std::size_t i = 0; i < angles; ++i)
                directions.push_back({theta_i, -80 + 160 * (static_cast<double>(i) + 0.5) / static_cast<double>(angles),
                                      90 * static_cast<double>(plane) / static_cast<double>(planes)});
    return directions;
}

std::vector<double> typical_candidates(const Model& model, std::size_t candidates, std::uint64_t seed) {
    std::mt19937_64 generator(seed);
    std::vector<double> values;
    for (std::size_t i = 0; i < candidates; ++i)
        for (const Parameter& p : model.parameters) {
            const double u = std::uniform_real_distribution<double>(0, 1)(generator);
            values.push_back(p.scale == Scale::linear ? p.typical_min + u * (p.typical_max - p.typical_min)
                                                      : p.typical_min * std::pow(p.typical_max / p.typical_min, u));
        }
    return values;
}

std::vector<Throughput> measure_throughput(Engine& engine, std::span<const Family> families,
                                           std::chrono::duration<double> each) {
    std::vector<Throughput> result;
    for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
        if (!engine.supports(precision)) continue;
        Throughput& throughput =
            result.emplace_back(Throughput{precision, exps_per_s(engine.impl(), precision, each), {}});
        for (const Family& family : families)
            for (const Model& model : family.variants) {
                ModelRate rate = rate_of(engine, model, precision, each);
                CostMeter meter(engine, model, precision);
                rate.cost = measure(engine, {&meter, 1}).front();
                rate.exps = throughput.exps_per_s /
                            *std::max_element(rate.evaluations_per_s.begin(), rate.evaluations_per_s.end());
                throughput.models.push_back(std::move(rate));
            }
    }
    return result;
}

}  // namespace brdfit::kernels
