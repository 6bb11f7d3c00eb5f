#include "optim/robust.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <Eigen/Core>

namespace brdfit::optim {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Median of |x| of a Gaussian of variance 1.
constexpr double kGaussianMedian = 0.6744897501960817;
/// The smallest scale, of the data.
constexpr double kLeastScale = 1e-6;
/// An outlier keeps less of its weight.
constexpr double kOutlier = 0.1;
/// Values of terms that are held at once, unless one candidate has more.
constexpr std::size_t kHeld = 2'000'000;

/// Residuals of a value, as the kernels form them.
struct Residual {
    double r = 0;
    double by_f = 0;
};
Residual residual(bool logarithmic, double f, double y) {
    if (!logarithmic) return {f - y, 1};
    constexpr double kTiny = std::numeric_limits<double>::min();
    return f > kTiny ? Residual{std::log(f) - y, 1 / f} : Residual{std::log(kTiny) - y, 0};
}

}  // namespace

void robust_loss(kernels::Evaluator& evaluator, const Weighted& weighted, std::span<const double> parameters,
                 std::span<const double> coefficients, kernels::Batch& out) {
    const kernels::Model& model = evaluator.model();
    const std::size_t p = model.parameters.size();
    const std::size_t t = model.terms.size();
    const std::size_t n = evaluator.samples();
    const std::size_t v = model.term_values();
    const std::vector<std::size_t> nonlinear = model.nonlinear();
    const std::size_t unknowns = t + nonlinear.size();
    const std::size_t normals = unknowns * (unknowns + 1) / 2;
    const std::size_t candidates = parameters.size() / p;
    out.loss.assign(candidates, 0.0);
    out.coefficients.assign(coefficients.begin(), coefficients.end());
    out.by_coefficient.assign(candidates * t, 0.0);
    out.by_parameter.assign(candidates * p, 0.0);
    out.normal.assign(candidates * normals, 0.0);

    /// Where a row of slopes goes: its term, and its place among the unknowns.
    struct Slope {
        std::size_t row, term, column;
    };
    std::vector<std::size_t> values;
    std::vector<Slope> slopes;
    for (std::size_t term = 0, row = 0; term < t; ++term) {
        values.push_back(row++);
        for (const std::size_t parameter : model.terms[term].of) {
            const auto place = std::lower_bound(nonlinear.begin(), nonlinear.end(), parameter) - nonlinear.begin();
            slopes.push_back({row++, term, t + static_cast<std::size_t>(place)});
        }
    }
    // Samples without a weight count for nothing.
    std::vector<Index> counted;
    for (std::size_t j = 0; j < n; ++j)
        if (weighted.weight[j] > 0) counted.push_back(static_cast<Index>(j));
    const auto m = static_cast<Index>(counted.size());
    MatrixXd slope(m, static_cast<Index>(unknowns));  // of the residuals, by the unknowns
    VectorXd f(m), pull(m), root(m);
    const std::size_t most = std::max<std::size_t>(1, kHeld / std::max<std::size_t>(1, v * n));
    for (std::size_t first = 0; first < candidates; first += most) {
        const std::size_t count = std::min(most, candidates - first);
        const std::vector<double> terms = evaluator.terms(parameters.subspan(first * p, count * p));
        for (std::size_t i = first; i < first + count; ++i) {
            const Eigen::Map<const MatrixXd> rows(terms.data() + (i - first) * v * n, static_cast<Index>(n),
                                                  static_cast<Index>(v));
            const Eigen::Map<const VectorXd> c(coefficients.data() + i * t, static_cast<Index>(t));
            for (std::size_t k = 0; k < t; ++k)
                slope.col(static_cast<Index>(k)) = rows.col(static_cast<Index>(values[k]))(counted);
            f.noalias() = slope.leftCols(static_cast<Index>(t)) * c;
            slope.rightCols(static_cast<Index>(nonlinear.size())).setZero();
            for (const Slope& s : slopes)
                slope.col(static_cast<Index>(s.column)) +=
                    c(static_cast<Index>(s.term)) * rows.col(static_cast<Index>(s.row))(counted);
            double loss = 0;
            for (Index j = 0; j < m; ++j) {
                const auto sample = static_cast<std::size_t>(counted[static_cast<std::size_t>(j)]);
                const Residual at = residual(weighted.logarithmic, f(j), weighted.y[sample]);
                const Influence influence = weighted.influence(weighted.weight[sample] * at.r * at.r);
                loss += influence.loss;
                root(j) = std::sqrt(weighted.weight[sample] * influence.weight);
                pull(j) = root(j) * at.r;
                root(j) *= at.by_f;
            }
            out.loss[i] = loss;
            slope.array().colwise() *= root.array();
            const VectorXd gradient = 2 * (slope.transpose() * pull);
            const MatrixXd normal = slope.transpose() * slope;
            std::copy_n(gradient.data(), t, out.by_coefficient.begin() + static_cast<std::ptrdiff_t>(i * t));
            for (std::size_t q = 0; q < nonlinear.size(); ++q)
                out.by_parameter[i * p + nonlinear[q]] = gradient(static_cast<Index>(t + q));
            double* entry = out.normal.data() + i * normals;
            for (Index a = 0; a < normal.rows(); ++a)
                for (Index b = a; b < normal.cols(); ++b) *entry++ = normal(a, b);
        }
    }
}

