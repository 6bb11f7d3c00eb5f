/// Directional albedos against another quadrature, closed forms and what is known of the models.
#include <algorithm>
#include <cmath>
#include <numbers>
#include <string>
#include <vector>

#include <gtest/gtest.h>
#include <boost/math/quadrature/gauss.hpp>

#include "kernels/evaluator.h"
#include "kernels/hemisphere.h"
#include "optim/physics.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Albedo;
using kernels::Direction;

constexpr double kRadian = std::numbers::pi / 180;
constexpr double kAsked = 0.4 * optim::kAlbedoTolerance;  // as optim/physics.cpp asks

struct Case {
    std::string model;
    std::vector<double> parameters{};
};

std::vector<Albedo> albedos(const Case& c, const std::vector<double>& theta_i_deg) {
    const kernels::Model& model = variant(c.model);
    kernels::Hemisphere hemisphere(engine(), model, optim::albedo_precision(engine(), model));
    return hemisphere.albedo(c.parameters, theta_i_deg, kAsked);
}

/// Panel ends from `from` to `to`, halving towards `centre` on either side.
std::vector<double> graded(double from, double to, double centre) {
    std::vector<double> ends{from, to};
    if (centre > from && centre < to) ends.push_back(centre);
    for (int k = 1; k <= 16; ++k)
        for (const double side : {from, to}) {
            const double at = centre + (side - centre) * std::exp2(-k);
            if (at > from && at < to) ends.push_back(at);
        }
    std::sort(ends.begin(), ends.end());
    ends.erase(std::unique(ends.begin(), ends.end()), ends.end());
    return ends;
}

/// The integral over (theta_r, phi) on panels graded towards an exitant angle, signed, in the plane of incidence, of
/// values from geometry that the host forms: neither coordinates nor geometry nor rule are those of the kernel.
double by_panels(const Case& c, double theta_i_deg, double centre_deg) {
    using Gauss = boost::math::quadrature::gauss<double, 8>;
    std::vector<Direction> directions;
    std::vector<double> weights;
    std::vector<double> theta = graded(0, 90, std::abs(centre_deg));
    for (int k = 1; k <= 6; ++k) theta.push_back(90 - 10 * std::exp2(-k));  // the models' roots of cos theta_r
    std::sort(theta.begin(), theta.end());
    const std::vector<double> phi = graded(0, 180, centre_deg < 0 ? 180 : 0);
    const auto nodes = [](double from, double to) {
        std::vector<std::pair<double, double>> all;
        for (std::size_t i = 0; i < Gauss::abscissa().size(); ++i)
            for (const double sign : {-1.0, 1.0})
                all.emplace_back((from + to) / 2 + sign * Gauss::abscissa()[i] * (to - from) / 2,
                                 Gauss::weights()[i] * (to - from) / 2 * kRadian);
        return all;
    };
    for (std::size_t i = 0; i + 1 < theta.size(); ++i)
        for (const auto& [t, t_weight] : nodes(theta[i], theta[i + 1]))
            for (std::size_t j = 0; j + 1 < phi.size(); ++j)
                for (const auto& [p, p_weight] : nodes(phi[j], phi[j + 1])) {
                    directions.push_back({theta_i_deg, t, p});
                    weights.push_back(2 * t_weight * p_weight * std::cos(t * kRadian) * std::sin(t * kRadian));
                }
    const auto values =
        kernels::evaluate(engine(), variant(c.model), engine().best_precision(), c.parameters, directions, false);
    double sum = 0;
    for (std::size_t i = 0; i < weights.size(); ++i) sum += weights[i] * values.f[i];
    return sum;
}

/// Exitant angle of the lobe's axis: the mirror direction, or that of a Lafortune lobe.
double axis_deg(const Case& c, double theta_i_deg) {
    if (!c.model.starts_with("lafortune")) return theta_i_deg;
    return std::atan2(-c.parameters[1] * std::sin(theta_i_deg * kRadian),
                      c.parameters[2] * std::cos(theta_i_deg * kRadian)) /
           kRadian;
}

