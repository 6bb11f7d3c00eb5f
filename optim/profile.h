/// Intervals of a fit's parameters by the loss's own rise: how far each may go while the others make up for it.
#pragma once

#include <array>
#include <optional>
#include <vector>

#include "optim/neighbourhood.h"

namespace brdfit::optim {

/// The set of values of each unknown at which the loss, with the others free within their bounds, is above its minimum
/// by less than noise makes it in 95 % of cases. Model's unit; none where the control is over. Throws what an evaluator
/// throws.
std::vector<std::optional<std::array<double, 2>>> profile_intervals(const Minimised& minimised, Refitter& refitter);

}  // namespace brdfit::optim
