#include "optim/fit.h"

#include <algorithm>
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
#include "optim/ledger.h"
#include "optim/optimum.h"
#include "optim/physics.h"
#include "optim/robust.h"
#include "optim/statistics.h"

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

/// The physics of the reported parameters.
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

/// The size of a column of the weighted Jacobian.
double effect(const Weighted& weighted, const Residuals& residuals, const std::vector<double>& by_parameter) {
    double sum = 0;
    for (std::size_t j = 0; j < by_parameter.size(); ++j) {
        const double x = residuals.by_f[j] * by_parameter[j];
        sum += weighted.weight[j] * x * x;
    }
    return std::sqrt(sum);
}

/// Terms that the samples do not see.
void add_unseen_terms(const Work& work, kernels::Precision precision, const Optimum& optimum, Fit& fit) {
    const Model& model = *optimum.model;
    kernels::Evaluator evaluator(work.engine, model, precision, work.directions.samples, {}, {});
    const std::vector<double> rows = evaluator.terms(optimum.parameters);
    const std::vector<double> c = model.coefficients(optimum.parameters);
    const auto largest = [](auto begin, auto end) {
        double most = 0;
        for (auto it = begin; it != end; ++it) most = std::max(most, std::abs(*it));
        return most;
    };
    const double seen = kUnseen * largest(fit.values.begin(), fit.values.end()) / optimum.scale;
    auto row = rows.begin();
    for (std::size_t t = 0; t < model.terms.size(); ++t) {
        const auto n = static_cast<std::ptrdiff_t>(evaluator.samples());
        if (!model.terms[t].of.empty() && std::abs(c[t]) * largest(row, row + n) <= seen)
            fit.warnings.push_back(model.terms[t].name + " is zero at every sample");
        row += n * static_cast<std::ptrdiff_t>(1 + model.terms[t].of.size());
    }
}

/// Parameter values with their errors, in the wire's unit.
void add_parameters(const Work& work, kernels::Precision precision, const Weighted& weighted, const Optimum& optimum,
                    const std::vector<Interval>& bounds, const kernels::Values& values, Fit& fit) {
    const Model& model = *optimum.model;
    const std::size_t n = values.f.size();

    const PseudoValues seen = pseudo_values(weighted, residuals(weighted, fit.values));
    std::vector<std::size_t> free;
    std::vector<std::vector<double>> jacobian;
    const auto undetermined = [&](const std::string& name) {
        fit.warnings.push_back("the data do not determine " + name);
    };
    for (std::size_t i = 0; i < model.parameters.size(); ++i) {
        const kernels::Parameter& declared = model.parameters[i];
        const double unit = to_model_unit(declared, work.channel);
        const double value = optimum.parameters[i];
        FittedParameter parameter;
        parameter.name = declared.name;
        parameter.unit = wire_unit(declared, work.channel);
        parameter.value = value / unit + 0.0;  // no -0
        parameter.fixed = bounds[i].fixed();
        parameter.at_bound = !parameter.fixed && is_at_bound(declared, model.is_linear(i), bounds[i], value);
        fit.parameters.push_back(std::move(parameter));
        if (fit.parameters.back().fixed) continue;
        if (fit.parameters.back().at_bound) {
            fit.warnings.push_back(
                bound_remark(declared, bounds[i], value, work.request.bounds.count(declared.name) > 0, unit));
            continue;
        }
        std::vector<double> row;
        for (std::size_t j = 0; j < n; ++j) row.push_back(optimum.scale * values.by_parameter[i * n + j]);
        // What the samples do not feel over the parameter's whole interval is rounding, not a slope.
        const double reach = declared.scale == kernels::Scale::logarithmic
                                 ? std::abs(value)
                                 : std::max(declared.max - declared.min, std::abs(value));
        if (!(effect(seen.weighted, seen.residuals, row) * reach > kUnseen * std::max(weighted.norm, fit.loss))) {
            undetermined(declared.name);
            continue;
        }
        free.push_back(i);
        jacobian.push_back(std::move(row));
    }
    if (work.unit == Unit::relative && knows_scale(model)) jacobian.push_back(values.f);
    const auto errors = standard_errors(seen.weighted, seen.residuals, jacobian);
    const bool too_few = weighted.used <= jacobian.size();
    std::string without;
    for (std::size_t i = 0; i < free.size(); ++i) {
        FittedParameter& parameter = fit.parameters[free[i]];
        if (errors[i]) parameter.std_error = *errors[i] / to_model_unit(model.parameters[free[i]], work.channel);
        else if (too_few) without += (without.empty() ? "" : ", ") + parameter.name;
        else undetermined(parameter.name);
    }
    if (!without.empty())
        fit.warnings.push_back("no standard error of " + without + ": no more samples than parameters");
    if (!fit.warnings.empty()) add_unseen_terms(work, precision, optimum, fit);  // some parameter knows it too
}

