// Data at the extremes: every fit is refused with a reason, or as good as a judge of its own can make it.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>
#include <map>
#include <ostream>
#include <set>
#include <tuple>

#include "optim/statistics.h"
#include "tests/fits/fitting.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using kernels::Scale;
using optim::Channel;
using optim::Dataset;
using optim::Fit;
using optim::FitOptions;
using optim::Interval;
using optim::Loss;
using optim::ModelRequest;
using optim::Report;
using optim::StopReason;
using optim::Unit;

const std::vector<std::string> kModels{"lambert", "phong", "ward", "lafortune_1", "lafortune_2", "he_torrance"};

/// Judges a fit from the model's values alone: residuals, their differences, Levenberg and Marquardt's steps within the
/// bounds, random probes. Coordinates are the model's parameters, in their logarithm where the model declares it, and
/// the logarithm of the scale where that is unknown.
class Judge {
public:
    Judge(const kernels::Model& model, const ModelRequest& request, const Channel& channel, Unit unit, Loss loss,
          double scale)
        : model_(model),
          weighted_(optim::weigh(channel, loss)),
          bounds_(optim::parameter_bounds(model, request, channel)),
          scale_(scale),
          evaluator_(engine(), model, engine().best_precision(), directions_of(channel), {}, {}) {
        smallest_ = std::numeric_limits<double>::infinity();
        for (const auto& s : channel.samples) {
            largest_ = std::max(largest_, std::abs(s.brdf));
            if (s.brdf != 0) smallest_ = std::min(smallest_, std::abs(s.brdf));
        }
        if (!std::isfinite(smallest_)) smallest_ = 1;
        free_scale_ = unit == Unit::relative && model.name == "he_torrance";
        for (std::size_t i = 0; i < bounds_.size(); ++i) {
            if (unit == Unit::relative && !free_scale_ && model.is_linear(i) && !bounds_[i].fixed())
                bounds_[i].max = model.parameters[i].domain_max;
            logarithmic_.push_back(model.parameters[i].scale == Scale::logarithmic && bounds_[i].min > 0);
        }
    }

    static std::vector<Direction> directions_of(const Channel& channel) {
        std::vector<Direction> directions;
        for (const auto& s : channel.samples) directions.push_back(s.direction);
        return directions;
    }

    [[nodiscard]] const std::vector<Interval>& bounds() const { return bounds_; }
    /// Of the measured values.
    [[nodiscard]] double largest() const { return largest_; }
    [[nodiscard]] double norm2() const { return weighted_.norm > 0 ? weighted_.norm * weighted_.norm : 1.0; }

    std::vector<double> coordinates(const std::vector<double>& parameters) const {
        std::vector<double> z = parameters;
        for (std::size_t i = 0; i < z.size(); ++i)
            if (logarithmic_[i]) z[i] = std::log(z[i]);
        if (free_scale_) z.push_back(std::log(scale_));
        return z;
    }

    /// Residuals times the root of their weight, at each of the points.
    std::vector<std::vector<double>> residuals(const std::vector<std::vector<double>>& points) {
        std::vector<double> all;
        std::vector<std::vector<double>> parameters;
        for (const auto& z : points) {
            parameters.emplace_back();
            for (std::size_t i = 0; i < bounds_.size(); ++i)
                parameters.back().push_back(
                    std::clamp(logarithmic_[i] ? std::exp(z[i]) : z[i], bounds_[i].min, bounds_[i].max));
            all.insert(all.end(), parameters.back().begin(), parameters.back().end());
        }
        const std::vector<double> terms = evaluator_.terms(all);
        const std::size_t n = evaluator_.samples();
        const std::size_t stride = model_.term_values() * n;
        std::vector<std::vector<double>> result;
        for (std::size_t b = 0; b < points.size(); ++b) {
            const std::vector<double> c = model_.coefficients(parameters[b]);
            std::vector<double> f(n, 0.0);
            std::size_t row = b * stride;
            for (std::size_t t = 0; t < c.size(); ++t) {
                for (std::size_t j = 0; j < n; ++j) f[j] += c[t] * terms[row + j];
                row += (1 + model_.terms[t].of.size()) * n;
            }
            const double s = free_scale_ ? std::exp(points[b].back()) : scale_;
            for (double& value : f) value *= s;
            std::vector<double> r = optim::residuals(weighted_, f).r;
            for (std::size_t j = 0; j < n; ++j) r[j] *= std::sqrt(weighted_.weight[j]);
            result.push_back(std::move(r));
        }
        return result;
    }