const std::vector<Case>& cases() {
    static const std::vector<Case> all{
        {"lambert", {0.7}},
        {"phong", {0.2, 0.5, 1e5}},
        {"phong", {0.2, 0.5, 40}},
        {"phong", {0, 3, 2}},
        {"ward", {0.2, 0.5, 1e-3}},
        {"ward", {0.2, 0.5, 0.15}},
        {"ward", {0, 90, 5}},
        {"lafortune_1", {0.3, -1, 1, 1e4}},           // mirror
        {"lafortune_1", {0.3, 1, 1, 1e4}},            // retro
        {"lafortune_1", {0.1, -0.999, 0.9995, 1e4}},  // off the mirror
        {"lafortune_1", {0.1, -1.1, 0.6, 30}},
        {"lafortune_1", {0, -1, 0.2, 2}},
        {"lafortune_1", {0.3, -1.22, -0.142, 21.4}},  // the axis below the horizon
        {"lafortune_1", {0.3, 0, 0.999, 800}},        // about the normal
        {"he_torrance", {0.932, 12.69, 1.5, 0, 0.534}},
        {"he_torrance", {0.3636, 14.85, 0.958, 6.69, 0.03}},
        {"he_torrance", {0.05, 200, 1.5, 0, 0.1}},  // near the mirror
        {"he_torrance", {1e-3, 0.1, 20, 20, 0}},
        {"he_torrance", {20, 40, 3, 4, 0}},
        {"he_torrance", {20, 200, 1.5, 0.1, 0}},
    };
    return all;
}

TEST(Albedo, AgreesWithAnotherQuadrature) {
    const std::vector<double> some{50, 80, 89};
    const std::vector<double> many{0, 2, 10, 20, 30, 40, 50, 60, 70, 75, 80, 83, 86, 88, 89};
    const std::vector<double>& angles = long_form() ? many : some;
    double worst = 0;
    for (const Case& c : cases()) {
        const std::vector<Albedo> found = albedos(c, angles);
        for (std::size_t i = 0; i < angles.size(); ++i) {
            SCOPED_TRACE(c.model + " " + std::to_string(c.parameters[0]) + " " + std::to_string(c.parameters.back()) +
                         " at " + std::to_string(angles[i]));
            const double reference = by_panels(c, angles[i], std::clamp(axis_deg(c, angles[i]), -90.0, 90.0));
            const double scale = std::max(1.0, reference);
            EXPECT_NEAR(found[i].value, reference, optim::kAlbedoTolerance * scale);
            EXPECT_LE(found[i].error, optim::kAlbedoTolerance * scale);
            EXPECT_FALSE(found[i].negative);
            worst = std::max(worst, std::abs(found[i].value - reference) / scale);
        }
    }
    RecordProperty("worst", std::to_string(worst));
    std::printf("worst difference %.2g\n", worst);
}

/// The integral in polar coordinates about the direction of incidence, on panels graded towards an angle from it.
double about_incidence(const Case& c, double theta_i_deg, double kink_deg) {
    using Gauss = boost::math::quadrature::gauss<double, 8>;
    std::vector<Direction> directions;
    std::vector<double> weights;
    const auto each_node = [](const std::vector<double>& ends, const auto& use) {
        for (std::size_t k = 0; k + 1 < ends.size(); ++k)
            for (std::size_t i = 0; i < Gauss::abscissa().size(); ++i)
                for (const double sign : {-1.0, 1.0})
                    use((ends[k] + ends[k + 1]) / 2 + sign * Gauss::abscissa()[i] * (ends[k + 1] - ends[k]) / 2,
                        Gauss::weights()[i] * (ends[k + 1] - ends[k]) / 2);
    };
    std::vector<double> angles = graded(0, 180, kink_deg);
    for (double at = 1; at < 30; ++at) angles.push_back(at);  // the lobe
    for (const double at : {90 - theta_i_deg, 90 + theta_i_deg})
        for (const double end : graded(0, 180, at)) angles.push_back(end);
    std::sort(angles.begin(), angles.end());
    const double sin_i = std::sin(theta_i_deg * kRadian);
    const double cos_i = std::cos(theta_i_deg * kRadian);
    each_node(angles, [&](double psi_deg, double psi_weight) {
        const double sin_psi = std::sin(psi_deg * kRadian);
        const double cos_psi = std::cos(psi_deg * kRadian);
        const double horizon = std::acos(std::clamp(cos_psi * cos_i / (sin_psi * sin_i), -1.0, 1.0)) / kRadian;
        each_node(graded(horizon, 180, 180), [&](double chi_deg, double chi_weight) {
            const double cos_chi = std::cos(chi_deg * kRadian);
            const double z = cos_psi * cos_i - sin_psi * cos_chi * sin_i;
            if (!(z > 0)) return;
            const double x = -(cos_psi * sin_i + sin_psi * cos_chi * cos_i);  // incidence lies at negative x
            const double y = sin_psi * std::sin(chi_deg * kRadian);
            directions.push_back({theta_i_deg, std::atan2(std::hypot(x, y), z) / kRadian, std::atan2(y, x) / kRadian});
            weights.push_back(2 * psi_weight * chi_weight * kRadian * kRadian * sin_psi * z);
        });
    });
    const auto values =
        kernels::evaluate(engine(), variant(c.model), engine().best_precision(), c.parameters, directions, false);
    double sum = 0;
    for (std::size_t i = 0; i < weights.size(); ++i) sum += weights[i] * values.f[i];
    return sum;
}

