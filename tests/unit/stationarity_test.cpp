// The judge of `converged`, on functions whose minima are known.

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "optim/stationarity.h"

namespace brdfit::tests {
namespace {

using optim::Minimum;
using optim::Objective;
using optim::Resolution;
using optim::SearchControl;
using optim::Stationarity;
using optim::StopReason;

double square(double x) { return x * x; }

/// 1 + (x - a)^2 + 100 (y - b)^2
Objective bowl(double a, double b) {
    return [=](std::span<const double> u, std::span<double> g) {
        if (!g.empty()) {
            g[0] = 2 * (u[0] - a);
            g[1] = 200 * (u[1] - b);
        }
        return 1 + square(u[0] - a) + 100 * square(u[1] - b);
    };
}

/// 2 + (y - 1/2)^2 - (x - 1/2)^2 + 4 (x - 1/2)^4: a saddle in the middle, minima of 2 - 1/16.
double saddle(std::span<const double> u, std::span<double> g) {
    const double x = u[0] - 0.5;
    const double y = u[1] - 0.5;
    if (!g.empty()) {
        g[0] = -2 * x + 16 * x * x * x;
        g[1] = 2 * y;
    }
    return 2 + y * y - x * x + 4 * x * x * x * x;
}

/// Rosenbrock's valley within the cube, 1e-3 above zero: minimum at (0.7, 0.49).
double valley(std::span<const double> u, std::span<double> g) {
    const double across = u[1] - u[0] * u[0];
    if (!g.empty()) {
        g[0] = -4e4 * across * u[0] + 2 * (u[0] - 0.7);
        g[1] = 2e4 * across;
    }
    return 1e-3 + 1e4 * across * across + square(u[0] - 0.7);
}

Minimum settle_from(const Objective& objective, std::vector<double> u, StopReason stop = StopReason::converged,
                    const SearchControl& control = {}) {
    return optim::settle(objective, {std::move(u), {}, 0, stop}, Resolution{}, control);
}

TEST(Examine, NewtonsDecrementIsTheDepthOfABowl) {
    const Stationarity look = optim::examine(bowl(0.42, 0.58), std::vector{0.4, 0.6}, Resolution{});
    EXPECT_NEAR(look.promised, square(0.02) + 100 * square(0.02), 1e-9);
    EXPECT_NEAR(look.step[0], 0.02, 1e-9);
    EXPECT_NEAR(look.step[1], -0.02, 1e-9);
    EXPECT_TRUE(look.doubtful.empty());
}

TEST(Examine, NothingIsPromisedBeyondABound) {
    EXPECT_EQ(optim::examine(bowl(-0.5, 1.5), std::vector{0.0, 1.0}, Resolution{}).promised, 0);
    const Stationarity look = optim::examine(bowl(-0.5, 0.5), std::vector{0.0, 0.51}, Resolution{});
    EXPECT_NEAR(look.promised, 0.01, 1e-9);
    EXPECT_EQ(look.step[0], 0);
}

TEST(Examine, ASaddleAndASlopeWithoutCurvatureAreDoubted) {
    EXPECT_FALSE(optim::examine(saddle, std::vector{0.5, 0.5}, Resolution{}).doubtful.empty());
    const Objective ramp = [](std::span<const double> u, std::span<double> g) {
        if (!g.empty()) g[0] = 1e-3;
        return 1 + 1e-3 * u[0];
    };
    EXPECT_FALSE(optim::examine(ramp, std::vector{0.5}, Resolution{}).doubtful.empty());
}

TEST(Examine, AFlatCoordinateIsNoDoubt) {
    const Objective flat = [](std::span<const double> u, std::span<double> g) {
        if (!g.empty()) g[0] = 2 * (u[0] - 0.5), g[1] = 0;
        return 1 + square(u[0] - 0.5);
    };
    const Stationarity look = optim::examine(flat, std::vector{0.5, 0.3}, Resolution{});
    EXPECT_EQ(look.promised, 0);
    EXPECT_TRUE(look.doubtful.empty());
    EXPECT_EQ(settle_from(flat, {0.5, 0.3}).stop, StopReason::converged);
}

TEST(Settle, LeavesASaddleEitherWay) {
    const Minimum end = settle_from(saddle, {0.5, 0.5});
    EXPECT_EQ(end.stop, StopReason::converged);
    EXPECT_NEAR(std::abs(end.u[0] - 0.5), std::sqrt(1.0 / 8), 1e-4);
    EXPECT_NEAR(end.loss2, 2 - 1.0 / 16, 1e-9);
}

TEST(Settle, FollowsABentValleyThatASearchGaveUpIn) {
    for (const StopReason stop : {StopReason::converged, StopReason::evaluation_limit, StopReason::roundoff}) {
        const Minimum end = settle_from(valley, {0.1, 0.01}, stop);
        EXPECT_EQ(end.stop, StopReason::converged);
        EXPECT_NEAR(end.u[0], 0.7, 1e-5);
        EXPECT_NEAR(end.loss2, 1e-3, 1e-11);
    }
}

TEST(Settle, GoesToTheBoundThatHoldsTheMinimum) {
    const Minimum end = settle_from(bowl(-0.5, 0.5), {0.3, 0.6});
    EXPECT_EQ(end.stop, StopReason::converged);
    EXPECT_EQ(end.u[0], 0);
    EXPECT_NEAR(end.u[1], 0.5, 1e-6);
}

TEST(Settle, ASlopeThatLeadsNowhereIsRoundoff) {
    const Objective wrong = [](std::span<const double> u, std::span<double> g) {
        if (!g.empty()) g[0] = 2 * (u[0] - 0.9);  // the value's minimum is at 0.5
        return 1 + square(u[0] - 0.5);
    };
    EXPECT_EQ(settle_from(wrong, {0.5}).stop, StopReason::roundoff);
}

TEST(Settle, AStopAndAPassedLimitStay) {
    EXPECT_EQ(settle_from(saddle, {0.5, 0.5}, StopReason::time_limit).stop, StopReason::time_limit);
    SearchControl late;
    late.deadline = std::chrono::steady_clock::now();
    EXPECT_EQ(settle_from(saddle, {0.5, 0.5}, StopReason::converged, late).stop, StopReason::time_limit);
    std::stop_source source;
    source.request_stop();
    SearchControl stopped;
    stopped.stop = source.get_token();
    EXPECT_EQ(settle_from(saddle, {0.5, 0.5}, StopReason::converged, stopped).stop, StopReason::cancelled);
}

}  // namespace
}  // namespace brdfit::tests
