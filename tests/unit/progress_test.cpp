// Progress rises, and tells what is there.
#include "optim/progress.h"

#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "api/progress.h"
#include "optim/fit.h"
#include "tests/support.h"

namespace brdfit {
namespace {

using nlohmann::json;

TEST(Progress, RisesFromNothingToAll) {
    optim::Progress progress;
    optim::TaskProgress& ward = progress.add("red", "ward");
    optim::TaskProgress& phong = progress.add("red", "phong");
    const auto told = [&](double rate = 0) { return json::parse(api::progress_json(progress.tasks(), rate)); };
    EXPECT_EQ(told()["fraction"], 0);
    EXPECT_EQ(told()["best"], json::array()) << "before the first candidate there is no best";
    double before = 0;
    for (int i = 0; i < 100; ++i) {
        ward.evaluated(10, 1.0 / (1 + i));
        ward.stepped();
        const double fraction = told()["fraction"];
        EXPECT_GE(fraction, before);
        EXPECT_LT(fraction, 0.5) << "half of it has not begun";
        before = fraction;
    }
    EXPECT_DOUBLE_EQ(told()["best"][0]["relative_loss"], 0.1);
    ward.evaluated(1, 5.0);
    EXPECT_DOUBLE_EQ(told()["best"][0]["relative_loss"], 0.1) << "the best so far";
    ward.finish(0.05);
    phong.finish({});
    const json end = told(1e6);
    EXPECT_EQ(end["fraction"], 1);
    EXPECT_EQ(end["models_done"], 2);
    EXPECT_EQ(end["models"], 2);
    EXPECT_EQ(end["evaluations"], 1001);
    EXPECT_EQ(end["evaluations_per_s"], 1e6);
    EXPECT_DOUBLE_EQ(end["best"][0]["relative_loss"], 0.05);
    EXPECT_EQ(json::parse(api::model_done_json(progress.tasks()[1])),
              json({{"channel", "red"}, {"model", "phong"}, {"relative_loss", nullptr}}));
}

TEST(Progress, OfAFitEndsAtItsReport) {
    const kernels::Catalogue catalogue;
    optim::Fitter fitter(tests::engine(), 2);
    optim::Dataset dataset{"", optim::Unit::per_steradian, {{"a", {}, {}}}};
    for (int angle = -70; angle <= 70; angle += 5)
        dataset.channels[0].samples.push_back(
            {{30, static_cast<double>(angle), 0}, 0.1 + std::exp(-angle * angle / 900.0), {}});
    optim::Progress progress;
    const std::vector<optim::ModelRequest> models{{catalogue.find("ward"), {}, {}, {}},
                                                  {catalogue.find("lambert"), {}, {}, {}}};
    const optim::Report report = fitter.fit(dataset, models, {}, {}, &progress);
    const auto tasks = progress.tasks();
    ASSERT_EQ(tasks.size(), 2U);
    for (const optim::Fit& fit : report.channels[0].fits) {
        const auto& task = tasks[fit.model == "ward" ? 0 : 1];
        EXPECT_EQ(task.model, fit.model);
        EXPECT_EQ(task.channel, "a");
        EXPECT_TRUE(task.done);
        EXPECT_DOUBLE_EQ(task.relative_loss.value(), fit.relative_loss);
    }
    EXPECT_GT(tasks[0].evaluations, report.channels[0].fits[0].search.evaluations / 2);
}

}  // namespace
}  // namespace brdfit
