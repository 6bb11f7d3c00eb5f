/// Errors of a fit and of its parameters.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "optim/loss.h"
#include "optim/report.h"

namespace brdfit::optim {

/// Loss and its residuals at given model values f (one a sample).
struct Residuals {
    double loss2 = 0;          ///< sum of w r^2, or what a robust form has for it
    std::vector<double> r;     ///< f - y or ln f - ln y, 0 where the weight is 0
    std::vector<double> by_f;  ///< d r/d f
};
Residuals residuals(const Weighted& weighted, std::span<const double> f);

/// rmse, error in decades, errors by incidence angle, AICc and BIC of `free` parameters, into the fit. A loss below
/// 1e-14 of the data counts as that much.
void describe_errors(const Channel& channel, const Weighted& weighted, std::size_t free, Fit& fit);

/// Standard errors of the free parameters by the sandwich A^-1 B A^-1, A = sum w J J', B = sum (w r)^2 J J' with each
/// residual divided by 1 - its leverage (HC3): right for noise that varies from sample to sample.
/// jacobian: one row a parameter, d f/d p at each sample. None for a parameter that the data do not determine.
std::vector<std::optional<double>> standard_errors(const Weighted& weighted, const Residuals& residuals,
                                                   const std::vector<std::vector<double>>& jacobian);

}  // namespace brdfit::optim
