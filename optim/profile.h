/// Intervals of a fit's parameters by the loss's own rise: how far each may go while the others make up for it.
#pragma once

#include <array>
#include <functional>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "optim/coordinate.h"
#include "optim/interval.h"
#include "optim/optimum.h"
#include "optim/refit.h"

namespace brdfit::optim {

/// A minimum as its profiles are asked for. References must outlive it. Unknowns are those that the samples feel and
/// that are not held, at bounds or not.
struct Minimised {
    const Task& task;
    const Point& point;
    std::vector<Coordinate> unknowns;
    std::vector<Interval> bounds;  ///< of each unknown, in the model's unit
    Eigen::VectorXd spreads;       ///< of each sample: standard deviation of its residual by noise
    Eigen::MatrixXd misfit;        ///< what misfit adds to half the loss's curvature, by the unknowns' own scales
    std::vector<double> degrees;   ///< of freedom of the noise, as each unknown sees it
};

/// The set of values of each unknown at which the loss, with the others free within their bounds, is above its minimum
/// by less than noise makes it in 95 % of cases. Model's unit; none where the control is over. Throws what an evaluator
/// throws.
std::vector<std::optional<std::array<double, 2>>> profile_intervals(const Minimised& minimised, Refitter& refitter);

}  // namespace brdfit::optim
