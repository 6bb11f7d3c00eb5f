// Steps in place of lobes: the scan finds the best of all places, and says what is left there.

#include "optim/steps.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <numbers>

#include "optim/space.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Evaluator;
using kernels::Model;
using optim::Interval;
using optim::Step;

constexpr double kPi = std::numbers::pi;

/// A diffuse surface with a step, seen with a little noise.
struct Surface {
    const Model& model = variant("lafortune_1");
    const kernels::Term::Homogeneous& lobe = *model.terms[1].homogeneous;
    kernels::DirectionSet directions{scan_directions({15, 45, 70}, 8)};
    std::vector<std::pair<double, double>> points = directions.points(lobe.columns->first, lobe.columns->second);
    optim::Weighted data;

    Surface(double diffuse, double height, double psi, double noise) {
        Random random(7);
        for (const auto& [a, b] : points) {
            const bool lit = std::cos(psi) * a + std::sin(psi) * b > 0;
            data.y.push_back((diffuse / kPi + (lit ? height : 0)) * (1 + noise * random.normal()));
            data.weight.push_back(random.uniform(0.5, 1.5));
        }
    }

    /// The scan about a diffuse coefficient [pi/sr], with a lobe anywhere.
    [[nodiscard]] std::vector<Step> best(double diffuse, std::size_t most) const {
        Evaluator evaluator(engine(), model, engine().best_precision(), directions, data.y, data.weight);
        const std::vector<double> values = evaluator.terms(std::vector<double>{0, -1, 1, 5});
        const std::vector<double> coefficients{diffuse, 0.3}, lower{0, 0}, upper{1, 1};
        return optim::StepScan(model, directions, data).best(1, {values, coefficients, lower, upper}, most);
    }

    /// The least squares of a diffuse term and a step, both above 0.
    [[nodiscard]] double loss2(double psi) const {
        double ww = 0, wy = 0, ss = 0, sy = 0, yy = 0;
        for (std::size_t j = 0; j < points.size(); ++j) {
            const double w = data.weight[j];
            const bool lit = std::cos(psi) * points[j].first + std::sin(psi) * points[j].second > 0;
            (lit ? ss : ww) += w;
            (lit ? sy : wy) += w * data.y[j];
            yy += w * data.y[j] * data.y[j];
        }
        // The means of both sides, or one mean where the lit side is the darker one.
        if (sy / ss >= wy / ww) return yy - wy * wy / ww - sy * sy / ss;
        return yy - (wy + sy) * (wy + sy) / (ww + ss);
    }
};

TEST(Steps, AreFoundWhereTheyAre) {
    for (const double psi : {0.3, 1.2, 2.0, 2.9, 4.0}) {
        const Surface surface(0.5, 0.02, psi, 1e-3);
        const std::vector<Step> steps = surface.best(0.5, 4);
        ASSERT_FALSE(steps.empty());
        for (const auto& [a, b] : surface.points)
            EXPECT_EQ(std::cos(psi) * a + std::sin(psi) * b > 0,
                      std::cos(steps[0].psi) * a + std::sin(steps[0].psi) * b > 0)
                << psi;
    }
}

TEST(Steps, AreTheBestOfAllPlacesAndLeaveWhatTheySay) {
    const Surface surface(0.5, 0.005, 2.0, 0.02);
    const std::vector<Step> steps = surface.best(0.5, 8);
    ASSERT_FALSE(steps.empty());
    double least = HUGE_VAL;
    for (int k = 0; k < 20000; ++k) least = std::min(least, surface.loss2(2 * kPi * k / 20000));
    EXPECT_LE(surface.loss2(steps[0].psi), least * (1 + 1e-4));
    for (const Step& step : steps) {
        EXPECT_NEAR(step.loss2, surface.loss2(step.psi), 1e-3 * least);
        EXPECT_GE(step.loss2, steps[0].loss2);
    }
}

TEST(Steps, AreApart) {
    const Surface surface(0.5, 0.02, 2.0, 0.02);
    const std::vector<Step> steps = surface.best(0.5, 20);
    EXPECT_GT(steps.size(), 3U);
    EXPECT_LE(steps.size(), 20U);
    for (std::size_t i = 0; i < steps.size(); ++i)
        for (std::size_t k = 0; k < i; ++k) {
            if ((std::cos(steps[i].psi) > 0) != (std::cos(steps[k].psi) > 0)) continue;  // 1 on opposite sides
            std::size_t differ = 0;
            for (const auto& [a, b] : surface.points)
                differ += (std::cos(steps[i].psi) * a + std::sin(steps[i].psi) * b > 0) !=
                          (std::cos(steps[k].psi) * a + std::sin(steps[k].psi) * b > 0);
            EXPECT_GT(differ, 5U);
        }
}

TEST(Steps, OfManyDirectionsAreNotLookedFor) {
    const Model& model = variant("lafortune_1");
    const kernels::DirectionSet directions(std::vector<kernels::Direction>(9000, {30, 20, 0}));
    optim::Weighted data;
    data.y.assign(9000, 1.0);
    data.weight.assign(9000, 1.0);
    const std::vector<double> values(9000 * model.term_values(), 1.0), ones{1, 1}, lower{0, 0}, upper{2, 2};
    EXPECT_TRUE(optim::StepScan(model, directions, data).best(1, {values, ones, lower, upper}, 4).empty());
}

TEST(Steps, TurnALobeAloneAndTellItFromOtherBlocks) {
    const Model& model = variant("lafortune_2");
    const kernels::DirectionSet directions(scan_directions({15, 45, 70}, 8));
    std::vector<Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    const optim::SearchSpace space(model, bounds, optim::Unknowns::nonlinear, {}, 1, optim::Charts::used, &directions);
    const std::vector<double> u(space.dimension(), 0.45);
    const std::vector<double> before = space.candidate(u).parameters;
    std::size_t lobes = 0;
    for (const auto& block : space.blocks()) {
        const auto term = space.lobe(block);
        if (!term) continue;
        ++lobes;
        const auto& lobe = *model.terms[*term].homogeneous;
        for (const double psi : {-1.2, 0.1, 1.5, 3.0}) {
            const std::vector<double> after =
                space.candidate(space.shaped(u, block, std::vector<optim::LobeShape>{{psi, 0.03}}).front()).parameters;
            EXPECT_NEAR(after[lobe.degree], 0.03, 1e-12);
            EXPECT_NEAR(std::remainder(std::atan2(after[lobe.plane.second], after[lobe.plane.first]) - psi, 2 * kPi), 0,
                        1e-9);
            for (std::size_t i = 0; i < after.size(); ++i) {
                if (i == lobe.degree || i == lobe.plane.first || i == lobe.plane.second) continue;
                EXPECT_EQ(after[i], before[i]) << i;
            }
        }
    }
    EXPECT_EQ(lobes, 2U);
}

}  // namespace
}  // namespace brdfit::tests
