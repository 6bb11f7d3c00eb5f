// Descents in step: where they end, what they make of bounds and of bad values, and the looks they go by.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include <Eigen/Core>
#include <Eigen/Eigenvalues>

#include "optim/descent.h"
#include "optim/loss.h"
#include "optim/space.h"
#include "optim/space_loss.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using optim::DescentGoal;
using optim::Landscape;
using optim::Look;
using optim::Minimum;
using optim::SearchSpace;
using optim::SpaceLoss;
using optim::StopReason;

/// Rosenbrock's valley as a sum of squares, its minimum 0 at (x, y).
Landscape valley(double x, double y) {
    return [=](std::span<const std::vector<double>> points) {
        std::vector<Look> looks;
        for (const std::vector<double>& u : points) {
            const double a = 10 * ((u[1] - y) - 4 * (u[0] - x) * (u[0] - x));
            const double b = u[0] - x;
            const double a_by_0 = -80 * (u[0] - x);
            looks.push_back({a * a + b * b,
                             {2 * (a * a_by_0 + b), 2 * a * 10},
                             {2 * (a_by_0 * a_by_0 + 1), 2 * a_by_0 * 10, 2 * a_by_0 * 10, 200}});
        }
        return looks;
    };
}

TEST(Descents, EndAtTheMinimumOfAValley) {
    const std::vector<std::vector<double>> starts{{0.9, 0.9}, {0.1, 0.9}, {0.9, 0.1}};
    for (const Minimum& end : descend_together(valley(0.4, 0.3), starts, {1e-9, 1e-20, 200}, {})) {
        EXPECT_NEAR(end.u[0], 0.4, 2e-3);
        EXPECT_NEAR(end.u[1], 0.3, 2e-3);
        EXPECT_EQ(end.stop, StopReason::converged);
    }
}

TEST(Descents, EndOnABoundWhereTheMinimumLiesBeyond) {
    const Minimum end = descend_together(valley(0.4, -0.5), {{0.9, 0.9}}, {1e-9, 1e-20, 200}, {}).front();
    EXPECT_NEAR(end.u[0], 0.4 + std::sqrt(0.5) / 2, 1e-3);  // where the valley's floor leaves the cube
    EXPECT_EQ(end.u[1], 0);
    EXPECT_EQ(end.stop, StopReason::converged);
}

TEST(Descents, EndOnThePathOfABetterOne) {
    std::size_t looked = 0;
    const Landscape counting = [&, inner = valley(0.4, 0.3)](std::span<const std::vector<double>> points) {
        looked += points.size();
        return inner(points);
    };
    (void)descend_together(counting, {{0.9, 0.9}}, {1e-9, 1e-20, 200}, {});
    const std::size_t one = looked;
    looked = 0;
    (void)descend_together(counting, {{0.9, 0.9}, {0.9, 0.9}}, {1e-9, 1e-20, 200}, {});
    EXPECT_EQ(looked, one + 1);
}

TEST(Descents, EndEarlyWhereTheyLackTooMuchOfTheBest) {
    std::size_t looked = 0;
    const Landscape two_valleys = [&](std::span<const std::vector<double>> points) {
        looked += points.size();
        std::vector<Look> looks;
        for (const std::vector<double>& u : points) {
            const bool higher = u[0] > 0.5;
            looks.push_back(valley(higher ? 0.8 : 0.2, 0.3)({&u, 1}).front());
            if (higher) looks.back().value += 1;
        }
        return looks;
    };
    const std::vector<std::vector<double>> starts{{0.1, 0.9}, {0.9, 0.9}};
    DescentGoal goal{1e-9, 1e-20, 200};
    const std::vector<Minimum> followed = descend_together(two_valleys, starts, goal, {});
    const std::size_t all = looked;
    looked = 0;
    goal.hopeful = 0.1;
    const std::vector<Minimum> ends = descend_together(two_valleys, starts, goal, {});
    EXPECT_LT(looked, all);
    EXPECT_EQ(ends[0].u, followed[0].u);
    EXPECT_GT(ends[1].loss2, followed[1].loss2);
}