    static double sum2(const std::vector<double>& r) {
        double sum = 0;
        for (const double x : r) sum += x * x;
        return sum;
    }

    double loss2(const std::vector<double>& z) { return sum2(residuals({z})[0]); }

    /// d residual/d z, a row a coordinate; a coordinate whose bounds leave no room has zeros.
    std::vector<std::vector<double>> jacobian(const std::vector<double>& z) {
        std::vector<std::vector<double>> points;
        std::vector<double> widths;
        for (std::size_t i = 0; i < z.size(); ++i) {
            const double h = difference(z, i);
            std::vector<double> high = z;
            std::vector<double> low = z;
            high[i] = std::min(z[i] + h, upper(i));
            low[i] = std::max(z[i] - h, lower(i));
            widths.push_back(high[i] - low[i]);
            points.push_back(high);
            points.push_back(low);
        }
        const auto r = residuals(points);
        std::vector<std::vector<double>> rows;
        for (std::size_t i = 0; i < z.size(); ++i) {
            rows.emplace_back(r[0].size(), 0.0);
            if (widths[i] > 0)
                for (std::size_t j = 0; j < rows.back().size(); ++j)
                    rows.back()[j] = (r[2 * i][j] - r[2 * i + 1][j]) / widths[i];
        }
        return rows;
    }

    /// The least loss^2 that steps from z reach.
    double descend(std::vector<double> z, int rounds = 40) {
        std::vector<double> r = residuals({z})[0];
        double best = sum2(r);
        double damping = 1e-3;
        for (int round = 0; round < rounds && damping < 1e9; ++round) {
            const auto rows = jacobian(z);
            const std::size_t d = z.size();
            std::vector<double> g(d, 0.0);
            std::vector<std::vector<double>> a(d, std::vector<double>(d, 0.0));
            for (std::size_t i = 0; i < d; ++i)
                for (std::size_t j = 0; j < r.size(); ++j) g[i] -= rows[i][j] * r[j];
            for (std::size_t i = 0; i < d; ++i)
                for (std::size_t k = 0; k < d; ++k)
                    for (std::size_t j = 0; j < r.size(); ++j) a[i][k] += rows[i][j] * rows[k][j];
            bool stepped = false;
            for (int attempt = 0; attempt < 8 && !stepped && damping < 1e9; ++attempt) {
                std::vector<double> next = z;
                const std::vector<double> step = solve(a, g, damping, z);
                for (std::size_t i = 0; i < d; ++i) next[i] = std::clamp(z[i] + step[i], lower(i), upper(i));
                std::vector<double> r_next = residuals({next})[0];
                const double value = sum2(r_next);
                if (value < best) {
                    stepped = value < best * (1 - 1e-12);
                    z = next;
                    r = std::move(r_next);
                    best = value;
                    damping = std::max(damping / 10, 1e-12);
                    if (!stepped) return best;
                } else {
                    damping *= 8;
                }
            }
            if (!stepped) break;
        }
        return best;
    }

    /// The least loss^2 at random points about z.
    double probe(const std::vector<double>& z, Random& random) {
        std::vector<std::vector<double>> points;
        for (const double size : {1e-2, 1e-3, 1e-4})
            for (int i = 0; i < 40; ++i) {
                std::vector<double> point = z;
                for (std::size_t k = 0; k < z.size(); ++k) {
                    const double unit = k >= bounds_.size() || logarithmic_[k] ? 1.0 : std::max(std::abs(z[k]), 1e-3);
                    point[k] = std::clamp(z[k] + size * unit * random.normal(), lower(k), upper(k));
                }
                points.push_back(std::move(point));
            }
        double least = std::numeric_limits<double>::infinity();
        for (const auto& r : residuals(points)) least = std::min(least, sum2(r));
        return least;
    }

