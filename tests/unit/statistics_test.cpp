// Errors of fits: by hand, and by repetition.

#include "optim/statistics.h"

#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <thread>

#include "optim/fit.h"
#include "tests/support.h"

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
    const Weighted weighted = weigh(channel, Loss::l2);
    Fit fit;
    fit.values = {10, 2, 10, 1};
    fit.loss = 0.5;
    describe_errors(channel, weighted, 1, fit);
    EXPECT_NEAR(fit.rmse, std::sqrt((81.0 + 4) / 4), 1e-14);
    EXPECT_NEAR(fit.log10_rmse.value(), std::sqrt(1.0 / 3), 1e-14);  // over three samples
    ASSERT_EQ(fit.scans.size(), 2U);
    EXPECT_EQ(fit.scans[0].theta_i_deg, 15);
    EXPECT_NEAR(fit.scans[0].rmse, std::sqrt(81.0 / 2), 1e-14);
    EXPECT_NEAR(fit.scans[0].log10_rmse.value(), std::sqrt(0.5), 1e-14);
    EXPECT_NEAR(fit.scans[1].rmse, std::sqrt(2.0), 1e-14);
    EXPECT_NEAR(fit.scans[1].log10_rmse.value(), 0, 1e-14);
    // n = 4; the free parameter and the noise's size: k = 2.
    const double deviance = 4 * std::log(0.25);
    EXPECT_NEAR(fit.bic, deviance + 2 * std::log(4), 1e-12);
    EXPECT_NEAR(fit.aicc.value(), deviance + 4 + 2.0 * 2 * 3 / (4 - 2 - 1), 1e-12);
}

TEST(Errors, AiccNeedsMoreSamplesThanParameters) {
    const Channel channel = four_samples();
    Fit fit;
    fit.values = {1, 2, 10, 0};
    fit.loss = 0;
    describe_errors(channel, weigh(channel, Loss::l2), 3, fit);
    EXPECT_FALSE(fit.aicc);
    EXPECT_TRUE(std::isfinite(fit.bic));  // a perfect fit's logarithm is held
}

TEST(StandardErrors, OfAMean) {
    // f = p: the sandwich with leverage 1/n is sqrt(sum r^2/(1 - 1/n)^2)/n.
    const Channel channel = four_samples();
    const Weighted weighted = weigh(channel, Loss::l2);
    const std::vector<double> f(4, 3.0);  // the mean
    const auto errors = standard_errors(weighted, residuals(weighted, f), {{1, 1, 1, 1}});
    const double sum2 = 4 + 1 + 49 + 16;
    EXPECT_NEAR(errors[0].value(), std::sqrt(sum2) / (1 - 0.25) / 4, 1e-12);
}

TEST(StandardErrors, OfWhatTheDataDoNotDetermineAreNone) {
    const Channel channel = four_samples();
    const Weighted weighted = weigh(channel, Loss::l2);
    const Residuals r = residuals(weighted, std::vector<double>(4, 3.0));
    const auto collinear = standard_errors(weighted, r, {{1, 2, 3, 4}, {2, 4, 6, 8}, {1, 0, 0, 1}});
    EXPECT_FALSE(collinear[0]);
    EXPECT_FALSE(collinear[1]);
    EXPECT_TRUE(collinear[2]);
    const auto unseen = standard_errors(weighted, r, {{1, 1, 1, 1}, {0, 0, 0, 0}});
    EXPECT_TRUE(unseen[0]);
    EXPECT_FALSE(unseen[1]);
    const auto too_many = standard_errors(weighted, r, {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}, {0, 0, 0, 1}});
    for (const auto& error : too_many) EXPECT_FALSE(error);
    EXPECT_TRUE(standard_errors(weighted, r, {}).empty());
}

TEST(StandardErrors, DoNotDependOnUnits) {
    const Channel channel = four_samples();
    const Weighted weighted = weigh(channel, Loss::l2);
    const Residuals r = residuals(weighted, std::vector<double>(4, 3.0));
    const auto plain = standard_errors(weighted, r, {{1, 1, 1, 1}, {1, 2, 3, 4}});
    const auto scaled = standard_errors(weighted, r, {{1e9, 1e9, 1e9, 1e9}, {1e-9, 2e-9, 3e-9, 4e-9}});
    EXPECT_NEAR(scaled[0].value() * 1e9, plain[0].value(), 1e-9 * plain[0].value());
    EXPECT_NEAR(scaled[1].value() * 1e-9, plain[1].value(), 1e-9 * plain[1].value());
}

class Coverage : public testing::TestWithParam<std::pair<std::string, std::vector<double>>> {};
INSTANTIATE_TEST_SUITE_P(Models, Coverage,
                         testing::Values(std::pair{"phong", std::vector{0.3, 0.2, 40.0}},
                                         std::pair{"ward", std::vector{0.3, 0.1, 0.15}},
                                         std::pair{"lafortune_1", std::vector{0.2, -1.0, 0.95, 40.0}}),
                         [](const auto& parameter) { return parameter.param.first; });

TEST_P(Coverage, OfTheTruthByIntervalsOfNinetyFivePercent) {
    const auto& [name, truth] = GetParam();
    const kernels::Model& model = variant(name);
    const std::vector<kernels::Direction> directions = scan_directions({15, 30, 45, 60, 75}, 4);
    const std::vector<double> exact = model_values(model, truth, directions);
    optim::ModelRequest request;
    request.family = catalogue().find(model.name);
    if (model.repeats > 0) request.lobes = model.repeats;
    // Noise of 2 % of the value, fitted with a loss that takes it for even: what measurements are like.
    constexpr std::size_t kReplicates = 200;
    optim::Dataset dataset{"replicates", optim::Unit::per_steradian, {}};
    Random random(12);
    for (std::size_t i = 0; i < kReplicates; ++i) {
        std::vector<double> y = exact;
        for (double& value : y) value *= 1 + 0.02 * random.normal();
        dataset.channels.push_back(make_channel(directions, y));
    }
    optim::FitOptions options;
    options.effort = optim::Effort::draft;
    options.time_limit = std::chrono::minutes(5);
    optim::Fitter fitter(engine(), std::max(1U, std::thread::hardware_concurrency()));
    const optim::Report report = fitter.fit(dataset, {request}, options);
    for (std::size_t k = 0; k < truth.size(); ++k) {
        std::size_t covered = 0;
        for (const optim::ChannelReport& channel : report.channels) {
            const optim::FittedParameter& p = channel.fits.at(0).parameters[k];
            if (p.std_error && std::abs(p.value - truth[k]) <= 1.96 * *p.std_error) ++covered;
        }
        const double share = static_cast<double>(covered) / kReplicates;
        std::printf("%s %s: %.1f %% covered\n", name.c_str(), model.parameters[k].name.c_str(), 100 * share);
        EXPECT_GE(share, 0.88) << model.parameters[k].name;
        EXPECT_LE(share, 0.99) << model.parameters[k].name;
    }
}

}  // namespace
}  // namespace brdfit::tests
