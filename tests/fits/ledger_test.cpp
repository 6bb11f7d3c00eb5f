/// What less work would have changed, on the data of the fit.
#include <algorithm>
#include <chrono>
#include <filesystem>
#include <string>
#include <vector>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "optim/ledger.h"
#include "optim/statistics.h"
#include "tests/fits/fitting.h"

namespace brdfit::tests {
namespace {

using optim::Effort;
using optim::Fit;
using optim::FitOptions;
using optim::LedgerLine;
using optim::LessWork;
using optim::Report;
using testing::ElementsAre;
using testing::IsEmpty;

constexpr double kNoise = 0.02;

/// Ward's surface with noise.
optim::Dataset surface() {
    const auto directions = scan_directions({15, 40, 65}, 5);
    std::vector<double> values = model_values(variant("ward"), {0.3, 0.1, 0.15}, directions);
    Random random(5);
    for (double& value : values) value *= 1 + kNoise * random.normal();
    return dataset_of(make_channel(directions, values));
}

FitOptions with_ledger() {
    FitOptions options;
    options.ledger = true;
    options.judge = false;
    return options;
}

std::vector<LessWork> changes(const Fit& fit) {
    std::vector<LessWork> result;
    for (const LedgerLine& line : fit.ledger) result.push_back(line.change);
    return result;
}

const LedgerLine& line(const Fit& fit, LessWork change) {
    const auto found = std::find_if(fit.ledger.begin(), fit.ledger.end(),
                                    [&](const LedgerLine& candidate) { return candidate.change == change; });
    if (found == fit.ledger.end()) throw std::runtime_error("no such line");
    return *found;
}

TEST(Ledger, HasALineForEachWayToDoLess) {
    const optim::Dataset dataset = surface();
    const Report report =
        fitter().fit(dataset, requests({"ward", "lafortune_2", "he_torrance", "lambert"}), with_ledger());
    EXPECT_THAT(report.channels[0].warnings, IsEmpty());
    for (const Fit& fit : report.channels[0].fits) {
        SCOPED_TRACE(fit.model);
        if (fit.model == "lambert")  // nothing to search
            EXPECT_THAT(changes(fit), ElementsAre(LessWork::single_precision, LessWork::draft));
        else if (fit.model == "ward")  // nothing to exchange
            EXPECT_THAT(changes(fit), ElementsAre(LessWork::single_precision, LessWork::draft,
                                                  LessWork::stop_after_screening, LessWork::stop_after_descents));
        else
            EXPECT_THAT(changes(fit),
                        ElementsAre(LessWork::single_precision, LessWork::draft, LessWork::stop_after_screening,
                                    LessWork::stop_after_descents, LessWork::stop_after_exchange));
        for (const LedgerLine& less : fit.ledger) {
            ASSERT_TRUE(less.loss_ratio.has_value());
            // Two searches may end in the same minimum: to the digits to which they do.
            EXPECT_GE(*less.loss_ratio, 1 - 1e-6);
            EXPECT_GE(less.evaluations, 1U);
            const bool again = less.change == LessWork::single_precision || less.change == LessWork::draft;
            EXPECT_EQ(less.time_s.has_value(), again);
            EXPECT_EQ(less.largest_shift.has_value(), again);
        }
        double ratio = HUGE_VAL;
        std::size_t evaluations = 0;
        for (const LedgerLine& less : fit.ledger) {
            if (less.time_s) continue;
            EXPECT_LE(*less.loss_ratio, ratio) << "a later stop is no worse";
            EXPECT_GT(less.evaluations, evaluations);
            EXPECT_LT(less.evaluations, fit.search.evaluations);
            ratio = *less.loss_ratio;
            evaluations = less.evaluations;
        }
    }
}

TEST(Ledger, LeavesTheFitAsItIsAndIsTheSameEachTime) {
    const optim::Dataset dataset = surface();
    for (const std::string model : {"lafortune_2", "he_torrance"}) {
        FitOptions options = with_ledger();
        const Fit once = only(fitter().fit(dataset, requests({model}), options));
        const Fit twice = only(fitter().fit(dataset, requests({model}), options));
        options.ledger = false;
        const Fit without = only(fitter().fit(dataset, requests({model}), options));
        EXPECT_EQ(values_of(once), values_of(without));
        EXPECT_EQ(once.loss, without.loss);
        EXPECT_EQ(once.search.evaluations, without.search.evaluations);
        EXPECT_THAT(without.ledger, IsEmpty());
        ASSERT_EQ(changes(once), changes(twice));
        for (std::size_t i = 0; i < once.ledger.size(); ++i) {
            EXPECT_EQ(once.ledger[i].loss_ratio, twice.ledger[i].loss_ratio);
            EXPECT_EQ(once.ledger[i].evaluations, twice.ledger[i].evaluations);
            ASSERT_EQ(once.ledger[i].largest_shift.has_value(), twice.ledger[i].largest_shift.has_value());
            if (!once.ledger[i].largest_shift) continue;
            EXPECT_EQ(once.ledger[i].largest_shift->parameter, twice.ledger[i].largest_shift->parameter);
            EXPECT_EQ(once.ledger[i].largest_shift->relative, twice.ledger[i].largest_shift->relative);
        }
    }
}

TEST(Ledger, SaysWhatTheRequestWithLessWouldHaveSaid) {
    const optim::Dataset dataset = surface();
    for (const optim::Criterion loss : {optim::Criterion(optim::Loss::cosine_l2), optim::Criterion(optim::Loss::log)}) {
        FitOptions options = with_ledger();
        options.loss = loss;
        const Fit fit = only(fitter().fit(dataset, requests({"lafortune_2"}), options));
        options.ledger = false;
        options.effort = Effort::draft;
        const Fit draft = only(fitter().fit(dataset, requests({"lafortune_2"}), options));
        EXPECT_NEAR(line(fit, LessWork::draft).loss_ratio.value(), draft.loss / fit.loss, 1e-9);
        EXPECT_EQ(line(fit, LessWork::draft).evaluations, draft.search.evaluations);
    }
}

TEST(Ledger, ComparesRobustLossesAtOneScale) {
    optim::Dataset dataset = surface();
    for (std::size_t j = 7; j < dataset.channels[0].samples.size(); j += 20) dataset.channels[0].samples[j].brdf *= 10;
    FitOptions options = with_ledger();
    options.loss.robust = optim::Robust::cauchy;
    const Report report = fitter().fit(dataset, requests({"ward"}), options);
    const Fit& fit = only(report);
    for (const LedgerLine& less : fit.ledger) EXPECT_GE(less.loss_ratio.value(), 1 - 1e-6);
    options.ledger = false;
    options.effort = Effort::draft;
    const Fit draft = only(fitter().fit(dataset, requests({"ward"}), options));
    const auto weighted =
        optim::weigh(report.channels[0].channel, options.loss, report.channels[0].robust_scale.value());
    EXPECT_NEAR(line(fit, LessWork::draft).loss_ratio.value(),
                std::sqrt(optim::residuals(weighted, draft.values).loss2) / fit.loss, 1e-9);
}

TEST(Ledger, HasNothingBelowADraftInSinglePrecision) {
    FitOptions options = with_ledger();
    options.effort = Effort::draft;
    options.precision = kernels::Precision::single_precision;
    const Fit fit = only(fitter().fit(surface(), requests({"ward"}), options));
    EXPECT_THAT(changes(fit), ElementsAre(LessWork::stop_after_screening, LessWork::stop_after_descents));
}

TEST(Ledger, SaysWhereTimeRanOut) {
    FitOptions options = with_ledger();
    options.time_limit = std::chrono::duration<double>(1e-9);
    const Report report = fitter().fit(surface(), requests({"ward"}), options);
    EXPECT_THAT(only(report).ledger, IsEmpty());
    EXPECT_THAT(report.channels[0].warnings, testing::Contains(testing::HasSubstr("ledger")));
}

TEST(Ledger, NamesTheParameterThatMovesMost) {
    const auto with = [](std::vector<optim::FittedParameter> parameters) {
        Fit fit;
        fit.parameters = std::move(parameters);
        return fit;
    };
    const auto moved = optim::largest_shift(
        with({{"a", "1", 1, 0.5, false, false}, {"b", "1", 2, 0.01, false, false}, {"c", "1", 1, {}, true, false}}),
        with({{"a", "1", 2, {}, false, false}, {"b", "1", 1.9, {}, false, false}, {"c", "1", 9, {}, true, false}}));
    EXPECT_EQ(moved->parameter, "b");
    EXPECT_NEAR(moved->std_errors.value(), 10, 1e-9);
    EXPECT_NEAR(moved->relative.value(), 0.05, 1e-9);
}

}  // namespace
}  // namespace brdfit::tests
