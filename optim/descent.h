/// Local searches for a sum of squares: Levenberg and Marquardt's method in the unit cube, many descents in step.
#pragma once

#include <cstddef>
#include <functional>
#include <span>
#include <vector>

#include "optim/search.h"

namespace brdfit::optim {

/// Looks at many points at once. A look that is not finite counts as worse than any other.
using Landscape = std::function<std::vector<Look>(std::span<const std::vector<double>> points)>;

/// When a descent ends.
struct DescentGoal {
    double relative = 1e-5;  ///< the decrease that the model still promises, of the value
    double absolute = 1e-24;
    int looks = 60;         ///< most evaluations of a descent
    double damping = 1e-2;  ///< Marquardt's, of the first step
    double apart = 2e-3;    ///< in some coordinate: two descents that come nearer are on one path
    /// If above 0, only the best end counts: a descent whose step promises less than this part of what it lacks ends.
    double hopeful = 0;
};

/// Descends from every start, one launch for the next step of all; returns the ends in the order of the starts. A
/// descent that comes upon the path of a better one ends there. Throws what the landscape throws.
std::vector<Minimum> descend_together(const Landscape& landscape, const std::vector<std::vector<double>>& starts,
                                      const DescentGoal& goal, const SearchControl& control);

}  // namespace brdfit::optim