    /// A random start within the typical ranges, linear parameters near the data.
    std::vector<double> random_start(Random& random) {
        std::vector<double> p;
        for (std::size_t i = 0; i < bounds_.size(); ++i) {
            const kernels::Parameter& parameter = model_.parameters[i];
            double value = random.on_scale(parameter.scale, parameter.typical_min, parameter.typical_max);
            if (model_.is_linear(i)) value = weighted_.logarithmic ? smallest_ : weighted_.norm * random.uniform(0, 1);
            p.push_back(std::clamp(value, bounds_[i].min, bounds_[i].max));
        }
        return coordinates(p);
    }

    /// How far the residuals move over the parameter's interval, or an e-fold of it, at first order.
    double effect(const std::vector<double>& z, std::size_t i) {
        return std::sqrt(sum2(jacobian(z)[i])) * (logarithmic_[i] ? 1.0 : std::max(std::abs(z[i]), 1.0));
    }

private:
    double lower(std::size_t i) const {
        if (i >= bounds_.size()) return std::log(scale_) - 30;
        return logarithmic_[i] ? std::log(bounds_[i].min) : bounds_[i].min;
    }
    double upper(std::size_t i) const {
        if (i >= bounds_.size()) return std::log(scale_) + 30;
        return logarithmic_[i] ? std::log(bounds_[i].max) : bounds_[i].max;
    }
    double difference(const std::vector<double>& z, std::size_t i) const {
        if (i >= bounds_.size() || logarithmic_[i]) return 1e-5;
        if (model_.is_linear(i)) return 1e-4 * std::max(std::abs(z[i]), 1e-2 * smallest_);
        return 1e-6 * std::max(std::abs(z[i]), 1e-2);
    }
    /// (A + damping diag A) x = g over the coordinates that are not pushed out of their bounds.
    std::vector<double> solve(std::vector<std::vector<double>> a, std::vector<double> g, double damping,
                              const std::vector<double>& z) const {
        const std::size_t d = g.size();
        for (std::size_t i = 0; i < d; ++i) {
            const bool held = (z[i] <= lower(i) && g[i] < 0) || (z[i] >= upper(i) && g[i] > 0) || !(a[i][i] > 0);
            if (!held) continue;
            for (std::size_t k = 0; k < d; ++k) a[i][k] = a[k][i] = 0;
            a[i][i] = 1;
            g[i] = 0;
        }
        std::vector<double> size(d);
        for (std::size_t i = 0; i < d; ++i) size[i] = std::sqrt(a[i][i]);
        for (std::size_t i = 0; i < d; ++i) {
            g[i] /= size[i];
            for (std::size_t k = 0; k < d; ++k) a[i][k] /= size[i] * size[k];
            a[i][i] = 1 + damping;
        }
        for (std::size_t i = 0; i < d; ++i)  // positive definite: no pivots needed
            for (std::size_t k = i + 1; k < d; ++k) {
                const double factor = a[k][i] / a[i][i];
                for (std::size_t j = i; j < d; ++j) a[k][j] -= factor * a[i][j];
                g[k] -= factor * g[i];
            }
        for (std::size_t i = d; i-- > 0;) {
            for (std::size_t k = i + 1; k < d; ++k) g[i] -= a[i][k] * g[k];
            g[i] /= a[i][i];
        }
        for (std::size_t i = 0; i < d; ++i) g[i] /= size[i];
        return g;
    }

    const kernels::Model& model_;
    optim::Weighted weighted_;
    std::vector<Interval> bounds_;
    double scale_;
    kernels::Evaluator evaluator_;
    std::vector<bool> logarithmic_;
    bool free_scale_ = false;
    double smallest_ = 1;
    double largest_ = 0;
};

bool mentions(const std::vector<std::string>& warnings, const std::string& name) {
    return std::any_of(warnings.begin(), warnings.end(), [&](const std::string& warning) {
        std::string text = " " + warning + " ";
        for (char& c : text)
            if (c == ',' || c == ':') c = ' ';
        return text.find(" " + name + " ") != std::string::npos;
    });
}

