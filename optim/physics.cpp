#include "optim/physics.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <set>

#include <fmt/format.h>

#include "kernels/evaluator.h"

namespace brdfit::optim {
namespace {

using kernels::Albedo;
using kernels::Hemisphere;

/// Asked of the quadrature, so that what it says of its error may be as wrong as that.
constexpr double kAsked = 0.4 * kAlbedoTolerance;
/// The search for the largest albedo ends where a parabola promises no more than this.
constexpr double kGain = 0.1 * kAlbedoTolerance;
constexpr int kMostRounds = 12;
/// f(u, v) and f(v, u) are one number but for rounding, up to this part of the larger, and of the largest in the set.
constexpr double kRounding = 1e-5;
constexpr double kFaint = 1e-9;

/// Pairs of directions (u, v) with their exchange (v, u) behind each: about the mirror direction, and everywhere.
const kernels::DirectionSet& exchanged_pairs() {
    static const kernels::DirectionSet set = [] {
        std::vector<kernels::Direction> directions;
        const auto add = [&](double theta_i_deg, double theta_r_deg, double phi_deg) {
            directions.push_back({theta_i_deg, theta_r_deg, phi_deg});
            directions.push_back({theta_r_deg, theta_i_deg, phi_deg});
        };
        for (const double theta_i_deg : {5.0, 20.0, 40.0, 60.0, 75.0}) {
            for (const double apart_deg : {0.03, 0.1, 0.3, 1.0, 3.0, 10.0})
                for (const double phi_deg : {0.0, 180.0}) add(theta_i_deg, theta_i_deg + apart_deg, phi_deg);
            for (const double theta_r_deg : {12.0, 33.0, 52.0, 68.0, 84.0})
                for (const double phi_deg : {35.0, 90.0, 140.0}) add(theta_i_deg, theta_r_deg, phi_deg);
        }
        return kernels::DirectionSet(std::move(directions));
    }();
    return set;
}

bool is_exact(const Albedo& albedo) {
    return std::isfinite(albedo.error) && albedo.error <= kAlbedoTolerance * std::max(1.0, std::abs(albedo.value));
}

/// At most kMostAlbedos of them.
std::vector<double> told(std::span<const double> theta_i_deg) {
    const std::size_t n = theta_i_deg.size();
    if (n <= kMostAlbedos) return {theta_i_deg.begin(), theta_i_deg.end()};
    std::vector<double> some;
    for (std::size_t i = 0; i < kMostAlbedos; ++i) some.push_back(theta_i_deg[i * (n - 1) / (kMostAlbedos - 1)]);
    return some;
}

/// Angles from 0 to kSteepestIncidence_deg between which an albedo has no hidden peak.
constexpr double kGrid_deg[] = {0, 15, 30, 45, 55, 63, 70, 76, 80, 83, 85.5, 87.5, kSteepestIncidence_deg};

}  // namespace

kernels::Precision albedo_precision(const kernels::Engine& engine, const kernels::Model& model) {
    return model.sums_series() ? engine.quickest_precision() : engine.best_precision();
}

Incidence::Incidence(std::span<const double> data_deg, Interval seen) : range{seen.min, kSteepestIncidence_deg} {
    std::vector<double> within;
    std::copy_if(data_deg.begin(), data_deg.end(), std::back_inserter(within),
                 [&](double angle) { return seen.holds(angle); });
    of_data = within.size();
    told_deg = told(within);
    if (!within.empty()) range.max = std::max(range.max, within.back());
    range.max = std::max(range.min, std::min(range.max, seen.max));
    std::set<double> grid{range.min, range.max};
    for (const double angle : kGrid_deg)
        if (range.holds(angle)) grid.insert(angle);
    grid_deg.assign(grid.begin(), grid.end());
    grid.insert(told_deg.begin(), told_deg.end());
    whole_deg.assign(grid.begin(), grid.end());
}

LargestAlbedo largest_albedo(Hemisphere& hemisphere, std::span<const double> parameters,
                             std::vector<double> theta_i_deg, std::vector<Albedo> known) {
    const auto largest = [&] {
        return static_cast<std::size_t>(
            std::max_element(known.begin(), known.end(),
                             [](const Albedo& a, const Albedo& b) { return a.value < b.value; }) -
            known.begin());
    };
    // The highest point of the parabola through the largest and its neighbours; where that is not to be trusted, the
    // middle of the wider gap.
    std::size_t at = largest();
    for (int round = 0; round < kMostRounds && std::isfinite(known[at].error); ++round) {
        const double scale = std::max(1.0, std::abs(known[at].value));
        const std::size_t low = at == 0 ? at : at - 1;
        const std::size_t high = at + 1 == known.size() ? at : at + 1;
        const double left = theta_i_deg[at] - theta_i_deg[low];
        const double right = theta_i_deg[high] - theta_i_deg[at];
        double next = theta_i_deg[at] + (right > left ? right : -left) / 2;
        if (left > 0 && right > 0) {
            const double rise = (known[at].value - known[low].value) / left;
            const double fall = (known[at].value - known[high].value) / right;
            const double bend = (rise + fall) / (left + right);  // f = f_at + slope x - bend x^2
            const double slope = rise - bend * left;
            if (!(bend > 0)) break;  // level
            const double step = slope / (2 * bend);
            if (round > 0 && slope * step / 2 <= kGain * scale) break;
            if (std::abs(step) > 0.05 * std::min(left, right)) next = theta_i_deg[at] + step;
        } else if (known[at].value - known[left > 0 ? low : high].value <= kGain * scale) {
            break;
        }
        const Albedo found = hemisphere.albedo(parameters, {&next, 1}, kAsked).front();
        const auto place = std::lower_bound(theta_i_deg.begin(), theta_i_deg.end(), next);
        if (place != theta_i_deg.end() && *place == next) break;
        known.insert(known.begin() + (place - theta_i_deg.begin()), found);
        theta_i_deg.insert(place, next);
        at = largest();
    }
    return {known[at], theta_i_deg[at]};
}

LargestAlbedo largest_albedo(Hemisphere& hemisphere, std::span<const double> parameters, const Incidence& incidence) {
    const std::vector<double>& angles = incidence.whole_deg;
    return largest_albedo(hemisphere, parameters, angles, hemisphere.albedo(parameters, angles, kAsked));
}

PairVerdict judge_pairs(kernels::Engine& engine, const kernels::Model& model, std::span<const double> parameters) {
    const std::vector<double> f = kernels::evaluate(engine, model, engine.best_precision(),
                                                    {parameters.begin(), parameters.end()}, exchanged_pairs(), false)
                                      .f;
    double most = 0;
    for (const double value : f) most = std::max(most, std::abs(value));
    PairVerdict verdict;
    for (std::size_t i = 0; i < f.size(); i += 2) {
        const double larger = std::max(std::abs(f[i]), std::abs(f[i + 1]));
        if (!(std::abs(f[i] - f[i + 1]) <= kRounding * larger + kFaint * most)) verdict.reciprocal = false;
        if (!(f[i] >= 0 && f[i + 1] >= 0)) verdict.nonnegative = false;
    }
    return verdict;
}

Judgement judge_physics(kernels::Engine& engine, const kernels::Model& model, std::span<const double> parameters,
                        const Incidence& incidence, bool scale_known) {
    Judgement judgement;
    judgement.physics.theta_i_deg = incidence.range;
    const PairVerdict pairs = judge_pairs(engine, model, parameters);
    judgement.physics.reciprocal = pairs.reciprocal;
    judgement.physics.nonnegative = pairs.nonnegative;

    const std::vector<double>& asked = incidence.told_deg;
    if (asked.size() < incidence.of_data)
        judgement.warnings.push_back(
            fmt::format("albedos are told at {} of the data's {} incidence angles", asked.size(), incidence.of_data));
    const std::vector<double>& angles = incidence.whole_deg;
    Hemisphere hemisphere(engine, model, albedo_precision(engine, model));
    const std::vector<Albedo> albedos = hemisphere.albedo(parameters, angles, kAsked);
    bool whole = true;
    for (std::size_t i = 0; i < angles.size(); ++i) {
        whole = whole && is_exact(albedos[i]);
        if (albedos[i].negative) judgement.physics.nonnegative = false;
        if (!std::binary_search(asked.begin(), asked.end(), angles[i])) continue;
        DirectionalAlbedo& albedo = judgement.albedo.emplace_back();
        albedo.theta_i_deg = angles[i];
        albedo.error = albedos[i].error;
        if (is_exact(albedos[i])) albedo.value = albedos[i].value;
    }
    const LargestAlbedo largest = largest_albedo(hemisphere, parameters, angles, albedos);
    whole = whole && is_exact(largest.albedo);
    const double least = largest.albedo.value - largest.albedo.error;
    if (whole) {
        judgement.physics.max_albedo = largest.albedo.value;
        judgement.physics.at_theta_i_deg = largest.theta_i_deg;
        judgement.physics.energy_conserving = largest.albedo.value <= 1 + kAlbedoTolerance;
    } else {
        judgement.warnings.push_back(fmt::format("albedos could not be computed within {:g}", kAlbedoTolerance));
        if (least > 1 || !std::isfinite(largest.albedo.value)) judgement.physics.energy_conserving = false;
    }
    if (!scale_known) judgement.physics.energy_conserving.reset();
    return judgement;
}

}  // namespace brdfit::optim
