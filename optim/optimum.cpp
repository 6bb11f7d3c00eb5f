#include "optim/optimum.h"

#include <algorithm>
#include <cmath>
#include <list>
#include <numbers>
#include <numeric>
#include <random>

#include "kernels/evaluator.h"
#include "optim/descent.h"
#include "optim/search.h"
#include "optim/stationarity.h"

namespace brdfit::optim {
namespace {

using kernels::Evaluator;
using kernels::Model;

/// Points of a special case that are looked at, and those from which it descends.
constexpr std::size_t kSpecialPoints = 16;
constexpr std::size_t kSpecialStarts = 2;
/// A search over more samples than this looks at a part of them, of about so many draws.
constexpr std::size_t kThinAbove = 6000;
constexpr std::size_t kThinTo = 2000;
/// Ends of the quadratic search that the descent for another loss starts from.
constexpr std::size_t kPolished = 6;

/// Starts within each special case that the bounds leave open.
std::vector<std::vector<double>> special_starts(const Task& task, SpaceLoss& loss) {
    const SearchSpace& space = loss.space();
    std::vector<std::vector<double>> starts;
    for (const kernels::SpecialCase& special : task.model.special_cases) {
        const auto& bounds = space.bounds();
        const bool possible = std::all_of(special.fixed.begin(), special.fixed.end(), [&](const auto& fixed) {
            return bounds[fixed.first].min <= fixed.second && fixed.second <= bounds[fixed.first].max;
        });
        if (!possible) continue;
        std::vector<std::vector<double>> points = screening_points(space, kSpecialPoints, task.control.seed + 1);
        for (std::vector<double>& u : points) {
            std::vector<double> parameters = space.candidate(u).parameters;
            for (const auto& [parameter, value] : special.fixed) parameters[parameter] = value;
            const double scale = std::sqrt(task.scale.min * task.scale.max);
            u = space.coordinates(parameters, scale);
        }
        for (auto& start : best_distinct(points, loss.screen(points, task.control), kSpecialStarts))
            starts.push_back(std::move(start));
    }
    return starts;
}

/// Sizes of the positive data, as a coefficient has them.
struct Levels {
    double least = 1;
    double middle = 1;  ///< geometric mean
};
Levels levels_of(const Task& task) {
    const double scale = std::sqrt(task.scale.min * task.scale.max);
    double least = HUGE_VAL;
    double sum = 0;
    double count = 0;
    for (const Sample& sample : task.channel.samples) {
        if (!(sample.brdf > 0)) continue;
        least = std::min(least, sample.brdf);
        sum += std::log(sample.brdf);
        ++count;
    }
    return count > 0 ? Levels{least / scale, std::exp(sum / count) / scale} : Levels{};
}

/// A start where the model is 0 or nearly so at a sample has no slope, or one that leads far off: adds each with its
/// constant terms raised to the data's.
void add_lit(const Task& task, const std::vector<Interval>& bounds, const Levels& levels, std::vector<Point>& starts) {
    for (std::size_t i = 0, size = starts.size(); i < size; ++i) {
        Point lit = starts[i];
        for (const kernels::Term& term : task.model.terms) {
            if (!term.factor || !term.of.empty()) continue;
            double& value = lit.parameters[*term.factor];
            value = std::clamp(std::max(value, std::numbers::pi * levels.middle), bounds[*term.factor].min,
                               bounds[*term.factor].max);
        }
        if (lit.parameters != starts[i].parameters) starts.push_back(std::move(lit));
    }
}

/// A part of many samples, with weights so that sums over it estimate those over all.
struct Thinned {
    std::vector<kernels::Direction> directions;
    Weighted data;
};

/// Half of the draws fall evenly, half in proportion to the weighted square of the value, which narrow peaks have and
/// an even draw would miss.
Thinned thinned(const Weighted& all, std::span<const kernels::Direction> directions, std::uint64_t seed) {
    const std::size_t n = all.y.size();
    std::vector<double> share(n);
    double energy = 0;
    for (std::size_t j = 0; j < n; ++j) energy += all.weight[j] * all.y[j] * all.y[j];
    for (std::size_t j = 0; j < n; ++j)
        share[j] = 0.5 / static_cast<double>(n) +
                   (energy > 0 ? 0.5 * all.weight[j] * all.y[j] * all.y[j] / energy : 0.5 / static_cast<double>(n));
    std::vector<std::size_t> order(n);
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::mt19937_64 random(seed);
    std::shuffle(order.begin(), order.end(), random);  // a regular grid of directions must not meet regular draws
    Thinned result;
    result.data.norm = all.norm;
    double sum = 0.5;
    for (const std::size_t j : order) {
        const double expected = share[j] * static_cast<double>(kThinTo);
        const double before = std::floor(sum);
        sum += expected;
        const double draws = std::floor(sum) - before;
        if (draws == 0) continue;
        result.directions.push_back(directions[j]);
        result.data.y.push_back(all.y[j]);
        result.data.weight.push_back(all.weight[j] * draws / expected);
    }
    result.data.used = result.data.y.size();
    return result;
}

/// The end of a search in parameters, with what its record says so far.
Optimum optimum_at(const Task& task, const SearchSpace& space, const Minimum& end, const SearchRecord& record) {
    Optimum optimum{{}, &task.model, end.loss2, record, {}, {}};
    optimum.parameters = space.parameters(end.u, end.coefficients, optimum.scale);
    optimum.record.stop_reason = end.stop;
    if (end.stop == StopReason::converged && SearchSpace::out_of_range(end.coefficients))
        optimum.record.stop_reason = StopReason::roundoff;
    return optimum;
}

/// The search's other ends, a few of them, and the losses of all.
void add_others(const SearchSpace& space, SpaceLoss& loss, SearchResult& found, Optimum& optimum) {
    constexpr std::size_t kMost = 6;
    for (std::size_t i = 1; i < std::min(kMost, found.minima.size()); ++i) {
        loss.complete(found.minima[i]);
        Point point;
        point.parameters = space.parameters(found.minima[i].u, found.minima[i].coefficients, point.scale);
        optimum.others.push_back(std::move(point));
    }
    optimum.ends = found.ends;
}

/// What settling made of an optimum, unless the parameters themselves have too few digits for the search's point.
Optimum better_of(const Optimum& found, Optimum settled) {
    const bool lost = settled.relative_loss2 > found.relative_loss2 * 1.0001 + 1e-24;
    if (!lost) return settled;
    Optimum kept = found;
    kept.record.evaluations = settled.record.evaluations;
    kept.record.stop_reason =
        settled.record.stop_reason == StopReason::converged ? StopReason::roundoff : settled.record.stop_reason;
    return kept;
}

/// The search's end in the parameters themselves, settled in the precision of what is reported. The loss is the
/// projected one, or with Unknowns::all that in all parameters.
Optimum settled(const Task& task, const std::vector<Interval>& bounds, const Weighted& weighted, Unknowns unknowns,
                double level, double scale2, const Optimum& found) {
    const kernels::Precision precision = task.engine.best_precision();
    const SearchSpace space(task.model, bounds, unknowns, task.scale, level, Charts::passed_over, &task.directions);
    if (space.dimension() == 0) return found;
    Evaluator evaluator(task.engine, task.model, precision, task.directions, weighted.y, weighted.weight);
    SpaceLoss loss(evaluator, space, scale2, weighted.logarithmic);
    const Objective objective = [&](std::span<const double> u, std::span<double> g) { return loss(u, g); };
    Minimum end{space.coordinates(found.parameters, found.scale), {}, 0, found.record.stop_reason};
    end = settle(objective, std::move(end), resolution(precision), task.control);
    loss.complete(end);
    end.loss2 /= scale2;
    Optimum optimum = optimum_at(task, space, end, found.record);
    optimum.record.evaluations += loss.evaluations();
    return better_of(found, std::move(optimum));
}

/// The last steps of a search, until it is settled. A lobe's edge at a sample is a kink of the loss, and there may be
/// one behind the other: descents in the parameters themselves, with first steps of several lengths, leap over other
/// ones than those in the lobe's chart.
Optimum finished(const Task& task, const std::vector<Interval>& bounds, const Weighted& weighted, Unknowns unknowns,
                 double level, double scale2, const Optimum& found) {
    constexpr int kRounds = 6;
    if (task.control.over()) return found;
    Optimum optimum = found;
    if (std::any_of(task.model.terms.begin(), task.model.terms.end(),
                    [](const kernels::Term& term) { return term.homogeneous.has_value(); })) {
        const SearchSpace space(task.model, bounds, unknowns, task.scale, level, Charts::none);
        Evaluator evaluator(task.engine, task.model, task.precision.value_or(task.engine.best_precision()),
                            task.directions, weighted.y, weighted.weight);
        SpaceLoss loss(evaluator, space, scale2, weighted.logarithmic);
        const Landscape landscape = [&](auto at) { return loss.looks(at); };
        Minimum best{
            space.coordinates(found.parameters, found.scale), {}, found.relative_loss2, found.record.stop_reason};
        bool gains = true;
        for (int round = 0; round < kRounds && gains; ++round) {
            gains = false;
            for (const double damping : {1e-2, 1e-4, 1.0}) {
                Minimum end = descend_together(landscape, {best.u}, {1e-11, 1e-26, 60, damping}, task.control).front();
                if (!(end.loss2 < best.loss2 * (1 - 1e-9))) continue;
                best = std::move(end);
                gains = true;
            }
        }
        if (best.loss2 < found.relative_loss2) {
            loss.complete(best);
            best.loss2 /= scale2;
            optimum = optimum_at(task, space, best, found.record);
        }
        optimum.record.evaluations += loss.evaluations();
    }
    return task.control.over() ? optimum : settled(task, bounds, weighted, unknowns, level, scale2, optimum);
}

/// The search in all parameters, for a loss that is not quadratic in the coefficients.
Optimum search_in_all(const Task& task, const std::vector<Interval>& bounds, double level,
                      const std::vector<Point>& starts) {
    const SearchSpace space(task.model, bounds, Unknowns::all, task.scale, level, Charts::used, &task.directions);
    Evaluator evaluator(task.engine, task.model, task.precision.value_or(task.engine.best_precision()), task.directions,
                        task.weighted.y, task.weighted.weight);
    SpaceLoss loss(evaluator, space, 1, task.weighted.logarithmic);
    std::vector<std::vector<double>> points;
    for (const Point& start : starts) points.push_back(space.coordinates(start.parameters, start.scale));
    SpaceLoss* const stage = &loss;
    SearchResult found =
        search_space({&stage, 1}, budget(task.effort, space.dimension(), task.model.repeats), task.control, points);
    Optimum optimum = optimum_at(task, space, found.best, found.record);
    add_others(space, loss, found, optimum);
    return optimum;
}

}  // namespace

Point extended(const Model& model, const Model& smaller, const Point& point) {
    Point start{{}, point.scale};
    for (const kernels::Parameter& parameter : model.parameters) {
        const auto known = smaller.find(parameter.name);
        const bool logarithmic = parameter.scale == kernels::Scale::logarithmic;
        start.parameters.push_back(known         ? point.parameters[*known]
                                   : logarithmic ? std::sqrt(parameter.typical_min * parameter.typical_max)
                                                 : 0.0);
    }
    return start;
}

Weighted balanced(Weighted weighted) {
    if (!(weighted.norm > 0)) return weighted;
    const double unit = std::exp2(std::round(std::log2(weighted.norm)));
    for (double& w : weighted.weight) w = w / unit / unit;
    weighted.norm /= unit;
    return weighted;
}

double coefficient_level(const Task& task) { return 0.1 * levels_of(task).least; }

Optimum find_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum* smaller) {
    // A logarithmic loss is searched through the relative one, which it equals for small residuals.
    const Weighted quadratic =
        balanced(task.weighted.logarithmic ? weigh(task.channel, Loss::relative) : task.weighted);
    const double scale2 = quadratic.norm > 0 ? quadratic.norm * quadratic.norm : 1.0;
    const SearchSpace space(task.model, bounds, Unknowns::nonlinear, task.scale, 1, Charts::used, &task.directions);
    const kernels::Precision precision = task.precision.value_or(task.engine.best_precision());
    std::list<Evaluator> evaluators;  // losses keep references
    std::list<SpaceLoss> losses;
    std::vector<SpaceLoss*> stages;
    const auto add_stage = [&](kernels::Precision arithmetic, kernels::Accuracy accuracy,
                               const kernels::DirectionSet& directions, const Weighted& data) {
        evaluators.emplace_back(task.engine, task.model, arithmetic, directions, data.y, data.weight, accuracy);
        stages.push_back(&losses.emplace_back(evaluators.back(), space, scale2));
    };
    const bool series = task.model.sums_series();
    const bool coarse = !task.precision && task.model.begins_quickly();
    const kernels::Precision quick = coarse ? task.engine.quickest_precision() : precision;
    const kernels::Accuracy accuracy = coarse && series ? kernels::Accuracy::search : kernels::Accuracy::full;
    if (quadratic.y.size() > kThinAbove) {
        const Thinned thin = thinned(quadratic, task.directions.directions(), task.control.seed);
        add_stage(quick, accuracy, thin.directions, thin.data);
    }
    if (coarse) add_stage(quick, accuracy, task.directions, quadratic);
    add_stage(precision, kernels::Accuracy::full, task.directions, quadratic);
    SpaceLoss& exact = *stages.back();

    std::vector<std::vector<double>> seeds = special_starts(task, *stages.front());
    if (smaller != nullptr) {
        const Point start = extended(task.model, *smaller->model, *smaller);
        seeds.push_back(space.coordinates(start.parameters, start.scale));
    }
    SearchResult found =
        search_space(stages, budget(task.effort, space.dimension(), task.model.repeats), task.control, seeds);
    found.best.loss2 /= scale2;
    Optimum optimum = optimum_at(task, space, found.best, found.record);
    if (!task.weighted.logarithmic) {
        Optimum end = finished(task, bounds, quadratic, Unknowns::nonlinear, 1, scale2, optimum);
        add_others(space, exact, found, end);
        return end;
    }

    std::vector<Point> starts;
    if (smaller != nullptr) starts.push_back(extended(task.model, *smaller->model, *smaller));
    for (std::size_t i = 0; i < std::min(kPolished, found.minima.size()); ++i) {
        exact.complete(found.minima[i]);
        Point start;
        start.parameters = space.parameters(found.minima[i].u, found.minima[i].coefficients, start.scale);
        starts.push_back(std::move(start));
    }
    const Levels levels = levels_of(task);
    add_lit(task, bounds, levels, starts);
    const double level = coefficient_level(task);
    optimum = search_in_all(task, bounds, level, starts);
    optimum.record.evaluations += found.record.evaluations;
    Optimum end = finished(task, bounds, task.weighted, Unknowns::all, level, 1, optimum);
    end.others = std::move(optimum.others);
    end.ends = std::move(optimum.ends);
    return end;
}

}  // namespace brdfit::optim
