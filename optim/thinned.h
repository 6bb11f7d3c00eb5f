/// A part of many samples that stands for all.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "kernels/geometry.h"
#include "optim/loss.h"

namespace brdfit::optim {

/// A search over more samples than this looks at a part of them, of about so many draws.
constexpr std::size_t kThinAbove = 6000;
constexpr std::size_t kThinTo = 2000;

/// Samples of all, with weights so that sums over them estimate those over all.
struct Thinned {
    std::vector<kernels::Direction> directions;
    Weighted data;
};

/// Of about `to` draws, from squares (no robust loss). Half of them fall evenly, half in proportion to the weighted
/// square of the value, which narrow peaks have and an even draw would miss.
Thinned thinned(const Weighted& all, std::span<const kernels::Direction> directions, std::size_t to,
                std::uint64_t seed);

}  // namespace brdfit::optim
