// Fits as a whole: what is recovered, how often, how surely, and what the paper found.

#include <gtest/gtest.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <limits>
#include <numbers>
#include <stop_token>
#include <thread>

#include "optim/fit.h"
#include "optim/statistics.h"
#include "tests/fits/fitting.h"
#include "tests/fits/materials.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using optim::Channel;
using optim::Criterion;
using optim::Dataset;
using optim::Effort;
using optim::Fit;
using optim::FitOptions;
using optim::Fitter;
using optim::Loss;
using optim::ModelRequest;
using optim::Report;
using optim::Robust;
using optim::StopReason;
using optim::Unit;

const std::filesystem::path kSource = BRDFIT_SOURCE_DIR;

const std::vector<Dataset>& samples() {
    static const std::vector<Dataset> instance = read_folder(kSource / "samples");
    return instance;
}

const Dataset& sample(const std::string& name) {
    for (const Dataset& dataset : samples())
        if (dataset.name == name) return dataset;
    throw std::invalid_argument("no sample " + name);
}

/// Measured surfaces, where the folder is there.
const std::vector<Dataset>& measured() {
    static const std::vector<Dataset> instance = [] {
        std::vector<Dataset> found = read_folder(kSource / ".." / "shared" / "data" / "real");
        std::printf("%zu measured surfaces beside the source%s\n", found.size(),
                    found.empty() ? ": their tests run on the samples alone" : "");
        return found;
    }();
    return instance;
}

Fit fit_one(const Dataset& dataset, const ModelRequest& model, const FitOptions& options = {}) {
    return only(fitter().fit(dataset, {model}, options));
}

FitOptions with_seed(std::uint64_t seed) {
    FitOptions options;
    options.seed = seed;
    return options;
}

// ---- recovery ----

class Recovery : public testing::TestWithParam<std::pair<std::string, std::vector<double>>> {};

TEST_P(Recovery, NoiselessDataGiveTheirParametersBack) {
    const auto& [name, truth] = GetParam();
    const kernels::Model& model = variant(name);
    const auto directions = scan_directions({15, 30, 45, 60, 75}, 2);
    const Dataset dataset = dataset_of(make_channel(directions, model_values(model, truth, directions)));
    const Fit fit = fit_one(dataset, request(name));
    EXPECT_LT(fit.relative_loss, 1e-7);
    for (std::size_t i = 0; i < truth.size(); ++i)
        EXPECT_NEAR(fit.parameters[i].value, truth[i], 1e-4 * std::max(std::abs(truth[i]), 0.01))
            << fit.parameters[i].name;
}

INSTANTIATE_TEST_SUITE_P(
    Models, Recovery,
    testing::Values(std::pair{"lambert", std::vector{0.4}}, std::pair{"phong", std::vector{0.3, 0.2, 67.8}},
                    std::pair{"phong", std::vector{0.02, 0.7, 4000.0}}, std::pair{"ward", std::vector{0.5, 0.05, 0.15}},
                    std::pair{"ward", std::vector{0.1, 0.3, 0.02}},
                    std::pair{"lafortune_1", std::vector{0.1, -1.02, 0.98, 50.0}},
                    std::pair{"lafortune_2", std::vector{0.542, -1.04, 0.893, 31.1, -1.22, -0.142, 21.4}},
                    std::pair{"he_torrance", std::vector{0.93, 12.7, 1.5, 0.0, 0.534}},
                    std::pair{"he_torrance", std::vector{0.3, 8.0, 0.96, 6.7, 0.03}}),
    [](const auto& parameter) { return parameter.param.first + "_" + std::to_string(parameter.index); });

// ---- success rate ----

struct Rate {
    std::string surface, model;
    std::size_t successes = 0, seeds = 0;
    double best = 0, worst = 0, seconds = 0;
};

/// Loss by every seed against the best known: over all seeds and a thorough search.
Rate success_rate(const Dataset& dataset, const std::string& model, std::size_t seeds) {
    Rate rate{dataset.name, model, 0, seeds, 0, 0, 0};
    FitOptions thorough;
    thorough.effort = Effort::thorough;
    thorough.time_limit = std::chrono::minutes(5);
    rate.best = fit_one(dataset, request(model), thorough).loss;
    std::vector<double> losses;
    const auto start = std::chrono::steady_clock::now();
    for (std::size_t seed = 1; seed <= seeds; ++seed)
        losses.push_back(fit_one(dataset, request(model), with_seed(seed)).loss);
    rate.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    rate.best = std::min(rate.best, *std::min_element(losses.begin(), losses.end()));
    rate.worst = *std::max_element(losses.begin(), losses.end());
    rate.successes = static_cast<std::size_t>(
        std::count_if(losses.begin(), losses.end(), [&](double loss) { return loss <= 1.001 * rate.best; }));
    return rate;
}

