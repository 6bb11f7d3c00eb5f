#include "optim/fit.h"

#include <algorithm>
#include <cmath>
#include <future>
#include <numbers>
#include <set>

#include <boost/asio/post.hpp>  // a kept thread pool
#include <boost/asio/thread_pool.hpp>

#include "kernels/evaluator.h"
#include "optim/optimum.h"
#include "optim/statistics.h"

namespace brdfit::optim {
namespace {

using Clock = std::chrono::steady_clock;
using kernels::Model;

/// A further lobe is reported only if the BIC falls by this much: "very strong" evidence (Kass and Raftery 1995).
constexpr double kEvidence = 10;

std::vector<kernels::Direction> directions_of(const Channel& channel) {
    std::vector<kernels::Direction> directions;
    for (const Sample& sample : channel.samples) directions.push_back(sample.direction);
    return directions;
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

/// The scale of a perfectly white diffuser with the data's rms.
double white_scale(const Channel& channel) {
    double sum = 0;
    for (const Sample& sample : channel.samples) sum += sample.brdf * sample.brdf;
    const double scale = std::numbers::pi * std::sqrt(sum / static_cast<double>(channel.samples.size()));
    return scale > 0 ? scale : 1.0;
}

Channel divided(Channel channel, double scale) {
    for (Sample& sample : channel.samples) {
        sample.brdf /= scale;
        if (sample.sigma) *sample.sigma /= scale;
    }
    return channel;
}

/// One (channel, model) of a request.
struct Work {
    kernels::Engine& engine;
    const Channel& channel;
    Unit unit;
    const ModelRequest& request;
    const FitOptions& options;
    SearchControl control;
};

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
    std::set<double> angles{low, high};
    const auto add = [&](double from, double to, int steps) {
        for (int i = 0; i <= steps; ++i) {
            const double angle = from + (to - from) * i / steps;
            if (angle >= low && angle <= high) angles.insert(angle);
        }
    };
    add(low, high, 160);
    add(theta_i_deg - 5, theta_i_deg + 5, 100);
    add(theta_i_deg - 0.5, theta_i_deg + 0.5, 50);
    return {angles.begin(), angles.end()};
}

std::vector<double> scaled_values(const Work& work, kernels::Precision precision, const Optimum& optimum,
                                  const std::vector<kernels::Direction>& directions) {
    std::vector<double> f =
        kernels::evaluate(work.engine, *optimum.model, precision, optimum.parameters, directions, false).f;
    for (double& value : f) value *= optimum.scale;
    return f;
}

void add_curves(const Work& work, kernels::Precision precision, const Optimum& optimum, Fit& fit) {
    std::set<double> incidences;
    for (const Sample& sample : work.channel.samples)
        if (canonical(sample.direction).phi_deg == 0) incidences.insert(sample.direction.theta_i_deg);
    std::vector<kernels::Direction> directions;
    for (const double theta_i_deg : incidences) {
        fit.curves.push_back({theta_i_deg, curve_angles(work.channel, theta_i_deg), {}});
        for (const double theta_r_deg : fit.curves.back().theta_r_deg)
            directions.push_back({theta_i_deg, theta_r_deg, 0});
    }
    const std::vector<double> f = scaled_values(work, precision, optimum, directions);
    auto next = f.begin();
    for (Fit::Curve& curve : fit.curves) {
        const auto end = next + static_cast<std::ptrdiff_t>(curve.theta_r_deg.size());
        curve.brdf.assign(next, end);
        next = end;
    }
}

bool is_at_bound(const kernels::Parameter& parameter, Interval bounds, double value) {
    constexpr double kNear = 1e-6;  // of the interval, on the parameter's scale
    if (parameter.scale == kernels::Scale::logarithmic && bounds.min > 0) {
        const double range = kNear * std::log(bounds.max / bounds.min);
        return std::log(value / bounds.min) <= range || std::log(bounds.max / value) <= range;
    }
    // Bounds that a request or relative data widen do not make a small value a bound.
    const double range = kNear * std::min(bounds.max - bounds.min, parameter.max - parameter.min);
    return value - bounds.min <= range || bounds.max - value <= range;
}

/// Parameter values with their errors, in the wire's unit.
void add_parameters(const Work& work, kernels::Precision precision, const Weighted& weighted, const Optimum& optimum,
                    const std::vector<Interval>& bounds, Fit& fit) {
    const Model& model = *optimum.model;
    const auto directions = directions_of(work.channel);
    const kernels::Values values =
        kernels::evaluate(work.engine, model, precision, optimum.parameters, directions, true);
    const std::size_t n = directions.size();

    std::vector<std::size_t> free;
    std::vector<std::vector<double>> jacobian;
    for (std::size_t i = 0; i < model.parameters.size(); ++i) {
        FittedParameter parameter;
        parameter.name = model.parameters[i].name;
        parameter.unit = wire_unit(model.parameters[i], work.channel);
        parameter.value = optimum.parameters[i] / to_model_unit(model.parameters[i], work.channel);
        parameter.fixed = bounds[i].fixed();
        parameter.at_bound = !parameter.fixed && is_at_bound(model.parameters[i], bounds[i], optimum.parameters[i]);
        fit.parameters.push_back(std::move(parameter));
        if (fit.parameters.back().fixed || fit.parameters.back().at_bound) continue;
        free.push_back(i);
        jacobian.emplace_back();
        for (std::size_t j = 0; j < n; ++j) jacobian.back().push_back(optimum.scale * values.by_parameter[i * n + j]);
    }
    if (work.unit == Unit::relative && knows_scale(model)) jacobian.push_back(values.f);
    const auto errors = standard_errors(weighted, residuals(weighted, fit.values), jacobian);
    for (std::size_t i = 0; i < free.size(); ++i) {
        FittedParameter& parameter = fit.parameters[free[i]];
        if (errors[i]) parameter.std_error = *errors[i] / to_model_unit(model.parameters[free[i]], work.channel);
        else fit.warnings.push_back("the data do not determine " + parameter.name);
    }
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

/// What a search of one variant sees: for relative data and a model that does not know the scale, the data divided by
/// that of a white diffuser, and albedos not bounded above.
struct Prepared {
    Channel channel;
    std::vector<Interval> bounds;
    double convention = 1;
    ScaleRange scale;
};

Prepared prepare(const Work& work, const Model& model) {
    Prepared prepared{work.channel, parameter_bounds(model, work.request, work.channel), 1, {}};
    if (work.unit != Unit::relative) return prepared;
    const double white = white_scale(work.channel);
    if (knows_scale(model)) {
        prepared.scale = {1e-6 * white, 1e6 * white};
        return prepared;
    }
    prepared.convention = white;
    prepared.channel = divided(work.channel, white);
    for (std::size_t i = 0; i < prepared.bounds.size(); ++i)
        if (model.is_linear(i) && !prepared.bounds[i].fixed() &&
            work.request.bounds.count(model.parameters[i].name) == 0)
            prepared.bounds[i].max = model.parameters[i].domain_max;
    return prepared;
}

/// Everything the report says of an optimum.
Fit describe(const Work& work, const Prepared& prepared, Optimum optimum) {
    order_lobes(work, optimum);
    optimum.scale *= prepared.convention;
    const kernels::Precision precision = work.engine.best_precision();
    const Weighted weighted = weigh(work.channel, work.options.loss);
    Fit fit;
    fit.model = work.request.family->name;
    fit.lobes = optimum.model->repeats;
    if (work.unit == Unit::relative) fit.scale = optimum.scale;
    fit.values = scaled_values(work, precision, optimum, directions_of(work.channel));
    fit.loss = std::sqrt(residuals(weighted, fit.values).loss2);
    if (!std::isfinite(fit.loss)) throw SearchError("the model gave a value that is not finite");
    fit.relative_loss = weighted.norm > 0 ? fit.loss / weighted.norm : 0.0;
    std::size_t free = free_parameters(prepared.bounds);
    if (work.unit == Unit::relative && knows_scale(*optimum.model)) ++free;
    describe_errors(work.channel, weighted, free, fit);
    add_parameters(work, precision, weighted, optimum, prepared.bounds, fit);
    add_curves(work, precision, optimum, fit);
    fit.search = optimum.record;
    if (prepared.convention != 1)
        fit.warnings.push_back(
            "relative data do not determine this model's scale: by convention it is that of a white "
            "diffuser with the data's rms");
    return fit;
}

/// Fits the request's variants from the fewest lobes up, each from the one before, and returns the last; with "auto",
/// the last for which there is strong evidence.
Fit fit_model(const Work& work) {
    const auto start = Clock::now();
    const kernels::Family& family = *work.request.family;
    const bool automatic = family.repeat && !work.request.lobes;
    const kernels::Precision precision = work.options.precision.value_or(work.engine.best_precision());
    std::optional<Optimum> smaller;
    std::optional<Fit> fit;
    for (std::size_t lobes = family.repeat ? family.repeat->min : 1; lobes <= work.request.most_lobes(); ++lobes) {
        const Model& model = family.variant(lobes);
        const Prepared prepared = prepare(work, model);
        const Weighted weighted = weigh(prepared.channel, work.options.loss);
        const std::size_t free = free_parameters(prepared.bounds);
        if (weighted.used < free) {
            if (automatic && fit) break;
            throw SearchError("too few samples: " + std::to_string(weighted.used) + " usable ones for " +
                              std::to_string(free) + " free parameters");
        }
        const Task task{work.engine,         model,        prepared.channel, weighted, precision,
                        work.options.effort, work.control, prepared.scale};
        const Optimum optimum =
            find_optimum(task, prepared.bounds, smaller ? &*smaller : nullptr, SpecialCases::start_from);
        Fit next = describe(work, prepared, optimum);
        if (automatic && fit && !(next.bic < fit->bic - kEvidence)) break;
        fit = std::move(next);
        smaller = optimum;
    }
    fit->search.time_s = std::chrono::duration<double>(Clock::now() - start).count();
    return std::move(*fit);
}

/// A fit, or why there is none.
struct Outcome {
    std::optional<Fit> fit;
    Failure failure;
};

Outcome try_fit(const Work& work) {
    const auto failed = [&](std::string reason, const std::exception& error) {
        return Outcome{std::nullopt, {work.request.family->name, std::move(reason), error.what()}};
    };
    try {
        return {fit_model(work), {}};
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

std::vector<std::string> channel_warnings(const Channel& channel) {
    const auto dark = std::count_if(channel.samples.begin(), channel.samples.end(),
                                    [](const Sample& sample) { return sample.brdf <= 0; });
    if (dark == 0) return {};
    return {std::to_string(dark) + " of " + std::to_string(channel.samples.size()) +
            " BRDF values are not positive: taken as noise below the floor, kept, but left out where logarithms or "
            "relative errors are taken"};
}

ChannelReport rank(const Channel& channel, std::vector<Outcome> outcomes) {
    ChannelReport report{channel, {}, {}, channel_warnings(channel)};
    for (Outcome& outcome : outcomes) {
        if (outcome.fit) report.fits.push_back(std::move(*outcome.fit));
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

std::vector<Interval> parameter_bounds(const Model& model, const ModelRequest& request, const Channel& channel) {
    std::vector<Interval> bounds;
    for (const kernels::Parameter& parameter : model.parameters) {
        const double unit = to_model_unit(parameter, channel);
        Interval interval{parameter.min, parameter.max};
        if (const auto it = request.bounds.find(parameter.name); it != request.bounds.end())
            interval = {it->second.min * unit, it->second.max * unit};
        if (const auto it = request.fixed.find(parameter.name); it != request.fixed.end())
            interval = {it->second * unit, it->second * unit};
        if (!(interval.min <= interval.max)) throw InvalidBounds(parameter.name, "the lower bound is above the upper");
        // In the model's unit a bound may have become too large for a double.
        if (interval.min < parameter.domain_min || interval.max > parameter.domain_max ||
            !std::isfinite(interval.max - interval.min))
            throw InvalidBounds(parameter.name, "outside the values the model is defined for");
        bounds.push_back(interval);
    }
    return bounds;
}

std::size_t samples_needed(const ModelRequest& request, const Channel& channel) {
    const kernels::Family& family = *request.family;
    const std::size_t lobes = request.lobes.value_or(family.repeat ? family.repeat->min : 1);
    return free_parameters(parameter_bounds(family.variant(lobes), request, channel));
}

struct Fitter::Pool {
    explicit Pool(unsigned threads) : pool(threads) {}
    boost::asio::thread_pool pool;
};

Fitter::Fitter(kernels::Engine& engine, unsigned threads)
    : engine_(engine), pool_(std::make_unique<Pool>(std::max(threads, 1U))) {}

Fitter::~Fitter() { pool_->pool.join(); }

void Fitter::warm_up(const kernels::Family& family) {
    const std::vector<kernels::Direction> directions(1);
    const std::vector<double> one(1, 1.0);
    for (const Model& model : family.variants) {
        kernels::Evaluator evaluator(engine_, model, engine_.best_precision(), directions, one, one);
        std::vector<double> parameters;
        for (const kernels::Parameter& p : model.parameters) parameters.push_back(p.typical_min);
        const std::vector<double> c(model.terms.size(), 1.0);
        kernels::Batch batch;
        evaluator.project(parameters, c, c, true, batch);
        evaluator.project(parameters, c, c, false, batch);
        evaluator.loss(parameters, c, false, batch);
        (void)evaluator.terms(parameters);
    }
}

Report Fitter::fit(const Dataset& dataset, const std::vector<ModelRequest>& models, const FitOptions& options,
                   std::stop_token stop) {
    Report report{dataset.name,
                  dataset.unit,
                  options.seed,
                  engine_.device(),
                  options.precision.value_or(engine_.best_precision()),
                  {}};
    if (const auto reason = engine_.refusal(report.precision)) throw kernels::PrecisionError(*reason);
    const SearchControl control{
        options.seed, Clock::now() + std::chrono::duration_cast<Clock::duration>(options.time_limit), std::move(stop)};
    // Before anything runs: requests that cannot be met throw here, in the caller's thread.
    for (const Channel& channel : dataset.channels) {
        (void)weigh(channel, options.loss);
        for (const ModelRequest& model : models) (void)samples_needed(model, channel);
    }

    std::vector<std::vector<std::future<Outcome>>> futures;
    for (const Channel& channel : dataset.channels) {
        futures.emplace_back();
        for (const ModelRequest& model : models) {
            std::packaged_task<Outcome()> task(
                [&, work = Work{engine_, channel, dataset.unit, model, options, control}] { return try_fit(work); });
            futures.back().push_back(task.get_future());
            boost::asio::post(pool_->pool, std::move(task));
        }
    }
    for (auto& channel : futures)
        for (auto& future : channel) future.wait();  // tasks refer to this call's arguments
    for (std::size_t c = 0; c < futures.size(); ++c) {
        std::vector<Outcome> outcomes;
        for (auto& future : futures[c]) outcomes.push_back(future.get());
        report.channels.push_back(rank(dataset.channels[c], std::move(outcomes)));
    }
    return report;
}

}  // namespace brdfit::optim