void expect_numbers(const Fit& fit) {
    for (const auto& p : fit.parameters) {
        EXPECT_TRUE(std::isfinite(p.value)) << p.name;
        EXPECT_TRUE(std::isfinite(p.std_error.value_or(0)) && p.std_error.value_or(0) >= 0) << p.name;
        EXPECT_FALSE((p.at_bound || p.fixed) && p.std_error) << p.name;
        EXPECT_TRUE(p.std_error || p.fixed || mentions(fit.warnings, p.name)) << p.name << ": no word of it";
    }
    for (const double value : {fit.loss, fit.relative_loss, fit.rmse, fit.bic, fit.aicc.value_or(0),
                               fit.log10_rmse.value_or(0), fit.scale.value_or(1)})
        EXPECT_TRUE(std::isfinite(value));
    for (const auto& scan : fit.scans) {
        EXPECT_TRUE(std::isfinite(scan.rmse));
        EXPECT_TRUE(std::isfinite(scan.log10_rmse.value_or(0)));
    }
    for (const double value : fit.values) EXPECT_TRUE(std::isfinite(value));
    for (const Fit::Curve& curve : fit.curves)
        for (const double value : curve.brdf) EXPECT_TRUE(std::isfinite(value));
}

struct Tally {
    std::size_t fits = 0, failures = 0;
    std::map<StopReason, std::size_t> stops;
};

/// Fits that say `roundoff` and are short of the optimum by up to 2e-5 of loss^2: along a lobe's edge at a sample, a
/// kink, the second lobe's exponent and the direction of both would have to move together.
const std::set<std::tuple<std::string, Loss, std::string>> kKnownShort{
    {"MirrorOf8Decades", Loss::cosine_l2, "lafortune_2"}};

void expect_sound(const Dataset& dataset, const ModelRequest& request, const Fit& fit, Loss loss, Tally& tally) {
    const Channel& channel = dataset.channels[0];
    const kernels::Model& model = request.variant(std::max<std::size_t>(fit.lobes, 1));
    ++tally.fits;
    ++tally.stops[fit.search.stop_reason];
    expect_numbers(fit);
    Judge judge(model, request, channel, dataset.unit, loss, fit.scale.value_or(1));
    std::vector<double> p = values_of(fit);
    for (std::size_t i = 0; i < p.size(); ++i) {
        p[i] *= optim::to_model_unit(model.parameters[i], channel);
        const Interval bounds = judge.bounds()[i];
        EXPECT_GE(p[i], bounds.min - 1e-12 * std::abs(bounds.min)) << model.parameters[i].name;
        EXPECT_LE(p[i], bounds.max + 1e-12 * std::abs(bounds.max)) << model.parameters[i].name;
        if (fit.parameters[i].fixed) continue;
        if (p[i] == bounds.min || p[i] == bounds.max) {
            EXPECT_TRUE(fit.parameters[i].at_bound) << model.parameters[i].name << " " << p[i];
        }
        const double away = std::min(p[i] - bounds.min, bounds.max - p[i]);
        if (away > 1e-3 * std::max(std::abs(p[i]), 1e-3 * (model.parameters[i].max - model.parameters[i].min))) {
            EXPECT_FALSE(fit.parameters[i].at_bound) << model.parameters[i].name << " " << p[i];
        }
        p[i] = std::clamp(p[i], bounds.min, bounds.max);
    }
    const std::vector<double> z = judge.coordinates(p);
    const double loss2 = fit.loss * fit.loss;
    const double rounding = 1e-22 * judge.norm2();
    EXPECT_NEAR(std::sqrt(judge.loss2(z)), fit.loss, 1e-9 * fit.loss + 1e-11 * std::sqrt(judge.norm2()));
    for (std::size_t i = 0; i < p.size(); ++i)
        EXPECT_FALSE(judge.effect(z, i) == 0 && fit.parameters[i].std_error) << model.parameters[i].name;

    Random random(5);
    const double near = std::min(judge.descend(z), judge.probe(z, random));
    if (fit.search.stop_reason == StopReason::converged) {
        EXPECT_GE(near, loss2 * (1 - 1e-6) - rounding) << "converged, but loss^2 falls by " << 1 - near / loss2;
    }
    // A lobe of 1e-30 needs a refractive index that differs from 1 by less than its last digit.
    if (fit.model == "he_torrance" && dataset.unit == Unit::per_steradian && judge.largest() < 1e-20) return;
    if (fit.search.stop_reason == StopReason::roundoff) {
        const double known = kKnownShort.count({dataset.name, loss, label(fit)}) > 0 ? 2e-5 : 1e-6;
        EXPECT_GE(near, loss2 * (1 - known) - rounding) << "roundoff, but loss^2 falls by " << 1 - near / loss2;
    }
    double far = near;
    const std::size_t descents = count_from("BRDFIT_DESCENTS", long_form() ? 10 : 3);
    for (std::size_t i = 0; i < descents; ++i) far = std::min(far, judge.descend(judge.random_start(random), 25));
    EXPECT_LE(fit.loss, 1.001 * std::sqrt(far) + std::sqrt(rounding)) << "random descents do better";
}