double robust_scale(const Weighted& weighted, std::span<const double> r, std::size_t free) {
    std::vector<double> sizes;
    double squares = 0;
    double count = 0;
    for (std::size_t j = 0; j < r.size(); ++j) {
        if (!(weighted.weight[j] > 0)) continue;
        sizes.push_back(std::sqrt(weighted.weight[j]) * std::abs(r[j]));
        squares += weighted.weight[j] * (weighted.logarithmic ? 1.0 : weighted.y[j] * weighted.y[j]);
        ++count;
    }
    if (sizes.empty()) return 0;
    const std::size_t left_out = std::min(free, sizes.size() - 1);
    const std::size_t middle = left_out + (sizes.size() - left_out) / 2;
    std::nth_element(sizes.begin(), sizes.begin() + static_cast<std::ptrdiff_t>(middle), sizes.end());
    return std::max(sizes[middle] / kGaussianMedian, kLeastScale * std::sqrt(squares / count));
}

Weighted reweighted(const Weighted& quadratic, const Weighted& robust, std::span<const double> r) {
    Weighted result = quadratic;
    for (std::size_t j = 0; j < r.size(); ++j)
        result.weight[j] *= robust.influence(robust.weight[j] * r[j] * r[j]).weight;
    return result;
}

PseudoValues pseudo_values(const Weighted& robust, const Residuals& residuals) {
    PseudoValues result{robust, residuals};
    double weights = 0;
    double slopes = 0;
    for (std::size_t j = 0; j < residuals.r.size(); ++j) {
        if (!(robust.weight[j] > 0)) continue;
        const Influence influence = robust.influence(robust.weight[j] * residuals.r[j] * residuals.r[j]);
        weights += influence.weight;
        slopes += influence.slope;
        result.weighted.weight[j] *= influence.weight;
    }
    // Not below a fifth, where hardly any sample is ordinary.
    const double slope = weights > 0 ? std::max(slopes / weights, 0.2) : 1.0;
    for (double& w : result.weighted.weight) w *= slope;
    for (double& r : result.residuals.r) r /= slope;
    return result;
}

std::vector<std::size_t> outliers(const Weighted& robust, std::span<const double> r) {
    std::vector<std::size_t> result;
    for (std::size_t j = 0; j < r.size(); ++j)
        if (robust.weight[j] > 0 && robust.influence(robust.weight[j] * r[j] * r[j]).weight < kOutlier)
            result.push_back(j);
    return result;
}

}  // namespace brdfit::optim
