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

TEST(Cosine, WeighsWithPowersOfBothCosines) {
    Criterion loss = Loss::cosine;
    const Channel channel = three_samples();
    EXPECT_EQ(weigh(channel, loss).weight, weigh(channel, Loss::cosine_l2).weight);  // 0 and 1 are the defaults
    loss.cos_theta_r_exponent = 0;
    EXPECT_EQ(weigh(channel, loss).weight, weigh(channel, Loss::l2).weight);
    loss.cos_theta_i_exponent = 3;  // the same at every sample: no difference
    for (const double weight : weigh(channel, loss).weight) EXPECT_NEAR(weight, 1.0 / 3, 1e-15);
    loss.cos_theta_r_exponent = -2;  // 1, 4, 4
    EXPECT_NEAR(weigh(channel, loss).weight[0], 1.0 / 9, 1e-15);
    EXPECT_NEAR(weigh(channel, loss).weight[1], 4.0 / 9, 1e-15);
}

Criterion robust_form(Loss kind, Robust robust) {
    Criterion loss = kind;
    loss.robust = robust;
    return loss;
}

TEST(RobustLosses, AreSquaresForSmallResiduals) {
    for (const Robust robust : {Robust::huber, Robust::cauchy}) {
        const Weighted w = weigh(three_samples(), robust_form(Loss::l2, robust), 1e6);
        EXPECT_NEAR(w.norm, weigh(three_samples(), Loss::l2).norm, 1e-10);
        const Influence small = w.influence(w.scale * w.scale * 1e-12);
        EXPECT_NEAR(small.loss / (w.scale * w.scale * 1e-12), 1, 1e-11);
        EXPECT_NEAR(small.weight, 1, 1e-11);
        EXPECT_NEAR(small.slope, 1, 1e-11);
    }
}

TEST(RobustLosses, TakeTheirScaleInTheUnitOfTheLoss) {
    const Channel channel = three_samples();  // residuals 2 and 4 and -1 of f = 0, of which 4 is beyond 1.345 x 2
    const Weighted w = weigh(channel, robust_form(Loss::l2, Robust::huber), 2.0);
    const double bend = 1.345 * 2;
    EXPECT_NEAR(w.norm * w.norm, (4 + bend * (2 * 4 - bend) + 1) / 3, 1e-13);
    EXPECT_NEAR(scale_in_loss(channel, robust_form(Loss::l2, Robust::huber), w.scale), 2, 1e-14);
}

TEST(RobustLosses, SlopeAndWeightAreThoseOfTheLoss) {
    for (const Robust robust : {Robust::huber, Robust::cauchy}) {
        const Weighted w = weigh(three_samples(), robust_form(Loss::cosine_l2, robust), 0.7);
        for (const double z : {0.1, 1.0, 1.3, 1.4, 2.3, 2.5, 10.0, 1e4}) {
            const double size = z * w.scale;
            const auto loss = [&](double x) { return w.influence(x * x).loss; };
            const double h = 1e-4 * size;
            const Influence at = w.influence(size * size);
            // d loss/d size = 2 weight size, and its slope 2 psi'.
            EXPECT_NEAR((loss(size + h) - loss(size - h)) / (2 * h), 2 * at.weight * size, 1e-5 * size) << z;
            EXPECT_NEAR((loss(size + h) - 2 * loss(size) + loss(size - h)) / (h * h), 2 * at.slope, 1e-4) << z;
            EXPECT_LE(at.loss, size * size * (1 + 1e-15)) << z;
        }
    }
}

}  // namespace
}  // namespace brdfit::optim