void expect_success(const std::vector<Dataset>& datasets, std::size_t seeds) {
    for (const Dataset& dataset : datasets)
        for (const char* model : {"phong", "ward", "lafortune_1", "lafortune_2", "he_torrance"}) {
            Dataset one = dataset;
            one.channels.resize(1);
            const Rate rate = success_rate(one, model, seeds);
            std::printf("%-32s %-12s %3zu of %3zu, best loss %.6g, worst %+.2g, %.1f ms a fit\n", rate.surface.c_str(),
                        model, rate.successes, rate.seeds, rate.best, rate.worst / rate.best - 1,
                        1e3 * rate.seconds / static_cast<double>(rate.seeds));
            EXPECT_GE(100 * rate.successes, 99 * rate.seeds) << rate.surface << " " << model;
        }
}

TEST(Success, AlmostEverySeedFindsTheBestKnownLossOnTheSamples) {
    expect_success(samples(), count_from("BRDFIT_SEEDS", long_form() ? 100 : 10));
}

TEST(Success, AlmostEverySeedFindsTheBestKnownLossOnMeasuredSurfaces) {
    if (long_form()) expect_success(measured(), count_from("BRDFIT_SEEDS", 100));
}

// ---- the paper's findings ----

double at(const Fit& fit, double theta_i, double theta_r, double wavelength_nm) {
    const kernels::Model& model = catalogue().find(fit.model)->variant(fit.lobes);
    std::vector<double> p = values_of(fit);
    for (std::size_t i = 0; i < p.size(); ++i)
        if (model.parameters[i].unit == "wavelength") p[i] *= 1000 / wavelength_nm;
    return model_values(model, p, {{theta_i, theta_r, 0}})[0];
}

/// How the value in the mirror direction rises from 15 to 75 degrees of incidence.
double rise(const Fit& fit) { return at(fit, 75, 75, 550) / at(fit, 15, 15, 550); }

TEST(Paper, OnPlasticOnlyTheOffSpecularModelsFollowTheRise) {
    for (const char* model : {"phong", "ward", "lafortune_2", "he_torrance"}) {
        const Fit fit = fit_one(sample("white_plastic"), request(model));
        std::printf("plastic, %s: the mirror direction brightens %.3g times\n", model, rise(fit));
        if (fit.model == "phong" || fit.model == "ward") {
            EXPECT_LT(rise(fit), 4) << model;
        } else {
            EXPECT_GT(rise(fit), 35) << model;
            EXPECT_LT(rise(fit), 75) << model;
        }
    }
}

TEST(Paper, OnPaperPhongAndWardFail) {
    for (const char* model : {"phong", "ward", "lafortune_2", "he_torrance"}) {
        const Fit fit = fit_one(sample("paper"), request(model));
        std::printf("paper, %s: relative loss %.3f\n", model, fit.relative_loss);
        if (fit.model == "phong" || fit.model == "ward") {
            EXPECT_GT(fit.relative_loss, 0.3) << model;
            EXPECT_LT(fit.relative_loss, 0.65) << model;
        } else {
            EXPECT_LT(fit.relative_loss, 0.1) << model;
        }
    }
}

TEST(Paper, OnMetallicPaintPhongAndWardTie) {
    const double phong = fit_one(sample("metallic_paint"), request("phong")).loss;
    const double ward = fit_one(sample("metallic_paint"), request("ward")).loss;
    std::printf("metallic paint: phong %.4g, ward %.4g\n", phong, ward);
    EXPECT_NEAR(phong / ward, 1, 0.1);
}

// ---- nested models ----

