// What each loss weighs, by hand.

#include "optim/loss.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>
#include <stdexcept>

namespace brdfit::optim {
namespace {

Channel three_samples() {
    return {"y", {}, {{{30, 0, 0}, 2.0, 0.5}, {{30, 60, 0}, 4.0, 0.25}, {{30, -60, 0}, -1.0, 1.0}}};
}

TEST(CosineLoss, WeighsWithTheCosineOfTheExitantAngle) {
    const Weighted w = weigh(three_samples(), Loss::cosine_l2);  // cosines 1, 1/2, 1/2
    EXPECT_NEAR(w.weight[0], 0.5, 1e-15);
    EXPECT_NEAR(w.weight[1], 0.25, 1e-15);
    EXPECT_NEAR(w.weight[2], 0.25, 1e-15);
    EXPECT_EQ(w.y, (std::vector<double>{2, 4, -1}));
    EXPECT_NEAR(w.norm, std::sqrt(0.5 * 4 + 0.25 * 16 + 0.25 * 1), 1e-14);
    EXPECT_EQ(w.used, 3U);
    EXPECT_FALSE(w.logarithmic);
}

TEST(PlainLoss, WeighsAllAlike) {
    const Weighted w = weigh(three_samples(), Loss::l2);
    for (const double weight : w.weight) EXPECT_NEAR(weight, 1.0 / 3, 1e-15);
    EXPECT_NEAR(w.norm, std::sqrt(21.0 / 3), 1e-14);
}

TEST(LogarithmicLoss, TakesDecadesAndLeavesOutWhatHasNone) {
    const Weighted w = weigh(three_samples(), Loss::log);
    EXPECT_TRUE(w.logarithmic);
    EXPECT_EQ(w.used, 2U);
    EXPECT_EQ(w.weight[2], 0);
    EXPECT_NEAR(w.y[1], std::log(4), 1e-15);
    EXPECT_EQ(w.norm, 1);
    // f = 10 y everywhere: one decade.
    double loss2 = 0;
    for (std::size_t j = 0; j < 2; ++j) loss2 += w.weight[j] * std::numbers::ln10 * std::numbers::ln10;
    EXPECT_NEAR(loss2, 1, 1e-15);
}

TEST(RelativeLoss, TakesFractionsAndLeavesOutWhatHasNone) {
    const Weighted w = weigh(three_samples(), Loss::relative);
    EXPECT_NEAR(w.weight[0], 1.0 / 4 / 2, 1e-15);
    EXPECT_NEAR(w.weight[1], 1.0 / 16 / 2, 1e-15);
    EXPECT_EQ(w.weight[2], 0);
    EXPECT_EQ(w.y[2], 0);
    EXPECT_NEAR(w.norm, 1, 1e-15);  // f = 0 errs by 100 %
}

TEST(ChiSquared, WeighsWithTheInverseVariance) {
    const Weighted w = weigh(three_samples(), Loss::chi2);
    EXPECT_NEAR(w.weight[0], 4.0 / 3, 1e-15);
    EXPECT_NEAR(w.weight[1], 16.0 / 3, 1e-14);
    EXPECT_NEAR(w.weight[2], 1.0 / 3, 1e-15);
}

TEST(ChiSquared, NeedsEverySigma) {
    Channel channel = three_samples();
    channel.samples[1].sigma.reset();
    EXPECT_THROW(weigh(channel, Loss::chi2), std::invalid_argument);
    EXPECT_NO_THROW(weigh(channel, Loss::l2));
}

TEST(EveryLoss, OfNothingIsNothing) {
    for (const LossName& name : kLossNames) {
        const Weighted w = weigh(Channel{"none", {}, {}}, name.loss);
        EXPECT_EQ(w.used, 0U) << name.name;
        EXPECT_TRUE(w.weight.empty()) << name.name;
    }
}

TEST(EveryLoss, OfDarknessIsFinite) {
    const Channel dark{"dark", {}, {{{30, 0, 0}, 0.0, 1.0}, {{30, 10, 0}, -1e-3, 1.0}}};
    for (const LossName& name : kLossNames) {
        const Weighted w = weigh(dark, name.loss);
        EXPECT_TRUE(std::isfinite(w.norm)) << name.name;
        for (const double weight : w.weight) EXPECT_TRUE(std::isfinite(weight)) << name.name;
        if (name.loss == Loss::log || name.loss == Loss::relative) {
            EXPECT_EQ(w.used, 0U);
        }
    }
}

}  // namespace
}  // namespace brdfit::optim
