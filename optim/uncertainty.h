/// What noise leaves open of a fit's parameters.
#pragma once

#include <array>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "optim/noise.h"
#include "optim/refit.h"

namespace brdfit::optim {

/// A fit as its uncertainty is asked for. References must outlive it.
struct Estimate {
    const Task& task;
    Criterion loss;
    const std::vector<Interval>& bounds;  ///< of each parameter, in the model's unit
    const Point& point;                   ///< the minimum of the task's loss
    std::vector<bool> at_bound;           ///< of each parameter
    std::span<const double> sigma;        ///< of each sample, in the task's unit; empty: the residuals' sizes
    const Noise& noise;                   ///< the channel's, of which sigma is
    bool scale_free;                      ///< the scale was fitted as well
    bool profiled;                        ///< intervals by profiles of the loss, not by its curvature alone
};

/// Of one parameter, in the model's unit.
struct ParameterUncertainty {
    std::optional<double> std_error{};
    std::optional<std::array<double, 2>> interval_95{};
    bool undetermined = false;  ///< the data do not determine it
};

struct Uncertainty {
    std::vector<ParameterUncertainty> parameters;  ///< one each
    Correlations correlations;
    std::vector<std::string> remarks;  ///< on parameters that are determined only together
    bool too_few = false;              ///< no more samples than parameters: nothing can be said
};

/// By the sandwich H^-1 B H^-1 in each parameter's own scale: H the loss's curvature, from differences of exact
/// gradients; B the covariance of its gradient under the noise. units: the model's unit over the one that remarks are
/// told in, one a parameter. Intervals are its own, or profiles' (optim/profile.h). docs/statistics.md has the
/// formulas. Throws what an evaluator throws.
Uncertainty uncertainty_of(const Estimate& estimate, Refitter& refitter, std::span<const double> units);

/// Intervals of each parameter from `replicates` refits of the data with noise added, bias-corrected percentiles. Needs
/// sigma. Empty if the time ran out first. Throws what an evaluator throws.
std::vector<std::array<double, 2>> bootstrap_intervals(const Estimate& estimate, Refitter& refitter,
                                                       std::size_t replicates);

}  // namespace brdfit::optim
