// What a scene sees, and what is recommended for it.
#include "optim/scene.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "optim/report.h"

namespace brdfit {
namespace {

using optim::Channel;
using optim::ChannelReport;
using optim::Fit;
using optim::Scene;
using testing::HasSubstr;

Fit fit(const std::string& model, std::optional<double> ns, std::optional<double> log10_rmse,
        std::size_t free_parameters = 3, const std::string& submodel = "") {
    Fit result;
    result.model = model;
    result.submodel = submodel;
    if (ns) result.cost = kernels::Cost{ns, {}, {}};
    result.log10_rmse = log10_rmse;
    result.parameters.resize(free_parameters);
    return result;
}

ChannelReport judged(const Scene& scene, std::vector<Fit> fits) {
    ChannelReport report;
    report.fits = std::move(fits);
    judge_scene(scene, report);
    return report;
}

std::vector<std::string> front(const ChannelReport& report) {
    std::vector<std::string> names;
    for (const optim::ParetoPoint& point : report.pareto) names.push_back(report.fits[point.fit].model);
    return names;
}

Scene tolerating(double decades) {
    Scene scene;
    scene.tolerance_log10 = decades;
    return scene;
}

Channel channel_at(const std::vector<kernels::Direction>& directions) {
    Channel channel;
    for (const kernels::Direction& direction : directions) channel.samples.push_back({direction, 1, {}});
    return channel;
}

TEST(Scene, LeavesOutWhatItDoesNotSee) {
    Scene scene;
    scene.theta_i_deg = {10, 60};
    scene.theta_r_deg = {0, 70};
    const Channel channel =
        channel_at({{10, 0, 0}, {60, -70, 0}, {60, 70.01, 0}, {9.9, 0, 0}, {60.1, 0, 0}, {30, -80, 0}});
    const Channel seen = seen_by(scene, channel);
    ASSERT_EQ(seen.samples.size(), 2U);
    EXPECT_EQ(seen.samples[1], channel.samples[1]) << "the sign of theta_r is a side, not a size";
}

TEST(Scene, OrWeighsItLess) {
    Scene scene;
    scene.theta_i_deg = {0, 45};
    scene.outside_weight = 0.25;
    const Channel seen = seen_by(scene, channel_at({{45, 0, 0}, {46, 0, 0}}));
    ASSERT_EQ(seen.samples.size(), 2U);
    EXPECT_EQ(seen.samples[0].weight, 1);
    EXPECT_EQ(seen.samples[1].weight, 0.25);
}

TEST(Scene, WithoutLimitsSeesAllAndChangesNothing) {
    const Channel channel = channel_at({{0, -90, 0}, {90, 90, 180}, {45, 45, 10}});
    EXPECT_EQ(seen_by(Scene{}, channel), channel);
}

TEST(Recommendation, IsTheCheapestThatIsGoodEnough) {
    const ChannelReport report =
        judged(tolerating(0.05), {fit("he_torrance", 80, 0.01), fit("ward", 4, 0.04), fit("lambert", 1, 0.5)});
    ASSERT_TRUE(report.recommended->fit);
    EXPECT_EQ(report.fits[*report.recommended->fit].model, "ward");
    ASSERT_TRUE(report.recommended->next_better);
    EXPECT_EQ(report.fits[report.recommended->next_better->fit].model, "he_torrance");
    EXPECT_THAT(report.recommended->reason, AllOf(HasSubstr("ward"), HasSubstr("he_torrance"), HasSubstr("80 ns")));
}

TEST(Recommendation, MayBeTheBestOfAll) {
    const ChannelReport report = judged(tolerating(0.05), {fit("ward", 4, 0.04), fit("lambert", 1, 0.5)});
    EXPECT_EQ(report.recommended->fit, 0U);
    EXPECT_FALSE(report.recommended->next_better);
}

TEST(Recommendation, IsNoneIfNoneIsGoodEnough) {
    const ChannelReport report = judged(tolerating(0.05), {fit("ward", 4, 0.4), fit("lambert", 1, 0.5)});
    EXPECT_FALSE(report.recommended->fit);
    EXPECT_THAT(report.recommended->reason, AllOf(HasSubstr("no model here is good enough"), HasSubstr("ward"),
                                                  HasSubstr("0.4 decades"), HasSubstr("0.05")));
}

TEST(Recommendation, IsNoneIfTheCheapestGoodOneCostsTooMuch) {
    Scene scene = tolerating(0.05);
    scene.max_ns_per_evaluation = 5;
    const ChannelReport report = judged(scene, {fit("he_torrance", 80, 0.01), fit("ward", 4, 0.1)});
    EXPECT_FALSE(report.recommended->fit);
    EXPECT_THAT(report.recommended->reason,
                AllOf(HasSubstr("cheap enough"), HasSubstr("he_torrance"), HasSubstr("80 ns"), HasSubstr("5 can"),
                      HasSubstr("ward, is off by 0.1 decades")));
    scene.max_ns_per_evaluation = 80;
    EXPECT_EQ(judged(scene, {fit("he_torrance", 80, 0.01)}).recommended->fit, 0U) << "the limit is within";
}

TEST(Recommendation, IsTheSimplerOfTwoThatCostTheSame) {
    const ChannelReport report =
        judged(tolerating(0.05),
               {fit("ward", 4, 0.03, 3), fit("ward", 4, 0.04, 2, "no diffuse term"), fit("lambert", 1, 0.5)});
    EXPECT_EQ(report.recommended->fit, 1U);
    EXPECT_THAT(report.recommended->reason, HasSubstr("ward, no diffuse term"));
    EXPECT_EQ(report.recommended->next_better->fit, 0U);
}

TEST(Recommendation, MayBeHardlyBetterThanACheaperOneThatIsNotGoodEnough) {
    const ChannelReport report = judged(tolerating(0.05), {fit("ward", 4, 0.049999), fit("phong", 3, 0.050001)});
    EXPECT_EQ(report.recommended->fit, 0U);
    EXPECT_THAT(front(report), testing::ElementsAre("phong"));
    EXPECT_THAT(report.recommended->reason, HasSubstr("none here is better"));
}

TEST(Recommendation, NeedsACostAndAnError) {
    const ChannelReport report = judged(tolerating(0.05), {fit("ward", {}, 0.01), fit("phong", 3, {})});
    EXPECT_FALSE(report.recommended->fit);
    EXPECT_TRUE(report.pareto.empty());
    EXPECT_THAT(report.recommended->reason, HasSubstr("could be judged"));
}

TEST(ParetoFront, HoldsWhatNoCheaperOneEquals) {
    const ChannelReport report = judged(
        tolerating(0.05), {fit("a", 9, 0.1), fit("b", 5, 0.2), fit("c", 7, 0.2), fit("d", 1, 0.5), fit("e", 9, 0.3)});
    EXPECT_THAT(front(report), testing::ElementsAre("d", "b", "a"));
}

TEST(ParetoFront, TakesErrorsThatHardlyDifferForEqual) {
    EXPECT_THAT(front(judged(tolerating(0.05), {fit("a", 9, 0.19999), fit("b", 5, 0.2)})), testing::ElementsAre("b"));
}

}  // namespace
}  // namespace brdfit
