/// The number of SIMD lanes that is fastest on a device, measured once on request and kept beside its builds.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "kernels/engine.h"
#include "kernels/precision.h"

namespace brdfit::kernels {

/// Numbers of lanes that a kernel text can have.
inline constexpr unsigned kLanes[] = {1, 2, 4, 8, 16};

struct LanesTiming {
    unsigned lanes = 1;
    double time_us = 0;  ///< of a candidate of the models measured, geometric mean; the least of many repetitions
};

/// The native number, unless another is faster by a factor of more than kClearly: a choice decides the last digits of
/// results, so noise must not make it.
inline constexpr double kClearly = 1.15;
unsigned choose_lanes(unsigned native, std::span<const LanesTiming> timings);

struct Tuning {
    Precision precision{};
    unsigned native = 1;
    unsigned chosen = 1;
    std::vector<LanesTiming> timings;
    bool kept = false;  ///< for the engines made from now on with these options
};

/// Measures each precision that a CPU has, which takes seconds, and keeps the choice in the cache. Nothing for another
/// device: a work-item of a GPU is one lane. Throws DeviceError, BuildError.
std::vector<Tuning> tune(const EngineOptions& options, std::span<const Family> families);

}  // namespace brdfit::kernels