/// Every model under every loss: a fit that is sound, or a reason.
void expect_fitted_or_refused(const Dataset& dataset, const std::vector<Loss>& losses) {
    Tally tally;
    for (const Loss loss : losses) {
        FitOptions options;
        options.loss = loss;
        const auto models = requests(kModels);
        const Report report = fitter().fit(dataset, models, options);
        const optim::ChannelReport& channel = report.channels.at(0);
        EXPECT_EQ(channel.fits.size() + channel.failures.size(), models.size());
        const auto name =
            std::find_if(optim::kLossNames.begin(), optim::kLossNames.end(), [&](const optim::LossName& n) {
                return n.loss == loss;
            })->name;
        double lambert = std::numeric_limits<double>::infinity();
        for (const Fit& fit : channel.fits)
            if (fit.model == "lambert") lambert = fit.loss;
        for (const Fit& fit : channel.fits) {
            SCOPED_TRACE(std::string(name) + ", " + label(fit));
            expect_sound(dataset, request(label(fit)), fit, loss, tally);
            EXPECT_LE(fit.loss, lambert * (1 + 1e-6) + 1e-11 * fit.loss / std::max(fit.relative_loss, 1e-300));
        }
        for (const optim::Failure& failure : channel.failures) {
            ++tally.failures;
            EXPECT_FALSE(failure.reason.empty());
            EXPECT_EQ(failure.reason.find("internal"), std::string::npos) << failure.detail;
        }
    }
    std::printf("%zu fits: %zu converged, %zu roundoff, %zu at a limit; %zu refused\n", tally.fits,
                tally.stops[StopReason::converged], tally.stops[StopReason::roundoff],
                tally.stops[StopReason::evaluation_limit] + tally.stops[StopReason::time_limit], tally.failures);
}

// ---- the datasets ----

/// Scans with steps of 5 degrees, finer about the mirror direction.
std::vector<Direction> sharp_directions(const std::vector<double>& theta_i_deg) {
    std::vector<Direction> directions;
    for (const double theta_i : theta_i_deg) {
        std::set<double> angles;
        for (double theta_r = -80; theta_r <= 80; theta_r += 5) angles.insert(theta_r);
        for (const double away : {0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0, 3.0})
            for (const double sign : {-1.0, 1.0}) angles.insert(theta_i + sign * away);
        for (const double theta_r : angles)
            if (theta_r < 90) directions.push_back({theta_i, theta_r, 0});
    }
    return directions;
}

struct Noise {
    double relative = 0;
    double additive = 0;
};

Channel made(const std::string& name, const std::vector<double>& parameters, const std::vector<Direction>& directions,
             Noise noise = {}, double factor = 1) {
    std::vector<double> y = model_values(variant(name), parameters, directions);
    Random random(17);
    for (double& value : y)
        value = factor * (value * (1 + noise.relative * random.normal()) + noise.additive * random.normal());
    Channel channel = make_channel(directions, y);
    for (auto& s : channel.samples) s.sigma = 0.03 * std::abs(s.brdf) + 1e-3 * factor;
    return channel;
}

Channel level(double value, const std::vector<Direction>& directions) {
    Channel channel = make_channel(directions, std::vector<double>(directions.size(), value));
    for (auto& s : channel.samples) s.sigma = value == 0 ? 1.0 : std::abs(value);
    return channel;
}

const std::vector<Direction> kScans = scan_directions({15, 45, 75}, 6);
const std::vector<double> kLobes{0.3, -1.05, 0.95, 30.0, -1.1, 0.3, 12.0};

