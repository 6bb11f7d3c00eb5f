#include "optim/statistics.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>

#include <boost/math/distributions/normal.hpp>
#include <boost/math/distributions/students_t.hpp>

#include <fmt/format.h>

namespace brdfit::optim {
namespace {

/// Root mean squares of f - y and of log10(f/y).
struct Errors {
    double sum2 = 0, log_sum2 = 0;
    std::size_t count = 0, log_count = 0;

    void add(double f, double y) {
        sum2 += (f - y) * (f - y);
        ++count;
        if (y > 0) {
            // As the loss log has it: a model that is 0 where the surface is not is off by hundreds of decades.
            const double decades = std::log10(std::max(f, std::numeric_limits<double>::min())) - std::log10(y);
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

/// Rounding, as a part of the data: a smaller misfit is no evidence, and its logarithm is to be finite.
constexpr double kRounding = 1e-14;

/// Over all samples, and over those of each incidence angle.
Errors errors_of(const Channel& channel, std::span<const double> f, std::vector<ScanError>& by_angle) {
    Errors all;
    std::map<double, Errors> angles;
    for (std::size_t j = 0; j < channel.samples.size(); ++j) {
        const Sample& sample = channel.samples[j];
        if (sample.weight < 1) continue;
        all.add(f[j], sample.brdf);
        angles[sample.direction.theta_i_deg].add(f[j], sample.brdf);
    }
    for (const auto& [theta_i_deg, errors] : angles)
        by_angle.push_back({theta_i_deg, errors.rmse(), errors.log10_rmse()});
    return all;
}

}  // namespace

Residuals residuals(const Weighted& weighted, std::span<const double> f) {
    Residuals result;
    result.r.resize(f.size());
    result.by_f.resize(f.size());
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
        result.r[j] = r;
        result.by_f[j] = by_f;
    }
    return result;
}

void describe_errors(const Channel& channel, Fit& fit) {
    const Errors all = errors_of(channel, fit.values, fit.scans);
    fit.rmse = all.rmse();
    fit.log10_rmse = all.log10_rmse();
    const auto dark = std::count_if(channel.samples.begin(), channel.samples.end(), [&](const Sample& sample) {
        return sample.weight == 1 && sample.brdf > 0 &&
               !(fit.values[static_cast<std::size_t>(&sample - channel.samples.data())] > 0);
    });
    if (dark > 0)
        fit.warnings.push_back(
            fmt::format("the model is 0 or less at {} of {} samples that are not: in decades it is nowhere near", dark,
                        channel.samples.size()));
}

HeldOut held_out_errors(const Channel& channel, const Weighted& weighted, std::span<const double> predicted) {
    HeldOut result;
    const Errors all = errors_of(channel, predicted, result.angles);
    result.rmse = all.rmse();
    result.log10_rmse = all.log10_rmse();
    result.loss = std::sqrt(residuals(weighted, predicted).loss2);
    return result;
}

Weighted weigh_by(const Channel& channel, std::span<const double> sigma) {
    Weighted result;
    result.used = channel.samples.size();
    double norm2 = 0;
    for (std::size_t j = 0; j < sigma.size(); ++j) {
        const double y = channel.samples[j].brdf;
        result.y.push_back(y);
        result.weight.push_back(channel.samples[j].weight / (sigma[j] * sigma[j]));
        norm2 += result.weight[j] * y * y;
    }
    result.norm = std::sqrt(norm2);
    return result;
}

double deviance(const Channel& channel, std::span<const double> sigma, double chi2, double norm) {
    double n = 0;
    double sizes = 0;
    for (std::size_t j = 0; j < sigma.size(); ++j) {
        const double weight = channel.samples[j].weight;
        n += weight;
        sizes += weight * 2 * std::log(sigma[j]);
    }
    const double held = chi2 + kRounding * kRounding * norm * norm;
    return n * std::log(2 * std::numbers::pi * std::max(held / n, std::numeric_limits<double>::min())) + sizes + n;
}

double deviance(const Weighted& weighted, double loss) {
    const double held = std::max(loss, kRounding * weighted.norm);
    return static_cast<double>(weighted.used) * std::log(std::max(held * held, std::numeric_limits<double>::min()));
}

void describe_evidence(double deviance, std::size_t samples, std::size_t free, Fit& fit) {
    const auto n = static_cast<double>(samples);
    const double k = static_cast<double>(free) + 1;
    fit.aicc.reset();
    if (n > k + 1) fit.aicc = deviance + 2 * k + 2 * k * (k + 1) / (n - k - 1);
    fit.bic = deviance + k * std::log(n);
}

double standard_errors_of_interval(double degrees) {
    constexpr double kUpper = (1 + kConfidence) / 2;
    if (!std::isfinite(degrees)) return boost::math::quantile(boost::math::normal(), kUpper);
    // In double alone: long double would take most of the time of a small fit's standard errors.
    using Policy = boost::math::policies::policy<boost::math::policies::promote_double<false>>;
    return boost::math::quantile(boost::math::students_t_distribution<double, Policy>(std::max(degrees, 1.0)), kUpper);
}

}  // namespace brdfit::optim
