/// What evaluations cost: the counted operations, and that a cost once known stays.
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>

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
    EXPECT_EQ(book.cost(model).double_ns, first.double_ns);  // from the folder, to the last digit
    EXPECT_EQ(book.cost(model).single_ns, first.single_ns);
    std::filesystem::remove_all(folder);
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
