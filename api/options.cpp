#include "api/options.h"

#include <algorithm>
#include <cmath>

#include "api/names.h"

namespace brdfit::api {
namespace {

using nlohmann::json;
using optim::FitOptions;
using optim::Interval;
using optim::Scene;

constexpr double kLargestSeed = 9007199254740991;  // 2^53 - 1: exact in every JSON parser
void read_seed(const json& value, const Place& place, FitOptions& out) {
    const auto number = read_number(value, place);
    if (!number) return;
    if (*number < 0 || *number > kLargestSeed || *number != std::floor(*number))
        place.fail("out_of_range", "must be a whole number from 0 to 2^53 - 1");
    else out.seed = static_cast<std::uint64_t>(*number);
}

constexpr Rule bad_time_limit{0, true, 3600, false, "must lie in (0, 3600]"};

const FitOptions kDefaults;

static_assert(optim::kSteepestCosine == 4 && optim::kLeastThreshold == 0.5 && optim::kMostThreshold == 20);
constexpr Rule bad_exponent{-optim::kSteepestCosine, false, optim::kSteepestCosine, false, "must lie in [-4, 4]"};
constexpr Rule bad_threshold{optim::kLeastThreshold, false, optim::kMostThreshold, false, "must lie in [0.5, 20]"};

void read_require(const json& value, const Place& place, FitOptions& out) {
    if (!value.is_array()) return place.fail("wrong_type", "must be an array of: " + names_of(kRequirements));
    for (std::size_t i = 0; i < value.size(); ++i) {
        const auto requirement = read_choice(value[i], place.at(i), kRequirements);
        if (!requirement) continue;
        if (std::find(value.begin(), value.end(), value[i]) != value.begin() + static_cast<std::ptrdiff_t>(i))
            place.at(i).fail("duplicate", "is required twice");
        else if (std::find(out.require.begin(), out.require.end(), *requirement) == out.require.end())
            out.require.push_back(*requirement);  // options and scene may both ask for it
    }
}

schema::Json require_schema() { return schema::array(schema::choice(kRequirements), 0, kRequirements.size()); }

const Scene kAnyScene;
constexpr Rule bad_scene_angle{0, false, 90, false, "must lie in [0, 90]"};
constexpr Rule bad_outside_weight{0, false, 1, true, "must lie in [0, 1)"};
constexpr Rule bad_tolerance{0, true, 10, false, "must lie in (0, 10]"};
constexpr Rule bad_ns{0, true, 1e9, false, "must lie in (0, 1e9]"};

/// These fields are read into FitOptions::scene, which is there.
Field<FitOptions> angles_field(std::string_view key, std::string_view doc, Interval Scene::*angles) {
    return {key, false, doc,
            schema::with_default(schema::array(schema::number(bad_scene_angle), 2, 2),
                                 {(kAnyScene.*angles).min, (kAnyScene.*angles).max}),
            [=](const json& v, const Place& p, FitOptions& out) {
                if (!v.is_array() || v.size() != 2) return p.fail("wrong_type", "must be [low, high]");
                const auto low = read_checked(v[0], p.at(std::size_t{0}), bad_scene_angle);
                const auto high = read_checked(v[1], p.at(std::size_t{1}), bad_scene_angle);
                if (!low || !high) return;
                if (*low > *high) p.fail("out_of_range", "low must not be above high");
                else (*out.scene).*angles = {*low, *high};
            }};
}

}  // namespace

const std::vector<Field<FitOptions>>& option_fields() {
    static const std::vector<Field<FitOptions>> fields{
        {kLossKey, false, "what is minimised",
         schema::with_default(schema::choice(kLosses), name_of(kLosses, kDefaults.loss.kind)),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto loss = read_choice(v, p, kLosses)) out.loss.kind = *loss;
         }},
        {kExponentIKey, false, "of the loss cosine: a in cos(theta_i)^a; 0 if absent", schema::number(bad_exponent),
         [](const json& v, const Place& p, FitOptions& out) {
             out.loss.cos_theta_i_exponent = read_checked(v, p, bad_exponent);
         }},
        {kExponentRKey, false, "of the loss cosine: b in cos(theta_r)^b; 1 if absent", schema::number(bad_exponent),
         [](const json& v, const Place& p, FitOptions& out) {
             out.loss.cos_theta_r_exponent = read_checked(v, p, bad_exponent);
         }},
        {"robust", false, "what takes the place of the loss's squares, against outliers",
         schema::with_default(schema::choice(kRobusts), name_of(kRobusts, kDefaults.loss.robust)),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto robust = read_choice(v, p, kRobusts)) out.loss.robust = *robust;
         }},
        {kThresholdKey, false, "of a robust loss, in robust standard deviations; 1.345 for huber, 2.385 for cauchy",
         schema::number(bad_threshold),
         [](const json& v, const Place& p, FitOptions& out) {
             out.loss.robust_threshold = read_checked(v, p, bad_threshold);
         }},
        {"effort", false, "how much the search may spend",
         schema::with_default(schema::choice(kEfforts), name_of(kEfforts, kDefaults.effort)),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto effort = read_choice(v, p, kEfforts)) out.effort = *effort;
         }},
        {"precision", false, "arithmetic of the search; what is reported is computed in double where that may be used",
         precision_schema(),
         [](const json& v, const Place& p, FitOptions& out) { out.precision = read_precision(v, p); }},
        {"seed", false, "of the starts; the same seed gives the same result",
         schema::with_default(schema::whole(0, kLargestSeed), kDefaults.seed), read_seed},
        {"time_limit_s", false, "of the whole request, in seconds",
         schema::with_default(schema::number(bad_time_limit), kDefaults.time_limit.count()),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto seconds = read_checked(v, p, bad_time_limit))
                 out.time_limit = std::chrono::duration<double>(*seconds);
         }},
        {"require", false, "what a fit must keep to", require_schema(), read_require},
        {"judge", false, "also held-out errors, rivals, albedo, physics, cost and a recommendation",
         schema::with_default(schema::boolean(), kDefaults.judge),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto judge = read_flag(v, p)) out.judge = *judge;
         }},
        {"rank_by", false, "what fits are sorted by",
         schema::with_default(schema::choice(kRankBy), name_of(kRankBy, kDefaults.rank_by)),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto rank_by = read_choice(v, p, kRankBy)) out.rank_by = *rank_by;
         }},
        {"ledger", false, "also what single precision, less effort and earlier stops would have changed",
         schema::with_default(schema::boolean(), kDefaults.ledger),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto ledger = read_flag(v, p)) out.ledger = *ledger;
         }},
    };
    return fields;
}