/// Less than n = 1 without k: beyond the critical angle all is reflected, and Fresnel's factor has a kink there.
TEST(Albedo, KnowsWhatAKinkCosts) {
    for (const double n : {0.0787, 0.3}) {
        const Case total{"he_torrance", {0.1407, 36.55, n, 0, 1}};
        const double kink_deg = 2 * std::asin(n) / kRadian;
        for (const double theta_i_deg : {5.0, kink_deg / 2 + 0.5}) {
            const Albedo found = albedos(total, {theta_i_deg}).front();
            const double reference = about_incidence(total, theta_i_deg, kink_deg);
            EXPECT_NEAR(found.value, reference, optim::kAlbedoTolerance * reference) << n << ' ' << theta_i_deg;
            EXPECT_NEAR(found.value, reference, found.error) << n << ' ' << theta_i_deg;
        }
    }
}

TEST(Albedo, IsWhatClosedFormsSayAtNormalIncidence) {
    for (const double n : {0.5, 30.0, 1e4, 1e5})
        EXPECT_NEAR(albedos({"phong", {0.2, 0.5, n}}, {0}).front().value, 0.2 + 0.5 * (n + 1) / (n + 2), 1e-5);
    for (const double n : {0.01, 3.0, 1e3})
        EXPECT_NEAR(albedos({"lafortune_1", {0.2, -0.5, 0.9, n}}, {0}).front().value,
                    0.2 + std::pow(0.9, n) * 2 * std::numbers::pi / (n + 2), 1e-5);
}

TEST(Albedo, OfRandomModelsAgreesWithAFinerOne) {
    // Every model over its whole default intervals: a quadrature asked for 1e-7 is told apart by less than promised.
    Random random(7);
    const std::vector<double> angles{0, 23, 47, 66, 78, 85, 89};
    for (const kernels::Model* model : variants()) {
        kernels::Hemisphere hemisphere(engine(), *model, optim::albedo_precision(engine(), *model));
        kernels::Hemisphere fine(engine(), *model, engine().best_precision());
        for (std::size_t k = 0; k < count_from("BRDFIT_ALBEDOS", long_form() ? 1000 : 20); ++k) {
            const std::vector<double> p = random.parameters(*model);
            const auto found = hemisphere.albedo(p, angles, kAsked);
            const auto reference = fine.albedo(p, angles, 1e-6);
            for (std::size_t i = 0; i < angles.size(); ++i) {
                const double scale = std::max(1.0, reference[i].value);
                if (!std::isfinite(found[i].error) || found[i].error > optim::kAlbedoTolerance * scale)
                    continue;  // it says so itself
                std::string text;
                for (const double value : p) text += " " + std::to_string(value);
                EXPECT_NEAR(found[i].value, reference[i].value, optim::kAlbedoTolerance * scale)
                    << label(*model) << text << " at " << angles[i];
            }
        }
    }
}

TEST(Physics, OfThePapersPlasticIsViolatedAt75Degrees) {
    const std::vector<double> angles{15, 30, 45, 60, 75};
    const auto judgement = optim::judge_physics(engine(), variant("lafortune_2"),
                                                std::vector<double>{0.542, -1.22, -0.142, 21.4, -1.04, 0.893, 21.1},
                                                optim::Incidence(angles), true);
    ASSERT_EQ(judgement.albedo.size(), 5U);
    EXPECT_NEAR(judgement.albedo[4].value.value(), 1.31, 0.005);
    EXPECT_LT(judgement.albedo[3].value.value(), 1);
    EXPECT_EQ(judgement.physics.energy_conserving, false);
    EXPECT_EQ(judgement.physics.at_theta_i_deg, optim::kSteepestIncidence_deg);
    EXPECT_TRUE(judgement.physics.reciprocal);
    EXPECT_TRUE(judgement.physics.nonnegative);
}

