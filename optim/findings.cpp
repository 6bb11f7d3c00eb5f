#include "optim/findings.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <set>

#include <fmt/format.h>

#include "kernels/evaluator.h"
#include "optim/constrained.h"
#include "optim/crossvalidation.h"
#include "optim/physics.h"
#include "optim/robust.h"
#include "optim/statistics.h"
#include "optim/uncertainty.h"

namespace brdfit::optim {
namespace {

using kernels::Model;

/// Parts of the data's size that are rounding.
constexpr double kUnseen = 1e-12;
/// A search's loss that its reported parameters miss by this part was found beyond their digits.
constexpr double kReproduced = 1e-6;
/// More outliers than this part of the samples are worth a warning.
constexpr double kManyOutliers = 0.1;

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

/// Where energy is judged.
Incidence incidence_of(const Work& work) {
    return Incidence(incidence_angles(work.channel), work.options.scene.value_or(Scene{}).theta_i_deg);
}

/// The physics of an optimum.
void add_physics(const Work& work, bool scale_known, const Optimum& optimum, Fit& fit) {
    Judgement judgement =
        judge_physics(work.engine, *optimum.model, optimum.parameters, incidence_of(work), scale_known);
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

/// AICc and BIC: of the model's likeliest parameters under the noise, which descents from the optimum find; without
/// sizes of the noise, of the loss.
void add_evidence(const Work& work, const Weighted& weighted, const Variant* smaller, Variant& variant) {
    constexpr double kEnough = 1e-7;  // of chi^2
    constexpr std::size_t kOthers = 2;
    Fit& fit = variant.fit;
    variant.likeliest = static_cast<const Point&>(variant.optimum);
    if (weighted.robust != Robust::none) {
        // The scale of a robust loss is common to all models: -2 ln L = 2 sum rho (Ronchetti 1985).
        const double size = fit.loss / weighted.scale;
        describe_evidence(size * size, weighted.used, variant.degrees(), fit);
        return;
    }
    if (variant.sigma.empty()) {
        describe_evidence(deviance(weighted, fit.loss), weighted.used, variant.degrees(), fit);
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
    const Weighted by_noise = weigh_by(variant.prepared.channel, variant.sigma);
    const Refitter::End likeliest = refitter.best(by_noise, starts, kEnough);
    variant.likeliest = static_cast<const Point&>(likeliest);
    describe_evidence(deviance(work.channel, work.noise.get().sigma, likeliest.loss2, by_noise.norm),
                      work.channel.samples.size(), variant.degrees(), fit);
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
    const Estimate estimate{variant.task,     work.options.loss,  bounds,
                            variant.optimum,  at_bound,           variant.sigma,
                            work.noise.get(), variant.scale_free, work.options.profiled.value_or(work.options.judge)};
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
        parameter.interval_95 = known.interval_95;
        if (!resampled.empty())  // about the estimate, which knows less of bounds and bent valleys than a profile
            parameter.interval_95 = {std::min((*known.interval_95)[0], resampled[i][0]),
                                     std::max((*known.interval_95)[1], resampled[i][1])};
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

}  // namespace

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
    // With slopes, which standard errors will ask for.
    for (const double value : variant.refitter->values(optimum, true).f) fit.values.push_back(value * prepared.unit);
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
        variant.optimum =
            energy_conserving_optimum(under_loss, variant.prepared.bounds, variant.optimum, incidence_of(work));
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
    fit.held_out = hold_out(*variant.refitter, variant.task, work.channel, prepared.unit,
                            weigh(work.channel, work.options.loss, robust_scale), starts, variant.degrees());
}

}  // namespace brdfit::optim
