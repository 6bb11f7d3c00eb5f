#include "kernels/hard_points.h"

namespace brdfit::kernels {
namespace {

constexpr HardPoint kPoints[] = {
#include "kernels/hard_points.inc"
};

}  // namespace

std::span<const HardPoint> hard_points() { return kPoints; }

}  // namespace brdfit::kernels
