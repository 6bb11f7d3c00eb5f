/// By what a profile of the loss may rise and noise still explain it.
#pragma once

#include "optim/neighbourhood.h"

namespace brdfit::optim {

/// By what the loss^2's profile of unknown psi rises above its minimum at most in 95 % of cases, if the truth is here:
/// noise t^2 where no bound is near, noise being what one standard error lifts the profile by here; what repetition in
/// the quadratic form and its bounds says elsewhere. Where an index may be real in truth, as any dielectric's is, and
/// noise alone may have lifted its k, the larger of that and what it is where k = 0: the noise that shows at the
/// estimate of k may be far from the truth's. degrees: of freedom of the noise. close: of loss^2, hardly more than
/// nothing. Throws what an evaluator throws.
double critical_value(const Neighbourhood& about, const Place& here, Eigen::Index psi, double noise, double degrees,
                      double close);

}  // namespace brdfit::optim
