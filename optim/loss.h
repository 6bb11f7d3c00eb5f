/// What a fit minimises.
#pragma once

#include <array>
#include <optional>
#include <string_view>
#include <vector>

#include "optim/dataset.h"

namespace brdfit::optim {

/// loss = sqrt( sum_j w_j r_j^2 / sum_j w_j ) with r = f - y, but ln f - ln y for `log`.
enum class Loss {
    cosine_l2,  ///< w = cos theta_r: the paper's
    cosine,     ///< w = cos(theta_i)^a cos(theta_r)^b
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
inline constexpr std::array<LossName, 6> kLossNames{{
    {Loss::cosine_l2, "cosine_l2", "sqrt(sum cos(theta_r) (f-y)^2 / sum cos(theta_r))"},
    {Loss::cosine, "cosine", "sqrt(sum w (f-y)^2 / sum w), w = cos(theta_i)^a cos(theta_r)^b"},
    {Loss::l2, "l2", "sqrt(mean (f-y)^2)"},
    {Loss::log, "log", "sqrt(mean log10(f/y)^2) over y > 0"},
    {Loss::relative, "relative", "sqrt(mean ((f-y)/y)^2) over y > 0"},
    {Loss::chi2, "chi2", "sqrt(mean ((f-y)/sigma)^2)"},
}};

/// What takes the place of the squares: 2 s^2 rho(z), where z = sqrt(w) r / s of a scale s.
enum class Robust {
    none,    ///< squares
    huber,   ///< rho = z^2/2 up to the threshold c, and c |z| - c^2/2 beyond
    cauchy,  ///< rho = c^2/2 ln(1 + (z/c)^2)
};

/// Exponents of `cosine` in a request lie within [-kSteepestCosine, kSteepestCosine]. A negative one would give all
/// weight to a few grazing samples, and is refused beside angles above kGrazing_deg.
inline constexpr double kSteepestCosine = 4;
inline constexpr double kGrazing_deg = 89;
/// Thresholds that a request may name, in robust standard deviations.
inline constexpr double kLeastThreshold = 0.5;
inline constexpr double kMostThreshold = 20;

/// A loss with all its parts.
struct Criterion {
    Loss kind = Loss::cosine_l2;
    std::optional<double> cos_theta_i_exponent{};  ///< of `cosine` only; none: 0
    std::optional<double> cos_theta_r_exponent{};  ///< of `cosine` only; none: 1
    Robust robust = Robust::none;
    std::optional<double> robust_threshold{};  ///< of robust forms; none: 95 % efficient under Gaussian noise

    Criterion() = default;
    Criterion(Loss kind_in) : kind(kind_in) {}  // NOLINT(google-explicit-constructor): most losses are just that
    bool operator==(const Criterion&) const = default;
    bool operator==(Loss) const = delete;  ///< of what? compare `kind`

    [[nodiscard]] double cos_theta_i_power() const { return cos_theta_i_exponent.value_or(0); }
    [[nodiscard]] double cos_theta_r_power() const { return cos_theta_r_exponent.value_or(1); }
    /// The threshold in robust standard deviations; 0 without a robust form.
    [[nodiscard]] double threshold() const;
};

/// What a sample whose weighted square w r^2 is known does to a loss.
struct Influence {
    double loss = 0;    ///< adds to loss^2
    double weight = 0;  ///< psi(z)/z: of the square that touches the loss there from above; 1 for squares
    double slope = 0;   ///< psi'(z); 1 for squares
};

/// A channel as the evaluator sees it under a loss: sum_j weight_j r_j^2 = loss^2, or of a robust form
/// sum_j 2 scale^2 rho(sqrt(weight_j) r_j / scale) = loss^2.
struct Weighted {
    std::vector<double> y;       ///< measured value; 0 where the weight is 0
    std::vector<double> weight;  ///< includes the loss's denominator
    bool logarithmic = false;    ///< residuals are ln f - ln y
    double norm = 0;             ///< the loss of f = 0 (for `log`: 1), the scale of relative_loss
    std::size_t used = 0;        ///< samples with a weight
    Robust robust = Robust::none;
    double threshold = 0;  ///< c
    double scale = 0;      ///< s, of sqrt(weight) r

    [[nodiscard]] Influence influence(double square) const;
};
/// Under the squares of a loss. Throws std::invalid_argument if `chi2` is asked for and a sigma is missing.
Weighted weigh(const Channel& channel, const Criterion& criterion);
/// Under its robust form, if it has one, with a scale of residuals in the unit of the loss.
Weighted weigh(const Channel& channel, const Criterion& criterion, double scale);
/// The scale that a robust form of `weighted` has, in the unit of the loss.
double scale_in_loss(const Channel& channel, const Criterion& criterion, double scale);
/// Whether losses are in the data's unit.
bool has_unit(Loss loss);

}  // namespace brdfit::optim