TEST(Physics, JudgesEnergyWhereASceneSees) {
    const std::vector<double> angles{15, 30, 45, 60, 75};
    const auto seen = [&](double low, double high) {
        return optim::judge_physics(engine(), variant("lafortune_2"),
                                    std::vector<double>{0.542, -1.22, -0.142, 21.4, -1.04, 0.893, 21.1},
                                    optim::Incidence(angles, {low, high}), true);
    };
    const auto shallow = seen(20, 62);
    EXPECT_EQ(shallow.physics.energy_conserving, true);
    EXPECT_EQ(shallow.physics.theta_i_deg, (optim::Interval{20, 62}));
    EXPECT_EQ(shallow.physics.at_theta_i_deg, 62) << "it rises all the way";
    ASSERT_EQ(shallow.albedo.size(), 3U) << "those of the data that are seen";
    EXPECT_EQ(shallow.albedo.front().theta_i_deg, 30);
    const auto steep = seen(0, 76);
    EXPECT_EQ(steep.physics.energy_conserving, false);
    EXPECT_EQ(steep.physics.at_theta_i_deg, 76);
    EXPECT_EQ(seen(75, 75).physics.max_albedo, seen(75, 75).albedo.front().value) << "a single angle";
    EXPECT_EQ(seen(0, 90).physics.theta_i_deg, (optim::Interval{0, optim::kSteepestIncidence_deg}));
}

TEST(Physics, FindsTheLargestAlbedoBetweenTheAngles) {
    const kernels::Model& model = variant("he_torrance");
    const std::vector<double> p{0.932, 12.69, 1.5, 0, 0.534};
    const auto judgement = optim::judge_physics(engine(), model, p, optim::Incidence(std::vector<double>{30}), true);
    std::vector<double> all;
    for (double angle = 0; angle <= 89; angle += 0.25) all.push_back(angle);
    kernels::Hemisphere hemisphere(engine(), model, engine().best_precision());
    const auto values = hemisphere.albedo(p, all, 1e-6);
    const auto best = std::max_element(values.begin(), values.end(),
                                       [](const Albedo& a, const Albedo& b) { return a.value < b.value; });
    EXPECT_NEAR(judgement.physics.max_albedo.value(), best->value, 1e-4);
    EXPECT_NEAR(judgement.physics.at_theta_i_deg.value(), all[static_cast<std::size_t>(best - values.begin())], 1);
    EXPECT_EQ(judgement.physics.energy_conserving, true);
}

TEST(Physics, TellsReciprocityByMeasuringIt) {
    const std::vector<double> angles{45};
    const auto reciprocal = [&](const std::string& model, std::vector<double> p) {
        return optim::judge_physics(engine(), variant(model), p, optim::Incidence(angles), true).physics.reciprocal;
    };
    EXPECT_FALSE(reciprocal("phong", {0.2, 0.5, 20}));
    EXPECT_FALSE(reciprocal("phong", {0.2, 0.01, 1e5}));
    EXPECT_TRUE(reciprocal("phong", {0.2, 0, 20}));
    EXPECT_TRUE(reciprocal("ward", {0.2, 0.5, 1e-3}));
    EXPECT_TRUE(reciprocal("lafortune_1", {0.3, -1, 1, 1e4}));
    EXPECT_TRUE(reciprocal("he_torrance", {0.05, 200, 1.5, 0, 0.1}));
}

TEST(Physics, SaysNothingOfEnergyWithoutAScaleOrWhereNumbersEnd) {
    const std::vector<double> angles{0, 45};
    const auto scaleless =
        optim::judge_physics(engine(), variant("lambert"), std::vector<double>{3}, optim::Incidence(angles), false);
    EXPECT_EQ(scaleless.physics.energy_conserving, std::nullopt);
    const auto endless = optim::judge_physics(engine(), variant("lafortune_1"), std::vector<double>{0, -3, 3, 1e4},
                                              optim::Incidence(angles), true);
    EXPECT_EQ(endless.physics.max_albedo, std::nullopt);
    EXPECT_EQ(endless.physics.energy_conserving, false);  // it is far above 1, that much is known
    EXPECT_EQ(endless.albedo.front().value, std::nullopt);
    EXPECT_FALSE(endless.warnings.empty());
}

}  // namespace
}  // namespace brdfit::tests