TEST(Screening, LooksAtFewSamplesFirstAndAtTheBetterPointsWhole) {
    const kernels::Model& model = catalogue().find("he_torrance")->variant();
    std::vector<optim::Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    const SearchSpace space(model, bounds);
    const auto loss_over = [&](double step) {
        const auto directions = scan_directions({15, 45, 70}, step);
        const std::vector<double> y = model_values(model, {0.3, 3, 1.5, 0, 0.2}, directions);
        return kernels::Evaluator(engine(), model, engine().best_precision(), directions, y,
                                  std::vector<double>(y.size(), 1 / static_cast<double>(y.size())));
    };
    kernels::Evaluator all = loss_over(2), few = loss_over(8);
    SpaceLoss loss(all, space, 1), fewer(few, space, 1);
    const auto points = optim::screening_points(space, 64, 1);
    const std::vector<double> exact = loss.screen(points, {});
    EXPECT_EQ(loss.screen_roughly(points, 4, {}), exact);  // there are no fewer
    loss.glance_through(fewer);
    const std::size_t before = loss.evaluations();
    const std::vector<double> rough = loss.screen_roughly(points, 4, {});
    EXPECT_EQ(loss.evaluations(), before + 64 + 16);
    std::size_t kept = 0;
    for (std::size_t i = 0; i < points.size(); ++i) {
        if (rough[i] == std::numeric_limits<double>::max()) continue;
        EXPECT_EQ(rough[i], exact[i]);
        ++kept;
    }
    EXPECT_EQ(kept, 16U);
    EXPECT_EQ(*std::min_element(rough.begin(), rough.end()), *std::min_element(exact.begin(), exact.end()));
}

TEST(Screening, ChoosesTheStrengthOfALobe) {
    const kernels::Model& model = catalogue().find("he_torrance")->variant();
    std::vector<optim::Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    for (const double unit : {1.0, 1.0 / 64}) {  // data as they are divided by a power of two
        const SearchSpace space(model, bounds, optim::Unknowns::nonlinear, {unit, unit});
        const auto directions = scan_directions({15, 45, 70}, 4);
        std::vector<double> y = model_values(model, {0.3, 3, 1.5, 0, 0.2}, directions);
        for (double& value : y) value *= unit;
        kernels::Evaluator evaluator(engine(), model, engine().best_precision(), directions, y,
                                     std::vector<double>(y.size(), 1.0));
        SpaceLoss loss(evaluator, space, 1);
        const std::vector<double> truth = space.coordinates({0.3, 3, 1.5, 0, 0.2}, unit);
        const std::size_t strength = space.strength().value().coordinate;
        std::vector<std::vector<double>> points{truth, truth, truth};
        points[0][strength] *= 0.5;
        points[1][strength] *= 2;
        const std::vector<double> held = loss.screen(points, {});
        const std::vector<double> freed = loss.screen_freed(points, {});
        EXPECT_NEAR(points[2][strength] / truth[strength], 1, 1e-6);
        const std::vector<double> moved = loss.screen(points, {});
        for (std::size_t i = 0; i < 2; ++i) {  // the shape of F changes with its strength, so one is not there at once
            EXPECT_LE(freed[i], held[i]);
            EXPECT_LT(moved[i], held[i]);
            EXPECT_LT(std::abs(points[i][strength] - truth[strength]), (i == 0 ? 0.5 : 1.0) * truth[strength]);
        }
    }
}

TEST(Descents, TurnBackFromWhatIsNotFinite) {
    const Landscape cliff = [inner = valley(0.4, 0.3)](std::span<const std::vector<double>> points) {
        std::vector<Look> looks = inner(points);
        for (std::size_t i = 0; i < points.size(); ++i)
            if (points[i][0] < 0.6) looks[i].value = std::numeric_limits<double>::quiet_NaN();
        return looks;
    };
    const Minimum end = descend_together(cliff, {{0.9, 0.9}}, {1e-9, 1e-20, 200}, {}).front();
    EXPECT_GE(end.u[0], 0.6);
    EXPECT_TRUE(std::isfinite(end.loss2));
    EXPECT_NE(end.stop, StopReason::converged);
}

