/// Points at which models are hard to evaluate, with reference values: what the self-test compares a device with.
#pragma once

#include <array>
#include <cstddef>
#include <span>
#include <string_view>

#include "kernels/geometry.h"

namespace brdfit::kernels {

/// The most parameters of a model that has points.
inline constexpr std::size_t kHardPointParameters = 10;

/// Parameters are floats, so that a point is the same in both precisions.
struct HardPoint {
    std::string_view model;
    std::size_t lobes = 0;                                 ///< 0 for a model without lobes
    std::array<float, kHardPointParameters> parameters{};  ///< in the model's units and order; then 0
    Direction direction{};
    long double value = 0;                                   ///< f [1/sr]
    std::array<long double, kHardPointParameters> slopes{};  ///< df/dp
};

/// The points of every built-in model, those of a model together. hard_points.inc holds them, which
/// tests/numerics/hard_points_generator.cpp writes from the 77-digit reference.
std::span<const HardPoint> hard_points();

}  // namespace brdfit::kernels
