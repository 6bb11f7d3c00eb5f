#include "optim/optimum.h"

#include <algorithm>
#include <cmath>
#include <list>
#include <numbers>
#include <optional>
#include <random>

#include "kernels/evaluator.h"
#include "optim/descent.h"
#include "optim/robust.h"
#include "optim/search.h"
#include "optim/space_loss.h"
#include "optim/stationarity.h"
#include "optim/statistics.h"
#include "optim/thinned.h"

namespace brdfit::optim {
namespace {

using kernels::Evaluator;
using kernels::Model;

/// Points of a special case that are looked at, and those from which it descends.
constexpr std::size_t kSpecialPoints = 16;
constexpr std::size_t kSpecialStarts = 2;
/// Screenings look at a part of the samples first, if the search sees more than this: of one in so many draws. Not for
/// several lobes, which may be as narrow as a sample.
constexpr std::size_t kGlanceAbove = 250;
constexpr std::size_t kGlanceShare = 4;
/// Ends of the quadratic search that the descent for another loss starts from.
constexpr std::size_t kPolished = 6;

/// From ends that a part of the samples has shown, through all of them: these are as good as there, and what cannot be
/// the best is not followed.
constexpr DescentGoal kThroughAllGoal{
    .relative = 1e-11, .absolute = 1e-26, .looks = 60, .damping = 1e-4, .hopeful = 0.1};

/// Searches under reweighted squares, each from the fit before.
constexpr int kReweightings = 6;
/// A model with so few parameters that are not coefficients is quickly searched.
constexpr std::size_t kFew = 3;
/// Ends of short descents under a robust loss that go on.
constexpr std::size_t kLast = 2;
/// A scale of residuals that falls by less has settled.
constexpr double kSettledScale = 0.98;
/// A loss^2 that falls to more than this part of the one before is no other fit.
constexpr double kAsGood = 1 - 1e-6;

/// Whether a search begins in the quickest arithmetic.
bool begins_quickly(const Task& task) { return !task.precision && task.model.begins_quickly(); }
bool is_small(const Model& model) { return model.nonlinear().size() <= kFew; }
kernels::Precision exact_precision(const Task& task) { return task.precision.value_or(task.engine.best_precision()); }

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

/// What losses of a search are divided by: loss^2 of f = 0.
double scale2_of(const Weighted& weighted) { return weighted.norm > 0 ? weighted.norm * weighted.norm : 1.0; }

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

/// The best of ends that a part of the samples has led to, as all of them see it: on from those that may be it. At
/// least one end.
Minimum best_through_all(SpaceLoss& part, const std::vector<Minimum>& ends, const SearchControl& control) {
    if (part.space().dimension() == 0) {
        Minimum only;
        part.whole().complete(only);
        return only;
    }
    std::vector<std::vector<double>> starts;
    for (const Minimum& end : ends) starts.push_back(end.u);
    const Landscape landscape = [&](auto at) { return part.whole().looks_bent_by(part, at); };
    std::vector<Minimum> found = descend_together(landscape, starts, kThroughAllGoal, control);
    Minimum best = *std::min_element(found.begin(), found.end(),
                                     [](const Minimum& a, const Minimum& b) { return a.loss2 < b.loss2; });
    part.whole().complete(best);
    return best;
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
    SpaceLoss loss(evaluator, space, scale2, &weighted);
    const Objective objective = [&](std::span<const double> u, std::span<double> g) { return loss(u, g); };
    Minimum end{space.coordinates(found.parameters, found.scale), {}, 0, found.record.stop_reason};
    std::optional<Thinned> thin;
    std::optional<Evaluator> thin_evaluator;
    std::optional<SpaceLoss> thin_loss;
    Objective bends;
    if (weighted.y.size() > kThinAbove && weighted.robust == Robust::none) {
        thin = thinned(weighted, task.directions.directions(), kThinTo, task.control.seed);
        thin_evaluator.emplace(task.engine, task.model, precision, thin->directions, thin->data.y, thin->data.weight);
        thin_loss.emplace(*thin_evaluator, space, scale2, &thin->data);
        bends = [&](std::span<const double> u, std::span<double> g) { return (*thin_loss)(u, g); };
    }
    end = settle(objective, std::move(end), resolution(precision), task.control, bends);
    loss.complete(end);
    end.loss2 /= scale2;
    Optimum optimum = optimum_at(task, space, end, found.record);
    optimum.record.evaluations += loss.evaluations() + (thin_loss ? thin_loss->evaluations() : 0);
    return better_of(found, std::move(optimum));
}

/// At a kink of the loss, such as a sample's critical angle is, no slope tells the way on: a point about the end may.
/// What a descent from the best such point ends at, or what was found if none is better.
Optimum beside(const Task& task, const std::vector<Interval>& bounds, const Weighted& weighted, Unknowns unknowns,
               double level, double scale2, const Optimum& found) {
    constexpr std::size_t kOfSize = 20;
    const SearchSpace space(task.model, bounds, unknowns, task.scale, level, Charts::none);
    if (space.dimension() == 0 || weighted.y.size() > kThinAbove) return found;
    Evaluator evaluator(task.engine, task.model, task.engine.best_precision(), task.directions, weighted.y,
                        weighted.weight);
    SpaceLoss loss(evaluator, space, scale2, &weighted);
    std::mt19937_64 random(task.control.seed);
    std::uniform_real_distribution<double> uniform(-1.0, 1.0);
    std::vector<std::vector<double>> points;
    for (const double size : {1e-2, 1e-3, 1e-4})
        for (std::size_t k = 0; k < kOfSize; ++k) {
            std::vector<double> parameters = found.parameters;
            for (std::size_t i = 0; i < parameters.size(); ++i)
                parameters[i] = std::clamp(parameters[i] * (1 + size * uniform(random)), bounds[i].min, bounds[i].max);
            points.push_back(space.coordinates(parameters, found.scale));
        }
    const std::vector<double> values = loss.screen(points, task.control);
    const auto least = std::min_element(values.begin(), values.end());
    if (!(*least < found.relative_loss2 * (1 - 1e-9))) {
        Optimum same = found;
        same.record.evaluations += loss.evaluations();
        return same;
    }
    const Landscape landscape = [&](auto at) { return loss.looks(at); };
    const auto& start = points[static_cast<std::size_t>(least - values.begin())];
    Minimum end = descend_together(landscape, {start}, {1e-11, 1e-26, 60}, task.control).front();
    loss.complete(end);
    end.loss2 /= scale2;
    Optimum optimum = optimum_at(task, space, end, found.record);
    optimum.record.evaluations += loss.evaluations();
    return optimum;
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
        Evaluator evaluator(task.engine, task.model, exact_precision(task), task.directions, weighted.y,
                            weighted.weight);
        SpaceLoss loss(evaluator, space, scale2, &weighted);
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
    if (task.control.over()) return optimum;
    optimum = settled(task, bounds, weighted, unknowns, level, scale2, optimum);
    for (int round = 0; round < kRounds && optimum.record.stop_reason == StopReason::roundoff; ++round) {
        Optimum next = beside(task, bounds, weighted, unknowns, level, scale2, optimum);
        const bool better = next.relative_loss2 < optimum.relative_loss2;
        optimum = better ? settled(task, bounds, weighted, unknowns, level, scale2, next) : std::move(next);
        if (!better) break;
    }
    return optimum;
}

/// A loss that is not quadratic in the coefficients, in all parameters.
struct AllParameters {
    AllParameters(const Task& task, const std::vector<Interval>& bounds, double level, const Weighted& form,
                  kernels::Precision precision, kernels::Accuracy accuracy)
        : space(task.model, bounds, Unknowns::all, task.scale, level, Charts::used, &task.directions),
          evaluator(task.engine, task.model, precision, task.directions, form.y, form.weight, accuracy),
          scale2(scale2_of(form)),
          loss(evaluator, space, scale2, &form) {}

