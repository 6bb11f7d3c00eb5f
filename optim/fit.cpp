#include "optim/fit.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <future>
#include <iterator>
#include <list>
#include <mutex>
#include <numbers>
#include <set>
#include <tuple>

#include <fmt/format.h>
#include <boost/asio/post.hpp>  // a kept thread pool
#include <boost/asio/thread_pool.hpp>

#include "kernels/evaluator.h"
#include "kernels/hemisphere.h"
#include "optim/broker.h"
#include "optim/constrained.h"
#include "optim/crossvalidation.h"
#include "optim/ledger.h"
#include "optim/noise.h"
#include "optim/optimum.h"
#include "optim/physics.h"
#include "optim/refit.h"
#include "optim/robust.h"
#include "optim/statistics.h"
#include "optim/uncertainty.h"

namespace brdfit::optim {
namespace {

using Clock = std::chrono::steady_clock;
using kernels::Model;

/// Data of a smaller rms are refused: losses are told in the data's own unit.
constexpr double kSmallestData = 1e-100;
/// Parts of the data's size that are rounding.
constexpr double kUnseen = 1e-12;
/// A search's loss that its reported parameters miss by this part was found beyond their digits.
constexpr double kReproduced = 1e-6;
/// More outliers than this part of the samples are worth a warning.
constexpr double kManyOutliers = 0.1;
/// A further lobe is reported only if the BIC falls by this much: "very strong" evidence (Kass and Raftery 1995).
constexpr double kEvidence = 10;

std::vector<kernels::Direction> directions_of(const Channel& channel) {
    std::vector<kernels::Direction> directions;
    for (const Sample& sample : channel.samples) directions.push_back(sample.direction);
    return directions;
}

bool same_directions(const Channel& channel, const kernels::DirectionSet& directions) {
    return std::equal(
        channel.samples.begin(), channel.samples.end(), directions.directions().begin(), directions.directions().end(),
        [](const Sample& sample, const kernels::Direction& direction) { return sample.direction == direction; });
}

std::size_t free_parameters(const std::vector<Interval>& bounds) {
    return static_cast<std::size_t>(
        std::count_if(bounds.begin(), bounds.end(), [](const Interval& b) { return !b.fixed(); }));
}

/// A model of which every term has a free height cannot tell the scale of relative data.
bool knows_scale(const Model& model) {
    return std::any_of(model.terms.begin(), model.terms.end(),
                       [](const kernels::Term& term) { return !term.factor && !term.homogeneous; });
}

/// Root mean square of the data, [1/sr].
double data_rms(const Channel& channel) {
    double largest = 0;
    for (const Sample& sample : channel.samples) largest = std::max(largest, std::abs(sample.brdf));
    if (largest == 0) return 0;
    double sum = 0;  // of squares that neither overflow nor vanish
    for (const Sample& sample : channel.samples) sum += (sample.brdf / largest) * (sample.brdf / largest);
    return largest * std::sqrt(sum / static_cast<double>(channel.samples.size()));
}

/// A power of two near the data's rms, so that dividing by it rounds nothing.
double data_unit(const Channel& channel) {
    const double rms = data_rms(channel);
    return rms > 0 ? std::exp2(std::round(std::log2(rms))) : 1.0;
}

/// The scale of a perfectly white diffuser with the data's rms.
double white_scale(const Channel& channel) {
    const double rms = data_rms(channel);
    return rms > 0 ? std::numbers::pi * rms : 1.0;
}

Channel divided(Channel channel, double scale) {
    for (Sample& sample : channel.samples) {
        sample.brdf /= scale;
        if (sample.sigma) *sample.sigma /= scale;
    }
    return channel;
}

/// The angles of a curve: even steps over the channel's range, finer about the mirror direction.
std::vector<double> curve_angles(const Channel& channel, double theta_i_deg) {
    double low = 90;
    double high = -90;
    for (const Sample& sample : channel.samples) {
        const kernels::Direction d = canonical(sample.direction);
        if (d.phi_deg != 0) continue;
        low = std::min(low, d.theta_r_deg);
        high = std::max(high, d.theta_r_deg);
    }
    std::vector<double> angles{low, high};
    const auto add = [&](double from, double to, int steps) {
        for (int i = 0; i <= steps; ++i) {
            const double angle = from + (to - from) * i / steps;
            if (angle >= low && angle <= high) angles.push_back(angle);
        }
    };
    add(low, high, 160);
    add(theta_i_deg - 5, theta_i_deg + 5, 100);
    add(theta_i_deg - 0.5, theta_i_deg + 0.5, 50);
    std::sort(angles.begin(), angles.end());
    angles.erase(std::unique(angles.begin(), angles.end()), angles.end());
    return angles;
}

/// What of a channel depends on directions alone; channels with the same directions share it.
struct Directions {
    explicit Directions(const Channel& channel) : samples(directions_of(channel)), curve_points(curves_of(channel)) {}