TEST(Nested, ALargerModelIsNeverWorse) {
    std::vector<Dataset> datasets = samples();
    datasets.insert(datasets.end(), measured().begin(), measured().end());
    FitOptions options;
    options.time_limit = std::chrono::minutes(5);
    ModelRequest real_index = request("he_torrance");
    real_index.fixed = {{"k", 0.0}};
    for (const Dataset& dataset : datasets) {
        const auto losses = [&](const ModelRequest& model) {
            std::vector<double> result;
            const Report report = fitter().fit(dataset, {model}, options);
            for (std::size_t c = 0; c < report.channels.size(); ++c) result.push_back(only(report, c).loss);
            return result;
        };
        const auto one = losses(request("lafortune_1"));
        const auto two = losses(request("lafortune_2"));
        const auto three = losses(request("lafortune_3"));
        const auto he = losses(request("he_torrance"));
        const auto he_real = losses(real_index);
        for (std::size_t c = 0; c < one.size(); ++c) {
            const std::string where = dataset.name + " " + dataset.channels[c].name;
            EXPECT_LE(two[c], one[c] * (1 + 1e-9)) << where;
            EXPECT_LE(three[c], two[c] * (1 + 1e-9)) << where;
            EXPECT_LE(he[c], he_real[c] * (1 + 1e-9)) << where;
            std::printf("%-32s %-5s lafortune %.5g, %.5g, %.5g; he_torrance k = 0: %.5g, free: %.5g\n",
                        dataset.name.c_str(), dataset.channels[c].name.c_str(), one[c], two[c], three[c], he_real[c],
                        he[c]);
        }
    }
}

// ---- determinism ----

const std::vector<std::string> kFour{"phong", "ward", "lafortune_2", "he_torrance"};

void expect_same(const Fit& a, const Fit& b) {
    EXPECT_EQ(label(a), label(b));
    EXPECT_EQ(values_of(a), values_of(b)) << label(a);
    EXPECT_EQ(a.loss, b.loss) << label(a);
    EXPECT_EQ(a.scale, b.scale) << label(a);
    EXPECT_EQ(a.search.evaluations, b.search.evaluations) << label(a);
    EXPECT_EQ(a.values, b.values) << label(a);
}

TEST(Determinism, TheSameSeedGivesTheSameFitTwice) {
    for (const Loss loss : {Loss::cosine_l2, Loss::log}) {
        FitOptions options = with_seed(7);
        options.loss = loss;
        const Report a = fitter().fit(sample("white_plastic"), requests(kFour), options);
        const Report b = fitter().fit(sample("white_plastic"), requests(kFour), options);
        ASSERT_EQ(a.channels[0].fits.size(), kFour.size());
        ASSERT_EQ(b.channels[0].fits.size(), kFour.size());
        for (std::size_t i = 0; i < kFour.size(); ++i) expect_same(a.channels[0].fits[i], b.channels[0].fits[i]);
    }
}

TEST(Determinism, ThreadsAndOtherModelsMakeNoDifference) {
    Fitter lonely(engine(), 1);
    Fitter crowded(engine(), 4);
    const Report alone = lonely.fit(sample("rough_metal"), requests({"he_torrance"}), with_seed(3));
    const Report together = crowded.fit(sample("rough_metal"), requests(kFour), with_seed(3));
    for (const Fit& fit : together.channels[0].fits)
        if (fit.model == "he_torrance") expect_same(fit, only(alone));
    const Report again = lonely.fit(sample("rough_metal"), requests(kFour), with_seed(3));
    for (std::size_t i = 0; i < kFour.size(); ++i) expect_same(again.channels[0].fits[i], together.channels[0].fits[i]);
}

TEST(Determinism, ChannelsDoNotTouchEachOther) {
    Dataset both = sample("white_plastic");
    both.channels.push_back(sample("paper").channels[0]);
    const Report together = fitter().fit(both, requests({"ward"}), with_seed(5));
    expect_same(only(together, 0), fit_one(sample("white_plastic"), request("ward"), with_seed(5)));
    expect_same(only(together, 1), fit_one(sample("paper"), request("ward"), with_seed(5)));
}

// ---- losses ----

class EveryLoss : public testing::TestWithParam<optim::LossName> {};
INSTANTIATE_TEST_SUITE_P(Losses, EveryLoss, testing::ValuesIn(optim::kLossNames),
                         [](const auto& parameter) { return std::string(parameter.param.name); });

/// Loss of a model with lengths in um, straight from the definition.
double loss_at(const Fit& fit, const Channel& channel, const std::vector<double>& wire, Loss loss) {
    const kernels::Model& model = catalogue().find(fit.model)->variant(fit.lobes);
    std::vector<double> p = wire;
    for (std::size_t i = 0; i < p.size(); ++i) p[i] *= optim::to_model_unit(model.parameters[i], channel);
    std::vector<Direction> directions;
    for (const auto& s : channel.samples) directions.push_back(s.direction);
    const std::vector<double> f = model_values(model, p, directions);
    return std::sqrt(optim::residuals(optim::weigh(channel, loss), f).loss2);
}

