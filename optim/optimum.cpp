#include "optim/optimum.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <random>

#include "kernels/evaluator.h"
#include "optim/search.h"
#include "optim/stationarity.h"

namespace brdfit::optim {
namespace {

using kernels::Evaluator;
using kernels::Model;

/// Guesses for the lobe that a larger variant has more.
constexpr std::size_t kLobeGuesses = 256;
/// Ends of the quadratic search that the descent for another loss starts from.
constexpr std::size_t kPolished = 6;

std::vector<kernels::Direction> directions_of(const Task& task) {
    std::vector<kernels::Direction> directions;
    for (const Sample& sample : task.channel.samples) directions.push_back(sample.direction);
    return directions;
}

/// A point to start from.
struct Start {
    std::vector<double> parameters;
    double scale = 1;
};

/// The smaller variant's optimum with guesses for the lobe that it lacks; the first has height 0.
std::vector<Start> extended(const Model& model, const Optimum& smaller, std::uint64_t seed) {
    std::vector<bool> is_height(model.parameters.size(), false);
    for (const kernels::Term& term : model.terms) {
        if (term.factor) is_height[*term.factor] = true;
        if (term.homogeneous)
            is_height[term.homogeneous->plane.first] = is_height[term.homogeneous->plane.second] = true;
    }
    std::mt19937_64 random(seed);
    std::uniform_real_distribution<double> uniform(0, 1);
    std::vector<Start> starts(1 + kLobeGuesses, {std::vector<double>(model.parameters.size()), smaller.scale});
    for (std::size_t i = 0; i < model.parameters.size(); ++i) {
        const kernels::Parameter& parameter = model.parameters[i];
        const auto known = smaller.model->find(parameter.name);
        for (Start& start : starts) {
            const double x = uniform(random);
            double& value = start.parameters[i];
            if (known) value = smaller.parameters[*known];
            else if (&start == &starts.front() && is_height[i]) value = 0;
            else if (parameter.scale == kernels::Scale::logarithmic)
                value = parameter.typical_min * std::pow(parameter.typical_max / parameter.typical_min, x);
            else value = parameter.typical_min + x * (parameter.typical_max - parameter.typical_min);
        }
    }
    return starts;
}

/// The optimum of each special case that the bounds leave open; counts its evaluations.
std::vector<Start> special_cases(const Task& task, const std::vector<Interval>& bounds, SearchRecord& record) {
    std::vector<Start> starts;
    for (const kernels::SpecialCase& special : task.model.special_cases) {
        std::vector<Interval> narrowed = bounds;
        bool narrower = false;
        bool possible = true;
        for (const auto& [parameter, value] : special.fixed) {
            possible = possible && bounds[parameter].min <= value && value <= bounds[parameter].max;
            narrower = narrower || !bounds[parameter].fixed();
            narrowed[parameter] = {value, value};
        }
        if (!possible || !narrower || task.control.over()) continue;
        Task quick = task;  // a start among others needs no certainty
        quick.effort = Effort::draft;
        const Optimum optimum = find_optimum(quick, narrowed, nullptr, SpecialCases::pass_over);
        record.evaluations += optimum.record.evaluations;
        starts.push_back({optimum.parameters, optimum.scale});
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
void add_lit(const Task& task, const std::vector<Interval>& bounds, const Levels& levels, std::vector<Start>& starts) {
    for (std::size_t i = 0, size = starts.size(); i < size; ++i) {
        Start lit = starts[i];
        for (const kernels::Term& term : task.model.terms) {
            if (!term.factor || !term.of.empty()) continue;
            double& value = lit.parameters[*term.factor];
            value = std::clamp(std::max(value, std::numbers::pi * levels.middle), bounds[*term.factor].min,
                               bounds[*term.factor].max);
        }
        if (lit.parameters != starts[i].parameters) starts.push_back(std::move(lit));
    }
}

/// With weights of a size that single precision can sum: sum of w y^2 near 1.
Weighted balanced(Weighted weighted) {
    if (!(weighted.norm > 0)) return weighted;
    const double unit = std::exp2(std::round(std::log2(weighted.norm)));
    for (double& w : weighted.weight) w = w / unit / unit;
    weighted.norm /= unit;
    return weighted;
}

/// The loss of a task in all parameters, for a loss that is not quadratic in the coefficients. References must outlive
/// it.
class FullLoss {
public:
    FullLoss(const Task& task, const SearchSpace& space, kernels::Precision precision)
        : space_(space),
          logarithmic_(task.weighted.logarithmic),
          evaluator_(task.engine, task.model, precision, directions_of(task), task.weighted.y, task.weighted.weight) {}

    double operator()(std::span<const double> u, std::span<double> gradient) {
        ++evaluations_;
        const Candidate at = space_.candidate(u);
        evaluator_.loss(at.parameters, at.lower, logarithmic_, batch_);
        if (!gradient.empty()) {
            space_.gradient(u, at, batch_.coefficients, batch_.by_parameter, batch_.by_coefficient, gradient);
            // Near underflow the slope of a logarithm overflows; at underflow there is none.
            for (double& slope : gradient)
                if (!std::isfinite(slope)) slope = 0;
        }
        return batch_.loss[0];
    }
    [[nodiscard]] std::size_t evaluations() const { return evaluations_; }

private:
    const SearchSpace& space_;
    bool logarithmic_;
    Evaluator evaluator_;
    kernels::Batch batch_;
    std::size_t evaluations_ = 0;
};

/// The end of a search in parameters, with what its record says so far.
Optimum optimum_at(const Task& task, const SearchSpace& space, const Minimum& end, const SearchRecord& record) {
    Optimum optimum{&task.model, {}, 1, end.loss2, record};
    optimum.parameters = space.parameters(end.u, end.coefficients, optimum.scale);
    optimum.record.stop_reason = end.stop;
    if (end.stop == StopReason::converged && SearchSpace::out_of_range(end.coefficients))
        optimum.record.stop_reason = StopReason::roundoff;
    return optimum;
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

/// Settles an optimum of the projected loss, in the precision of what is reported.
Optimum settled(const Task& task, const std::vector<Interval>& bounds, const Weighted& quadratic, double scale2,
                const Optimum& found) {
    const kernels::Precision precision = task.engine.best_precision();
    const SearchSpace space(task.model, bounds, Unknowns::nonlinear, task.scale, 1, Charts::passed_over);
    Evaluator evaluator(task.engine, task.model, precision, directions_of(task), quadratic.y, quadratic.weight);
    ProjectedLoss problem(evaluator, space, scale2);
    const Objective objective = [&](std::span<const double> u, std::span<double> g) { return problem(u, g); };
    Minimum end{space.coordinates(found.parameters, found.scale), {}, 0, found.record.stop_reason};
    end = settle(objective, std::move(end), resolution(precision), task.control);
    problem.complete(end);
    end.loss2 /= scale2;
    Optimum optimum = optimum_at(task, space, end, found.record);
    optimum.record.evaluations += problem.evaluations();
    return better_of(found, std::move(optimum));
}

/// The same for the loss in all parameters.
Optimum settled_in_all(const Task& task, const std::vector<Interval>& bounds, double level, const Optimum& found) {
    const kernels::Precision precision = task.engine.best_precision();
    const SearchSpace space(task.model, bounds, Unknowns::all, task.scale, level, Charts::passed_over);
    FullLoss loss(task, space, precision);
    const Objective objective = [&](std::span<const double> u, std::span<double> g) { return loss(u, g); };
    Minimum end{space.coordinates(found.parameters, found.scale), {}, 0, found.record.stop_reason};
    end = settle(objective, std::move(end), resolution(precision), task.control);
    end.loss2 = objective(end.u, {});
    end.coefficients = space.candidate(end.u).lower;
    Optimum optimum = optimum_at(task, space, end, found.record);
    optimum.record.evaluations += loss.evaluations();
    return better_of(found, std::move(optimum));
}

/// Descents in all parameters.
Optimum descend_in_all(const Task& task, const std::vector<Interval>& bounds, double level,
                       const std::vector<Start>& starts) {
    const SearchSpace space(task.model, bounds, Unknowns::all, task.scale, level);
    FullLoss loss(task, space, task.precision);
    const Objective objective = [&](std::span<const double> u, std::span<double> g) { return loss(u, g); };
    std::vector<std::vector<double>> points;
    for (const Start& start : starts) points.push_back(space.coordinates(start.parameters, start.scale));
    Descents found = descend_all(objective, points, 500, task.control);
    found.best.coefficients = space.candidate(found.best.u).lower;
    return optimum_at(task, space, found.best,
                      {found.ends.size(), found.agreed, loss.evaluations(), found.best.stop, 0});
}

}  // namespace

Optimum find_optimum(const Task& task, const std::vector<Interval>& bounds, const Optimum* smaller,
                     SpecialCases with_special_cases) {
    SearchRecord extra;
    std::vector<Start> known;
    if (with_special_cases == SpecialCases::start_from) known = special_cases(task, bounds, extra);
    const std::size_t fixed_starts = known.size() + (smaller != nullptr ? 1 : 0);
    if (smaller != nullptr) {
        const std::vector<Start> guesses = extended(task.model, *smaller, task.control.seed);
        known.insert(known.end(), guesses.begin(), guesses.end());
    }

    // A logarithmic loss is searched through the relative one, which it equals for small residuals.
    const Weighted quadratic =
        balanced(task.weighted.logarithmic ? weigh(task.channel, Loss::relative) : task.weighted);
    const SearchSpace space(task.model, bounds, Unknowns::nonlinear, task.scale);
    Evaluator evaluator(task.engine, task.model, task.precision, directions_of(task), quadratic.y, quadratic.weight);
    std::vector<std::vector<double>> seeds;
    for (const Start& start : known) {
        seeds.push_back(space.coordinates(start.parameters, start.scale));
        // On an edge of the cube the slope across may vanish by symmetry: begin a little inside as well.
        std::vector<double> inside = seeds.back();
        for (double& x : inside) x = std::clamp(x, 0.02, 0.98);
        if (inside != seeds.back()) seeds.push_back(std::move(inside));
    }
    const double scale2 = quadratic.norm > 0 ? quadratic.norm * quadratic.norm : 1.0;
    SearchResult found =
        search_projected(evaluator, space, budget(task.effort, space.dimension()), task.control, scale2, seeds);
    found.best.loss2 /= scale2;
    Optimum optimum = optimum_at(task, space, found.best, found.record);
    // A special case is a start among others.
    const bool settles = with_special_cases == SpecialCases::start_from && !task.control.over();
    if (task.weighted.logarithmic) {
        known.resize(fixed_starts);
        ProjectedLoss problem(evaluator, space, scale2);
        for (std::size_t i = 0; i < std::min(kPolished, found.minima.size()); ++i) {
            problem.complete(found.minima[i]);
            Start start;
            start.parameters = space.parameters(found.minima[i].u, found.minima[i].coefficients, start.scale);
            known.push_back(std::move(start));
        }
        const Levels levels = levels_of(task);
        add_lit(task, bounds, levels, known);
        const double level = 0.1 * levels.least;
        optimum = descend_in_all(task, bounds, level, known);
        optimum.record.evaluations += found.record.evaluations;
        if (settles) optimum = settled_in_all(task, bounds, level, optimum);
    } else if (settles && space.dimension() > 0) {
        optimum = settled(task, bounds, quadratic, scale2, optimum);
    }
    optimum.record.evaluations += extra.evaluations;
    return optimum;
}

}  // namespace brdfit::optim
