#include "optim/refit.h"

#include <algorithm>
#include <optional>

#include "optim/descent.h"
#include "optim/space_loss.h"
#include "optim/thinned.h"

namespace brdfit::optim {

Refitter::Refitter(const Task& task, const std::vector<Interval>& bounds, Residual residual)
    : task_(task),
      logarithmic_(residual == Residual::of_loss && task.weighted.logarithmic),
      space_(task.model, bounds, logarithmic_ ? Unknowns::all : Unknowns::nonlinear, task.scale,
             logarithmic_ ? coefficient_level(task) : 1.0, Charts::used, &task.directions),
      evaluator_(task.engine, task.model, task.engine.best_precision(), task.directions, {}, {}) {}

std::vector<Refitter::End> Refitter::descend(const Weighted& weighted, std::span<const Point> starts, double relative) {
    return descend(evaluator_, weighted, starts, relative, 0);
}

Refitter::End Refitter::best(const Weighted& weighted, std::span<const Point> starts, double relative) {
    constexpr double kHopeful = 0.05;
    if (weighted.y.size() <= kThinAbove || logarithmic_ || starts.size() < 2)
        return descend(evaluator_, weighted, starts, relative, kHopeful).front();
    // Which it is a part of the samples tells.
    const Thinned few = thinned(weighted, task_.directions.directions(), kThinTo, task_.control.seed);
    const kernels::DirectionSet directions(few.directions);
    kernels::Evaluator evaluator(task_.engine, task_.model, task_.engine.best_precision(), directions, {}, {});
    const Point best = descend(evaluator, few.data, starts, relative, kHopeful).front();
    return descend(evaluator_, weighted, {&best, 1}, relative, 0, &evaluator).front();
}

std::vector<Refitter::End> Refitter::descend(kernels::Evaluator& evaluator, const Weighted& weighted,
                                             std::span<const Point> starts, double relative, double hopeful,
                                             kernels::Evaluator* part) {
    constexpr int kMostLooks = 40;
    constexpr double kLittle = 1e-4;  // of damping, where the curvature is Newton's
    const Weighted data = logarithmic_ ? weighted : balanced(weighted);
    const double norm2 = data.norm > 0 && !logarithmic_ ? data.norm * data.norm : 1.0;
    const double unit2 = data.norm > 0 && !logarithmic_ ? weighted.norm * weighted.norm / norm2 : 1.0;
    evaluator.assign(data.y, data.weight);
    SpaceLoss loss(evaluator, space_, norm2, logarithmic_ ? &data : nullptr);
    std::vector<Minimum> ends;
    if (space_.dimension() == 0) {
        ends.emplace_back();
    } else {
        std::vector<std::vector<double>> from;
        for (const Point& start : starts) from.push_back(space_.coordinates(start.parameters, start.scale));
        std::optional<SpaceLoss> bends;
        if (part != nullptr) bends.emplace(*part, space_, norm2);
        const Landscape landscape = [&](auto at) { return bends ? loss.looks_bent_by(*bends, at) : loss.looks(at); };
        DescentGoal goal{.relative = relative, .absolute = 1e-26, .looks = kMostLooks, .hopeful = hopeful};
        if (bends) goal.damping = kLittle;
        ends = descend_together(landscape, from, goal, task_.control);
    }
    std::vector<End> result;
    for (Minimum& minimum : ends) {
        const StopReason stop = minimum.stop;
        loss.complete(minimum);
        End end{{}, minimum.loss2 * unit2, stop};
        end.parameters = space_.parameters(minimum.u, minimum.coefficients, end.scale);
        result.push_back(std::move(end));
    }
    std::stable_sort(result.begin(), result.end(), [](const End& a, const End& b) { return a.loss2 < b.loss2; });
    evaluations_ += loss.evaluations();
    return result;
}

const kernels::Values& Refitter::values(const Point& point, bool gradient) {
    if (known_ && known_->parameters == point.parameters && known_->scale == point.scale) return with_gradient_;
    kernels::Values& values = gradient ? with_gradient_ : without_;
    if (gradient) known_.reset();
    values = evaluator_.values(point.parameters, gradient);
    for (double& f : values.f) f *= point.scale;
    for (double& slope : values.by_parameter) slope *= point.scale;
    if (gradient) known_ = point;
    return values;
}

std::vector<double> Refitter::half_slopes(std::span<const Point> points) {
    const kernels::Model& model = task_.model;
    const std::size_t p = model.parameters.size();
    const std::size_t t = model.terms.size();
    std::vector<double> parameters, coefficients;
    for (const Point& point : points) {
        parameters.insert(parameters.end(), point.parameters.begin(), point.parameters.end());
        for (const double c : model.coefficients(point.parameters)) coefficients.push_back(point.scale * c);
    }
    evaluator_.assign(task_.weighted.y, task_.weighted.weight);
    kernels::Batch batch;
    evaluator_.loss(parameters, coefficients, task_.weighted.logarithmic, batch);
    std::vector<double> result;
    for (std::size_t k = 0; k < points.size(); ++k) {
        const auto first = batch.by_parameter.begin() + static_cast<std::ptrdiff_t>(k * p);
        std::vector<double> slopes(first, first + static_cast<std::ptrdiff_t>(p));
        double by_scale = 0;
        for (std::size_t term = 0; term < t; ++term) {
            const double by_coefficient = batch.by_coefficient[k * t + term];
            by_scale += by_coefficient * coefficients[k * t + term];
            if (const auto& factor = model.terms[term].factor) slopes[*factor] += points[k].scale * by_coefficient;
        }
        slopes.push_back(by_scale);
        for (const double slope : slopes) result.push_back(slope / 2);
    }
    return result;
}

}  // namespace brdfit::optim