    kernels::DirectionSet samples;
    std::vector<Fit::Curve> curves;  ///< without values
    kernels::DirectionSet curve_points;

private:
    std::vector<kernels::Direction> curves_of(const Channel& channel) {
        std::set<double> incidences;
        for (const Sample& sample : channel.samples)
            if (canonical(sample.direction).phi_deg == 0) incidences.insert(sample.direction.theta_i_deg);
        std::vector<kernels::Direction> directions;
        for (const double theta_i_deg : incidences) {
            curves.push_back({theta_i_deg, curve_angles(channel, theta_i_deg), {}});
            for (const double theta_r_deg : curves.back().theta_r_deg)
                directions.push_back({theta_i_deg, theta_r_deg, 0});
        }
        return directions;
    }
};

/// One (channel, model) of a request.
struct Work {
    kernels::Engine& engine;
    const Channel& channel;
    const Directions& directions;
    const Noise& noise;
    Unit unit;
    const ModelRequest& request;
    const FitOptions& options;
    SearchControl control;
};

void add_curves(const Work& work, kernels::Precision precision, const Optimum& optimum, Fit& fit) {
    fit.curves = work.directions.curves;
    const std::vector<double> f = kernels::evaluate(work.engine, *optimum.model, precision, optimum.parameters,
                                                    work.directions.curve_points, false)
                                      .f;
    auto next = f.begin();
    for (Fit::Curve& curve : fit.curves) {
        const auto end = next + static_cast<std::ptrdiff_t>(curve.theta_r_deg.size());
        std::transform(next, end, std::back_inserter(curve.brdf), [&](double value) { return value * optimum.scale; });
        next = end;
    }
}

/// Distinct incidence angles of the data, rising.
std::vector<double> incidence_angles(const Channel& channel) {
    std::set<double> angles;
    for (const Sample& sample : channel.samples) angles.insert(sample.direction.theta_i_deg);
    return {angles.begin(), angles.end()};
}

/// The physics of an optimum.
void add_physics(const Work& work, bool scale_known, const Optimum& optimum, Fit& fit) {
    Judgement judgement =
        judge_physics(work.engine, *optimum.model, optimum.parameters, incidence_angles(work.channel), scale_known);
    fit.albedo = std::move(judgement.albedo);
    fit.physics = judgement.physics;
    for (std::string& warning : judgement.warnings) fit.warnings.push_back(std::move(warning));
}

bool is_at_bound(const kernels::Parameter& parameter, bool linear, Interval bounds, double value) {
    constexpr double kNear = 1e-6;  // of the interval, on the parameter's scale
    // Coefficients are solved for: on a bound they are equal to it, to single precision, and 1e-30 is not 0.
    const auto equals = [&](double bound) {
        return std::isfinite(bound) && std::abs(value - bound) <= kNear * std::abs(bound);
    };
    if (linear) return equals(bounds.min) || equals(bounds.max);
    if (parameter.scale == kernels::Scale::logarithmic && bounds.min > 0) {
        const double range = kNear * std::log(bounds.max / bounds.min);
        return std::log(value / bounds.min) <= range || std::log(bounds.max / value) <= range;
    }
    // Bounds that a request or relative data widen do not make a small value a bound.
    const double range = kNear * std::min(bounds.max - bounds.min, parameter.max - parameter.min);
    return value - bounds.min <= range || bounds.max - value <= range;
}

/// Which bound a parameter stands at, and whose it is; values in the wire's unit.
std::string bound_remark(const kernels::Parameter& parameter, Interval bounds, double value, bool requested,
                         double unit) {
    const double bound = std::abs(value - bounds.min) <= std::abs(value - bounds.max) ? bounds.min : bounds.max;
    const bool natural = bound == parameter.domain_min || bound == parameter.domain_max;
    const char* whose = natural ? "natural limit" : requested ? "bound in the request," : "default bound";
    return fmt::format("{} stands at its {} {:g}", parameter.name, whose, bound / unit);
}

/// Lobes in falling order of their exponent, unless the request speaks of single lobes.
void order_lobes(const Work& work, const Model& model, Point& point) {
    if (model.repeats < 2 || !work.request.bounds.empty() || !work.request.fixed.empty()) return;
    std::vector<std::vector<double>> lobes;
    auto at = point.parameters.begin() + static_cast<std::ptrdiff_t>(model.group_begin);
    for (std::size_t j = 0; j < model.repeats; ++j, at += static_cast<std::ptrdiff_t>(model.group_size))
        lobes.emplace_back(at, at + static_cast<std::ptrdiff_t>(model.group_size));
    std::stable_sort(lobes.begin(), lobes.end(),
                     [&](const auto& a, const auto& b) { return a[model.order_by] > b[model.order_by]; });
    at = point.parameters.begin() + static_cast<std::ptrdiff_t>(model.group_begin);
    for (const auto& lobe : lobes) at = std::copy(lobe.begin(), lobe.end(), at);
}

/// What a search of one variant sees: the data in a unit of their own size, which sets the model's scale. For relative
/// data and a model that does not know the scale, that of a white diffuser, and albedos not bounded above.
struct Prepared {
    Channel channel;
    std::vector<Interval> bounds;
    double unit = 1;   ///< the data's values over the channel's here
    ScaleRange scale;  ///< of the channel here
    bool by_convention = false;
};

Prepared prepare(const Work& work, const Model& model) {
    const double white = white_scale(work.channel);
    const bool relative = work.unit == Unit::relative;
    const bool by_convention = relative && !knows_scale(model);
    const double unit = by_convention ? white : data_unit(work.channel);
    Prepared prepared{divided(work.channel, unit),
                      parameter_bounds(model, work.request, work.channel),
                      unit,
                      {1 / unit, 1 / unit},
                      by_convention};
    if (by_convention) prepared.scale = {1, 1};
    else if (relative) prepared.scale = {1e-6 * white / unit, 1e6 * white / unit};
    if (!by_convention) return prepared;
    for (std::size_t i = 0; i < prepared.bounds.size(); ++i)
        if (model.is_linear(i) && !prepared.bounds[i].fixed() &&
            work.request.bounds.count(model.parameters[i].name) == 0)
            prepared.bounds[i].max = model.parameters[i].domain_max;
    return prepared;
}

/// The unit of a loss's residuals in which prepared data are measured.
double residual_unit(const Work& work, const Prepared& prepared) {
    return has_unit(work.options.loss.kind) ? prepared.unit : 1.0;
}

void add_outliers(const Weighted& weighted, Fit& fit) {
    Outliers found{outliers(weighted, residuals(weighted, fit.values).r), 0};
    if (weighted.used > 0)
        found.fraction = static_cast<double>(found.samples.size()) / static_cast<double>(weighted.used);
    if (found.fraction > kManyOutliers)
        fit.warnings.push_back(
            fmt::format("{} of {} samples are taken as outliers: the model may not follow a part of the surface",
                        found.samples.size(), weighted.used));
    fit.outliers = std::move(found);
}

/// One variant of the model: what its search sees and what it has found. Its parts refer to each other.
struct Variant {
    /// Throws SearchError where the loss cannot weigh these data.
    Variant(const Work& work, const Model& model)
        : prepared(prepare(work, model)),
          weighted(weigh(prepared.channel, work.options.loss)),
          free(free_parameters(prepared.bounds)),
          scale_free(work.unit == Unit::relative && knows_scale(model)),
          task{work.engine,
               model,
               prepared.channel,
               work.directions.samples,
               weighted,
               work.options.precision,
               work.options.effort,
               work.control,
               prepared.scale} {
        if (!std::isfinite(weighted.norm))
            throw SearchError("the weights of this loss overflow: a value or a sigma is too small beside the others");
        for (const double size : work.noise.sigma) sigma.push_back(size / prepared.unit);
    }
    Variant(const Variant&) = delete;
    Variant& operator=(const Variant&) = delete;
    ~Variant() = default;