struct Extreme {
    std::string name;
    Dataset dataset;
    std::vector<Loss> losses;
};

std::vector<Extreme> extremes() {
    const std::vector<Loss> all{Loss::cosine_l2, Loss::l2, Loss::log, Loss::relative, Loss::chi2};
    const std::vector<Loss> some{Loss::cosine_l2, Loss::log, Loss::relative};
    const auto mirror = sharp_directions({10, 50});
    std::vector<Extreme> result;
    const auto add = [&](const std::string& name, const std::vector<Loss>& losses, Channel channel) {
        result.push_back({name, dataset_of(std::move(channel)), losses});
        result.back().dataset.name = name;
    };
    add("MirrorOf5Decades", all, made("ward", {0.03, 0.5, 0.005}, mirror, {0.02, 0}));
    add("MirrorOf8Decades", some, made("ward", {3e-5, 0.5, 0.003}, mirror, {0.02, 0}));
    add("MirrorOf8DecadesExact", some, made("phong", {3e-5, 0.5, 5e4}, mirror));
    add("MirrorOfRoughMetal", some, made("he_torrance", {0.1, 20.0, 0.96, 6.7, 1e-5}, mirror, {0.02, 0}));
    add("Black", all, made("lafortune_2", kLobes, kScans, {0.03, 0}, 1e-4));
    add("BlackUnderNoise", all, made("lambert", {3e-4}, kScans, {0, 1e-4}));
    add("BlackExact", some, made("ward", {3e-4, 1e-5, 0.2}, kScans));
    add("AllEqual", all, level(0.1, kScans));
    add("AllEqualTiny", some, level(1e-30, kScans));
    add("AllZero", all, level(0, kScans));
    add("AllMinusZero", {Loss::cosine_l2}, level(-0.0, kScans));
    add("AllNegative", some, level(-0.01, kScans));
    add("OneIncidence", some, made("lafortune_2", kLobes, scan_directions({30}, 3), {0.02, 0}));
    add("NormalIncidence", some, made("ward", {0.2, 0.1, 0.2}, scan_directions({0}, 3), {0.02, 0}));
    add("Tiny", all, made("lafortune_2", kLobes, kScans, {0.02, 0}, 1e-30));
    add("Huge", all, made("lafortune_2", kLobes, kScans, {0.02, 0}, 1e6));
    add("Grazing", some, made("he_torrance", {0.7, 10.0, 1.5, 0.05, 0.5}, scan_directions({89}, 3), {0.02, 0}));
    add("GrazingExit", some, [&] {
        std::vector<Direction> directions = scan_directions({45, 89}, 8);
        for (const double t : {-89.999, -89.9, 89.9, 89.999}) directions.push_back({45, t, 0});
        return made("ward", {0.2, 0.05, 0.2}, directions, {0.02, 0});
    }());
    add("OneSample", some, level(0.2, {{30, 20, 0}}));
    add("TwoSamples", some, made("ward", {0.2, 0.1, 0.2}, {{30, 30, 0}, {30, -10, 0}}));
    add("ThreeSamples", some, made("ward", {0.2, 0.1, 0.2}, {{30, 30, 0}, {30, 34, 0}, {30, -10, 0}}));
    add("Duplicates", some, [&] {
        std::vector<Direction> directions;
        for (int i = 0; i < 5; ++i)
            for (const double t : {-20.0, 25.0, 32.0}) directions.push_back({30, t, 0});
        return made("ward", {0.2, 0.1, 0.2}, directions, {0.02, 0});
    }());
    add("RetroSideOnly", some, [&] {
        std::vector<Direction> directions;
        for (const Direction& d : kScans)
            if (d.theta_r_deg < 0) directions.push_back(d);
        return made("lafortune_1", {0.1, 1.0, 1.0, 15.0}, directions, {0.02, 0});
    }());
    for (const auto& [name, sigma] : {std::pair{"HugeSigma", 1e30}, std::pair{"TinySigma", 1e-30}}) {
        Channel channel = made("ward", {0.2, 0.1, 0.2}, kScans, {0.02, 0});
        for (auto& s : channel.samples) s.sigma = sigma;
        add(name, {Loss::chi2}, std::move(channel));
    }
    {
        Channel channel = made("ward", {0.2, 0.1, 0.2}, kScans, {0.02, 0});
        for (std::size_t j = 0; j < channel.samples.size(); j += 2) channel.samples[j].sigma = 1e200;
        add("VanishingWeights", {Loss::chi2}, std::move(channel));
    }
    add("OneOutlier", some, [&] {
        Channel channel = made("ward", {0.2, 0.1, 0.2}, kScans, {0.02, 0});
        channel.samples[20].brdf = 1e6;
        return channel;
    }());
    add("Relative", some, made("he_torrance", {0.7, 10.0, 1.5, 0.05, 0.5}, kScans, {0.02, 0}, 37));
    add("RelativeTiny", some, made("lafortune_2", kLobes, kScans, {0.02, 0}, 1e-30));
    add("RelativeZero", some, level(0, kScans));
    for (Extreme& extreme : result)
        if (extreme.name.rfind("Relative", 0) == 0) extreme.dataset.unit = Unit::relative;
    return result;
}

