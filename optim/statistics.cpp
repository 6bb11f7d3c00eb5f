#include "optim/statistics.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include <Eigen/Dense>  // small dense symmetric problems: eigenvalues tell what the data do not determine

namespace brdfit::optim {
namespace {

/// Root mean squares of f - y and of log10(f/y).
struct Errors {
    double sum2 = 0, log_sum2 = 0;
    std::size_t count = 0, log_count = 0;

    void add(double f, double y) {
        sum2 += (f - y) * (f - y);
        ++count;
        if (f > 0 && y > 0) {
            const double decades = std::log10(f / y);
            log_sum2 += decades * decades;
            ++log_count;
        }
    }
    [[nodiscard]] double rmse() const { return std::sqrt(sum2 / static_cast<double>(count)); }
    [[nodiscard]] std::optional<double> log10_rmse() const {
        if (log_count == 0) return std::nullopt;
        return std::sqrt(log_sum2 / static_cast<double>(log_count));
    }
};

}  // namespace

Residuals residuals(const Weighted& weighted, std::span<const double> f) {
    Residuals result;
    for (std::size_t j = 0; j < f.size(); ++j) {
        double r = 0;
        double by_f = 0;
        if (weighted.weight[j] > 0 && weighted.logarithmic) {
            const double floored = std::max(f[j], std::numeric_limits<double>::min());
            r = std::log(floored) - weighted.y[j];
            by_f = 1 / floored;
        } else if (weighted.weight[j] > 0) {
            r = f[j] - weighted.y[j];
            by_f = 1;
        }
        result.loss2 += weighted.influence(weighted.weight[j] * r * r).loss;
        result.r.push_back(r);
        result.by_f.push_back(by_f);
    }
    return result;
}

void describe_errors(const Channel& channel, const Weighted& weighted, std::size_t free, Fit& fit) {
    Errors all;
    std::map<double, Errors> by_angle;
    for (std::size_t j = 0; j < channel.samples.size(); ++j) {
        const Sample& sample = channel.samples[j];
        if (sample.weight < 1) continue;
        all.add(fit.values[j], sample.brdf);
        by_angle[sample.direction.theta_i_deg].add(fit.values[j], sample.brdf);
    }
    fit.rmse = all.rmse();
    fit.log10_rmse = all.log10_rmse();
    for (const auto& [theta_i_deg, errors] : by_angle)
        fit.scans.push_back({theta_i_deg, errors.rmse(), errors.log10_rmse()});

    // Gaussian noise of unknown size under the loss's weights: -2 ln L = n ln loss^2 + constant; it counts as one
    // parameter. A loss that is rounding is held at rounding's size: no evidence, and a finite logarithm.
    const auto n = static_cast<double>(weighted.used);
    const double k = static_cast<double>(free) + 1;
    constexpr double kRounding = 1e-14;  // of the data
    const double loss = std::max(fit.loss, kRounding * weighted.norm);
    double deviance = n * std::log(std::max(loss * loss, std::numeric_limits<double>::min()));
    // The scale of a robust loss is common to all models: -2 ln L = 2 sum rho (Ronchetti 1985).
    if (weighted.robust != Robust::none) deviance = (fit.loss / weighted.scale) * (fit.loss / weighted.scale);
    if (n > k + 1) fit.aicc = deviance + 2 * k + 2 * k * (k + 1) / (n - k - 1);
    fit.bic = deviance + k * std::log(n);
}

std::vector<std::optional<double>> standard_errors(const Weighted& weighted, const Residuals& residuals,
                                                   const std::vector<std::vector<double>>& jacobian) {
    const auto p = static_cast<Eigen::Index>(jacobian.size());
    std::vector<std::optional<double>> result(jacobian.size());
    if (p == 0 || weighted.used <= jacobian.size()) return result;

    // Rows sqrt(w) dr/dp, each parameter scaled to unit length.
    const auto n = static_cast<Eigen::Index>(residuals.r.size());
    Eigen::MatrixXd rows(n, p);
    for (Eigen::Index j = 0; j < n; ++j)
        for (Eigen::Index i = 0; i < p; ++i) {
            const auto js = static_cast<std::size_t>(j);
            rows(j, i) =
                std::sqrt(weighted.weight[js]) * residuals.by_f[js] * jacobian[static_cast<std::size_t>(i)][js];
        }
    const Eigen::VectorXd size = rows.colwise().norm();
    for (Eigen::Index i = 0; i < p; ++i)
        if (size(i) > 0) rows.col(i) /= size(i);
    if (!rows.allFinite()) return result;

    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(rows.transpose() * rows);
    constexpr double kUndetermined = 1e-11;  // relative to unit columns: below, a direction is rounding noise
    Eigen::VectorXd inverse = eigen.eigenvalues();
    std::vector<bool> determined(jacobian.size(), true);
    for (Eigen::Index e = 0; e < p; ++e) {
        if (inverse(e) > kUndetermined) {
            inverse(e) = 1 / inverse(e);
            continue;
        }
        inverse(e) = 0;
        for (Eigen::Index i = 0; i < p; ++i)
            if (std::abs(eigen.eigenvectors()(i, e)) > 1e-3) determined[static_cast<std::size_t>(i)] = false;
    }
    const Eigen::MatrixXd a_inverse = eigen.eigenvectors() * inverse.asDiagonal() * eigen.eigenvectors().transpose();
    Eigen::MatrixXd b = Eigen::MatrixXd::Zero(p, p);
    for (Eigen::Index j = 0; j < n; ++j) {
        const auto js = static_cast<std::size_t>(j);
        const double leverage = rows.row(j) * a_inverse * rows.row(j).transpose();
        const double r = std::sqrt(weighted.weight[js]) * residuals.r[js] / std::max(1 - leverage, 0.05);
        b += r * r * rows.row(j).transpose() * rows.row(j);
    }
    const Eigen::MatrixXd covariance = a_inverse * b * a_inverse;
    for (Eigen::Index i = 0; i < p; ++i) {
        const double error = std::sqrt(std::max(covariance(i, i), 0.0)) / size(i);
        if (determined[static_cast<std::size_t>(i)] && size(i) > 0 && std::isfinite(error))
            result[static_cast<std::size_t>(i)] = error;
    }
    return result;
}

}  // namespace brdfit::optim
