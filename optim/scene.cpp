#include "optim/scene.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <tuple>

#include <fmt/format.h>

#include "kernels/model.h"
#include "optim/report.h"

namespace brdfit::optim {
namespace {

/// An error must be lower by such a part to be lower at all: less is the search's rounding.
constexpr double kLower = 1e-3;

std::size_t free_parameters(const Fit& fit) {
    return static_cast<std::size_t>(
        std::count_if(fit.parameters.begin(), fit.parameters.end(), [](const FittedParameter& p) { return !p.fixed; }));
}

std::string name_of(const Fit& fit) { return kernels::variant_name(fit.model, fit.lobes, fit.submodel); }

/// What a renderer pays: in single precision, where the device has it.
std::optional<double> ns_per_evaluation(const Fit& fit) {
    if (!fit.cost) return std::nullopt;
    return fit.cost->single_ns ? fit.cost->single_ns : fit.cost->double_ns;
}

/// The fits with a cost and an error, cheapest first.
std::vector<ParetoPoint> by_cost(const std::vector<Fit>& fits) {
    std::vector<ParetoPoint> points;
    for (std::size_t i = 0; i < fits.size(); ++i)
        if (const auto ns = ns_per_evaluation(fits[i]); ns && fits[i].log10_rmse)
            points.push_back({i, *ns, *fits[i].log10_rmse});
    std::stable_sort(points.begin(), points.end(), [&](const ParetoPoint& a, const ParetoPoint& b) {
        return std::tuple(a.ns_per_evaluation, free_parameters(fits[a.fit]), a.log10_rmse) <
               std::tuple(b.ns_per_evaluation, free_parameters(fits[b.fit]), b.log10_rmse);
    });
    return points;
}

using Place = std::vector<ParetoPoint>::const_iterator;

std::string none_good_enough(const Scene& scene, const std::vector<Fit>& fits, const std::vector<ParetoPoint>& points,
                             Place cheapest) {
    if (points.empty()) return "no model here could be judged: no fit has a cost and an error in decades";
    const auto nearest = [&](double most_ns) {
        const ParetoPoint* best = nullptr;
        for (const ParetoPoint& point : points)
            if (point.ns_per_evaluation <= most_ns && (best == nullptr || point.log10_rmse < best->log10_rmse))
                best = &point;
        return best;
    };
    if (cheapest != points.end()) {
        const double most_ns = *scene.max_ns_per_evaluation;
        std::string reason = fmt::format(
            "no model here is cheap enough: {} is the cheapest within {:g} decades, but takes {:.3g} ns an evaluation, "
            "and {:g} can be paid",
            name_of(fits[cheapest->fit]), scene.tolerance_log10, cheapest->ns_per_evaluation, most_ns);
        const ParetoPoint* const affordable = nearest(most_ns);
        if (affordable == nullptr) return reason;
        return reason + fmt::format("; the best for that, {}, is off by {:.2g} decades", name_of(fits[affordable->fit]),
                                    affordable->log10_rmse);
    }
    const ParetoPoint* const best = nearest(std::numeric_limits<double>::infinity());
    return fmt::format("no model here is good enough: the best, {}, is off by {:.2g} decades, and {:g} are tolerated",
                       name_of(fits[best->fit]), best->log10_rmse, scene.tolerance_log10);
}

}  // namespace

bool Scene::sees(const kernels::Direction& direction) const {
    return theta_i_deg.holds(direction.theta_i_deg) && theta_r_deg.holds(std::abs(direction.theta_r_deg));
}

Channel seen_by(const Scene& scene, Channel channel) {
    const auto outside = [&](const Sample& sample) { return !scene.sees(sample.direction); };
    if (scene.outside_weight == 0) std::erase_if(channel.samples, outside);
    for (Sample& sample : channel.samples)
        if (outside(sample)) sample.weight = scene.outside_weight;
    return channel;
}

void judge_scene(const Scene& scene, ChannelReport& report) {
    const std::vector<ParetoPoint> points = by_cost(report.fits);
    for (const ParetoPoint& point : points)
        if (report.pareto.empty() || point.log10_rmse < report.pareto.back().log10_rmse * (1 - kLower))
            report.pareto.push_back(point);
    // Of all, not of the front: one that is hardly better than a cheaper one may yet be the first within the tolerance.
    const auto cheapest = std::find_if(points.begin(), points.end(), [&](const ParetoPoint& point) {
        return point.log10_rmse <= scene.tolerance_log10;
    });
    Recommendation& recommended = report.recommended.emplace();
    const double most = scene.max_ns_per_evaluation.value_or(std::numeric_limits<double>::infinity());
    if (cheapest == points.end() || cheapest->ns_per_evaluation > most) {
        recommended.reason = none_good_enough(scene, report.fits, points, cheapest);
        return;
    }
    recommended.fit = cheapest->fit;
    recommended.reason = fmt::format("{} is the cheapest model here within {:g} decades: {:.2g} decades at {:.3g} ns",
                                     name_of(report.fits[cheapest->fit]), scene.tolerance_log10, cheapest->log10_rmse,
                                     cheapest->ns_per_evaluation);
    const auto next = std::find_if(report.pareto.begin(), report.pareto.end(), [&](const ParetoPoint& point) {
        return point.ns_per_evaluation >= cheapest->ns_per_evaluation &&
               point.log10_rmse < cheapest->log10_rmse * (1 - kLower);
    });
    if (next != report.pareto.end()) {
        recommended.next_better = *next;
        recommended.reason += fmt::format("; the next better one, {}, is off by {:.2g} decades at {:.3g} ns",
                                          name_of(report.fits[next->fit]), next->log10_rmse, next->ns_per_evaluation);
    } else recommended.reason += "; none here is better";
}

}  // namespace brdfit::optim