    [[nodiscard]] bool possible() const { return weighted.used >= free; }
    void require_possible() const {
        if (!possible())
            throw SearchError("too few samples: " + std::to_string(weighted.used) + " usable ones for " +
                              std::to_string(free) + " free parameters");
    }

    Prepared prepared;
    Weighted weighted;          ///< under the loss; once a robust fit is found, squares of its pseudo-values
    std::size_t free;           ///< parameters
    bool scale_free;            ///< the scale is one more
    std::vector<double> sigma;  ///< of the noise; none in a robust fit, whose weights are no noise's
    Task task;
    Optimum optimum;
    std::optional<Refitter> refitter;
    Point likeliest;  ///< by the noise, not by the loss
    Fit fit;
};

/// AICc and BIC: of the model's likeliest parameters under the noise, which descents from the optimum find; without
/// sizes of the noise, of the loss.
void add_evidence(const Work& work, const Weighted& weighted, const Variant* smaller, Variant& variant) {
    constexpr double kEnough = 1e-7;  // of chi^2
    constexpr std::size_t kOthers = 2;
    Fit& fit = variant.fit;
    const std::size_t free = variant.free + (variant.scale_free ? 1 : 0);
    variant.likeliest = variant.optimum;
    if (weighted.robust != Robust::none) {
        // The scale of a robust loss is common to all models: -2 ln L = 2 sum rho (Ronchetti 1985).
        const double size = fit.loss / weighted.scale;
        describe_evidence(size * size, weighted.used, free, fit);
        return;
    }
    if (variant.sigma.empty()) {
        describe_evidence(deviance(weighted, fit.loss), weighted.used, free, fit);
        return;
    }
    std::vector<Point> starts{variant.optimum};
    for (std::size_t i = 0; i < std::min(kOthers, variant.optimum.others.size()); ++i)
        starts.push_back(variant.optimum.others[i]);
    if (smaller != nullptr && !smaller->likeliest.parameters.empty())
        starts.push_back(extended(variant.task.model, smaller->task.model, smaller->likeliest));
    std::optional<Refitter> own;
    if (variant.refitter->logarithmic())
        own.emplace(variant.task, variant.prepared.bounds, Refitter::Residual::difference);
    Refitter& refitter = own ? *own : *variant.refitter;
    variant.likeliest = refitter.descend(weigh_by(variant.prepared.channel, variant.sigma), starts, kEnough).front();
    std::vector<double> f = refitter.values(variant.likeliest, false).f;
    for (double& value : f) value *= variant.prepared.unit;
    describe_evidence(deviance(work.channel, work.noise.sigma, f), work.channel.samples.size(), free, fit);
}

/// Has what follows see squares in place of a robust loss: those of its pseudo-values, which have their minimum, and
/// its errors, where the loss has them.
void take_pseudo_values(Variant& variant) {
    const std::vector<double> f = variant.refitter->values(variant.optimum, false).f;
    const PseudoValues pseudo = pseudo_values(variant.weighted, residuals(variant.weighted, f));
    variant.weighted = pseudo.weighted;
    variant.weighted.robust = Robust::none;
    for (std::size_t j = 0; j < f.size(); ++j)
        if (variant.weighted.weight[j] > 0)
            variant.weighted.y[j] = (variant.weighted.logarithmic ? std::log(f[j]) : f[j]) - pseudo.residuals.r[j];
    variant.sigma.clear();
    variant.optimum.others.clear();  // of another loss
}

/// What the choice of a variant rests on: losses, errors, evidence. robust_scale: the channel's, of a robust loss.
void describe(const Work& work, const Variant* smaller, double robust_scale, Variant& variant) {
    const Optimum& optimum = variant.optimum;
    const Prepared& prepared = variant.prepared;
    const Weighted weighted = weigh(work.channel, work.options.loss, robust_scale);
    Fit& fit = variant.fit = {};
    fit.model = work.request.family->name;
    fit.lobes = variant.task.model.repeats;
    if (work.request.submodel != nullptr) fit.submodel = work.request.submodel->name;
    if (work.unit == Unit::relative) fit.scale = optimum.scale * prepared.unit;
    variant.refitter.emplace(variant.task, prepared.bounds);
    for (const double value : variant.refitter->values(optimum, false).f) fit.values.push_back(value * prepared.unit);
    fit.loss = std::sqrt(residuals(weighted, fit.values).loss2);
    if (!std::isfinite(fit.loss)) throw SearchError("the model gave a value that is not finite");
    fit.relative_loss = weighted.norm > 0 ? fit.loss / weighted.norm : 0.0;
    describe_errors(work.channel, fit);
    if (weighted.robust != Robust::none) {
        add_outliers(weighted, fit);
        take_pseudo_values(variant);
    }
    fit.search = optimum.record;
    const double found =
        weighted.logarithmic ? std::sqrt(optimum.relative_loss2) : std::sqrt(optimum.relative_loss2) * weighted.norm;
    if (fit.search.stop_reason == StopReason::converged &&
        fit.loss > found * (1 + kReproduced) + kUnseen * (weighted.norm > 0 ? weighted.norm : 1.0))
        fit.search.stop_reason = StopReason::roundoff;
    add_evidence(work, weighted, smaller, variant);
}

/// Terms that the samples do not see.
void add_unseen_terms(Variant& variant) {
    const Model& model = variant.task.model;
    kernels::Evaluator& evaluator = variant.refitter->evaluator();
    const std::vector<double> rows = evaluator.terms(variant.optimum.parameters);
    const std::vector<double> c = model.coefficients(variant.optimum.parameters);
    const auto largest = [](auto begin, auto end) {
        double most = 0;
        for (auto it = begin; it != end; ++it) most = std::max(most, std::abs(*it));
        return most;
    };
    Fit& fit = variant.fit;
    const double seen =
        kUnseen * largest(fit.values.begin(), fit.values.end()) / (variant.optimum.scale * variant.prepared.unit);
    auto row = rows.begin();
    for (std::size_t t = 0; t < model.terms.size(); ++t) {
        const auto n = static_cast<std::ptrdiff_t>(evaluator.samples());
        if (!model.terms[t].of.empty() && std::abs(c[t]) * largest(row, row + n) <= seen)
            fit.warnings.push_back(model.terms[t].name + " is zero at every sample");
        row += n * static_cast<std::ptrdiff_t>(1 + model.terms[t].of.size());
    }
}

/// Parameter values with what noise leaves open of them, in the wire's unit.
void add_parameters(const Work& work, Variant& variant) {
    constexpr std::size_t kReplicates = 400;
    const Model& model = variant.task.model;
    const std::vector<Interval>& bounds = variant.prepared.bounds;
    Fit& fit = variant.fit;
    std::vector<bool> at_bound;
    std::vector<double> units;
    for (std::size_t i = 0; i < model.parameters.size(); ++i) {
        const kernels::Parameter& declared = model.parameters[i];
        const double value = variant.optimum.parameters[i];
        units.push_back(to_model_unit(declared, work.channel));
        FittedParameter parameter;
        parameter.name = declared.name;
        parameter.unit = wire_unit(declared, work.channel);
        parameter.value = value / units[i] + 0.0;  // no -0
        parameter.fixed = bounds[i].fixed();
        parameter.at_bound = !parameter.fixed && is_at_bound(declared, model.is_linear(i), bounds[i], value);
        at_bound.push_back(parameter.at_bound);
        if (parameter.at_bound)
            fit.warnings.push_back(
                bound_remark(declared, bounds[i], value, work.request.bounds.count(declared.name) > 0, units[i]));
        fit.parameters.push_back(std::move(parameter));
    }
    const Estimate estimate{variant.task,    work.options.loss,  bounds,
                            variant.optimum, at_bound,           variant.sigma,
                            work.noise,      variant.scale_free, work.options.profiled.value_or(work.options.judge)};
    Uncertainty uncertainty = uncertainty_of(estimate, *variant.refitter, units);
    std::vector<std::array<double, 2>> resampled;
    if (work.options.judge && work.options.effort == Effort::thorough && !variant.sigma.empty())
        resampled = bootstrap_intervals(estimate, *variant.refitter, kReplicates);
    if (!resampled.empty()) fit.replicates = kReplicates;
    std::string without;
    for (std::size_t i = 0; i < model.parameters.size(); ++i) {
        FittedParameter& parameter = fit.parameters[i];
        const ParameterUncertainty& known = uncertainty.parameters[i];
        if (parameter.fixed) continue;
        if (known.undetermined) fit.warnings.push_back("the data do not determine " + parameter.name);
        else if (uncertainty.too_few && !parameter.at_bound) without += (without.empty() ? "" : ", ") + parameter.name;
        if (known.std_error) parameter.std_error = *known.std_error / units[i];
        if (!known.interval_95) continue;
        parameter.interval_95 = resampled.empty() ? known.interval_95 : resampled[i];
        for (double& end : *parameter.interval_95) end = end / units[i] + 0.0;
    }
    if (!without.empty())
        fit.warnings.push_back("no standard error of " + without + ": no more samples than parameters");
    if (!fit.warnings.empty()) add_unseen_terms(variant);  // some parameter knows it too
    fit.correlations = std::move(uncertainty.correlations);
    for (std::string& remark : uncertainty.remarks) fit.warnings.push_back(std::move(remark));
}

/// Other minima that the search has met, each polished; returns them as starts, best first.
std::vector<Point> add_rivals(const Work& work, Variant& variant) {
    constexpr std::size_t kMost = 4;
    constexpr double kEnough = 1e-7;  // of loss^2
    constexpr double kAlike = 1e-3;   // of the loss
    const Optimum& optimum = variant.optimum;
    std::vector<Point> found;
    if (optimum.others.empty()) return found;
    const double norm = variant.weighted.logarithmic ? 1.0 : variant.weighted.norm;
    const double best = std::sqrt(optimum.relative_loss2);
    double last = best;
    for (Refitter::End& end : variant.refitter->descend(variant.weighted, optimum.others, kEnough)) {
        const double loss = std::sqrt(end.loss2) / norm;
        if (end.stop != StopReason::converged || !(loss > last * (1 + kAlike) + kUnseen)) continue;
        last = loss;
        order_lobes(work, variant.task.model, end);
        Rival& rival = variant.fit.search.rivals.emplace_back();
        rival.loss = variant.weighted.logarithmic ? loss : loss * variant.fit.loss / best;
        rival.agreed = static_cast<std::size_t>(std::count_if(optimum.ends.begin(), optimum.ends.end(), [&](double l2) {
            return std::abs(std::sqrt(l2) - loss) <= kAlike * loss;
        }));
        for (std::size_t i = 0; i < end.parameters.size(); ++i) {
            const kernels::Parameter& declared = variant.task.model.parameters[i];
            rival.parameters.emplace_back(declared.name,
                                          end.parameters[i] / to_model_unit(declared, work.channel) + 0.0);
        }
        found.push_back(end);
        if (found.size() == kMost) break;
    }
    return found;
}

/// Makes the variant keep to what the request requires: as it is, or searched anew under the constraint. Throws
/// SearchError where it cannot.
void keep_to_requirements(const Work& work, const Variant* smaller, double robust_scale, const Weighted& loss,
                          Variant& variant) {
    const auto asked = [&](Requirement requirement) {
        const auto& all = work.options.require;
        return std::find(all.begin(), all.end(), requirement) != all.end();
    };
    const auto judge = [&] { add_physics(work, !variant.prepared.by_convention, variant.optimum, variant.fit); };
    const double loss_without = variant.fit.loss;
    judge();
    if (asked(Requirement::energy_conserving) && !variant.fit.physics->energy_conserving.value_or(false)) {
        if (variant.prepared.by_convention)
            throw SearchError("relative data do not determine this model's scale, nor whether it conserves energy");
        const Task& task = variant.task;
        const Task under_loss{task.engine,    task.model,  task.channel, task.directions, loss,
                              task.precision, task.effort, task.control, task.scale};
        variant.optimum = energy_conserving_optimum(under_loss, variant.prepared.bounds, variant.optimum,
                                                    incidence_angles(work.channel));
        order_lobes(work, variant.task.model, variant.optimum);
        describe(work, smaller, robust_scale, variant);
        judge();
        if (!variant.fit.physics->energy_conserving.value_or(false))
            throw SearchError("no parameters were found that conserve energy");
        variant.fit.warnings.push_back("standard errors take no account of the requirement");
    }
    if (asked(Requirement::reciprocal) && !variant.fit.physics->reciprocal)
        throw SearchError("the model is not reciprocal, which the request requires");
    if (asked(Requirement::nonnegative) && !variant.fit.physics->nonnegative)
        throw SearchError("the model falls below 0, which the request forbids");
    variant.fit.constrained = Constrained{work.options.require, loss_without, variant.fit.loss != loss_without};
}

/// Everything else the report says of the variant that was chosen.
void explain(const Work& work, double robust_scale, Variant& variant) {
    const Prepared& prepared = variant.prepared;
    Fit& fit = variant.fit;
    add_parameters(work, variant);
    Optimum reported = variant.optimum;
    reported.scale *= prepared.unit;
    add_curves(work, work.engine.best_precision(), reported, fit);
    if (prepared.scale.min < prepared.scale.max)
        if (const double s = variant.optimum.scale;
            s <= prepared.scale.min * 1.0001 || s >= prepared.scale.max / 1.0001)
            fit.warnings.push_back("scale stands at the end of its range, 1e6 times from a white diffuser's");
    if (prepared.by_convention)
        fit.warnings.push_back(
            "relative data do not determine this model's scale: by convention it is that of a white "
            "diffuser with the data's rms");
    if (!work.options.judge || work.control.over()) return;
    if (!fit.physics) add_physics(work, !prepared.by_convention, variant.optimum, fit);
    if (fit.constrained && fit.constrained->binding) return;  // folds know of no requirement
    constexpr std::size_t kRivals = 2;                        // that folds are fitted from as well
    std::vector<Point> starts{variant.optimum};
    for (Point& rival : add_rivals(work, variant))
        if (starts.size() <= kRivals) starts.push_back(std::move(rival));
    const std::size_t free = variant.free + (variant.scale_free ? 1 : 0);
    fit.held_out = hold_out(*variant.refitter, variant.task, work.channel, prepared.unit,
                            weigh(work.channel, work.options.loss, robust_scale), starts, free);
}

/// Why a search is over.
StopReason stop_of(const SearchControl& control) {
    return control.stop.stop_requested() ? StopReason::cancelled : StopReason::time_limit;
}

std::size_t least_lobes(const kernels::Family& family) { return family.repeat ? family.repeat->min : 1; }

void refuse_tiny(const Channel& channel) {
    if (const double rms = data_rms(channel); rms > 0 && rms < kSmallestData)
        throw SearchError("the BRDF values are too small, below 1e-100, where squares vanish: use another unit");
}

/// What robust fits of one (channel, model) begin with.
struct Beginning {
    std::vector<Groundwork> variants;  ///< from the fewest lobes up
    double scale = HUGE_VAL;           ///< the least of theirs, in the loss's unit
    double time_s = 0;
};

Beginning begin_robustly(const Work& work) {
    const auto start = Clock::now();
    refuse_tiny(work.channel);
    Beginning beginning;
    const Model* smaller = nullptr;
    for (std::size_t lobes = least_lobes(*work.request.family); lobes <= work.request.most_lobes(); ++lobes) {
        const Variant variant(work, work.request.variant(lobes));
        if (!beginning.variants.empty() && !variant.possible()) break;
        variant.require_possible();
        const Point* before = smaller != nullptr ? &beginning.variants.back().starts.front() : nullptr;
        beginning.variants.push_back(lay_groundwork(variant.task, variant.prepared.bounds, before, smaller));
        smaller = &variant.task.model;
        beginning.scale = std::min(beginning.scale, scale_in_loss(variant.prepared.channel, work.options.loss,
                                                                  beginning.variants.back().scale) *
                                                        residual_unit(work, variant.prepared));
    }
    beginning.time_s = std::chrono::duration<double>(Clock::now() - start).count();
    return beginning;
}

/// Fits the request's variants from the fewest lobes up, each from the one before, and returns the last; with "auto",
/// the last for which there is strong evidence. With a robust loss, from its beginning and under the channel's scale.
Fit fit_model(const Work& work, const Beginning* beginning, double robust_scale) {
    const auto start = Clock::now();
    const bool automatic = work.request.family->repeat && !work.request.lobes;
    refuse_tiny(work.channel);
    std::unique_ptr<Variant> chosen, smaller;
    std::size_t evaluations = 0;
    const std::size_t least = least_lobes(*work.request.family);
    for (std::size_t lobes = least; lobes <= work.request.most_lobes(); ++lobes) {
        auto variant = std::make_unique<Variant>(work, work.request.variant(lobes));
        if (automatic && chosen && !variant->possible()) break;
        variant->require_possible();
        const Variant* const before = chosen ? chosen.get() : smaller.get();
        const Optimum* const start_from = before != nullptr ? &before->optimum : nullptr;
        const Prepared& prepared = variant->prepared;
        if (beginning != nullptr)
            variant->weighted =
                weigh(prepared.channel, work.options.loss, robust_scale / residual_unit(work, prepared));
        const Weighted loss = variant->weighted;
        variant->optimum = beginning != nullptr ? find_robust_optimum(variant->task, prepared.bounds, start_from,
                                                                      beginning->variants.at(lobes - least))
                                                : find_optimum(variant->task, prepared.bounds, start_from);
        add_before(variant->optimum.record, evaluations);
        evaluations = variant->optimum.record.evaluations;
        order_lobes(work, variant->task.model, variant->optimum);
        const bool last = lobes == work.request.most_lobes();
        if (!automatic && !last) {
            smaller = std::move(variant);
            continue;
        }
        describe(work, before, robust_scale, *variant);
        if (!work.options.require.empty()) {
            keep_to_requirements(work, before, robust_scale, loss, *variant);
            evaluations = variant->optimum.record.evaluations;
        }
        if (chosen && !(variant->fit.bic < chosen->fit.bic - kEvidence)) break;
        chosen = std::move(variant);
        if (automatic && !last && work.control.over()) {
            chosen->fit.search.stop_reason = stop_of(work.control);
            break;
        }
    }
    explain(work, robust_scale, *chosen);
    chosen->fit.search.evaluations = evaluations;
    chosen->fit.search.time_s = std::chrono::duration<double>(Clock::now() - start).count();
    if (beginning != nullptr) chosen->fit.search.time_s += beginning->time_s;
    return std::move(chosen->fit);
}

/// Searches at once: enough that the device always has launches, no more than that, for each takes memory and all of
/// them are as late as the last.
Broker::Limits broker_limits(const kernels::DeviceInfo& device) {
    constexpr std::size_t kTasksOfUnit = 8;
    return {std::clamp<std::size_t>(kTasksOfUnit * device.compute_units, 16, 256)};
}

/// What a task has made, or why there is nothing.
template <class Result>
struct Outcome {
    std::optional<Result> result;
    Failure failure;
    bool dropped = false;  ///< another says the same
};

template <class Job>
auto attempt(const Work& work, const Job& job) -> Outcome<decltype(job())> {
    const auto failed = [&](std::string reason, const std::exception& error) -> Outcome<decltype(job())> {
        const kernels::Submodel* submodel = work.request.submodel;
        return {
            std::nullopt,
            {work.request.family->name, std::move(reason), error.what(), submodel != nullptr ? submodel->name : ""}};
    };
    try {
        return {job(), {}};
    } catch (const SearchError& error) {
        return failed(error.what(), error);
    } catch (const kernels::BuildError& error) {
        return failed("the model does not build for this device", error);
    } catch (const kernels::DeviceError& error) {
        return failed("the OpenCL device failed", error);
    } catch (const std::exception& error) {
        return failed("internal error", error);
    }
}

void add_costs(kernels::CostBook& costs, const std::vector<ModelRequest>& models, Report& report) {
    std::map<std::string, const kernels::Family*> families;
    for (const ModelRequest& model : models) families[model.family->name] = model.family;
    for (ChannelReport& channel : report.channels)
        for (Fit& fit : channel.fits) {
            const kernels::Family& family = *families.at(fit.model);
            fit.cost = costs.cost(family.variant(std::max<std::size_t>(1, fit.lobes), family.submodel(fit.submodel)));
        }
}

std::vector<std::string> channel_warnings(const Channel& channel) {
    const auto dark = std::count_if(channel.samples.begin(), channel.samples.end(),
                                    [](const Sample& sample) { return sample.brdf <= 0; });
    if (dark == 0) return {};
    return {std::to_string(dark) + " of " + std::to_string(channel.samples.size()) +
            " BRDF values are not positive: taken as noise below the floor, kept, but left out where logarithms or "
            "relative errors are taken"};
}

/// What a fit is ranked by; infinite where it has none.
double measure(const Fit& fit, RankBy by) {
    switch (by) {
        case RankBy::loss: return fit.loss;
        case RankBy::aicc: return fit.aicc.value_or(HUGE_VAL);
        case RankBy::bic: return fit.bic;
        case RankBy::held_out: return fit.held_out ? fit.held_out->loss : HUGE_VAL;
        case RankBy::log10_rmse: return fit.log10_rmse.value_or(HUGE_VAL);
    }
    return HUGE_VAL;
}

/// A model to fit, and which of the request's it is a form of.
struct Form {
    ModelRequest model;
    std::size_t of = 0;
};

/// The models, and their simpler forms: those with fewer lobes, and submodels that hold nothing the request speaks of.
std::vector<Form> with_simpler_forms(const std::vector<ModelRequest>& models) {
    std::vector<Form> forms;
    for (std::size_t i = 0; i < models.size(); ++i) {
        std::vector<ModelRequest> wholes{models[i]};
        if (const auto& repeat = models[i].family->repeat)
            for (std::size_t lobes = models[i].most_lobes() - 1; lobes >= repeat->min; --lobes) {
                wholes.push_back(models[i]);
                wholes.back().lobes = lobes;
            }
        for (const ModelRequest& whole : wholes) {
            forms.push_back({whole, i});
            if (whole.submodel != nullptr) continue;
            for (const kernels::Submodel& submodel : whole.family->submodels) {
                const auto is_named = [&](const auto& held) {
                    return whole.fixed.count(held.first) > 0 || whole.bounds.count(held.first) > 0;
                };
                if (std::any_of(submodel.fixed.begin(), submodel.fixed.end(), is_named)) continue;
                forms.push_back({whole, i});
                forms.back().model.submodel = &submodel;
            }
        }
    }
    return forms;
}

std::string name_of(const ModelRequest& model) {
    return kernels::variant_name(model.family->name, model.lobes.value_or(0),
                                 model.submodel != nullptr ? model.submodel->name : "");
}

/// Tells, however a task ends, that it is over.
struct TaskEnd {
    explicit TaskEnd(TaskProgress* progress) : progress_(progress) {}
    ~TaskEnd() {
        if (progress_ != nullptr) progress_->finish(relative_loss);
    }
    TaskEnd(const TaskEnd&) = delete;
    TaskEnd& operator=(const TaskEnd&) = delete;

