// Robust losses: their sums beside the kernels', scales, outliers.

#include "optim/robust.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <vector>

#include "optim/search.h"
#include "optim/space_loss.h"
#include "tests/support.h"

namespace brdfit::optim {
namespace {

using tests::Random;

Channel three_samples() {
    return {"y", {}, {{{30, 0, 0}, 2.0, 0.5}, {{30, 60, 0}, 4.0, 0.25}, {{30, -60, 0}, -1.0, 1.0}}};
}

Criterion robust_form(Loss kind, Robust robust) {
    Criterion loss = kind;
    loss.robust = robust;
    return loss;
}

class RobustSums : public testing::TestWithParam<const kernels::Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, RobustSums, testing::ValuesIn(tests::variants()),
                         [](const auto& parameter) { return tests::label(*parameter.param); });

/// Of a scale beyond all residuals a robust loss is the squares, which the kernels sum.
TEST_P(RobustSums, AreTheKernelsWhereNothingIsAnOutlier) {
    const kernels::Model& model = *GetParam();
    const kernels::DirectionSet directions(tests::scan_directions({15, 45, 70}, 8));
    const std::vector<kernels::Direction> list(directions.directions().begin(), directions.directions().end());
    std::vector<Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    const SearchSpace space(model, bounds, Unknowns::nonlinear, {}, 1, Charts::used, &directions);
    Random random(7);
    std::vector<double> y;
    for (std::size_t j = 0; j < list.size(); ++j) y.push_back(random.uniform(0.05, 0.5));
    const Channel channel = tests::make_channel(list, y);
    for (const Loss kind : {Loss::cosine_l2, Loss::log}) {
        const Weighted weighted = weigh(channel, robust_form(kind, Robust::huber), 1e9);
        kernels::Evaluator evaluator(tests::engine(), model, tests::engine().best_precision(), directions, weighted.y,
                                     weighted.weight);
        std::vector<double> parameters, coefficients;
        for (int i = 0; i < 5; ++i) {
            std::vector<double> u;  // of lobes no higher than 1 at any sample
            for (const Interval& typical : space.typical()) u.push_back(random.uniform(typical.min, typical.max));
            const std::vector<double> p = space.candidate(u).parameters;
            parameters.insert(parameters.end(), p.begin(), p.end());
            for (std::size_t t = 0; t < model.terms.size(); ++t) coefficients.push_back(random.uniform(0.1, 1));
        }
        kernels::Batch kernel, here;
        evaluator.loss(parameters, coefficients, weighted.logarithmic, kernel);
        robust_loss(evaluator, weighted, parameters, coefficients, here);
        const auto near = [&](const std::vector<double>& a, const std::vector<double>& b, const char* what) {
            ASSERT_EQ(a.size(), b.size()) << what;
            const std::size_t stride = a.size() / 5;
            for (std::size_t i = 0; i < 5; ++i) {
                double size = kernel.loss[i];
                for (std::size_t k = 0; k < stride; ++k) size = std::max(size, std::abs(a[i * stride + k]));
                for (std::size_t k = 0; k < stride; ++k)
                    EXPECT_NEAR(a[i * stride + k], b[i * stride + k], 1e-11 * size) << what << " " << k;
            }
        };
        near(kernel.loss, here.loss, "loss");
        near(kernel.by_coefficient, here.by_coefficient, "by_coefficient");
        near(kernel.by_parameter, here.by_parameter, "by_parameter");
        near(kernel.normal, here.normal, "normal");
        EXPECT_EQ(kernel.coefficients, here.coefficients);
    }
}

TEST_P(RobustSums, HaveTheSlopeOfTheLoss) {
    const kernels::Model& model = *GetParam();
    const kernels::DirectionSet directions(tests::scan_directions({15, 45, 70}, 8));
    const std::vector<kernels::Direction> list(directions.directions().begin(), directions.directions().end());
    std::vector<Interval> bounds;
    for (const kernels::Parameter& p : model.parameters) bounds.push_back({p.min, p.max});
    const SearchSpace space(model, bounds, Unknowns::all, {}, 0.1, Charts::used, &directions);
    Random random(11);
    for (const Robust robust : {Robust::huber, Robust::cauchy})
        for (const Loss kind : {Loss::cosine_l2, Loss::log}) {
            std::vector<double> u;
            for (const Interval& typical : space.typical())
                u.push_back(
                    random.uniform(0.6 * typical.min + 0.4 * typical.max, 0.4 * typical.min + 0.6 * typical.max));
            std::vector<double> y;
            for (std::size_t j = 0; j < list.size(); ++j) y.push_back(random.uniform(0.05, 0.5));
            const Weighted weighted = weigh(tests::make_channel(list, y), robust_form(kind, robust), 0.05);
            kernels::Evaluator evaluator(tests::engine(), model, tests::engine().best_precision(), directions,
                                         weighted.y, weighted.weight);
            SpaceLoss loss(evaluator, space, weighted.norm * weighted.norm, &weighted);
            const Look look = loss.looks({&u, 1}).front();
            for (std::size_t k = 0; k < u.size(); ++k) {
                constexpr double kStep = 1e-6;
                std::vector<double> up = u, down = u;
                up[k] += kStep;
                down[k] -= kStep;
                EXPECT_NEAR(look.gradient[k], (loss(up, {}) - loss(down, {})) / (2 * kStep),
                            1e-4 * (std::abs(look.gradient[k]) + look.value))
                    << k;
            }
        }
}

TEST(RobustScale, IsTheStandardDeviationOfGaussianResidualsAndBearsOutliers) {
    std::mt19937_64 random(1);
    std::normal_distribution<double> normal(0, 0.3);
    Channel channel{"y", {}, {}};
    std::vector<double> r;
    for (std::size_t j = 0; j < 20'000; ++j) {
        channel.samples.push_back({{30, 0, 0}, 1.0, {}});
        r.push_back(normal(random));
    }
    const Weighted w = weigh(channel, Loss::l2);
    EXPECT_NEAR(scale_in_loss(channel, Loss::l2, robust_scale(w, r, 4)), 0.3, 0.006);
    for (std::size_t j = 0; j < r.size(); j += 20) r[j] = 1e6;  // 5 %: as if ordinary ones were fewer
    EXPECT_NEAR(scale_in_loss(channel, Loss::l2, robust_scale(w, r, 4)), 0.32, 0.01);
}

TEST(RobustScale, IsNotDeceivedByWhatParametersCanBringToNothing) {
    Channel channel{"y", {}, {}};
    for (std::size_t j = 0; j < 8; ++j) channel.samples.push_back({{30, 0, 0}, 1.0, {}});
    const std::vector<double> r{0, 0, 0, 0, 0.5, 0.5, 0.5, 0.5};
    const Weighted w = weigh(channel, Loss::l2);
    EXPECT_NEAR(scale_in_loss(channel, Loss::l2, robust_scale(w, r, 4)), 0.5 / 0.67449, 1e-4);
    // Data that are met exactly have a floor.
    EXPECT_NEAR(scale_in_loss(channel, Loss::l2, robust_scale(w, std::vector<double>(8, 0.0), 1)), 1e-6, 1e-12);
}

TEST(Outliers, KeepLessThanATenthOfTheirWeight) {
    const Weighted w = weigh(three_samples(), robust_form(Loss::l2, Robust::cauchy), 0.1);
    // Cauchy's weight is 1/10 at three thresholds.
    const double edge = 3 * 2.385 * 0.1;
    EXPECT_EQ(outliers(w, std::vector{0.99 * edge, -1.01 * edge, 50.0}), (std::vector<std::size_t>{1, 2}));
    EXPECT_TRUE(outliers(weigh(three_samples(), Loss::l2), std::vector{1e9, 0.0, 0.0}).empty());
}

TEST(PseudoValues, OfSquaresAreTheResidualsThemselves) {
    const Weighted w = weigh(three_samples(), Loss::cosine_l2);
    const Residuals at = residuals(w, std::vector{2.5, 3.0, 0.0});
    const PseudoValues seen = pseudo_values(w, at);
    EXPECT_EQ(seen.residuals.r, at.r);
    EXPECT_EQ(seen.weighted.weight, w.weight);
}

}  // namespace
}  // namespace brdfit::optim