TEST_P(EveryLoss, TheReportedLossIsTheLossThereAndAMinimum) {
    const Loss loss = GetParam().loss;
    for (const char* surface : {"white_plastic", "rough_metal", "paper"}) {
        Dataset dataset = sample(surface);
        for (auto& s : dataset.channels[0].samples) s.sigma = 0.02 * s.brdf + 1e-3;
        FitOptions options;
        options.loss = loss;
        for (const std::string& name : kFour) {
            const Fit fit = fit_one(dataset, request(name), options);
            const Channel& channel = dataset.channels[0];
            const std::vector<double> best = values_of(fit);
            EXPECT_NEAR(loss_at(fit, channel, best, loss), fit.loss, 1e-9 * fit.loss) << surface << " " << name;
            const kernels::Model& model = catalogue().find(fit.model)->variant(fit.lobes);
            const auto bounds = optim::parameter_bounds(model, request(name), channel);
            for (std::size_t i = 0; i < best.size(); ++i)
                for (const double step : {-1e-2, -1e-3, -1e-4, 1e-4, 1e-3, 1e-2}) {
                    std::vector<double> moved = best;
                    const double unit = optim::to_model_unit(model.parameters[i], channel);
                    moved[i] = std::clamp(best[i] + step * std::max(std::abs(best[i]), 1e-3), bounds[i].min / unit,
                                          bounds[i].max / unit);
                    EXPECT_GE(loss_at(fit, channel, moved, loss), fit.loss * (1 - 1e-6))
                        << surface << " " << name << " " << model.parameters[i].name << " " << step;
                }
        }
    }
}

// ---- robust losses ----

Criterion robust_form(Loss kind, Robust robust) {
    Criterion loss = kind;
    loss.robust = robust;
    return loss;
}

FitOptions with_loss(const Criterion& loss) {
    FitOptions options;
    options.loss = loss;
    return options;
}

/// A surface with 2 % of noise, known as sigma, and one value of 20 ten times too large or too small.
Dataset contaminated(const kernels::Model& model, const std::vector<double>& truth) {
    const auto directions = scan_directions({15, 30, 45, 60, 75}, 2);
    Channel channel = make_channel(directions, model_values(model, truth, directions));
    Random random(3);
    for (auto& s : channel.samples) {
        s.sigma = 0.02 * s.brdf;
        s.brdf += *s.sigma * random.normal();
    }
    contaminate(channel, 0.05, 1);
    return dataset_of(channel);
}

const std::vector<std::pair<std::string, std::vector<double>>> kTruths{
    {"lambert", {0.4}},
    {"phong", {0.3, 0.2, 67.8}},
    {"ward", {0.5, 0.05, 0.15}},
    {"lafortune_1", {0.1, -1.02, 0.98, 50.0}},
    {"lafortune_2", {0.542, -1.04, 0.893, 31.1, -1.22, -0.142, 21.4}},
    {"he_torrance", {0.93, 12.7, 1.5, 0.0, 0.534}}};

/// Distance of the farthest parameter from the truth, in standard errors of `judge`; those without one are passed over.
double farthest(const Fit& fit, const Fit& judge, const std::vector<double>& truth) {
    double most = 0;
    for (std::size_t i = 0; i < truth.size(); ++i)
        if (const auto error = judge.parameters[i].std_error)
            most = std::max(most, std::abs(fit.parameters[i].value - truth[i]) / *error);
    return most;
}