    std::optional<double> relative_loss;

private:
    TaskProgress* progress_;
};

/// Drops fits of forms that turned out to be the same: "auto" had found that fewer lobes are enough.
std::vector<Outcome<Fit>> distinct(const std::vector<Form>& forms, std::vector<Outcome<Fit>> outcomes) {
    std::set<std::tuple<std::size_t, std::size_t, std::string>> seen;
    std::vector<Outcome<Fit>> kept;
    for (std::size_t i = 0; i < outcomes.size(); ++i) {
        const std::optional<Fit>& fit = outcomes[i].result;
        if (!fit || seen.emplace(forms[i].of, fit->lobes, fit->submodel).second) kept.push_back(std::move(outcomes[i]));
    }
    return kept;
}

ChannelReport rank(const Channel& channel, RankBy by, std::vector<Outcome<Fit>> outcomes) {
    ChannelReport report{channel, {}, {}, channel_warnings(channel)};
    for (Outcome<Fit>& outcome : outcomes) {
        if (outcome.result) report.fits.push_back(std::move(*outcome.result));
        else report.failures.push_back(std::move(outcome.failure));
    }
    std::stable_sort(report.fits.begin(), report.fits.end(), [&](const Fit& a, const Fit& b) {
        return std::pair(measure(a, by), a.loss) < std::pair(measure(b, by), b.loss);
    });
    for (std::size_t i = 0; i < report.fits.size(); ++i) report.fits[i].rank = i + 1;
    return report;
}

}  // namespace

std::size_t ModelRequest::most_lobes() const {
    if (!family->repeat) return 1;
    return lobes.value_or(family->repeat->auto_max);
}

double to_model_unit(const kernels::Parameter& parameter, const Channel& channel) {
    return parameter.unit == "wavelength" && channel.wavelength_nm ? 1000 / *channel.wavelength_nm : 1.0;
}

std::string wire_unit(const kernels::Parameter& parameter, const Channel& channel) {
    if (parameter.unit != "wavelength") return parameter.unit;
    return channel.wavelength_nm ? "um" : "lambda";
}

std::string domain_rule(const kernels::Parameter& parameter, const Channel& channel) {
    const double unit = to_model_unit(parameter, channel);
    const std::string name = wire_unit(parameter, channel);
    return fmt::format("the model is defined from {:g} to {:g}{}", parameter.domain_min / unit,
                       parameter.domain_max / unit, name == "1" ? "" : " " + name);
}

std::vector<Interval> parameter_bounds(const Model& model, const ModelRequest& request, const Channel& channel) {
    std::vector<Interval> bounds;
    for (const kernels::Parameter& parameter : model.parameters) {
        const double unit = to_model_unit(parameter, channel);
        Interval interval{parameter.min, parameter.max};
        if (const auto it = request.bounds.find(parameter.name); it != request.bounds.end())
            interval = {it->second.min * unit, it->second.max * unit};
        if (const auto it = request.fixed.find(parameter.name); it != request.fixed.end())
            interval = {it->second * unit, it->second * unit};
        if (request.submodel != nullptr)
            if (const auto it = request.submodel->fixed.find(parameter.name); it != request.submodel->fixed.end())
                interval = {it->second, it->second};
        if (!(interval.min <= interval.max)) throw InvalidBounds(parameter.name, "the lower bound is above the upper");
        // In the model's unit a bound may have become too large for a double.
        if (interval.min < parameter.domain_min || interval.max > parameter.domain_max ||
            !std::isfinite(interval.max - interval.min))
            throw InvalidBounds(parameter.name, domain_rule(parameter, channel));
        bounds.push_back(interval);
    }
    return bounds;
}

std::size_t samples_needed(const ModelRequest& request, const Channel& channel) {
    const kernels::Family& family = *request.family;
    const std::size_t lobes = request.lobes.value_or(family.repeat ? family.repeat->min : 1);
    return free_parameters(parameter_bounds(request.variant(lobes), request, channel));
}

/// One of the two.
struct Fitter::Workers {
    Workers(const kernels::Engine& engine, unsigned threads) {
        if (engine.overlaps()) broker.emplace(broker_limits(engine.device()));
        else pool = std::make_unique<boost::asio::thread_pool>(std::max(threads, 1U));
    }

