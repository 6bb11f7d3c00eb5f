/// How a model does where it has not been fitted.
#pragma once

#include <optional>

#include "optim/refit.h"

namespace brdfit::optim {

/// Leaves out each incidence angle in turn, fits the others from the starts (the whole fit's optimum first) and
/// measures the errors at what was left out. More than 24 angles are left out in 24 groups, each every 24th. None with
/// fewer than two angles, or where a fold would have fewer samples than `free` parameters. `channel`, in whose unit
/// errors are, has the task's samples times `unit`. Throws what the refitter throws.
std::optional<HeldOut> hold_out(Refitter& refitter, const Task& task, const Channel& channel, double unit,
                                const Weighted& weighted, std::span<const Point> starts, std::size_t free);

}  // namespace brdfit::optim