void PrintTo(const Extreme& extreme, std::ostream* out) { *out << extreme.name; }

class Extremes : public testing::TestWithParam<Extreme> {};
INSTANTIATE_TEST_SUITE_P(Datasets, Extremes, testing::ValuesIn(extremes()),
                         [](const auto& parameter) { return parameter.param.name; });

TEST_P(Extremes, AreFittedOrRefusedWithAReason) { expect_fitted_or_refused(GetParam().dataset, GetParam().losses); }

// ---- data in another unit ----

/// The fit of factor * y is that of y with its heights multiplied, where no upper bound is in the way.
TEST(ScaleOfTheData, IsTheScaleOfTheFit) {
    struct Case {
        std::string model;
        std::vector<double> parameters;
    };
    const std::vector<Case> cases{{"lambert", {0.3}},
                                  {"phong", {0.3, 0.2, 67.8}},
                                  {"ward", {0.2, 0.1, 0.2}},
                                  {"lafortune_1", {0.1, -1.02, 0.98, 50.0}}};
    for (const auto& [name, parameters] : cases) {
        const kernels::Model& model = variant(name);
        ModelRequest wide = request(name);
        for (std::size_t i = 0; i < model.parameters.size(); ++i)
            if (model.is_linear(i)) wide.bounds[model.parameters[i].name] = {0, 1e12};
        for (const optim::LossName& loss : optim::kLossNames) {
            FitOptions options;
            options.loss = loss.loss;
            const Channel channel = made(name, parameters, kScans, {0.05, 0});
            const Fit fit = only(fitter().fit(dataset_of(channel), {wide}, options));
            for (const double factor : {1e-30, 1e-4, 1e6}) {
                SCOPED_TRACE(name + ", " + std::string(loss.name) + ", times " + std::to_string(factor));
                Channel scaled = channel;
                for (auto& s : scaled.samples) {
                    s.brdf *= factor;
                    s.sigma = *s.sigma * factor;
                }
                const Fit other = only(fitter().fit(dataset_of(scaled), {wide}, options));
                EXPECT_NEAR(other.relative_loss, fit.relative_loss, 1e-9 * fit.relative_loss);
                EXPECT_EQ(other.search.stop_reason, fit.search.stop_reason);
                for (std::size_t i = 0; i < parameters.size(); ++i) {
                    const bool length = model.parameters[i].name.rfind("c_", 0) == 0;
                    const double n = fit.parameters.back().value;
                    const double expected = fit.parameters[i].value * (model.is_linear(i) ? factor
                                                                       : length           ? std::pow(factor, 1 / n)
                                                                                          : 1);
                    EXPECT_NEAR(other.parameters[i].value, expected, 2e-5 * std::abs(expected))
                        << model.parameters[i].name;
                    EXPECT_EQ(other.parameters[i].at_bound, fit.parameters[i].at_bound) << model.parameters[i].name;
                }
            }
        }
    }
}

