// The noise that a channel's own samples tell, against the noise that was put on them.

#include "optim/noise.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "tests/fits/materials.h"
#include "tests/fits/truth.h"

namespace brdfit::tests {
namespace {

using optim::Channel;
using optim::Noise;
using optim::NoiseSource;

/// How far an estimated sigma is from the true one, over the samples: the mean of its logarithm.
double excess(const Noise& noise, const Channel& truth, double relative, double floor) {
    double sum = 0;
    for (std::size_t j = 0; j < noise.sigma.size(); ++j)
        sum += std::log(noise.sigma[j] / std::hypot(floor, relative * truth.samples[j].brdf));
    return sum / static_cast<double>(noise.sigma.size());
}

struct Size {
    double relative;
    double floor;  ///< of the data's median
};

class NoiseOf : public testing::TestWithParam<std::string> {};
INSTANTIATE_TEST_SUITE_P(Samples, NoiseOf, testing::ValuesIn(sample_names()),
                         [](const auto& parameter) { return parameter.param; });

TEST_P(NoiseOf, IsRecoveredWithinItsStatedError) {
    const Channel truth = noise_free(GetParam());
    std::vector<double> values;
    for (const optim::Sample& s : truth.samples) values.push_back(s.brdf);
    std::nth_element(values.begin(), values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2), values.end());
    const double median = values[values.size() / 2];
    for (const Size size : {Size{0.02, 0}, Size{0.01, 0.01}, Size{0.05, 0}}) {
        const double floor = size.floor * median;
        constexpr std::size_t kReplicates = 100;
        Random random(3);
        double told = 0;
        double mean = 0;
        double square = 0;
        double stated = 0;
        double relative = 0;  // over the true one
        for (std::size_t i = 0; i < kReplicates; ++i) {
            const Noise noise = noise_of(measured(truth, size.relative, floor, random));
            told += noise.record.source == NoiseSource::estimated;
            if (noise.record.source != NoiseSource::estimated) continue;
            const double x = excess(noise, truth, size.relative, floor);
            mean += x;
            square += x * x;
            stated += *noise.record.relative_error;
            relative += *noise.record.relative / size.relative;
        }
        // Peaks narrower than the steps may pass for differences that are no noise: then nothing is told.
        EXPECT_GE(told, 0.8 * kReplicates);
        mean /= told;
        square /= told;
        stated /= told;
        relative /= told;
        const double spread = std::sqrt(square - mean * mean);
        std::printf(
            "%s, %g of the value, %g of the median: %.1f %% off, spread %.1f %%, stated %.1f %%; told by %g; the "
            "relative part %.1f %% off\n",
            GetParam().c_str(), size.relative, size.floor, 100 * mean, 100 * spread, 100 * stated, told,
            100 * (relative - 1));
        EXPECT_GT(relative, 0.98);  // no floor is taken for a part of it
        EXPECT_LT(relative, 1.08);
        EXPECT_LT(std::abs(mean), 0.08);  // a narrow peak's curvature on the rough metal
        EXPECT_LT(spread, 1.6 * stated);
        EXPECT_GT(spread, 0.6 * stated);
    }
}

TEST(NoiseOf, RandomMaterialsIsFound) {
    std::vector<double> off;
    std::size_t asked = 0;
    for (const kernels::Model* model : variants()) {
        if (model->name == "lambert") continue;
        for (std::size_t i = 0; i < 30; ++i) {
            const auto& directions = sampling_patterns()[i % 2];
            Random random(100 + i);
            const Channel truth =
                make_channel(directions, model_values(*model, random_material(*model, random, directions), directions));
            const Noise noise = noise_of(measured(truth, 0.02, 0, random));
            ++asked;
            if (noise.record.source == NoiseSource::estimated) off.push_back(excess(noise, truth, 0.02, 0));
        }
    }
    std::sort(off.begin(), off.end());
    const auto at = [&](double share) {
        return off[static_cast<std::size_t>(share * static_cast<double>(off.size() - 1))];
    };
    std::printf("%zu of %zu materials tell: ln(found/true) %.2f, %.2f, %.2f, %.2f, %.2f at 0, 5, 50, 95, 100 %%\n",
                off.size(), asked, at(0), at(0.05), at(0.5), at(0.95), at(1));
    EXPECT_GE(static_cast<double>(off.size()), 0.9 * static_cast<double>(asked));
    EXPECT_LT(std::abs(at(0.5)), 0.04);
    EXPECT_GT(at(0.05), -0.25);
    EXPECT_LT(at(0.9), 0.4);
}

TEST(NoiseOf, DataWithSigmaIsThat) {
    Channel channel = noise_free("paper");
    for (optim::Sample& s : channel.samples) s.sigma = 0.5;
    const Noise noise = noise_of(channel);
    EXPECT_EQ(noise.record.source, NoiseSource::given);
    EXPECT_FALSE(noise.record.relative);
    EXPECT_EQ(noise.sigma, std::vector<double>(channel.samples.size(), 0.5));
}

TEST(NoiseOf, SparseScansIsNotGuessed) {
    const std::vector<kernels::Direction> directions = scan_directions({15, 45}, 50);  // too few samples a scan
    EXPECT_EQ(noise_of(make_channel(directions, std::vector<double>(directions.size(), 1.0))).record.source,
              NoiseSource::residuals);
    EXPECT_EQ(noise_of(make_channel(directions, std::vector<double>(directions.size(), 0.0))).record.source,
              NoiseSource::none);
}

TEST(NoiseOf, DataScalesWithThem) {
    Random random(1);
    Channel channel = measured(noise_free("paper"), 0.02, 0.001, random);
    const Noise noise = noise_of(channel);
    for (optim::Sample& s : channel.samples) s.brdf *= 0x1p-90;
    const Noise small = noise_of(channel);
    EXPECT_NEAR(*small.record.relative, *noise.record.relative, 1e-12);
    EXPECT_NEAR(*small.record.floor * 0x1p90, *noise.record.floor, 1e-12);
}

TEST(NoiseOf, MeasuredSurfaces) {
    for (const optim::Dataset& dataset :
         read_folder(std::filesystem::path(BRDFIT_SOURCE_DIR) / ".." / "shared" / "data" / "real"))
        for (const Channel& channel : dataset.channels) {
            const Noise noise = noise_of(channel);
            std::printf("%s %s: %d, %.3g, %.3g\n", dataset.name.c_str(), channel.name.c_str(),
                        static_cast<int>(noise.record.source), noise.record.relative.value_or(0),
                        noise.record.floor.value_or(0));
            for (const double sigma : noise.sigma) EXPECT_TRUE(sigma > 0 && std::isfinite(sigma));
        }
}

}  // namespace
}  // namespace brdfit::tests