TEST(Descents, SayWhyTheyStop) {
    EXPECT_EQ(descend_together(valley(0.4, 0.3), {{0.9, 0.9}}, {1e-9, 1e-20, 2}, {}).front().stop,
              StopReason::evaluation_limit);
    optim::SearchControl late;
    late.deadline = std::chrono::steady_clock::now();
    EXPECT_EQ(descend_together(valley(0.4, 0.3), {{0.9, 0.9}}, {1e-9, 1e-20, 200}, late).front().stop,
              StopReason::time_limit);
    std::stop_source source;
    source.request_stop();
    optim::SearchControl stopped;
    stopped.stop = source.get_token();
    EXPECT_EQ(descend_together(valley(0.4, 0.3), {{0.9, 0.9}}, {1e-9, 1e-20, 200}, stopped).front().stop,
              StopReason::cancelled);
}

class EveryLook : public testing::TestWithParam<const kernels::Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, EveryLook, testing::ValuesIn(variants()),
                         [](const auto& parameter) { return label(*parameter.param); });

/// Without residuals Gauss and Newton's matrix is the curvature itself.
TEST_P(EveryLook, HasTheCurvatureOfAnExactFit) {
    const kernels::Model& model = *GetParam();
    std::vector<optim::Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    const kernels::DirectionSet directions(scan_directions({15, 45, 70}, 8));
    const SearchSpace space(model, bounds, optim::Unknowns::nonlinear, {}, 1, optim::Charts::used, &directions);
    const std::size_t d = space.dimension();
    if (d == 0) return;
    Random random(5);
    std::size_t compared = 0;
    for (int i = 0; i < 12; ++i) {
        std::vector<double> u;
        for (const optim::Interval& typical : space.typical())
            u.push_back(random.uniform(0.6 * typical.min + 0.4 * typical.max, 0.4 * typical.min + 0.6 * typical.max));
        double scale = 1;
        const std::vector<double> truth = space.parameters(u, std::vector<double>(model.terms.size(), 0.4), scale);
        const std::vector<kernels::Direction> list(directions.directions().begin(), directions.directions().end());
        const std::vector<double> y = model_values(model, truth, list);
        const double norm2 = std::inner_product(y.begin(), y.end(), y.begin(), 0.0);
        if (!(norm2 > 1e-12) || norm2 > 1e12) continue;
        const std::vector<double> w(y.size(), 1.0);
        kernels::Evaluator evaluator(engine(), model, engine().best_precision(), directions, y, w);
        SpaceLoss loss(evaluator, space, norm2);
        const Look look = loss.looks({&u, 1}).front();
        std::vector<double> gradient(d);
        EXPECT_EQ(loss(u, gradient), look.value);
        EXPECT_EQ(gradient, look.gradient);
        const Eigen::Map<const Eigen::MatrixXd> curvature(look.curvature.data(), static_cast<Eigen::Index>(d),
                                                          static_cast<Eigen::Index>(d));
        const double largest = curvature.cwiseAbs().maxCoeff();
        EXPECT_GE(Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(curvature).eigenvalues().minCoeff(), -1e-9 * largest);
        for (std::size_t k = 0; k < d; ++k) {
            constexpr double kStep = 1e-5;
            std::vector<double> up = u, down = u, above(d), below(d);
            up[k] += kStep;
            down[k] -= kStep;
            loss(up, above);
            loss(down, below);
            for (std::size_t j = 0; j < d; ++j)
                EXPECT_NEAR(curvature(static_cast<Eigen::Index>(j), static_cast<Eigen::Index>(k)),
                            (above[j] - below[j]) / (2 * kStep), 2e-3 * largest)
                    << j << ", " << k;
        }
        ++compared;
    }
    EXPECT_GE(compared, 4U);
}

