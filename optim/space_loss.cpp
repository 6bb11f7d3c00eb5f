#include "optim/space_loss.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include <Eigen/Cholesky>

#include "optim/robust.h"
#include "optim/thinned.h"

namespace brdfit::optim {
namespace {

/// A coordinate of strength is not taken for less: there slopes vanish.
constexpr double kLeastStrength = 0.02;

}  // namespace

void SpaceLoss::evaluate(std::span<const std::vector<double>> points, bool gradient,
                         const std::optional<Strength>& freed) {
    if (candidates_.size() < points.size()) candidates_.resize(points.size());
    parameters_.clear();
    lower_.clear();
    upper_.clear();
    for (std::size_t i = 0; i < points.size(); ++i) {
        Candidate& at = candidates_[i];
        space_.place(points[i], at);
        parameters_.insert(parameters_.end(), at.parameters.begin(), at.parameters.end());
        lower_.insert(lower_.end(), at.lower.begin(), at.lower.end());
        upper_.insert(upper_.end(), at.upper.begin(), at.upper.end());
        if (!freed) continue;
        const double u = std::max(points[i][freed->coordinate], kLeastStrength);
        lower_[i * at.lower.size() + freed->term] = 0;
        upper_[i * at.upper.size() + freed->term] = at.upper[freed->term] / (u * u);
    }
    if (space_.unknowns() == Unknowns::nonlinear) evaluator_.project(parameters_, lower_, upper_, gradient, batch_);
    else if (robust()) robust_loss(evaluator_, *form_, parameters_, lower_, batch_);
    else evaluator_.loss(parameters_, lower_, logarithmic(), batch_);
    evaluations_ += points.size();
}

bool SpaceLoss::is_dear() const { return evaluator_.samples() > kThinAbove; }

SpaceLoss::Known SpaceLoss::at(std::span<const double> u, bool gradient) {
    for (const Known& known : known_)
        if (std::equal(u.begin(), u.end(), known.u.begin(), known.u.end())) return known;
    const bool kept = is_dear();
    Known known{{u.begin(), u.end()}, {}, 0, {}};
    evaluate({&known.u, 1}, gradient || kept);
    if (gradient || kept) {
        known.gradient.resize(space_.dimension());
        space_.gradient(u, candidates_[0], batch_.coefficients, batch_.by_parameter, batch_.by_coefficient,
                        known.gradient);
        for (double& g : known.gradient) g /= scale2_;
        // Near underflow the slope of a logarithm overflows; at underflow there is none.
        for (double& slope : known.gradient)
            if (logarithmic() && !std::isfinite(slope)) slope = 0;
    }
    known.value = batch_.loss[0] / scale2_;
    known.coefficients = batch_.coefficients;
    if (kept) keep(known);
    return known;
}

void SpaceLoss::keep(Known known) {
    constexpr std::size_t kMost = 8;
    if (known_.size() == kMost) known_.erase(known_.begin());
    known_.push_back(std::move(known));
}

double SpaceLoss::operator()(std::span<const double> u, std::span<double> gradient) {
    const Known known = at(u, !gradient.empty());
    if (!gradient.empty()) std::copy(known.gradient.begin(), known.gradient.end(), gradient.begin());
    return known.value;
}

std::vector<Look> SpaceLoss::looks(std::span<const std::vector<double>> points) {
    evaluate(points, true);
    const kernels::Model& model = space_.model();
    const std::size_t p = model.parameters.size();
    const std::size_t t = model.terms.size();
    const std::size_t d = space_.dimension();
    const std::size_t unknowns = t + space_.nonlinear();
    const std::size_t normals = unknowns * (unknowns + 1) / 2;
    std::vector<Look> result(points.size());
    normal_.resize(unknowns * unknowns);
    bent_.resize(unknowns * d);
    for (std::size_t i = 0; i < points.size(); ++i) {
        Look& look = result[i];
        const Candidate& at = candidates_[i];
        const std::span<const double> c(batch_.coefficients.data() + i * t, t);
        space_.jacobian(points[i], at, c, jacobian_);
        look.value = batch_.loss[i] / scale2_;
        look.gradient.resize(d);
        space_.gradient(jacobian_, {batch_.by_parameter.data() + i * p, p}, {batch_.by_coefficient.data() + i * t, t},
                        look.gradient);
        for (double& g : look.gradient) g /= scale2_;

        const double* entry = batch_.normal.data() + i * normals;
        for (std::size_t row = 0; row < unknowns; ++row)
            for (std::size_t column = row; column < unknowns; ++column)
                normal_[row * unknowns + column] = normal_[column * unknowns + row] = *entry++;
        // What free coefficients take up of a step is taken out of its curvature.
        for (std::size_t k = 0; k < t; ++k) {
            double* const of_k = normal_.data() + k * unknowns;
            const double pivot = of_k[k];
            if (!SearchSpace::is_free(c[k], at.lower[k], at.upper[k]) || !(pivot > 0)) continue;
            for (std::size_t row = 0; row < unknowns; ++row) {
                const double part = of_k[row] / pivot;
                if (row == k || part == 0) continue;
                for (std::size_t column = 0; column < unknowns; ++column)
                    normal_[row * unknowns + column] -= part * of_k[column];
                normal_[row * unknowns + k] = 0;
            }
            std::fill_n(of_k, unknowns, 0.0);
        }
        // The Jacobian's rows are sparse.
        std::fill(bent_.begin(), bent_.end(), 0.0);
        for (std::size_t row = 0; row < unknowns; ++row)
            for (std::size_t j = 0; j < d; ++j)
                if (const double slope = jacobian_[row * d + j]; slope != 0)
                    for (std::size_t k = 0; k < unknowns; ++k)
                        bent_[j * unknowns + k] += slope * normal_[row * unknowns + k];
        look.curvature.resize(d * d);
        for (std::size_t row = 0; row < unknowns; ++row)
            for (std::size_t j = 0; j < d; ++j)
                if (const double slope = 2 / scale2_ * jacobian_[row * d + j]; slope != 0)
                    for (std::size_t k = 0; k < d; ++k) look.curvature[j * d + k] += slope * bent_[k * unknowns + row];
        if (is_dear() && !logarithmic()) keep({points[i], look.gradient, look.value, {c.begin(), c.end()}});
    }
    return result;
}

std::vector<Look> SpaceLoss::looks_bent_by(SpaceLoss& part, std::span<const std::vector<double>> points) {
    using Matrix = Eigen::MatrixXd;
    constexpr double kStep = 1e-4;  // of the cube, on either side
    std::vector<Look> result = looks(points);
    const std::size_t d = space_.dimension();
    const auto n = static_cast<Eigen::Index>(d);
    for (std::size_t i = 0; i < points.size(); ++i) {
        std::vector<std::vector<double>> about{points[i]};
        for (std::size_t j = 0; j < d; ++j)
            for (const double side : {-1.0, 1.0}) {
                about.push_back(points[i]);
                about.back()[j] = std::clamp(points[i][j] + side * kStep, 0.0, 1.0);
            }
        const std::vector<Look> seen = part.looks(about);
        Matrix bend(n, n);
        for (std::size_t j = 0; j < d; ++j) {
            const Look& below = seen[1 + 2 * j];
            const Look& above = seen[2 + 2 * j];
            const double width = about[2 + 2 * j][j] - about[1 + 2 * j][j];
            const auto column = static_cast<Eigen::Index>(j);
            for (Eigen::Index k = 0; k < n; ++k) {
                const auto at = static_cast<std::size_t>(k);
                bend(k, column) = (above.gradient[at] - below.gradient[at]) / width;
            }
        }
        Eigen::Map<Matrix> curvature(result[i].curvature.data(), n, n);
        const Matrix whole =
            curvature + (bend + bend.transpose()) / 2 - Eigen::Map<const Matrix>(seen[0].curvature.data(), n, n);
        const double largest = whole.diagonal().maxCoeff();
        if (!whole.allFinite() || !(whole.diagonal().minCoeff() > 1e-9 * largest)) continue;
        const Eigen::VectorXd unit = whole.diagonal().cwiseSqrt().cwiseInverse();
        if (Eigen::LLT<Matrix>(unit.asDiagonal() * whole * unit.asDiagonal()).info() == Eigen::Success)
            curvature = whole;
    }
    return result;
}

std::vector<double> SpaceLoss::screen(const std::vector<std::vector<double>>& points, const SearchControl& control,
                                      const std::optional<Strength>& freed, std::vector<double>& strengths) {
    constexpr std::size_t kLaunch = 1'000'000;  // candidates x samples: under a second on one core
    const std::size_t most = std::max<std::size_t>(1, kLaunch / std::max<std::size_t>(1, evaluator_.samples()));
    const std::size_t terms = space_.model().terms.size();
    std::vector<double> values(points.size(), std::numeric_limits<double>::max());
    for (std::size_t first = 0; first < points.size() && !control.over(); first += most) {
        const std::size_t count = std::min(most, points.size() - first);
        evaluate(std::span(points).subspan(first, count), false, freed);
        for (std::size_t i = 0; i < count; ++i) {
            if (!std::isfinite(batch_.loss[i])) continue;
            values[first + i] = batch_.loss[i] / scale2_;
            if (freed)
                strengths[first + i] = batch_.coefficients[i * terms + freed->term] / candidates_[i].upper[freed->term];
        }
        control.evaluated(count, *std::min_element(values.begin() + static_cast<std::ptrdiff_t>(first),
                                                   values.begin() + static_cast<std::ptrdiff_t>(first + count)));
    }
    return values;
}

std::vector<double> SpaceLoss::screen(const std::vector<std::vector<double>>& points, const SearchControl& control) {
    std::vector<double> none;
    return screen(points, control, std::nullopt, none);
}

std::vector<double> SpaceLoss::screen_freed(std::vector<std::vector<double>>& points, const SearchControl& control) {
    const std::optional<Strength> strength = space_.strength();
    if (!strength) return screen(points, control);
    std::vector<double> strengths(points.size(), 1.0);
    std::vector<double> values = screen(points, control, strength, strengths);
    for (std::size_t i = 0; i < points.size(); ++i) {
        double& u = points[i][strength->coordinate];
        u = std::clamp(std::max(u, kLeastStrength) * std::sqrt(strengths[i]), kLeastStrength, 1.0);
    }
    return values;
}

std::vector<double> SpaceLoss::screen_roughly(const std::vector<std::vector<double>>& points, std::size_t wanted,
                                              const SearchControl& control) {
    constexpr std::size_t kKept = 4;  // for each that is wanted
    const std::size_t kept = kKept * wanted;
    if (fewer_ == nullptr || kept >= points.size()) return screen(points, control);
    const std::vector<double> rough = fewer_->screen(points, control);
    std::vector<std::size_t> order(points.size());
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::nth_element(order.begin(), order.begin() + static_cast<std::ptrdiff_t>(kept), order.end(),
                     [&](std::size_t a, std::size_t b) { return std::pair(rough[a], a) < std::pair(rough[b], b); });
    order.resize(kept);
    std::vector<std::vector<double>> better;
    for (const std::size_t i : order) better.push_back(points[i]);
    const std::vector<double> exact = screen(better, control);
    std::vector<double> values(points.size(), std::numeric_limits<double>::max());
    for (std::size_t k = 0; k < kept; ++k) values[order[k]] = exact[k];
    return values;
}

void SpaceLoss::complete(Minimum& minimum) {
    Known known = at(minimum.u, false);
    minimum.loss2 = known.value * scale2_;
    minimum.coefficients = std::move(known.coefficients);
}

}  // namespace brdfit::optim
