/// The best parameters among those that conserve energy.
#pragma once

#include <vector>

#include "optim/optimum.h"
#include "optim/physics.h"

namespace brdfit::optim {

/// Searches from `found`, an optimum of the same task whose albedo exceeds 1 somewhere, and from other starts, with
/// NLopt's SLSQP under albedo <= 1 at the incidence angles where that binds; further angles join until the largest
/// albedo over all of them is at most 1 + kAlbedoTolerance. The record's stop_reason is that of the best start's
/// descent. Throws kernels::DeviceError, kernels::BuildError, and SearchError where no such parameters are found.
Optimum energy_conserving_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum& found,
                                  const Incidence& incidence);

}  // namespace brdfit::optim