/// A model that cannot follow its data, seen through all of them or through every third.
TEST(BentLooks, HaveNewtonsCurvatureWhereItIsPositive) {
    const kernels::Model& model = variant("phong");
    const kernels::DirectionSet directions(scan_directions({15, 45, 70}, 2));
    const SearchSpace space(model, {{0, 1}, {0, 1}, {1, 1000}});
    std::vector<double> y, w;
    Random random(9);
    for (const kernels::Direction& d : directions.directions()) {
        const double off = (d.theta_r_deg - d.theta_i_deg) / 15;
        y.push_back(0.1 + std::exp(-off * off) + 0.3 * std::exp(-off * off / 25) + random.uniform(0, 0.02));
        w.push_back(1);
    }
    kernels::Evaluator evaluator(engine(), model, engine().best_precision(), directions, y, w);
    SpaceLoss loss(evaluator, space, 1);
    std::size_t positive = 0;
    std::size_t negative = 0;
    for (double u = 0.05; u < 1; u += 0.05) {
        const std::vector<double> point{u};
        constexpr double kStep = 1e-4;
        std::vector<double> above(1), below(1);
        loss(std::vector<double>{u + kStep}, above);
        loss(std::vector<double>{u - kStep}, below);
        const double newton = (above[0] - below[0]) / (2 * kStep);
        const Look plain = loss.looks({&point, 1}).front();
        const Look bent = loss.looks_bent_by(loss, {&point, 1}).front();
        EXPECT_EQ(bent.value, plain.value);
        EXPECT_EQ(bent.gradient, plain.gradient);
        EXPECT_NEAR(bent.curvature[0], newton > 0 ? newton : plain.curvature[0], 1e-6 * plain.curvature[0]);
        ++(newton > 0 ? positive : negative);
    }
    EXPECT_GT(positive, 3U);
    EXPECT_GT(negative, 0U);
}

TEST(DearLosses, AreNotLookedAtTwice) {
    const kernels::Model& model = variant("ward");
    const kernels::DirectionSet directions(scan_directions({15, 45, 70}, 0.05));
    const SearchSpace space(model, {{0, 1}, {0, 1}, {0.01, 1}});
    const std::vector<double> ones(directions.directions().size(), 1.0);
    kernels::Evaluator evaluator(engine(), model, engine().best_precision(), directions, ones, ones);
    SpaceLoss loss(evaluator, space, 1);
    const std::vector<double> u{0.4};
    const double value = loss(u, {});
    std::vector<double> gradient(1);
    EXPECT_EQ(loss(u, gradient), value);
    Minimum minimum;
    minimum.u = u;
    loss.complete(minimum);
    EXPECT_EQ(minimum.loss2, value);
    EXPECT_EQ(minimum.coefficients.size(), model.terms.size());
    EXPECT_EQ(loss.evaluations(), 1U);
    const Look look = loss.looks({&u, 1}).front();
    EXPECT_EQ(look.value, value);
    EXPECT_EQ(look.gradient, gradient);
}

TEST_P(EveryLook, BlocksPartitionTheCoordinates) {
    std::vector<optim::Interval> bounds;
    for (const kernels::Parameter& p : GetParam()->parameters) bounds.push_back({p.min, p.max});
    for (const optim::Unknowns unknowns : {optim::Unknowns::nonlinear, optim::Unknowns::all}) {
        const SearchSpace space(*GetParam(), bounds, unknowns, {0.1, 10});
        std::vector<std::size_t> all;
        for (const auto& block : space.blocks()) {
            EXPECT_FALSE(block.empty());
            all.insert(all.end(), block.begin(), block.end());
        }
        std::sort(all.begin(), all.end());
        std::vector<std::size_t> expected(space.dimension());
        std::iota(expected.begin(), expected.end(), std::size_t{0});
        EXPECT_EQ(all, expected);
    }
}

}  // namespace
}  // namespace brdfit::tests