/// Single precision holds neither 1e-60 nor 1e60, which are squares of such data.
TEST(ScaleOfTheData, IsNoMatterInSinglePrecision) {
    FitOptions options;
    options.precision = kernels::Precision::single_precision;
    const Channel channel = made("ward", {0.2, 0.1, 0.2}, kScans, {0.02, 0});
    for (const Loss loss : {Loss::cosine_l2, Loss::log, Loss::relative, Loss::chi2}) {
        options.loss = loss;
        const Fit fit = only(fitter().fit(dataset_of(channel), {request("ward")}, options));
        Channel scaled = channel;
        for (auto& s : scaled.samples) {
            s.brdf *= 1e-30;
            s.sigma = *s.sigma * 1e-30;
        }
        const Fit other = only(fitter().fit(dataset_of(scaled), {request("ward")}, options));
        EXPECT_NEAR(other.relative_loss, fit.relative_loss, 1e-4 * fit.relative_loss);
        EXPECT_NEAR(other.parameters[2].value, fit.parameters[2].value, 1e-3 * fit.parameters[2].value);
    }
}

/// Where residuals add to the curvature, by the scale as well.
TEST(ScaleOfTheData, IsNoMatterForStandardErrorsOfRelativeData) {
    optim::Dataset dataset = dataset_of(made("phong", {0.3, 0.2, 67.8}, kScans, {0.001, 0}));
    dataset.unit = optim::Unit::relative;
    const Fit fit = only(fitter().fit(dataset, {request("he_torrance")}, {}));
    for (auto& s : dataset.channels[0].samples) {
        s.brdf *= 1.5;
        s.sigma = *s.sigma * 1.5;
    }
    const Fit other = only(fitter().fit(dataset, {request("he_torrance")}, {}));
    EXPECT_NEAR(*other.scale, 1.5 * *fit.scale, 1e-4 * *fit.scale);
    std::size_t told = 0;
    for (std::size_t i = 0; i < fit.parameters.size(); ++i) {
        const auto& error = fit.parameters[i].std_error;
        ASSERT_EQ(error.has_value(), other.parameters[i].std_error.has_value()) << fit.parameters[i].name;
        if (!error) continue;
        ++told;
        EXPECT_NEAR(*other.parameters[i].std_error, *error, 1e-3 * *error) << fit.parameters[i].name;
    }
    EXPECT_GE(told, 2);
}

// ---- what is said of bounds ----

std::string all_of(const std::vector<std::string>& warnings) {
    std::string text;
    for (const std::string& warning : warnings) text += warning + "\n";
    return text;
}

TEST(BoundsInWords, SayWhoseTheyAre) {
    const auto directions = scan_directions({15, 45, 75}, 6);
    const Dataset bright = dataset_of(make_channel(directions, std::vector<double>(directions.size(), 5.0)));
    EXPECT_NE(all_of(only(fitter().fit(bright, {request("lambert")}, {})).warnings)
                  .find("k_d stands at its default "
                        "bound 1\n"),
              std::string::npos);
    const Dataset ward = dataset_of(made("ward", {0.2, 0.1, 0.2}, directions, {0.02, 0}));
    ModelRequest narrow = request("ward");
    narrow.bounds = {{"alpha", {0.3, 1}}};
    const Fit fit = only(fitter().fit(ward, {narrow}, {}));
    EXPECT_TRUE(fit.parameters[2].at_bound);
    EXPECT_FALSE(fit.parameters[2].std_error);
    EXPECT_NE(all_of(fit.warnings).find("alpha stands at its bound in the request, 0.3\n"), std::string::npos);
}

TEST(BoundsInWords, AZeroIsNaturalAndALobeOfZeroIsNamed) {
    const auto directions = scan_directions({15, 45, 75}, 6);
    const Dataset dark = dataset_of(make_channel(directions, std::vector<double>(directions.size(), -0.01)));
    const Fit fit = only(fitter().fit(dark, {request("ward")}, {}));
    const std::string words = all_of(fit.warnings);
    EXPECT_NE(words.find("rho_s stands at its natural limit 0\n"), std::string::npos) << words;
    EXPECT_NE(words.find("the data do not determine alpha\n"), std::string::npos) << words;
    EXPECT_NE(words.find("lobe is zero at every sample\n"), std::string::npos) << words;
}

}  // namespace
}  // namespace brdfit::tests
