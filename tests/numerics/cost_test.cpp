/// What evaluations cost: the counted operations, and that a cost once known stays.
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "kernels/cost.h"
#include "tests/numerics/operation_counts.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

TEST(Cost, TableOfOperationsIsCurrent) {
    std::ifstream in(std::filesystem::path(BRDFIT_SOURCE_DIR) / "kernels" / "operation_counts.inc");
    const std::string committed{std::istreambuf_iterator<char>(in), {}};
    EXPECT_EQ(committed, operation_counts_table())
        << "cmake --build build --target operation_counts_generator && "
           "build/tests/operation_counts_generator kernels/operation_counts.inc";
}

TEST(Cost, OfLambertsModelIsAProduct) {
    const auto counts = kernels::operation_counts(variant("lambert")).value();
    EXPECT_EQ(counts.multiply, 1);
    EXPECT_EQ(counts.divide + counts.sqrt + counts.fma, 0);
    EXPECT_LE(counts.add, 1);
}

TEST(Cost, StaysAsItWasFirstMeasured) {
    const std::filesystem::path folder = std::filesystem::temp_directory_path() / "brdfit-cost-test";
    std::filesystem::remove_all(folder);
    kernels::EngineOptions options;
    options.cache = folder;
    kernels::Engine kept(options);
    const kernels::Model& model = variant("ward");
    const kernels::Cost first = kernels::CostBook(kept).cost(model);
    ASSERT_TRUE(first.double_ns.has_value());
    EXPECT_GT(*first.double_ns, 0);
    kernels::Engine later(options);
    kernels::CostBook book(later);
    const kernels::Cost second = book.cost(model);
    if (first.under_load) {  // measured again
        EXPECT_LE(second.double_ns.value(), first.double_ns.value());
    } else {  // from the folder, to the last digit
        EXPECT_EQ(second.double_ns, first.double_ns);
        EXPECT_EQ(second.single_ns, first.single_ns);
    }
    EXPECT_EQ(book.cost(model).double_ns, second.double_ns);
    std::filesystem::remove_all(folder);
}

TEST(Cost, MeasuredBesideOtherWorkIsMarkedAndMeasuredAgain) {
    if (!engine().device().runs_inline) GTEST_SKIP() << "a driver's threads count as this program's own";
    kernels::CostBook book(engine());
    std::vector<std::jthread> load;
    for (unsigned i = 0; i < 2 * std::thread::hardware_concurrency(); ++i)
        load.emplace_back([](const std::stop_token& stop) {
            while (!stop.stop_requested()) {
            }
        });
    const kernels::Cost loaded = book.cost(variant("phong"));
    EXPECT_TRUE(loaded.under_load);
    load.clear();
    const bool settled = book.settle();
    const kernels::Cost later = book.cost(variant("phong"));
    EXPECT_EQ(later.under_load, !settled);  // other programs may go on
    EXPECT_LE(later.double_ns.value(), loaded.double_ns.value());
    EXPECT_LE(later.single_ns.value(), loaded.single_ns.value());
}

TEST(Cost, IsTheHigherTheMoreThereIsToDo) {
    kernels::CostBook book(engine());
    const auto ns = [&](const std::string& name) { return book.cost(variant(name)).double_ns.value(); };
    EXPECT_LT(ns("lambert"), ns("ward"));
    EXPECT_LT(ns("ward"), ns("he_torrance"));
    EXPECT_LT(ns("lafortune_1"), ns("lafortune_3"));
}

}  // namespace
}  // namespace brdfit::tests
