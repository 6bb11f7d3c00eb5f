// The number of lanes: noise does not change it, and what was measured and kept is used.

#include "kernels/tuning.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <filesystem>

#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::choose_lanes;
using kernels::LanesTiming;
using kernels::Precision;

TEST(ChooseLanes, NativeUnlessAnotherIsClearlyFaster) {
    const auto choose = [](unsigned native, std::initializer_list<LanesTiming> timings) {
        return choose_lanes(native, std::vector<LanesTiming>(timings));
    };
    EXPECT_EQ(choose(8, {{1, 50}, {4, 12}, {8, 10}, {16, 10.1}}), 8);
    EXPECT_EQ(choose(8, {{1, 50}, {4, 9}, {8, 10}, {16, 11}}), 8) << "within the noise";
    EXPECT_EQ(choose(8, {{1, 50}, {4, 8.6}, {8, 10}, {16, 8.5}}), 16);
    EXPECT_EQ(choose(1, {{1, 50}, {4, 9}}), 4);
    EXPECT_EQ(choose(8, {{1, 50}}), 8) << "nothing is known of the native one";
    EXPECT_EQ(choose(8, {}), 8);
}

TEST(Tune, KeepsItsChoiceInTheCache) {
    if (engine().device().type != "cpu") GTEST_SKIP() << "another device has one lane";
    namespace fs = std::filesystem;
    const fs::path folder = fs::temp_directory_path() / ("brdfit-tuning-test-" + std::to_string(::getpid()));
    kernels::EngineOptions options;
    options.cache = folder;
    const kernels::Family lambert = *catalogue().find("lambert");
    const auto tunings = kernels::tune(options, {&lambert, 1});
    ASSERT_FALSE(tunings.empty());
    for (const kernels::Tuning& tuning : tunings) {
        EXPECT_TRUE(tuning.kept);
        EXPECT_EQ(tuning.native, engine().lanes(tuning.precision));
        EXPECT_EQ(tuning.timings.size(), std::size(kernels::kLanes));
        EXPECT_EQ(tuning.chosen, choose_lanes(tuning.native, tuning.timings));
        EXPECT_EQ(kernels::Engine(options).lanes(tuning.precision), tuning.chosen);
    }
    options.lanes = 2;
    EXPECT_EQ(kernels::Engine(options).lanes(Precision::single_precision), 2) << "who asks for a number gets it";
    fs::remove_all(folder);
}

}  // namespace
}  // namespace brdfit::tests
