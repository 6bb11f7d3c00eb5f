/// Fits that are required to keep to physics.
#include <algorithm>
#include <filesystem>
#include <numbers>
#include <string>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "kernels/hemisphere.h"
#include "optim/physics.h"
#include "tests/fits/fitting.h"

namespace brdfit::tests {
namespace {

using optim::Requirement;
using testing::HasSubstr;

optim::Dataset sample(const std::string& name) {
    return read_samples(std::filesystem::path(BRDFIT_SOURCE_DIR) / "samples" / (name + ".csv"));
}

optim::Report fit(const optim::Dataset& dataset, const std::vector<std::string>& models,
                  std::vector<Requirement> require) {
    optim::FitOptions options;
    options.require = std::move(require);
    return fitter().fit(dataset, requests(models), options);
}

/// The largest albedo of a fit to an absolute channel of 550 nm, on a fine grid of angles.
double largest(const optim::Fit& fit, const std::string& name) {
    std::vector<double> angles;
    for (double angle = 0; angle <= optim::kSteepestIncidence_deg; angle += 0.5) angles.push_back(angle);
    kernels::Hemisphere hemisphere(engine(), variant(name), engine().best_precision());
    double most = 0;
    for (const kernels::Albedo& albedo : hemisphere.albedo(values_of(fit), angles, 1e-6))
        most = std::max(most, albedo.value);
    return most;
}

TEST(Constrained, PlasticLosesItsSurplusOfEnergy) {
    const optim::Dataset plastic = sample("white_plastic");
    const optim::Fit free = only(fit(plastic, {"lafortune_2"}, {}));
    ASSERT_EQ(free.physics->energy_conserving, false);
    EXPECT_GT(largest(free, "lafortune_2"), 1.1);

    const optim::Fit kept = only(fit(plastic, {"lafortune_2"}, {Requirement::energy_conserving}));
    EXPECT_EQ(kept.physics->energy_conserving, true);
    EXPECT_LE(kept.physics->max_albedo.value(), 1 + optim::kAlbedoTolerance);
    EXPECT_LE(largest(kept, "lafortune_2"), 1 + optim::kAlbedoTolerance);
    EXPECT_GT(largest(kept, "lafortune_2"), 0.99);  // the constraint binds
    EXPECT_EQ(kept.constrained->loss_without, free.loss);
    EXPECT_GT(kept.search.evaluations, free.search.evaluations) << "the second search counts";
    // SciPy's SLSQP under a quadrature of its own at 17 angles: the best of 24 ends, which 8 of them share.
    EXPECT_NEAR(kept.loss, 0.167842, 2e-5);
    std::printf("loss %g, without the requirement %g, %zu of %zu starts agree, %zu evaluations\n", kept.loss, free.loss,
                kept.search.agreed, kept.search.starts, kept.search.evaluations);
}

TEST(Constrained, IsAskedOnlyWhereASceneSees) {
    // Phong's lobe, divided by cos theta_i, sends back too much near the horizon alone.
    const std::vector<kernels::Direction> directions = scan_directions({10, 30, 60}, 5);
    const optim::Channel channel = make_channel(
        directions,
        kernels::evaluate(engine(), variant("phong"), engine().best_precision(), {0.3, 0.6, 50}, directions, false).f);
    optim::FitOptions options;
    options.require = {Requirement::energy_conserving};
    const optim::Fit kept = only(fitter().fit(dataset_of(channel), requests({"phong"}), options));
    options.scene.emplace().theta_i_deg = {0, 60};
    const optim::Report report = fitter().fit(dataset_of(channel), requests({"phong"}), options);
    const optim::Fit& seen = report.channels.front().fits.front();
    EXPECT_EQ(seen.physics->energy_conserving, true);
    EXPECT_EQ(seen.physics->theta_i_deg, (optim::Interval{0, 60}));
    EXPECT_LT(seen.relative_loss, 1e-6);
    EXPECT_GT(largest(seen, "phong"), 1.1) << "beyond what the scene sees nothing is asked";
    EXPECT_LE(largest(kept, "phong"), 1 + optim::kAlbedoTolerance);
    EXPECT_GT(kept.relative_loss, 1e-3);
}

TEST(Constrained, EndsAtTheEdgeThatIsKnown) {
    // A surface brighter than any: k_d = 1.2 within bounds that allow it becomes 1.
    std::vector<kernels::Direction> directions = scan_directions({10, 50}, 10);
    optim::Channel channel = make_channel(directions, std::vector<double>(directions.size(), 1.2 / std::numbers::pi));
    optim::ModelRequest lambert = request("lambert");
    lambert.bounds["k_d"] = {0, 2};
    optim::FitOptions options;
    options.require = {Requirement::energy_conserving};
    const optim::Fit kept = only(fitter().fit(dataset_of(channel), {lambert}, options));
    EXPECT_NEAR(kept.parameters.front().value, 1, optim::kAlbedoTolerance);
    EXPECT_NEAR(kept.loss, 0.2 / std::numbers::pi, 1e-4);
}

TEST(Constrained, AFitThatConservesEnergyStaysAsItIs) {
    const optim::Dataset paper = sample("paper");
    const std::vector<Requirement> all{Requirement::energy_conserving, Requirement::reciprocal,
                                       Requirement::nonnegative};
    for (const std::string model : {"lambert", "he_torrance"}) {
        const optim::Fit free = only(fit(paper, {model}, {}));
        ASSERT_EQ(free.physics->energy_conserving, true) << model;
        const optim::Fit kept = only(fit(paper, {model}, all));
        EXPECT_EQ(values_of(kept), values_of(free)) << model;
        EXPECT_EQ(kept.loss, free.loss) << model;
        EXPECT_EQ(kept.constrained->loss_without, free.loss) << model;
        EXPECT_EQ(kept.search.evaluations, free.search.evaluations) << model;
    }
}

TEST(Constrained, AModelThatCannotIsAFailureAndTheOthersGoOn) {
    const optim::Report report = fit(sample("paper"), {"phong", "ward"}, {Requirement::reciprocal});
    const optim::ChannelReport& channel = report.channels.front();
    ASSERT_EQ(channel.fits.size(), 1U);
    EXPECT_EQ(channel.fits.front().model, "ward");
    ASSERT_EQ(channel.failures.size(), 1U);
    EXPECT_EQ(channel.failures.front().model, "phong");
    EXPECT_THAT(channel.failures.front().reason, HasSubstr("not reciprocal"));
}

TEST(Constrained, JudgingCanBeLeftOut) {
    optim::FitOptions options;
    options.judge = false;
    const optim::Fit fit = only(fitter().fit(sample("paper"), requests({"lambert"}), options));
    EXPECT_TRUE(fit.albedo.empty());
    EXPECT_FALSE(fit.physics.has_value());
}

}  // namespace
}  // namespace brdfit::tests