/// Huber's loss bounds what an outlier does, and Cauchy's forgets it.
TEST(RobustLosses, RecoverParametersThatOutliersHideFromSquares) {
    for (const auto& [name, truth] : kTruths) {
        const Dataset dataset = contaminated(variant(name), truth);
        const Fit plain = fit_one(dataset, request(name), with_loss(Loss::chi2));
        for (const Robust robust : {Robust::huber, Robust::cauchy}) {
            const Fit fit = fit_one(dataset, request(name), with_loss(robust_form(Loss::chi2, robust)));
            const double off = farthest(fit, fit, truth);
            const double plainly_off = farthest(plain, fit, truth);
            const char* form = robust == Robust::huber ? "huber" : "cauchy";
            std::printf("%-12s %-6s farthest parameter %.2f standard errors off; of the squares' fit %.0f\n",
                        name.c_str(), form, off, plainly_off);
            EXPECT_LT(off, 4) << name << " " << form;
            EXPECT_GT(plainly_off, 20) << name << " " << form;
            EXPECT_EQ(fit.search.stop_reason, StopReason::converged) << name << " " << form;
            ASSERT_TRUE(fit.outliers);
            for (std::size_t j = 0; j < fit.values.size(); ++j) {
                const double y = dataset.channels[0].samples[j].brdf;
                if (std::max(y / fit.values[j], fit.values[j] / y) < 5 || y < fit.values[j]) continue;
                EXPECT_TRUE(std::binary_search(fit.outliers->samples.begin(), fit.outliers->samples.end(), j)) << j;
            }
            EXPECT_LT(fit.outliers->fraction, 0.08) << name << " " << form;
        }
    }
}

/// A scale of its own would make light of a bad model's residuals.
TEST(RobustLosses, JudgeAllModelsOfAChannelByOneScale) {
    const Dataset dataset = contaminated(variant("ward"), {0.5, 0.05, 0.15});
    const FitOptions options = with_loss(robust_form(Loss::cosine_l2, Robust::cauchy));
    const Report report = fitter().fit(dataset, requests({"lambert", "phong", "ward"}), options);
    const auto& fits = report.channels[0].fits;
    ASSERT_EQ(fits.size(), 3U);
    EXPECT_EQ(fits.front().model, "ward");
    EXPECT_EQ(fits.back().model, "lambert");
    const double scale = report.channels[0].robust_scale.value();
    const optim::Weighted weighted = optim::weigh(dataset.channels[0], options.loss, scale);
    for (const Fit& fit : fits) {
        EXPECT_NEAR(fit.loss, std::sqrt(optim::residuals(weighted, fit.values).loss2), 1e-12 * fit.loss);
        EXPECT_NEAR(fit.relative_loss, fit.loss / weighted.norm, 1e-12);
    }
}

TEST(RobustLosses, OfDataWithoutOutliersAreNearlyTheSquares) {
    const auto directions = scan_directions({15, 30, 45, 60, 75}, 2);
    Channel channel = make_channel(directions, model_values(variant("ward"), {0.5, 0.05, 0.15}, directions));
    Random random(4);
    for (auto& s : channel.samples) s.brdf *= 1 + 0.02 * random.normal();
    const Dataset dataset = dataset_of(channel);
    const Fit plain = fit_one(dataset, request("ward"), with_loss(Loss::relative));
    for (const Robust robust : {Robust::huber, Robust::cauchy}) {
        Criterion loss = robust_form(Loss::relative, robust);
        const Fit fit = fit_one(dataset, request("ward"), with_loss(loss));
        EXPECT_LT(farthest(fit, plain, values_of(plain)), 1);
        EXPECT_NEAR(fit.loss / plain.loss, 1, 0.1);
        for (std::size_t i = 0; i < fit.parameters.size(); ++i)  // 95 % efficient: errors 3 % larger
            EXPECT_NEAR(*fit.parameters[i].std_error / *plain.parameters[i].std_error, 1, 0.15);
        loss.robust_threshold = optim::kMostThreshold;
        const Fit wide = fit_one(dataset, request("ward"), with_loss(loss));
        EXPECT_LT(farthest(wide, plain, values_of(plain)), 0.05);
    }
}

/// A factor on the data is one on the scale of losses in the data's unit, and on no other.
TEST(RobustLosses, ScaleWithTheData) {
    Dataset dataset = contaminated(variant("ward"), {0.05, 0.005, 0.15});
    Dataset larger = dataset;
    for (auto& s : larger.channels[0].samples) s.brdf *= 8;  // sigma is not read here
    for (const Loss kind : {Loss::l2, Loss::relative, Loss::log}) {
        const FitOptions options = with_loss(robust_form(kind, Robust::cauchy));
        const Report a = fitter().fit(dataset, requests({"ward"}), options);
        const Report b = fitter().fit(larger, requests({"ward"}), options);
        const double factor = kind == Loss::l2 ? 8 : 1;
        EXPECT_NEAR(*b.channels[0].robust_scale / *a.channels[0].robust_scale, factor, 1e-3 * factor);
        EXPECT_NEAR(only(b).loss / only(a).loss, factor, 1e-3 * factor);
        EXPECT_NEAR(only(b).parameters[2].value, only(a).parameters[2].value, 1e-3 * only(a).parameters[2].value);
    }
}

