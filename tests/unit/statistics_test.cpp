// Errors of fits and the evidence for them, by hand.

#include "optim/statistics.h"

#include <gtest/gtest.h>

#include <cmath>
#include <numbers>

namespace brdfit::tests {
namespace {

using optim::Channel;
using optim::Fit;
using optim::Loss;
using optim::Residuals;
using optim::Weighted;

Channel four_samples() {
    return {"y", {}, {{{15, 0, 0}, 1.0, {}}, {{15, 10, 0}, 2.0, {}}, {{45, 0, 0}, 10.0, {}}, {{45, 10, 0}, -1.0, {}}}};
}

TEST(Residuals, AreDifferences) {
    const Residuals r = residuals(weigh(four_samples(), Loss::l2), std::vector<double>{1, 4, 9, 0});
    EXPECT_EQ(r.r, (std::vector<double>{0, 2, -1, 1}));
    EXPECT_EQ(r.by_f, (std::vector<double>{1, 1, 1, 1}));
    EXPECT_NEAR(r.loss2, 6.0 / 4, 1e-15);
}

TEST(Residuals, AreDecadesForTheLogarithmicLoss) {
    const Residuals r = residuals(weigh(four_samples(), Loss::log), std::vector<double>{10, 2, 1, 5});
    EXPECT_NEAR(r.loss2, (1.0 + 0 + 1) / 3, 1e-14);
    EXPECT_NEAR(r.r[0], std::log(10), 1e-14);
    EXPECT_NEAR(r.by_f[0], 0.1, 1e-15);
    EXPECT_EQ(r.r[3], 0);
    EXPECT_EQ(r.by_f[3], 0);
}

TEST(Errors, ByHand) {
    const Channel channel = four_samples();
    Fit fit;
    fit.values = {10, 2, 10, 1};
    describe_errors(channel, fit);
    EXPECT_NEAR(fit.rmse, std::sqrt((81.0 + 4) / 4), 1e-14);
    EXPECT_NEAR(fit.log10_rmse.value(), std::sqrt(1.0 / 3), 1e-14);  // over three samples
    ASSERT_EQ(fit.scans.size(), 2U);
    EXPECT_EQ(fit.scans[0].theta_i_deg, 15);
    EXPECT_NEAR(fit.scans[0].rmse, std::sqrt(81.0 / 2), 1e-14);
    EXPECT_NEAR(fit.scans[0].log10_rmse.value(), std::sqrt(0.5), 1e-14);
    EXPECT_NEAR(fit.scans[1].rmse, std::sqrt(2.0), 1e-14);
    EXPECT_NEAR(fit.scans[1].log10_rmse.value(), 0, 1e-14);
    EXPECT_TRUE(fit.warnings.empty());
}

TEST(Errors, AModelThatIsZeroWhereTheSurfaceIsNotIsFarOffInDecades) {
    Fit fit;
    fit.values = {1, 2, 0, 1};
    describe_errors(four_samples(), fit);
    EXPECT_GT(fit.log10_rmse.value(), 100);
    EXPECT_TRUE(std::isfinite(*fit.log10_rmse));
    ASSERT_EQ(fit.warnings.size(), 1U);
    EXPECT_NE(fit.warnings[0].find("at 1 of 4 samples"), std::string::npos);
}

TEST(Errors, OfHeldOutValuesAreMeasuredByTheLoss) {
    const Channel channel = four_samples();
    const optim::HeldOut held_out =
        held_out_errors(channel, weigh(channel, Loss::l2), std::vector<double>{10, 2, 10, 1});
    EXPECT_NEAR(held_out.loss, std::sqrt((81.0 + 4) / 4), 1e-14);
    EXPECT_NEAR(held_out.rmse, held_out.loss, 1e-14);
    ASSERT_EQ(held_out.angles.size(), 2U);
    EXPECT_NEAR(held_out.angles[1].rmse, std::sqrt(2.0), 1e-14);
}

TEST(Evidence, OfKnownErrorsIsTheGaussiansLogarithm) {
    const Channel channel = four_samples();
    const std::vector<double> sigma{1, 2, 3, 4};
    const std::vector<double> f{3, 2, 10, 1};  // z: 2, 0, 0, 1/2
    const double size2 = (4 + 0.25) / 4;
    double minus_two_log = 0;
    for (std::size_t j = 0; j < 4; ++j) {
        const double variance = size2 * sigma[j] * sigma[j];
        minus_two_log += std::log(2 * std::numbers::pi * variance) +
                         (f[j] - channel.samples[j].brdf) * (f[j] - channel.samples[j].brdf) / variance;
    }
    const double chi2 = 4 + 0.25;
    EXPECT_NEAR(optim::deviance(channel, sigma, chi2, weigh_by(channel, sigma).norm), minus_two_log, 1e-12);
}

TEST(Evidence, CountsTheErrorsSizeAsAParameter) {
    Fit fit;
    describe_evidence(-3.0, 4, 1, fit);  // k = 2
    EXPECT_NEAR(fit.bic, -3 + 2 * std::log(4), 1e-12);
    EXPECT_NEAR(fit.aicc.value(), -3 + 4 + 2.0 * 2 * 3 / (4 - 2 - 1), 1e-12);
    describe_evidence(-3.0, 4, 2, fit);
    EXPECT_FALSE(fit.aicc);  // too few samples for the correction
}

TEST(Evidence, OfAPerfectFitIsFinite) {
    const Channel channel = four_samples();
    const std::vector<double> sigma(4, 1.0);
    EXPECT_TRUE(std::isfinite(optim::deviance(channel, sigma, 0, weigh_by(channel, sigma).norm)));
    EXPECT_TRUE(std::isfinite(optim::deviance(weigh(channel, Loss::l2), 0.0)));
}

}  // namespace
}  // namespace brdfit::tests
