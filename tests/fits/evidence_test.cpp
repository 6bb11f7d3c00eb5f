// Which model the evidence chooses where the truth is known, and what held-out angles, rivals and intervals say.

#include <gtest/gtest.h>

#include <cmath>
#include <cstdio>
#include <numbers>

#include "tests/fits/fitting.h"
#include "tests/fits/materials.h"
#include "tests/fits/truth.h"

namespace brdfit::tests {
namespace {

using optim::Channel;
using optim::Dataset;
using optim::Effort;
using optim::Fit;
using optim::FitOptions;
using optim::RankBy;
using optim::Report;

bool mentions(const Fit& fit, const std::string& words) {
    return std::any_of(fit.warnings.begin(), fit.warnings.end(),
                       [&](const std::string& warning) { return warning.find(words) != std::string::npos; });
}

/// A lobe off another by its width, as strong: two that 2 % of noise does not hide.
Dataset lobes(std::size_t count, std::size_t materials) {
    const kernels::Model& model = variant("lafortune_2");
    const std::vector<kernels::Direction> directions = scan_directions({15, 30, 45, 60, 75}, 4);
    Dataset dataset{"lobes", optim::Unit::per_steradian, {}};
    for (std::size_t i = 0; i < materials; ++i) {
        Random random(500 + i);
        std::vector<double> p{
            random.uniform(0.05, 0.5), -1, 0.98, random.on_scale(kernels::Scale::logarithmic, 20, 200), -0.8, 0.4,
            random.uniform(2, 8)};
        if (count == 1) p[4] = p[5] = 0;
        Channel channel = measured(make_channel(directions, model_values(model, p, directions)), 0.02, 0, random);
        channel.name = std::to_string(i);
        dataset.channels.push_back(std::move(channel));
    }
    return dataset;
}

TEST(Evidence, ChoosesTheNumberOfLobes) {
    FitOptions options;
    options.judge = false;
    optim::ModelRequest automatic = request("lafortune_1");
    automatic.lobes.reset();
    const std::size_t materials = long_form() ? 500 : 60;
    for (const std::size_t count : {1U, 2U}) {
        const Report report = fitter().fit(lobes(count, materials), {automatic}, options);
        std::size_t right = 0;
        for (std::size_t c = 0; c < materials; ++c) right += only(report, c).lobes == count;
        std::printf("%zu lobes: %zu of %zu are told\n", count, right, materials);
        EXPECT_GE(static_cast<double>(right), 0.95 * static_cast<double>(materials));
    }
}

TEST(Evidence, ChoosesTheModelThatMadeTheData) {
    FitOptions options;
    options.judge = false;
    options.rank_by = RankBy::bic;
    const auto& directions = sampling_patterns()[0];
    const std::size_t materials = long_form() ? 200 : 20;
    std::size_t right = 0, by_loss = 0, all = 0;
    for (const char* name : {"phong", "ward", "lafortune_1", "he_torrance"}) {
        Dataset dataset{name, optim::Unit::per_steradian, {}};
        for (std::size_t i = 0; i < materials; ++i)
            dataset.channels.push_back(random_measurement(variant(name), 7000 + i, directions));
        const Report report =
            fitter().fit(dataset, requests({"phong", "ward", "lafortune_1", "lafortune_2", "he_torrance"}), options);
        std::size_t found = 0;
        for (const optim::ChannelReport& channel : report.channels) {
            found += label(channel.fits.front()) == name;
            const auto least = std::min_element(channel.fits.begin(), channel.fits.end(),
                                                [](const Fit& a, const Fit& b) { return a.loss < b.loss; });
            by_loss += label(*least) == name;
        }
        std::printf("%s: the lowest BIC has it in %zu of %zu\n", name, found, materials);
        right += found;
        all += materials;
    }
    std::printf("in all %zu of %zu; the lowest loss has it in %zu\n", right, all, by_loss);
    EXPECT_GE(static_cast<double>(right), 0.85 * static_cast<double>(all));
    EXPECT_GT(right, by_loss);
}

TEST(Evidence, IsTheSameInAnyUnitButForAConstant) {
    Random random(4);
    Channel channel = measured(noise_free("paper"), 0.02, 0, random);
    const Report report = fitter().fit(dataset_of(channel), requests({"ward", "he_torrance"}), {});
    for (optim::Sample& s : channel.samples) s.brdf *= 0x1p-40;
    const auto model = requests({"ward"});
    const auto n = static_cast<double>(channel.samples.size());
    const double shift = n * 2 * 40 * std::log(2);
    FitOptions options;
    const Report small = fitter().fit(dataset_of(channel), model, options);
    const auto& fits = report.channels[0].fits;
    const Fit& ward = fits[0].model == "ward" ? fits[0] : fits[1];
    EXPECT_NEAR(only(small).bic + shift, ward.bic, 1e-3 * std::abs(ward.bic) + 1);
}

TEST(HeldOut, AreTheErrorsOfFitsWithoutEachAngle) {
    Random random(5);
    const Channel channel = measured(noise_free("white_plastic"), 0.02, 0, random);
    for (const char* name : {"phong", "ward", "lafortune_1"}) {  // a minimum each: a fold's is where a search finds it
        const Fit fit = only(fitter().fit(dataset_of(channel), {request(name)}, {}));
        ASSERT_TRUE(fit.held_out);
        ASSERT_EQ(fit.held_out->angles.size(), 5U);
        for (const optim::ScanError& angle : fit.held_out->angles) {
            Channel rest = channel;
            std::erase_if(rest.samples,
                          [&](const optim::Sample& s) { return s.direction.theta_i_deg == angle.theta_i_deg; });
            const Fit without = only(fitter().fit(dataset_of(rest), {request(name)}, {}));
            std::vector<double> p;
            const kernels::Model& model = variant(name);
            for (std::size_t i = 0; i < model.parameters.size(); ++i)
                p.push_back(without.parameters[i].value * optim::to_model_unit(model.parameters[i], channel));
            double sum = 0, count = 0;
            for (const optim::Sample& s : channel.samples) {
                if (s.direction.theta_i_deg != angle.theta_i_deg) continue;
                const double f = model_values(model, p, {s.direction})[0];
                sum += (f - s.brdf) * (f - s.brdf);
                ++count;
            }
            EXPECT_NEAR(angle.rmse, std::sqrt(sum / count), 5e-3 * std::sqrt(sum / count))
                << name << " " << angle.theta_i_deg;
        }
    }
}

TEST(HeldOut, NeedTwoAngles) {
    const std::vector<kernels::Direction> directions = scan_directions({30}, 4);
    const Fit fit = only(
        fitter().fit(dataset_of(make_channel(directions, model_values(variant("ward"), {0.3, 0.1, 0.2}, directions))),
                     {request("ward")}, {}));
    EXPECT_FALSE(fit.held_out);
}

TEST(Ranks, AreByWhatIsAsked) {
    Random random(6);
    const Dataset dataset = dataset_of(measured(noise_free("white_plastic"), 0.02, 0, random));
    const auto models = requests({"lambert", "phong", "ward", "lafortune_2", "he_torrance"});
    const auto sorted = [&](RankBy by, auto value) {
        FitOptions options;
        options.rank_by = by;
        const Report report = fitter().fit(dataset, models, options);
        const auto& fits = report.channels[0].fits;
        for (std::size_t i = 1; i < fits.size(); ++i) EXPECT_LE(value(fits[i - 1]), value(fits[i]));
        for (std::size_t i = 0; i < fits.size(); ++i) EXPECT_EQ(fits[i].rank, i + 1);
    };
    sorted(RankBy::loss, [](const Fit& f) { return f.loss; });
    sorted(RankBy::aicc, [](const Fit& f) { return f.aicc.value(); });
    sorted(RankBy::bic, [](const Fit& f) { return f.bic; });
    sorted(RankBy::held_out, [](const Fit& f) { return f.held_out.value().loss; });
    sorted(RankBy::log10_rmse, [](const Fit& f) { return f.log10_rmse.value(); });
}

TEST(Rivals, AreWorseThanTheBestAndDistinct) {
    const Fit fit = only(fitter().fit(dataset_of(noise_free("paper")), {request("lafortune_2")}, {}));
    std::printf("%zu rivals\n", fit.search.rivals.size());
    EXPECT_FALSE(fit.search.rivals.empty());
    double last = fit.loss;
    for (const optim::Rival& rival : fit.search.rivals) {
        EXPECT_GT(rival.loss, last * 1.0009);
        EXPECT_EQ(rival.parameters.size(), fit.parameters.size());
        last = rival.loss;
    }
}

TEST(Judging, IsSkippedOnRequest) {
    FitOptions options;
    options.judge = false;
    const Fit fit = only(fitter().fit(dataset_of(noise_free("paper")), {request("ward")}, options));
    EXPECT_FALSE(fit.held_out);
    EXPECT_TRUE(fit.search.rivals.empty());
    EXPECT_TRUE(fit.parameters[2].interval_95);
}

/// k_d of Lambert's model is pi times the mean.
Channel constant_with(const std::vector<double>& y, std::optional<double> sigma) {
    std::vector<kernels::Direction> directions;
    for (std::size_t j = 0; j < y.size(); ++j) directions.push_back({30, 20.0 * static_cast<double>(j), 0});
    Channel channel = make_channel(directions, y);
    for (optim::Sample& s : channel.samples) s.sigma = sigma;
    return channel;
}

TEST(Intervals, OfAMean) {
    FitOptions options;
    options.loss = optim::Loss::l2;
    const Fit given =
        only(fitter().fit(dataset_of(constant_with({0.14, 0.16, 0.15}, 0.01)), {request("lambert")}, options));
    const double error = std::numbers::pi * 0.01 / std::sqrt(3);
    EXPECT_NEAR(given.parameters[0].std_error.value(), error, 1e-9);
    const double value = std::numbers::pi * 0.15;
    EXPECT_NEAR(given.parameters[0].interval_95.value()[0], value - 1.959964 * error, 1e-6);
    EXPECT_NEAR(given.parameters[0].interval_95.value()[1], value + 1.959964 * error, 1e-6);
    // Without sigma: the residuals, each over 1 - 1/3, and Student's t of two degrees of freedom.
    const Fit own =
        only(fitter().fit(dataset_of(constant_with({0.14, 0.16, 0.15}, {})), {request("lambert")}, options));
    const double by_residuals = std::numbers::pi * std::sqrt(2 * 0.01 * 0.01) / (2.0 / 3) / 3;
    EXPECT_NEAR(own.parameters[0].std_error.value(), by_residuals, 1e-9);
    EXPECT_NEAR(own.parameters[0].interval_95.value()[1], value + 4.302653 * by_residuals, 1e-6);
}

TEST(Intervals, OfTheBootstrapAgreeWithTheCovariance) {
    Random random(8);
    const Dataset dataset = dataset_of(measured(noise_free("smooth_metal"), 0.02, 0, random));
    FitOptions thorough;
    thorough.effort = Effort::thorough;
    const Fit quick = only(fitter().fit(dataset, {request("lafortune_1")}, {}));
    const Fit slow = only(fitter().fit(dataset, {request("lafortune_1")}, thorough));
    EXPECT_EQ(quick.replicates, 0U);
    EXPECT_EQ(slow.replicates, 400U);
    for (std::size_t i = 0; i < quick.parameters.size(); ++i) {
        const auto [a, b] = quick.parameters[i].interval_95.value();
        const auto [c, d] = slow.parameters[i].interval_95.value();
        EXPECT_NEAR(a, c, 0.2 * (b - a)) << quick.parameters[i].name;
        EXPECT_NEAR(b, d, 0.2 * (b - a)) << quick.parameters[i].name;
    }
}

TEST(Intervals, NameWhatIsDeterminedOnlyTogether) {
    Random random(9);
    const Fit fit = only(
        fitter().fit(dataset_of(measured(noise_free("smooth_metal"), 0.02, 0, random)), {request("he_torrance")}, {}));
    EXPECT_TRUE(mentions(fit, "n and k only together"));
    for (const std::string& warning : fit.warnings) std::printf("%s\n", warning.c_str());
    // The matrix is symmetric, with ones.
    const auto& c = fit.correlations;
    ASSERT_EQ(c.matrix.size(), c.names.size() * c.names.size());
    for (std::size_t i = 0; i < c.names.size(); ++i) {
        EXPECT_EQ(c.matrix[i * c.names.size() + i], 1);
        for (std::size_t j = 0; j < i; ++j)
            EXPECT_NEAR(c.matrix[i * c.names.size() + j], c.matrix[j * c.names.size() + i], 1e-12);
    }
}

}  // namespace
}  // namespace brdfit::tests