    [[nodiscard]] std::vector<std::vector<double>> points(const std::vector<Point>& starts) const {
        std::vector<std::vector<double>> result;
        for (const Point& start : starts) result.push_back(space.coordinates(start.parameters, start.scale));
        return result;
    }

    SearchSpace space;
    Evaluator evaluator;
    double scale2;
    SpaceLoss loss;
};

Optimum search_in_all(const Task& task, const std::vector<Interval>& bounds, double level,
                      const std::vector<Point>& starts, Effort effort, bool from_starts_alone) {
    AllParameters all(task, bounds, level, task.weighted, exact_precision(task), kernels::Accuracy::full);
    SpaceLoss* const stage = &all.loss;
    const SearchBudget allowed =
        from_starts_alone ? SearchBudget{} : budget(effort, all.space.dimension(), task.model.repeats);
    SearchResult found = search_space({&stage, 1}, allowed, task.control, all.points(starts));
    found.best.loss2 /= all.scale2;
    Optimum optimum = optimum_at(task, all.space, found.best, found.record);
    add_others(all.space, all.loss, found, optimum);
    return optimum;
}

/// The squares that are searched for the loss: a logarithmic one equals the relative one for small residuals.
Weighted squares_of(const Task& task) {
    if (task.weighted.logarithmic) return weigh(task.channel, Loss::relative);
    Weighted squares = task.weighted;
    if (squares.robust == Robust::none) return squares;
    squares.robust = Robust::none;
    double norm2 = 0;
    for (std::size_t j = 0; j < squares.y.size(); ++j) norm2 += squares.weight[j] * squares.y[j] * squares.y[j];
    squares.norm = std::sqrt(norm2);
    return squares;
}

/// What a search of the coefficients' projection has found.
struct Separable {
    Optimum optimum;            ///< not settled
    std::vector<Point> starts;  ///< the best distinct ends
};

/// Searches under balanced squares. `smaller`: a start, may be nullptr. `ends`: how many are asked for.
Separable search_separable(const Task& task, const std::vector<Interval>& bounds, const Weighted& squares,
                           const Point* smaller, std::size_t ends, Effort effort) {
    const double scale2 = scale2_of(squares);
    const SearchSpace space(task.model, bounds, Unknowns::nonlinear, task.scale, 1, Charts::used, &task.directions);
    const kernels::Precision precision = exact_precision(task);
    std::list<Evaluator> evaluators;  // losses keep references
    std::list<SpaceLoss> losses;
    std::vector<SpaceLoss*> stages;
    const auto loss_of = [&](kernels::Precision arithmetic, kernels::Accuracy accuracy,
                             const kernels::DirectionSet& directions, const Weighted& data) {
        evaluators.emplace_back(task.engine, task.model, arithmetic, directions, data.y, data.weight, accuracy);
        return &losses.emplace_back(evaluators.back(), space, scale2);
    };
    const bool coarse = begins_quickly(task);
    const kernels::Precision quick = coarse ? task.engine.quickest_precision() : precision;
    const kernels::Accuracy accuracy = coarse ? task.model.first_accuracy() : kernels::Accuracy::full;
    std::optional<Thinned> thin;
    std::optional<kernels::DirectionSet> thin_directions;
    if (squares.y.size() > kThinAbove) {
        thin = thinned(squares, task.directions.directions(), kThinTo, task.control.seed);
        thin_directions.emplace(thin->directions);
    }
    const kernels::DirectionSet& directions = thin ? *thin_directions : task.directions;
    const Weighted& data = thin ? thin->data : squares;
    StepScan scan(task.model, directions, data);
    if (coarse) stages.push_back(loss_of(quick, accuracy, directions, data));
    stages.push_back(loss_of(precision, kernels::Accuracy::full, directions, data));
    SpaceLoss& exact = *stages.back();
    if (thin) exact.stand_for(*loss_of(precision, kernels::Accuracy::full, task.directions, squares));
    // Of logarithms the search under squares makes starts, and what is best for squares alone is none.
    const bool only_starts = task.weighted.logarithmic;
    if (const std::size_t seen = stages.front()->samples();
        coarse && !only_starts && task.model.repeats <= 1 && seen > kGlanceAbove) {
        const Thinned few = thinned(squares, task.directions.directions(), seen / kGlanceShare, task.control.seed + 1);
        stages.front()->glance_through(*loss_of(quick, accuracy, few.directions, few.data));
    }

    std::vector<std::vector<double>> seeds = special_starts(task, *stages.front());
    if (smaller != nullptr) seeds.push_back(space.coordinates(smaller->parameters, smaller->scale));
    SearchResult found = search_space(stages, budget(effort, space.dimension(), task.model.repeats), task.control,
                                      seeds, only_starts ? nullptr : &scan);
    if (thin) {
        std::vector<Minimum> seen = std::move(found.last);
        if (smaller != nullptr) seen.push_back({seeds.back(), {}, 0, StopReason::converged});
        found.best = best_through_all(exact, seen, task.control);
        found.record.evaluations += exact.whole().evaluations();
        found.record.stop_reason = found.best.stop;
    }
    found.best.loss2 /= scale2;
    Separable result{optimum_at(task, space, found.best, found.record), {}};
    add_others(space, exact, found, result.optimum);
    for (std::size_t i = 0; i < std::min(ends, found.minima.size()); ++i) {
        exact.complete(found.minima[i]);
        Point start;
        start.parameters = space.parameters(found.minima[i].u, found.minima[i].coefficients, start.scale);
        result.starts.push_back(std::move(start));
    }
    return result;
}

/// Loss and residuals of a model at a start.
Residuals residuals_at(const Task& task, const Point& start) {
    std::vector<double> f = kernels::evaluate(task.engine, task.model, task.engine.best_precision(), start.parameters,
                                              task.directions, false)
                                .f;
    for (double& value : f) value *= start.scale;
    return residuals(task.weighted, f);
}

/// The ends of short descents under a loss that is not quadratic in the coefficients, best first: but for small models
/// only the best is followed to its end, and they move in the search's quick arithmetic, if it has one.
std::vector<Point> descended(const Task& task, const std::vector<Interval>& bounds, double level, const Weighted& form,
                             const std::vector<Point>& starts, std::size_t& evaluations) {
    constexpr double kHopeful = 0.01;
    constexpr double kSame = 1e-2;
    const bool quickly = begins_quickly(task);
    const DescentGoal goal{.relative = quickly ? 1e-4 : 1e-6, .hopeful = is_small(task.model) ? 0.0 : kHopeful};
    AllParameters all(task, bounds, level, form, quickly ? task.engine.quickest_precision() : exact_precision(task),
                      quickly ? task.model.first_accuracy() : kernels::Accuracy::full);
    if (all.space.dimension() == 0) return starts;
    const Landscape landscape = [&](auto at) { return all.loss.looks(at); };
    std::vector<Minimum> ends = descend_together(landscape, all.points(starts), goal, task.control);
    std::stable_sort(ends.begin(), ends.end(), [](const Minimum& a, const Minimum& b) { return a.loss2 < b.loss2; });
    std::vector<Point> result;
    for (Minimum& end : distinct_ends(ends, kSame)) {
        if (result.size() == kPolished) break;
        all.loss.complete(end);
        Point start;
        start.parameters = all.space.parameters(end.u, end.coefficients, start.scale);
        result.push_back(std::move(start));
    }
    evaluations += all.loss.evaluations();
    return result;
}

/// Of searches that others have gone before.
Effort again(Effort effort) { return effort == Effort::standard ? Effort::draft : effort; }

/// Size from which on coefficients are searched by their logarithm.
double level_of(const Task& task, const Levels& levels) {
    return 0.1 * (task.weighted.logarithmic ? levels.least : levels.middle);
}

/// The last steps of a search, and what else it has found.
Optimum finished_with_others(const Task& task, const std::vector<Interval>& bounds, const Weighted& weighted,
                             Unknowns unknowns, double level, double scale2, const Optimum& found) {
    Optimum optimum = finished(task, bounds, weighted, unknowns, level, scale2, found);
    optimum.others = found.others;
    optimum.ends = found.ends;
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

double coefficient_level(const Task& task) { return level_of(task, levels_of(task)); }

void add_before(SearchRecord& record, std::size_t evaluations) {
    record.evaluations += evaluations;
    for (Milestone& milestone : record.milestones) milestone.evaluations += evaluations;
}

Optimum find_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum* smaller) {
    const Weighted squares = balanced(squares_of(task));
    std::optional<Point> extension;
    if (smaller != nullptr) extension = extended(task.model, *smaller->model, *smaller);
    Separable found = search_separable(task, bounds, squares, extension ? &*extension : nullptr,
                                       task.weighted.logarithmic ? kPolished : 0, task.effort);
    if (!task.weighted.logarithmic)
        return finished_with_others(task, bounds, squares, Unknowns::nonlinear, 1, scale2_of(squares), found.optimum);

    std::vector<Point> starts;
    if (extension) starts.push_back(*extension);
    starts.insert(starts.end(), found.starts.begin(), found.starts.end());
    const Levels levels = levels_of(task);
    add_lit(task, bounds, levels, starts);
    const double level = level_of(task, levels);
    Optimum optimum = search_in_all(task, bounds, level, starts, task.effort, false);
    add_before(optimum.record, found.optimum.record.evaluations);
    return finished_with_others(task, bounds, task.weighted, Unknowns::all, level, 1, optimum);
}

Groundwork lay_groundwork(const Task& task, const std::vector<Interval>& bounds, const Point* smaller,
                          const Model* smaller_model) {
    const Weighted squares = squares_of(task);
    const Levels levels = levels_of(task);
    const double level = level_of(task, levels);
    const auto free = static_cast<std::size_t>(
        std::count_if(bounds.begin(), bounds.end(), [](const Interval& b) { return !b.fixed(); }));
    std::optional<Point> extension;
    if (smaller != nullptr) extension = extended(task.model, *smaller_model, *smaller);
    Groundwork work;
    const auto search = [&](const Weighted& of, Effort effort) {
        Separable found =
            search_separable(task, bounds, balanced(of), extension ? &*extension : nullptr, kPolished, effort);
        work.evaluations += found.optimum.record.evaluations;
        work.starts.insert(work.starts.end(), found.starts.begin(), found.starts.end());
    };
    if (extension) work.starts.push_back(*extension);
    search(squares, is_small(task.model) ? task.effort : again(task.effort));
    if (task.weighted.logarithmic) add_lit(task, bounds, levels, work.starts);
    std::vector<double> best;  // residuals
    // The least scale of the starts, of which the first is the one that has it.
    const auto least_scale = [&] {
        double least = HUGE_VAL;
        for (Point& start : work.starts) {
            std::vector<double> r = residuals_at(task, start).r;
            const double scale = robust_scale(task.weighted, r, free);
            if (!(scale < least)) continue;
            least = scale;
            best = std::move(r);
            std::swap(work.starts.front(), start);
        }
        return least;
    };
    work.scale = least_scale();
    Weighted form = task.weighted;
    Criterion cauchy;
    cauchy.robust = form.robust = Robust::cauchy;
    form.threshold = cauchy.threshold();
    for (int round = 0; round < kReweightings && !task.control.over(); ++round) {
        form.scale = work.scale;
        search(reweighted(squares, form, best), again(task.effort));
        work.starts = descended(task, bounds, level, form, work.starts, work.evaluations);
        double next = least_scale();
        const bool settled = next > kSettledScale * work.scale;
        // The next search is worth more at weights that stay.
        for (int k = 0; k < kReweightings && next <= kSettledScale * form.scale && !task.control.over(); ++k) {
            form.scale = next;
            Point& front = work.starts.front();
            front = descended(task, bounds, level, form, {front}, work.evaluations).front();
            best = residuals_at(task, front).r;
            next = robust_scale(task.weighted, best, free);
        }
        work.scale = std::min({work.scale, form.scale, next});
        if (settled) break;
    }
    return work;
}

Optimum find_robust_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum* smaller,
                            const Groundwork& groundwork) {
    const Weighted squares = squares_of(task);
    const double level = coefficient_level(task);
    std::vector<Point> starts = groundwork.starts;
    std::optional<Point> extension;
    if (smaller != nullptr) starts.push_back(extension.emplace(extended(task.model, *smaller->model, *smaller)));
    std::size_t evaluations = groundwork.evaluations;
    starts = descended(task, bounds, level, task.weighted, starts, evaluations);
    starts.resize(std::min(starts.size(), kLast));
    if (extension) starts.push_back(*extension);
    Optimum optimum = search_in_all(task, bounds, level, starts, task.effort, task.effort != Effort::thorough);
    add_before(optimum.record, evaluations);
    evaluations = 0;
    const double scale2 = scale2_of(task.weighted);
    // The squares that touch the loss at the best fit so far may lead to a better one.
    for (int round = 0; round < kReweightings && !task.control.over(); ++round) {
        const Point here{optimum.parameters, optimum.scale};
        const Weighted touching = balanced(reweighted(squares, task.weighted, residuals_at(task, here).r));
        Separable found =
            search_separable(task, bounds, touching, extension ? &*extension : nullptr, kPolished, task.effort);
        evaluations += found.optimum.record.evaluations;
        const Point best = descended(task, bounds, level, task.weighted, found.starts, evaluations).front();
        const double relative_loss2 = residuals_at(task, best).loss2 / scale2;
        if (!(relative_loss2 < optimum.relative_loss2)) break;
        const bool settled = relative_loss2 > optimum.relative_loss2 * kAsGood;
        optimum.parameters = best.parameters;
        optimum.scale = best.scale;
        optimum.relative_loss2 = relative_loss2;
        if (settled) break;
    }
    optimum.record.evaluations += evaluations;
    return finished_with_others(task, bounds, task.weighted, Unknowns::all, level, scale2, optimum);
}

}  // namespace brdfit::optim