/// Lobes in falling order of their exponent, unless the request speaks of single lobes.
void order_lobes(const Work& work, Optimum& optimum) {
    const Model& model = *optimum.model;
    if (model.repeats < 2 || !work.request.bounds.empty() || !work.request.fixed.empty()) return;
    std::vector<std::vector<double>> lobes;
    auto at = optimum.parameters.begin() + static_cast<std::ptrdiff_t>(model.group_begin);
    for (std::size_t j = 0; j < model.repeats; ++j, at += static_cast<std::ptrdiff_t>(model.group_size))
        lobes.emplace_back(at, at + static_cast<std::ptrdiff_t>(model.group_size));
    std::stable_sort(lobes.begin(), lobes.end(),
                     [&](const auto& a, const auto& b) { return a[model.order_by] > b[model.order_by]; });
    at = optimum.parameters.begin() + static_cast<std::ptrdiff_t>(model.group_begin);
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

/// Everything the report says of an optimum. robust_scale: the channel's, of a robust loss.
Fit describe(const Work& work, const Prepared& prepared, Optimum optimum, double robust_scale) {
    order_lobes(work, optimum);
    optimum.scale *= prepared.unit;
    const kernels::Precision precision = work.engine.best_precision();
    const Weighted weighted = weigh(work.channel, work.options.loss, robust_scale);
    Fit fit;
    fit.model = work.request.family->name;
    fit.lobes = optimum.model->repeats;
    if (work.request.submodel != nullptr) fit.submodel = work.request.submodel->name;
    if (work.unit == Unit::relative) fit.scale = optimum.scale;
    const kernels::Values values =
        kernels::evaluate(work.engine, *optimum.model, precision, optimum.parameters, work.directions.samples, true);
    for (const double value : values.f) fit.values.push_back(value * optimum.scale);
    fit.loss = std::sqrt(residuals(weighted, fit.values).loss2);
    if (!std::isfinite(fit.loss)) throw SearchError("the model gave a value that is not finite");
    fit.relative_loss = weighted.norm > 0 ? fit.loss / weighted.norm : 0.0;
    std::size_t free = free_parameters(prepared.bounds);
    if (work.unit == Unit::relative && knows_scale(*optimum.model)) ++free;
    describe_errors(work.channel, weighted, free, fit);
    add_parameters(work, precision, weighted, optimum, prepared.bounds, values, fit);
    if (weighted.robust != Robust::none) add_outliers(weighted, fit);
    add_curves(work, precision, optimum, fit);
    if (work.options.judge || !work.options.require.empty()) add_physics(work, !prepared.by_convention, optimum, fit);
    fit.search = optimum.record;
    const double found =
        weighted.logarithmic ? std::sqrt(optimum.relative_loss2) : std::sqrt(optimum.relative_loss2) * weighted.norm;
    if (fit.search.stop_reason == StopReason::converged &&
        fit.loss > found * (1 + kReproduced) + kUnseen * (weighted.norm > 0 ? weighted.norm : 1.0))
        fit.search.stop_reason = StopReason::roundoff;
    if (prepared.scale.min < prepared.scale.max)
        if (const double s = optimum.scale / prepared.unit;
            s <= prepared.scale.min * 1.0001 || s >= prepared.scale.max / 1.0001)
            fit.warnings.push_back("scale stands at the end of its range, 1e6 times from a white diffuser's");
    if (prepared.by_convention)
        fit.warnings.push_back(
            "relative data do not determine this model's scale: by convention it is that of a white "
            "diffuser with the data's rms");
    return fit;
}

/// The fit that keeps to what the request requires: this one, or one searched under the constraint. Throws SearchError
/// where there is none.
Fit required(const Work& work, const Prepared& prepared, const Task& task, const Optimum& optimum, double robust_scale,
             Fit fit) {
    const auto asked = [&](Requirement requirement) {
        const auto& all = work.options.require;
        return std::find(all.begin(), all.end(), requirement) != all.end();
    };
    const double loss_without = fit.loss;
    const bool conserves = fit.physics->energy_conserving.value_or(false);
    if (asked(Requirement::energy_conserving) && !conserves) {
        if (prepared.by_convention)
            throw SearchError("relative data do not determine this model's scale, nor whether it conserves energy");
        fit = describe(work, prepared,
                       energy_conserving_optimum(task, prepared.bounds, optimum, incidence_angles(work.channel)),
                       robust_scale);
        if (!fit.physics->energy_conserving.value_or(false))
            throw SearchError("no parameters were found that conserve energy");
        fit.warnings.push_back("standard errors take no account of the requirement");
    }
    if (asked(Requirement::reciprocal) && !fit.physics->reciprocal)
        throw SearchError("the model is not reciprocal, which the request requires");
    if (asked(Requirement::nonnegative) && !fit.physics->nonnegative)
        throw SearchError("the model falls below 0, which the request forbids");
    fit.constrained = Constrained{work.options.require, loss_without};
    return fit;
}

/// Why a search is over.
StopReason stop_of(const SearchControl& control) {
    return control.stop.stop_requested() ? StopReason::cancelled : StopReason::time_limit;
}

/// A variant of a model as its search sees it.
struct Variant {
    const Model& model;
    Prepared prepared;
    Weighted weighted;  ///< the squares
    std::size_t free;

    Variant(const Work& work, std::size_t lobes)
        : model(work.request.variant(lobes)),
          prepared(prepare(work, model)),
          weighted(weigh(prepared.channel, work.options.loss)),
          free(free_parameters(prepared.bounds)) {
        if (!std::isfinite(weighted.norm))
            throw SearchError("the weights of this loss overflow: a value or a sigma is too small beside the others");
    }

    [[nodiscard]] bool possible() const { return weighted.used >= free; }
    void require_possible() const {
        if (!possible())
            throw SearchError("too few samples: " + std::to_string(weighted.used) + " usable ones for " +
                              std::to_string(free) + " free parameters");
    }
    [[nodiscard]] Task task(const Work& work) const {
        return {work.engine,
                model,
                prepared.channel,
                work.directions.samples,
                weighted,
                work.options.precision,
                work.options.effort,
                work.control,
                prepared.scale};
    }
};

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
        const Variant variant(work, lobes);
        if (!beginning.variants.empty() && !variant.possible()) break;
        variant.require_possible();
        const Start* before = smaller != nullptr ? &beginning.variants.back().starts.front() : nullptr;
        beginning.variants.push_back(lay_groundwork(variant.task(work), variant.prepared.bounds, before, smaller));
        smaller = &variant.model;
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
    std::optional<Optimum> smaller;
    std::optional<Fit> fit;
    std::size_t evaluations = 0;
    const std::size_t least = least_lobes(*work.request.family);
    for (std::size_t lobes = least; lobes <= work.request.most_lobes(); ++lobes) {
        Variant variant(work, lobes);
        if (automatic && fit && !variant.possible()) break;
        variant.require_possible();
        const Optimum* before = smaller ? &*smaller : nullptr;
        const Prepared& prepared = variant.prepared;
        if (beginning != nullptr)
            variant.weighted = weigh(prepared.channel, work.options.loss, robust_scale / residual_unit(work, prepared));
        Optimum optimum = beginning != nullptr ? find_robust_optimum(variant.task(work), prepared.bounds, before,
                                                                     beginning->variants.at(lobes - least))
                                               : find_optimum(variant.task(work), prepared.bounds, before);
        add_before(optimum.record, evaluations);
        evaluations = optimum.record.evaluations;
        const bool last = lobes == work.request.most_lobes();
        if (automatic || last) {
            Fit next = describe(work, prepared, optimum, robust_scale);
            if (!work.options.require.empty())
                next = required(work, prepared, variant.task(work), optimum, robust_scale, std::move(next));
            if (automatic && fit && !(next.bic < fit->bic - kEvidence)) break;
            fit = std::move(next);
        }
        smaller = std::move(optimum);
        if (automatic && !last && work.control.over()) {
            fit->search.stop_reason = stop_of(work.control);
            break;
        }
    }
    fit->search.evaluations = evaluations;
    fit->search.time_s = std::chrono::duration<double>(Clock::now() - start).count();
    if (beginning != nullptr) fit->search.time_s += beginning->time_s;
    return std::move(*fit);
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

ChannelReport rank(const Channel& channel, std::vector<Outcome<Fit>> outcomes) {
    ChannelReport report{channel, {}, {}, channel_warnings(channel)};
    for (Outcome<Fit>& outcome : outcomes) {
        if (outcome.result) report.fits.push_back(std::move(*outcome.result));
        else report.failures.push_back(std::move(outcome.failure));
    }
    std::stable_sort(report.fits.begin(), report.fits.end(),
                     [](const Fit& a, const Fit& b) { return a.loss < b.loss; });
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
                   std::stop_token stop) {
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
                                std::move(stop), options.ledger};
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
    std::vector<Work> works;  // channels x forms
    for (const Channel& channel : channels) {
        if (directions.empty() || !same_directions(channel, directions.back().samples))
            directions.emplace_back(channel);
        for (const Form& form : forms)
            works.push_back({engine_, channel, directions.back(), dataset.unit, form.model, options, control});
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
        if (!robust) return fit_model(works[i], nullptr, 0);
        if (!beginnings[i].result) throw SearchError(beginnings[i].failure.reason);
        return fit_model(works[i], &*beginnings[i].result, scales[i / forms.size()]);
    });
    for (std::size_t i = 0; i < beginnings.size(); ++i)
        if (!beginnings[i].result) outcomes[i].failure = beginnings[i].failure;
    for (std::size_t i = 0; i < outcomes.size(); ++i)
        if (outcomes[i].result) outcomes[i].result->form = i % forms.size();
    auto next = outcomes.begin();
    for (std::size_t c = 0; c < channels.size(); ++c) {
        const auto end = next + static_cast<std::ptrdiff_t>(forms.size());
        report.channels.push_back(
            rank(channels[c], distinct(forms, {std::make_move_iterator(next), std::make_move_iterator(end)})));
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
