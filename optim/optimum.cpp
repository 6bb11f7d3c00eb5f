#include "optim/optimum.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <random>

#include "kernels/evaluator.h"
#include "optim/search.h"

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
        if (!possible || !narrower) continue;
        Task quick = task;  // a start among others needs no certainty
        quick.effort = Effort::draft;
        const Optimum optimum = find_optimum(quick, narrowed, nullptr, SpecialCases::pass_over);
        record.evaluations += optimum.record.evaluations;
        starts.push_back({optimum.parameters, optimum.scale});
    }
    return starts;
}

/// Descents in all parameters, for a loss that is not quadratic in the coefficients.
Optimum descend_in_all(const Task& task, const SearchSpace& space, const std::vector<Start>& starts) {
    Evaluator evaluator(task.engine, task.model, task.precision, directions_of(task), task.weighted.y,
                        task.weighted.weight);
    kernels::Batch batch;
    std::size_t evaluations = 0;
    const Objective objective = [&](std::span<const double> u, std::span<double> gradient) {
        ++evaluations;
        const Candidate at = space.candidate(u);
        evaluator.loss(at.parameters, at.lower, task.weighted.logarithmic, batch);
        if (!gradient.empty())
            space.gradient(u, at, batch.coefficients, batch.by_parameter, batch.by_coefficient, gradient);
        return batch.loss[0];
    };
    std::vector<std::vector<double>> points;
    for (const Start& start : starts) points.push_back(space.coordinates(start.parameters, start.scale));
    const Descents found = descend_all(objective, points, 500, task.control);
    Optimum optimum{&task.model, {}, 1, {}};
    optimum.parameters = space.parameters(found.best.u, space.candidate(found.best.u).lower, optimum.scale);
    optimum.record = {found.ends.size(), found.agreed, evaluations, found.best.stop, 0};
    return optimum;
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
    const Weighted quadratic = task.weighted.logarithmic ? weigh(task.channel, Loss::relative) : task.weighted;
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
    const SearchResult found =
        search_projected(evaluator, space, budget(task.effort, space.dimension()), task.control, scale2, seeds);
    Optimum optimum{&task.model, {}, 1, found.record};
    optimum.parameters = space.parameters(found.best.u, found.best.coefficients, optimum.scale);
    if (task.weighted.logarithmic) {
        known.resize(fixed_starts);
        for (std::size_t i = 0; i < std::min(kPolished, found.minima.size()); ++i) {
            Start start;
            start.parameters = space.parameters(found.minima[i].u, found.minima[i].coefficients, start.scale);
            known.push_back(std::move(start));
        }
        optimum = descend_in_all(task, SearchSpace(task.model, bounds, Unknowns::all, task.scale), known);
        optimum.record.evaluations += found.record.evaluations;
    }
    optimum.record.evaluations += extra.evaluations;
    return optimum;
}

}  // namespace brdfit::optim
