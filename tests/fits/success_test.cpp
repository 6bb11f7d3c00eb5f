// How often a search ends within 1e-3 of the best known loss, over random materials.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <limits>

#include "optim/fit.h"
#include "tests/fits/fitting.h"
#include "tests/fits/materials.h"

namespace brdfit::tests {
namespace {

using optim::Dataset;
using optim::Effort;
using optim::FitOptions;

/// The materials of one pattern as the channels of one dataset.
Dataset materials(const kernels::Model& model, std::size_t pattern, std::size_t first, std::size_t count) {
    const auto& patterns = sampling_patterns();
    Dataset dataset{"materials", optim::Unit::per_steradian, {}};
    for (std::size_t i = pattern; i < count; i += patterns.size())
        dataset.channels.push_back(random_measurement(model, first + i, patterns[pattern]));
    return dataset;
}

std::vector<double> losses(const Dataset& dataset, const std::string& model, Effort effort, std::uint64_t seed) {
    FitOptions options;
    options.effort = effort;
    options.seed = seed;
    options.time_limit = std::chrono::hours(2);
    const optim::Report report = fitter().fit(dataset, {request(model)}, options);
    std::vector<double> result;
    for (std::size_t c = 0; c < report.channels.size(); ++c) result.push_back(only(report, c).relative_loss);
    return result;
}

struct Cell {
    std::string model;
    double least_rate;  ///< that is promised
    std::size_t materials = 24;
};

class Materials : public testing::TestWithParam<Cell> {};

/// The best known loss is that of searches 50 times as long: five of effort `thorough`, and the tested one's.
TEST_P(Materials, AreFitAsWellAsByASearchFiftyTimesAsLong) {
    const Cell& cell = GetParam();
    const std::size_t count = count_from("BRDFIT_MATERIALS", long_form() ? 1000 : cell.materials);
    const std::size_t first = count_from("BRDFIT_FIRST_MATERIAL", 0);
    const std::size_t references = long_form() ? 5 : 1;
    const kernels::Model& model = variant(cell.model);
    std::vector<double> excess;
    for (std::size_t pattern = 0; pattern < sampling_patterns().size(); ++pattern) {
        const Dataset dataset = materials(model, pattern, first, count);
        if (dataset.channels.empty()) continue;
        const std::vector<double> found = losses(dataset, cell.model, Effort::standard, 1);
        std::vector<double> best = found;
        for (std::size_t seed = 0; seed < references; ++seed) {
            const std::vector<double> reference = losses(dataset, cell.model, Effort::thorough, 100 + seed);
            for (std::size_t i = 0; i < best.size(); ++i) best[i] = std::min(best[i], reference[i]);
        }
        for (std::size_t i = 0; i < best.size(); ++i) {
            excess.push_back(best[i] > 1e-12 ? found[i] / best[i] - 1 : 0.0);
            if (excess.back() > 1e-3)
                std::printf("    material %s, pattern %zu: %.2g above %.4g\n", dataset.channels[i].name.c_str(),
                            pattern, excess.back(), best[i]);
        }
    }
    std::sort(excess.begin(), excess.end());
    const auto within = [&](double bound) {
        return static_cast<double>(std::upper_bound(excess.begin(), excess.end(), bound) - excess.begin()) /
               static_cast<double>(excess.size());
    };
    std::printf("%s: %zu materials; within 1e-6 %.4f, 1e-3 %.4f, 1e-2 %.4f, 1e-1 %.4f; worst %.2g\n",
                cell.model.c_str(), excess.size(), within(1e-6), within(1e-3), within(1e-2), within(1e-1),
                excess.back());
    // A rate over so few is known to two standard deviations.
    const double rate = cell.least_rate;
    EXPECT_GE(within(1e-3), rate - 2 * std::sqrt(rate * (1 - rate) / static_cast<double>(excess.size())));
}

INSTANTIATE_TEST_SUITE_P(Models, Materials,
                         testing::Values(Cell{"phong", 0.999, 48}, Cell{"ward", 0.999, 48},
                                         Cell{"lafortune_1", 0.999, 48}, Cell{"lafortune_2", 0.96},
                                         Cell{"lafortune_3", 0.9}, Cell{"he_torrance", 0.99}),
                         [](const auto& parameter) { return parameter.param.model; });

}  // namespace
}  // namespace brdfit::tests