TEST(RobustLosses, MeetNoiselessDataWithOutliersExactly) {
    const std::vector<double> truth{0.3, 0.2, 67.8};
    const auto directions = scan_directions({15, 30, 45, 60, 75}, 2);
    Channel channel = make_channel(directions, model_values(variant("phong"), truth, directions));
    contaminate(channel, 0.1, 2);
    for (const Robust robust : {Robust::huber, Robust::cauchy}) {
        const Fit fit = fit_one(dataset_of(channel), request("phong"), with_loss(robust_form(Loss::cosine_l2, robust)));
        for (std::size_t i = 0; i < truth.size(); ++i)
            EXPECT_NEAR(fit.parameters[i].value, truth[i], 1e-5 * truth[i]) << fit.parameters[i].name;
    }
}

TEST(RelativeData, AFactorOnTheDataIsAFactorOnTheScale) {
    Dataset dataset = sample("white_plastic");
    dataset.unit = Unit::relative;
    Dataset scaled = dataset;
    for (auto& s : scaled.channels[0].samples) s.brdf *= 1000;
    for (const std::string& name : kFour) {
        const Fit fit = fit_one(dataset, request(name));
        const Fit other = fit_one(scaled, request(name));
        ASSERT_TRUE(fit.scale && other.scale) << name;
        EXPECT_NEAR(*other.scale / *fit.scale, 1000, 1) << name;
        EXPECT_NEAR(other.relative_loss, fit.relative_loss, 1e-6 * fit.relative_loss) << name;
        for (std::size_t i = 0; i < fit.parameters.size(); ++i)
            EXPECT_NEAR(other.parameters[i].value, fit.parameters[i].value,
                        2e-3 * std::max(std::abs(fit.parameters[i].value), 0.01))
                << name << " " << fit.parameters[i].name;
    }
}

TEST(RelativeData, IsFittedAsWellAsAbsoluteData) {
    for (const std::string& name : kFour) {
        Dataset dataset = sample("white_plastic");
        const double absolute = fit_one(dataset, request(name)).relative_loss;
        dataset.unit = Unit::relative;
        for (auto& s : dataset.channels[0].samples) s.brdf *= 37;
        EXPECT_LE(fit_one(dataset, request(name)).relative_loss, absolute * (1 + 1e-6)) << name;
    }
}

// ---- bounds and fixed parameters ----

TEST(Bounds, AreKeptAndFixedParametersStay) {
    for (const char* surface : {"white_plastic", "rough_metal"})
        for (const Loss loss : {Loss::cosine_l2, Loss::log}) {
            ModelRequest lafortune = request("lafortune_2");
            lafortune.bounds = {{"c_xy_1", {-3, -0.5}}, {"n_2", {5, 40}}, {"k_d", {0, 0.2}}};
            lafortune.fixed = {{"c_z_2", 0.9}};
            ModelRequest he = request("he_torrance");
            he.bounds = {{"n", {1.3, 1.7}}, {"sigma", {0.3, 0.9}}};
            he.fixed = {{"k", 0.1}};
            FitOptions options;
            options.loss = loss;
            for (const ModelRequest& model : {lafortune, he}) {
                const Report report = fitter().fit(sample(surface), {model}, options);
                ASSERT_EQ(report.channels[0].fits.size(), 1U)
                    << surface << " " << model.family->name << ": " << report.channels[0].failures.front().detail;
                for (const auto& p : only(report).parameters) {
                    if (const auto it = model.bounds.find(p.name); it != model.bounds.end()) {
                        EXPECT_GE(p.value, it->second.min * (1 - 1e-12) - (it->second.min < 0 ? 1e-9 : 0)) << p.name;
                        EXPECT_LE(p.value, it->second.max + 1e-12) << p.name;
                    }
                    if (const auto it = model.fixed.find(p.name); it != model.fixed.end()) {
                        EXPECT_NEAR(p.value, it->second, 1e-12) << p.name;
                        EXPECT_TRUE(p.fixed) << p.name;
                        EXPECT_FALSE(p.std_error) << p.name;
                    }
                }
            }
        }
}