const std::vector<Field<FitOptions>>& scene_fields() {
    static const std::vector<Field<FitOptions>> fields{
        angles_field("theta_i_deg", "incidence angles that the scene sees, [low, high]", &Scene::theta_i_deg),
        angles_field("theta_r_deg", "exitant angles that the scene sees, without sign, [low, high]",
                     &Scene::theta_r_deg),
        {"outside_weight", false, "weight of a sample outside, where one within has 1; 0: left out",
         schema::with_default(schema::number(bad_outside_weight), kAnyScene.outside_weight),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto weight = read_checked(v, p, bad_outside_weight)) out.scene->outside_weight = *weight;
         }},
        {"tolerance_log10", false, "the largest root mean square error that is good enough, in decades",
         schema::with_default(schema::number(bad_tolerance), kAnyScene.tolerance_log10),
         [](const json& v, const Place& p, FitOptions& out) {
             if (const auto tolerance = read_checked(v, p, bad_tolerance)) out.scene->tolerance_log10 = *tolerance;
         }},
        {"max_ns_per_evaluation", false, "the most that an evaluation may cost on this device, in nanoseconds",
         schema::number(bad_ns),
         [](const json& v, const Place& p, FitOptions& out) {
             out.scene->max_ns_per_evaluation = read_checked(v, p, bad_ns);
         }},
        {"require", false, "what a fit must keep to, beside options.require", require_schema(), read_require},
    };
    return fields;
}

}  // namespace brdfit::api
