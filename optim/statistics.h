/// Errors of a fit and the evidence for its model.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include "optim/loss.h"
#include "optim/report.h"

namespace brdfit::optim {

/// Of every interval that is told.
inline constexpr double kConfidence = 0.95;
/// By how many standard errors such an interval goes to each side: Student's t; the normal distribution's value for
/// infinitely many degrees of freedom. Fewer than one count as one.
double standard_errors_of_interval(double degrees);

/// Loss and its residuals at given model values f (one a sample).
struct Residuals {
    double loss2 = 0;          ///< sum of w r^2, or what a robust form has for it
    std::vector<double> r;     ///< f - y or ln f - ln y, 0 where the weight is 0
    std::vector<double> by_f;  ///< d r/d f
};
Residuals residuals(const Weighted& weighted, std::span<const double> f);

/// rmse, error in decades, errors by incidence angle, into the fit.
void describe_errors(const Channel& channel, Fit& fit);

/// Errors and loss of values predicted for samples that were not fitted.
HeldOut held_out_errors(const Channel& channel, const Weighted& weighted, std::span<const double> predicted);

/// The measured values with weights 1/sigma^2, by which least squares are maximum likelihood.
Weighted weigh_by(const Channel& channel, std::span<const double> sigma);

/// -2 ln L of n independent Gaussian errors of sizes s sigma_j, s being the most likely: n ln(2 pi s^2) +
/// sum ln sigma_j^2 + n with s^2 = chi2/n. chi2: sum ((f - y)/sigma)^2; norm: its root for f = 0. Residuals count as
/// 1e-14 of the values at least.
double deviance(const Channel& channel, std::span<const double> sigma, double chi2, double norm);
/// The same of a loss alone, without the sizes: n ln loss^2, of the samples that have a weight.
double deviance(const Weighted& weighted, double loss);

/// AICc and BIC of so many free parameters and the errors' size, of n samples, into the fit.
void describe_evidence(double deviance, std::size_t n, std::size_t free, Fit& fit);

}  // namespace brdfit::optim
