/// What a fit minimises.
#pragma once

#include <array>
#include <string_view>
#include <vector>

#include "optim/dataset.h"

namespace brdfit::optim {

/// loss = sqrt( sum_j w_j r_j^2 / sum_j w_j ) with r = f - y, but ln f - ln y for `log`.
enum class Loss {
    cosine_l2,  ///< w = cos theta_r: the paper's
    l2,         ///< w = 1
    log,        ///< w = 1, over samples with y > 0; in decades: r = log10(f/y)
    relative,   ///< w = 1/y^2 and divided by the number of samples with y > 0, over those
    chi2,       ///< w = 1/sigma^2, divided by the number of samples
};

struct LossName {
    Loss loss;
    std::string_view name;
    std::string_view doc;
};
/// Every loss with its name on the wire.
inline constexpr std::array<LossName, 5> kLossNames{{
    {Loss::cosine_l2, "cosine_l2", "sqrt(sum cos(theta_r) (f-y)^2 / sum cos(theta_r))"},
    {Loss::l2, "l2", "sqrt(mean (f-y)^2)"},
    {Loss::log, "log", "sqrt(mean log10(f/y)^2) over y > 0"},
    {Loss::relative, "relative", "sqrt(mean ((f-y)/y)^2) over y > 0"},
    {Loss::chi2, "chi2", "sqrt(mean ((f-y)/sigma)^2)"},
}};

/// A channel as the evaluator sees it under a loss: sum_j weight_j r_j^2 = loss^2.
struct Weighted {
    std::vector<double> y;       ///< measured value; 0 where the weight is 0
    std::vector<double> weight;  ///< includes the loss's denominator
    bool logarithmic = false;    ///< residuals are ln f - ln y
    double norm = 0;             ///< the loss of f = 0 (for `log`: 1), the scale of relative_loss
    std::size_t used = 0;        ///< samples with a weight
};
/// Throws std::invalid_argument if `chi2` is asked for and a sigma is missing.
Weighted weigh(const Channel& channel, Loss loss);

}  // namespace brdfit::optim