    void post(std::packaged_task<void()> task, std::size_t samples) {
        if (broker) broker->post(std::move(task), samples);
        else boost::asio::post(*pool, std::move(task));
    }

    /// Outcomes of job(i) for each work, in their order; waits for all of them.
    template <class Job>
    auto run(const std::vector<Work>& works, const Job& job) {
        using Result = Outcome<decltype(job(std::size_t{}))>;
        std::vector<std::packaged_task<Result()>> tasks;
        std::vector<std::future<Result>> futures;
        for (std::size_t i = 0; i < works.size(); ++i) {
            tasks.emplace_back([&works, &job, i] { return attempt(works[i], [&job, i] { return job(i); }); });
            futures.push_back(tasks.back().get_future());
        }
        // The longest first, so that no thread is left with one at the end.
        for (const bool longest : {true, false})
            for (std::size_t i = 0; i < tasks.size(); ++i)
                if (works[i].request.family->variants.front().sums_series() == longest)
                    post(std::packaged_task<void()>(std::move(tasks[i])), works[i].channel.samples.size());
        for (auto& future : futures) future.wait();  // tasks refer to this call's arguments
        std::vector<Result> outcomes;
        for (auto& future : futures) outcomes.push_back(future.get());
        return outcomes;
    }

    std::unique_ptr<boost::asio::thread_pool> pool;
    std::optional<Broker> broker;
    std::mutex mutex;            ///< of what follows
    std::set<std::string> warm;  ///< submodels with a text of their own that have been built
};

Fitter::Fitter(kernels::Engine& engine, unsigned threads)
    : engine_(engine), costs_(engine), workers_(std::make_unique<Workers>(engine, threads)) {}

Fitter::~Fitter() {
    if (workers_->pool) workers_->pool->join();
}

void Fitter::warm_up(const kernels::Family& family) {
    for (const Model& model : family.variants) warm_up(model);
}

void Fitter::warm_up(const ModelRequest& request) {
    if (request.submodel == nullptr) return;  // whole models are warm
    const kernels::Submodel& submodel = *request.submodel;
    for (const Model& model : submodel.variants) {
        const std::lock_guard lock(workers_->mutex);
        if (!workers_->warm.insert(model.name + ' ' + std::to_string(model.repeats)).second) continue;
        try {
            warm_up(model);
        } catch (const kernels::BuildError&) {  // the fit will tell
        }
    }
}

void Fitter::warm_up(const Model& model) {
    const std::vector<kernels::Direction> directions(1);
    const std::vector<double> one(1, 1.0);
    const auto run = [&](kernels::Precision precision, kernels::Accuracy accuracy) {
        kernels::Evaluator evaluator(engine_, model, precision, directions, one, one, accuracy);
        std::vector<double> parameters;
        for (const kernels::Parameter& p : model.parameters) parameters.push_back(p.typical_min);
        const std::vector<double> c(model.terms.size(), 1.0);
        kernels::Batch batch;
        evaluator.project(parameters, c, c, true, batch);
        evaluator.project(parameters, c, c, false, batch);
        evaluator.loss(parameters, c, false, batch);
        (void)evaluator.terms(parameters);
    };
    run(engine_.best_precision(), kernels::Accuracy::full);
    std::vector<double> parameters;
    for (const kernels::Parameter& p : model.parameters) parameters.push_back(p.typical_max);
    constexpr double kIncidence_deg[] = {45};
    (void)kernels::Hemisphere(engine_, model, albedo_precision(engine_, model)).albedo(parameters, kIncidence_deg, 0.1);
    if (model.begins_quickly()) run(engine_.quickest_precision(), model.first_accuracy());
}

Report Fitter::fit(const Dataset& dataset, const std::vector<ModelRequest>& models, const FitOptions& options,
                   std::stop_token stop, Progress* progress) {
    Report report{dataset.name,
                  dataset.unit,
                  options.seed,
                  engine_.device(),
                  options.precision.value_or(engine_.best_precision()),
                  {},
                  options.loss,
                  options.scene};
    if (const auto reason = engine_.refusal(report.precision)) throw kernels::PrecisionError(*reason);
    const SearchControl control{options.seed,
                                Clock::now() + std::chrono::duration_cast<Clock::duration>(options.time_limit),
                                std::move(stop), nullptr, options.ledger};
    std::vector<Channel> channels = dataset.channels;
    std::vector<Form> forms;
    if (options.scene) {
        for (Channel& channel : channels) channel = seen_by(*options.scene, std::move(channel));
        forms = with_simpler_forms(models);
    } else
        for (std::size_t i = 0; i < models.size(); ++i) forms.push_back({models[i], i});
    // Before anything runs: requests that cannot be met throw here, in the caller's thread.
    for (const Channel& channel : channels) {
        (void)weigh(channel, options.loss);
        for (const ModelRequest& model : models) (void)samples_needed(model, channel);
    }
    for (const Form& form : forms) warm_up(form.model);

    std::list<Directions> directions;
    std::list<Noise> noises;  // one a channel
    std::vector<Work> works;  // channels x forms
    for (const Channel& channel : channels) {
        if (directions.empty() || !same_directions(channel, directions.back().samples))
            directions.emplace_back(channel);
        noises.push_back(noise_of(channel));
        for (const Form& form : forms) {
            works.push_back(
                {engine_, channel, directions.back(), noises.back(), dataset.unit, form.model, options, control});
            if (progress != nullptr) works.back().control.progress = &progress->add(channel.name, name_of(form.model));
        }
    }
    const bool robust = options.loss.robust != Robust::none;
    std::vector<Outcome<Beginning>> beginnings;
    std::vector<double> scales(channels.size(), HUGE_VAL);  // each common to the channel's models
    if (robust) {
        beginnings = workers_->run(works, [&](std::size_t i) { return begin_robustly(works[i]); });
        for (std::size_t i = 0; i < works.size(); ++i)
            if (beginnings[i].result)
                scales[i / forms.size()] = std::min(scales[i / forms.size()], beginnings[i].result->scale);
    }
    std::vector<Outcome<Fit>> outcomes = workers_->run(works, [&](std::size_t i) {
        TaskEnd end(works[i].control.progress);
        if (robust && !beginnings[i].result) throw SearchError(beginnings[i].failure.reason);
        Fit fit = robust ? fit_model(works[i], &*beginnings[i].result, scales[i / forms.size()])
                         : fit_model(works[i], nullptr, 0);
        end.relative_loss = fit.relative_loss;
        return fit;
    });
    for (std::size_t i = 0; i < beginnings.size(); ++i)
        if (!beginnings[i].result) outcomes[i].failure = beginnings[i].failure;
    for (std::size_t i = 0; i < outcomes.size(); ++i)
        if (outcomes[i].result) outcomes[i].result->form = i % forms.size();
    auto next = outcomes.begin();
    for (std::size_t c = 0; c < channels.size(); ++c) {
        const auto end = next + static_cast<std::ptrdiff_t>(forms.size());
        report.channels.push_back(rank(channels[c], options.rank_by,
                                       distinct(forms, {std::make_move_iterator(next), std::make_move_iterator(end)})));
        report.channels.back().noise = works[c * forms.size()].noise.record;
        if (std::isfinite(scales[c])) report.channels.back().robust_scale = scales[c];
        next = end;
    }
    if (options.judge) {
        add_costs(costs_, models, report);
        for (ChannelReport& channel : report.channels) judge_scene(options.scene.value_or(Scene{}), channel);
    }
    if (options.ledger) add_ledger(*this, dataset, models, options, control, report);
    return report;
}

}  // namespace brdfit::optim