TEST(Bounds, OutsideTheDomainAreRefused) {
    ModelRequest ward = request("ward");
    ward.fixed = {{"alpha", -0.1}};
    EXPECT_THROW(fitter().fit(sample("paper"), {ward}, {}), optim::InvalidBounds);
    ward.fixed.clear();
    ward.bounds = {{"alpha", {0.5, 0.2}}};
    EXPECT_THROW(fitter().fit(sample("paper"), {ward}, {}), optim::InvalidBounds);
}

TEST(Failures, TooFewSamplesAreAFailureBesideTheModelsThatWorked) {
    Dataset dataset = sample("paper");
    dataset.channels[0].samples.resize(4);
    const Report report = fitter().fit(dataset, requests({"lambert", "phong", "he_torrance"}), {});
    EXPECT_EQ(report.channels[0].fits.size(), 2U);
    ASSERT_EQ(report.channels[0].failures.size(), 1U);
    EXPECT_EQ(report.channels[0].failures[0].model, "he_torrance");
    EXPECT_NE(report.channels[0].failures[0].reason.find("too few samples"), std::string::npos);
}

TEST(Ranking, IsByLoss) {
    const Report report = fitter().fit(sample("metallic_paint"), requests(kFour), {});
    const auto& fits = report.channels[0].fits;
    ASSERT_EQ(fits.size(), 4U);
    for (std::size_t i = 0; i < fits.size(); ++i) {
        EXPECT_EQ(fits[i].rank, i + 1);
        if (i > 0) {
            EXPECT_LE(fits[i - 1].loss, fits[i].loss);
        }
    }
    EXPECT_EQ(label(fits[0]), "lafortune_2");  // the sample was made with it
}

TEST(Lobes, AutoStopsWhereTheEvidenceDoes) {
    const auto directions = scan_directions({15, 30, 45, 60, 75}, 2);
    Random random(11);
    std::vector<double> y = model_values(variant("lafortune_1"), {0.1, -1.02, 0.98, 50.0}, directions);
    for (double& value : y) value *= 1 + 0.02 * random.normal();
    EXPECT_EQ(
        fit_one(dataset_of(make_channel(directions, y)), ModelRequest{catalogue().find("lafortune"), {}, {}, {}}).lobes,
        1U);
    EXPECT_EQ(fit_one(sample("white_plastic"), ModelRequest{catalogue().find("lafortune"), {}, {}, {}}).lobes, 2U);
}

TEST(Precisions, SingleIsCloseToDouble) {
    for (const std::string& name : kFour) {
        FitOptions options;
        options.precision = kernels::Precision::single_precision;
        const double single = fit_one(sample("metallic_paint"), request(name), options).loss;
        const double full = fit_one(sample("metallic_paint"), request(name)).loss;
        EXPECT_GE(single, full * (1 - 1e-6)) << name;
        EXPECT_LE(single, full * 1.01) << name;
    }
}

// ---- time and stops ----

TEST(Time, TheLimitEndsASearchAndIsSaid) {
    FitOptions options;
    options.effort = Effort::thorough;
    options.time_limit = std::chrono::milliseconds(4);
    const auto start = std::chrono::steady_clock::now();
    const Report report = fitter().fit(sample("paper"), requests({"he_torrance", "lafortune_3"}), options);
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    EXPECT_LT(seconds, 1.0);
    ASSERT_EQ(report.channels[0].fits.size(), 2U);
    for (const Fit& fit : report.channels[0].fits) {
        EXPECT_EQ(fit.search.stop_reason, StopReason::time_limit) << label(fit);
        EXPECT_TRUE(std::isfinite(fit.loss));
    }
}

TEST(Time, AStopCancels) {
    FitOptions options;
    options.effort = Effort::thorough;
    std::stop_source source;
    std::jthread later([&] {
        std::this_thread::sleep_for(std::chrono::milliseconds(4));
        source.request_stop();
    });
    const auto start = std::chrono::steady_clock::now();
    const Report report =
        fitter().fit(sample("paper"), requests({"he_torrance", "lafortune_3"}), options, source.get_token());
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    EXPECT_LT(seconds, 1.0);
    ASSERT_EQ(report.channels[0].fits.size(), 2U);
    for (const Fit& fit : report.channels[0].fits)
        EXPECT_EQ(fit.search.stop_reason, StopReason::cancelled) << label(fit);
}

}  // namespace
}  // namespace brdfit::tests
