/// Robust losses: what single samples may add to a loss, their weights, and the size of ordinary residuals.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "kernels/evaluator.h"
#include "optim/loss.h"
#include "optim/statistics.h"

namespace brdfit::optim {

/// Evaluator::loss under a robust loss: the sums are formed here, from the terms. `normal` is the matrix of the squares
/// that touch the loss from above, sum w weight J'J. y and w of the evaluator are not read. Throws DeviceError.
void robust_loss(kernels::Evaluator& evaluator, const Weighted& weighted, std::span<const double> parameters,
                 std::span<const double> coefficients, kernels::Batch& out);

/// Size of ordinary residuals, in the unit of Weighted::scale: the median of |sqrt(w) r| over 0.6745, which is the
/// standard deviation of Gaussian ones. The `free` smallest are left out, as so many parameters can bring them to 0. At
/// least 1e-6 of the root mean square of sqrt(w) y (of a decade for `log`): nothing is an outlier by rounding.
double robust_scale(const Weighted& weighted, std::span<const double> r, std::size_t free);

/// The squares that touch a robust loss from above at these residuals: another step of reweighting.
Weighted reweighted(const Weighted& quadratic, const Weighted& robust, std::span<const double> r);

/// What Gaussian statistics should see in place of a robust loss, after Huber: residuals s psi / mean(psi') under
/// weights w mean(psi').
struct PseudoValues {
    Weighted weighted;
    Residuals residuals;
};
PseudoValues pseudo_values(const Weighted& robust, const Residuals& residuals);

/// Samples that keep less than a tenth of their weight, in rising order.
std::vector<std::size_t> outliers(const Weighted& robust, std::span<const double> r);

}  // namespace brdfit::optim
