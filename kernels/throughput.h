/// How fast a device evaluates models; and the directions and candidates that every benchmark uses.
#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "kernels/cost.h"
#include "kernels/engine.h"
#include "kernels/geometry.h"
#include "kernels/model.h"

namespace brdfit::kernels {

/// A goniometer's directions: incidence at 15, 30, 45, 60 and 75 degrees, exitance evenly from -80 to 80, up to 100
/// angles each. 500 lie in the plane of incidence, further 500s in planes at other azimuths below 90 degrees. As many
/// as asked for, less what is no multiple of 5 (of 500 beyond 500).
std::vector<Direction> goniometer_scan(std::size_t samples);

/// Random parameters from the model's typical ranges, on the parameters' scales: candidates x parameters.
std::vector<double> typical_candidates(const Model& model, std::size_t candidates, std::uint64_t seed);

/// Candidates to a launch, as measure_throughput tries them.
inline constexpr std::size_t kLaunches[] = {1, 16, 256, 1024, 4096};
inline constexpr std::size_t kLaunchSamples = 500;

/// One model, with its number of lobes.
struct ModelRate {
    std::string model;
    std::size_t lobes = 0;  ///< 0 for a model without lobes
    std::vector<double>
        evaluations_per_s;  ///< of kLaunches: a candidate at a sample, with gradient, transfers included
    double exps = 0;        ///< exponentials that take as long as an evaluation in the fastest launch
    MeasuredCost cost{};    ///< measured anew; what kernels::Cost says of it
};

struct Throughput {
    Precision precision{};
    double exps_per_s = 0;  ///< of a kernel that does nothing else
    std::vector<ModelRate> models;
};

/// Measures every variant of the families in every precision that may be used; on a CPU on one core, in its processor
/// time. Of the repetitions in so much time for each figure, and three at least, the fastest counts. Throws BuildError,
/// DeviceError.
std::vector<Throughput> measure_throughput(Engine& engine, std::span<const Family> families,
                                           std::chrono::duration<double> each);

}  // namespace brdfit::kernels
