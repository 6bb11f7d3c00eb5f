// Every model against the high-precision reference, on every way the kernel text can run, and the physics it states.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdio>

#include "tests/numerics/host_kernel.h"
#include "tests/numerics/points.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Direction;
using kernels::Model;
using kernels::Precision;

// ---- golden values ----

class GoldenTest : public testing::TestWithParam<std::tuple<const Model*, Precision>> {};

/// Points to a model and a precision.
std::size_t point_count() { return count_from("BRDFIT_POINTS", long_form() ? 1000000 : 20000); }

TEST_P(GoldenTest, ValuesAndSlopesAreWithinTheirBoundsOverTheWholeDomain) {
    const auto& [model, precision] = GetParam();
    if (!engine().supports(precision)) GTEST_SKIP() << "the device lacks this precision";
    const bool is_double = precision == Precision::double_precision;
    constexpr std::size_t kBatch = 20000;
    const std::size_t count = point_count();
    std::vector<Errors> errors(backends().size(), Errors(*model, precision));
    for (std::size_t first = 0; first < count; first += kBatch) {
        const std::vector<Golden> points =
            golden(*model, draw_points(*model, precision, std::min(kBatch, count - first), 20040203 + first));
        for (std::size_t b = 0; b < backends().size(); ++b) {
            const std::vector<Measured> got = measure(*model, precision, backends()[b], points);
            for (std::size_t i = 0; i < points.size(); ++i) errors[b].add(points[i], got[i]);
        }
    }
    for (std::size_t b = 0; b < backends().size(); ++b) {
        const Errors& e = errors[b];
        const std::string& name = backends()[b].name;
        EXPECT_EQ(e.broken, 0U) << name << ": " << e.broken_where;
        EXPECT_LE(e.value.ratio, kBound) << name << ": " << e.value.where;
        EXPECT_LE(e.slope.ratio, kBound) << name << ": " << e.slope.where;
        if (model->name != "lambert") {
            EXPECT_GT(e.compared, count / 4);
        }
        std::printf("%-12s %-9s %-6s %7zu points: value %6.2f eps, slopes %6.2f eps\n", label(*model).c_str(),
                    name.c_str(), is_double ? "double" : "float", e.compared, e.value.ratio, e.slope.ratio);
        RecordProperty(name + "_value_eps", std::to_string(e.value.ratio));
        RecordProperty(name + "_slope_eps", std::to_string(e.slope.ratio));
    }
}

INSTANTIATE_TEST_SUITE_P(Models, GoldenTest,
                         testing::Combine(testing::ValuesIn(variants()),
                                          testing::Values(Precision::double_precision, Precision::single_precision)),
                         [](const auto& parameter) {
                             const bool is_double = std::get<1>(parameter.param) == Precision::double_precision;
                             return label(*std::get<0>(parameter.param)) + (is_double ? "_double" : "_float");
                         });

// ---- the host's skeleton ----

class HostTest : public testing::TestWithParam<const Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, HostTest, testing::ValuesIn(variants()),
                         [](const auto& parameter) { return label(*parameter.param); });

TEST_P(HostTest, ProjectsAsTheDeviceDoes) {
    const Model& model = *GetParam();
    const std::vector<Direction> directions = scan_directions({15, 45, 70}, 5);
    Random random(9);
    std::vector<double> y, w, parameters;
    for (std::size_t j = 0; j < directions.size(); ++j) {
        y.push_back(random.uniform(0.1, 1));
        w.push_back(random.uniform(0, 1));
    }
    constexpr std::size_t kCandidates = 50;
    for (std::size_t i = 0; i < kCandidates; ++i) {
        std::vector<double> p = random.typical_parameters(model);
        for (const kernels::Term& term : model.terms)
            if (term.homogeneous) p[term.homogeneous->plane.first] /= 4, p[term.homogeneous->plane.second] /= 4;
        parameters.insert(parameters.end(), p.begin(), p.end());
    }
    const std::size_t t = model.terms.size();
    const std::vector<double> lower(kCandidates * t, 0.0), upper(kCandidates * t, 0.5);
    for (const Precision precision : {Precision::double_precision, Precision::single_precision}) {
        if (!engine().supports(precision)) continue;
        const std::vector<double> rows =
            host_kernel(model, precision).project(columns_of(directions, precision), y, w, parameters, lower, upper);
        kernels::Evaluator evaluator(engine(), model, precision, directions, y, w);
        kernels::Batch batch;
        evaluator.project(parameters, lower, upper, true, batch);
        const std::size_t stride = rows.size() / kCandidates;
        for (std::size_t i = 0; i < kCandidates; ++i)
            EXPECT_NEAR(rows[i * stride], batch.loss[i],
                        (precision == Precision::double_precision ? 1e-10 : 1e-4) * batch.loss[i]);
    }
}

}  // namespace
}  // namespace brdfit::tests
