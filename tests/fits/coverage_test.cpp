// Intervals of 95 % against repetition: noise put on the bundled samples again and again.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>

#include "tests/fits/fitting.h"
#include "tests/fits/truth.h"

namespace brdfit::tests {
namespace {

using optim::Dataset;
using optim::Fit;
using optim::FitOptions;
using optim::FittedParameter;

constexpr double kNoise = 0.02;

FitOptions options_for(optim::Effort effort) {
    FitOptions options;
    options.effort = effort;
    options.judge = effort == optim::Effort::thorough;  // then by resampling
    options.profiled = true;
    options.time_limit = std::chrono::hours(2);
    return options;
}

/// Which lobe is called the first is a convention: a fit with its lobes in the order that is nearest to the truth's.
std::vector<FittedParameter> matched(const Fit& fit, const Fit& truth) {
    std::vector<FittedParameter> result = fit.parameters;
    if (fit.lobes != 2) return result;
    std::vector<FittedParameter> swapped = result;
    std::swap_ranges(swapped.begin() + 1, swapped.begin() + 4, swapped.begin() + 4);
    const auto distance = [&](const std::vector<FittedParameter>& p) {
        double sum = 0;
        for (std::size_t k = 1; k < p.size(); ++k)
            sum += std::pow((p[k].value - truth.parameters[k].value) / (std::abs(truth.parameters[k].value) + 0.1), 2);
        return sum;
    };
    return distance(swapped) < distance(result) ? swapped : result;
}

/// The truth is the fit of the data without noise: what the estimate tends to, whether the model is right or not.
void expect_coverage(const std::string& sample, const std::string& model, optim::Effort effort,
                     std::size_t replicates) {
    const optim::Channel exact = noise_free(sample);
    const optim::Report clean = fitter().fit(dataset_of(exact), {request(model)}, options_for(optim::Effort::standard));
    const Fit& truth = only(clean);
    Dataset dataset{"replicates", optim::Unit::per_steradian, {}};
    Random random(count_from("BRDFIT_SEED", 12) + std::hash<std::string>{}(sample + model));
    for (std::size_t i = 0; i < replicates; ++i) dataset.channels.push_back(measured(exact, kNoise, 0, random));
    const char* known = std::getenv("BRDFIT_KNOWN_SIGMA");  // tells apart what not knowing the noise does
    if (known != nullptr && std::string(known) == "1")
        for (optim::Channel& channel : dataset.channels)
            for (std::size_t j = 0; j < channel.samples.size(); ++j)
                channel.samples[j].sigma = kNoise * exact.samples[j].brdf;
    const optim::Report report = fitter().fit(dataset, {request(model)}, options_for(effort));
    std::vector<std::vector<FittedParameter>> fits;
    for (std::size_t c = 0; c < replicates; ++c) fits.push_back(matched(only(report, c), truth));
    const auto n = static_cast<double>(replicates);
    // What so many replicates leave open, by the binomial distribution.
    const auto slack = [&](double edge) { return 3 * std::sqrt(edge * (1 - edge) / n); };
    double covered_of_all = 0;
    double parameters = 0;
    for (std::size_t k = 0; k < truth.parameters.size(); ++k) {
        const FittedParameter& t = truth.parameters[k];
        double covered = 0, bounds = 0, below = 0, above = 0;
        std::vector<double> widths;
        for (std::size_t c = 0; c < replicates; ++c) {
            const FittedParameter& p = fits[c][k];
            bounds += p.at_bound;
            ASSERT_TRUE(p.interval_95) << t.name;
            const auto [low, high] = *p.interval_95;
            covered += low <= t.value && t.value <= high;
            below += high < t.value;
            above += t.value < low;
            widths.push_back(high - low);
        }
        std::nth_element(widths.begin(), widths.begin() + static_cast<std::ptrdiff_t>(replicates / 2), widths.end());
        std::printf(
            "COVER %-14s %-11s %-8s %10.4g%s: %5.1f %%; truth above %4.1f %%, below %4.1f %%; at bound %5.1f %%; "
            "width %.2g\n",
            sample.c_str(), model.c_str(), t.name.c_str(), t.value, t.at_bound ? " (bound)" : "", 100 * covered / n,
            100 * below / n, 100 * above / n, 100 * bounds / n, widths[replicates / 2]);
        // Where the model wants to go beyond a bound, truth and estimates stand there, and all is certain.
        if (t.at_bound && bounds > 0.975 * n) continue;
        EXPECT_GE(covered / n, 0.93 - slack(0.93)) << t.name;
        ++parameters;
        covered_of_all += covered / n;
    }
    const double share = covered_of_all / parameters;
    std::printf("COVER %-14s %-11s all: %.1f %%\n", sample.c_str(), model.c_str(), 100 * share);
    // The parameters of a fit go together: their mean is as uncertain as one's.
    EXPECT_GE(share, 0.93 - slack(0.93));
    EXPECT_LE(share, 0.97 + slack(0.97));
}

using Cell = std::tuple<std::string, std::string>;  // sample and model
std::string name_of(const testing::TestParamInfo<Cell>& info) {
    return std::get<0>(info.param) + "_" + std::get<1>(info.param);
}

class Coverage : public testing::TestWithParam<Cell> {};
INSTANTIATE_TEST_SUITE_P(Cells, Coverage,
                         testing::Combine(testing::ValuesIn(sample_names()),
                                          testing::Values("phong", "ward", "lafortune_1", "lafortune_2",
                                                          "he_torrance")),
                         name_of);

TEST_P(Coverage, OfTheTruthIsNinetyFivePercent) {
    const auto& [sample, model] = GetParam();
    expect_coverage(sample, model, optim::Effort::standard, count_from("BRDFIT_REPLICATES", long_form() ? 1000 : 50));
}

class Resampling : public testing::TestWithParam<Cell> {};
INSTANTIATE_TEST_SUITE_P(Cells, Resampling,
                         testing::Values(Cell("paper", "phong"), Cell("rough_metal", "ward"),
                                         Cell("metallic_paint", "lafortune_1"), Cell("white_plastic", "lafortune_2"),
                                         Cell("smooth_metal", "he_torrance"), Cell("white_plastic", "he_torrance")),
                         name_of);

/// Intervals of effort thorough: each is hundreds of fits.
TEST_P(Resampling, CoversTheTruthInNinetyFivePercent) {
    const auto& [sample, model] = GetParam();
    const std::size_t replicates = count_from("BRDFIT_RESAMPLED", long_form() ? 300 : model == "phong" ? 40 : 0);
    if (replicates == 0) GTEST_SKIP() << "in the long form";
    expect_coverage(sample, model, optim::Effort::thorough, replicates);
}

}  // namespace
}  // namespace brdfit::tests
