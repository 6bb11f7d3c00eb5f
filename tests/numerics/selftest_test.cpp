// The self-test: its table is the reference's, this device passes, and a worse one does not.

#include "kernels/selftest.h"

#include <algorithm>
#include <limits>
#include <set>
#include <stdexcept>
#include <string>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "kernels/embedded.h"
#include "optim/fit.h"
#include "tests/numerics/hard_points.h"
#include "tests/support.h"

namespace brdfit::tests {
namespace {

using kernels::Engine;
using kernels::EngineOptions;
using kernels::HardPoint;
using kernels::Model;
using kernels::ModelTest;
using kernels::Precision;
using kernels::PrecisionError;
using kernels::SelfTest;
using kernels::SelfTestForm;
using testing::AllOf;
using testing::HasSubstr;
using testing::Not;

/// A device that takes the models' constants as floats: off by 2^-24 in double precision, as it should be in single.
const EngineOptions kRoughInDouble{"auto", {}, "-cl-single-precision-constant"};

/// The family alone, for tests that build programs of their own.
std::vector<kernels::Family> only(const std::string& name) { return {*catalogue().find(name)}; }

/// Phong's model with another exponent: as a device with a poor exponential would compute it.
std::vector<kernels::Family> phong_with(const std::string& exponent) {
    const auto all = kernels::embedded_models();
    std::string text(std::find_if(all.begin(), all.end(), [](const auto& m) { return m.name == "phong"; })->text);
    const std::string right = "exponential(p.n * l)";
    const auto at = text.find(right);
    if (at == std::string::npos) throw std::logic_error("phong.cl has changed");
    return {
        kernels::parse_family("phong", "phong.cl", text.replace(at, right.size(), "exponential(" + exponent + ")"))};
}

std::vector<HardPoint> table_of(const Model& model) {
    std::vector<HardPoint> points;
    for (const HardPoint& point : kernels::hard_points())
        if (point.model == model.name && point.lobes == model.repeats) points.push_back(point);
    return points;
}

class HardPointsTest : public testing::TestWithParam<const Model*> {};
INSTANTIATE_TEST_SUITE_P(Models, HardPointsTest, testing::ValuesIn(variants()),
                         [](const auto& parameter) { return label(*parameter.param); });

TEST_P(HardPointsTest, TheTableIsWhatTheGeneratorWrites) {
    const Model& model = *GetParam();
    const std::vector<HardPoint> table = table_of(model);
    std::vector<HardPoint> points = choose_hard_points(model);
    ASSERT_EQ(table.size(), points.size()) << "run build/tests/hard_points_generator kernels/hard_points.inc";
    for (std::size_t i = 0; i < points.size(); ++i) {
        refer(model, points[i]);
        EXPECT_EQ(text_of(model, table[i]), text_of(model, points[i]));
    }
}

TEST_P(HardPointsTest, ThereAreEnough) {
    const Model& model = *GetParam();
    const bool has_lobe = model.parameters.size() > 1;
    const std::size_t enough = has_lobe ? 40 : 3;
    EXPECT_GE(table_of(model).size(), enough);
    std::set<std::string> texts;
    for (const HardPoint& point : table_of(model)) texts.insert(text_of(model, point));
    EXPECT_EQ(texts.size(), table_of(model).size()) << "a point twice";
}

std::string failures(const SelfTest& test) {
    std::string text;
    for (const ModelTest& model : test.models)
        for (const std::string& line : model.failures())
            text += kernels::variant_name(model.model, model.lobes) + ": " + line + "\n";
    return text;
}

void expect_passes(Engine& device, SelfTestForm form, std::size_t fewest, std::size_t most) {
    const auto tests = kernels::prove(device, catalogue().families(), form);
    ASSERT_EQ(tests.size(), device.device().has_double ? 2U : 1U);
    for (const SelfTest& test : tests) {
        EXPECT_TRUE(test.passed()) << failures(test);
        EXPECT_EQ(test.reason(), "");
        EXPECT_TRUE(device.supports(test.precision));
        std::size_t models = 0;
        for (const kernels::Family& family : catalogue().families())
            models += form == SelfTestForm::whole ? family.texts().size() : family.variants.size();
        ASSERT_EQ(test.models.size(), models);
        for (const ModelTest& model : test.models) {
            if (model.model == "lambert") continue;
            EXPECT_GE(model.points, fewest) << model.model;
            EXPECT_LE(model.points, most) << model.model;
        }
    }
}

TEST(SelfTests, ThisDevicePassesTheWholeForm) {
    Engine device;
    expect_passes(device, SelfTestForm::whole, 30, 100);
}
TEST(SelfTests, ThisDevicePassesTheWholeFormOneSampleAtATime) {
    Engine device({"auto", 1U});
    expect_passes(device, SelfTestForm::whole, 30, 100);
}
TEST(SelfTests, ThisDevicePassesTheBriefForm) {
    Engine device;
    expect_passes(device, SelfTestForm::brief, 5, 10);
}

TEST(SelfTests, AWorseDeviceFailsInThePrecisionThatNoticesAndOnlyThere) {
    Engine device(kRoughInDouble);
    if (!device.device().has_double) GTEST_SKIP() << "the device lacks double precision";
    for (const SelfTestForm form : {SelfTestForm::brief, SelfTestForm::whole}) {
        const SelfTest test = kernels::self_test(device, only("phong"), Precision::double_precision, form);
        EXPECT_FALSE(test.passed());
        EXPECT_GT(test.models[0].value.eps, 1e3);
        EXPECT_GT(test.models[0].slope.eps, 1e3);
        EXPECT_THAT(test.models[0].value.where, AllOf(HasSubstr("n=0x"), HasSubstr("theta_r_deg=")));
        EXPECT_THAT(test.reason(),
                    AllOf(HasSubstr("in double precision (32 eps are allowed)"), HasSubstr("phong is off by")));
    }
    const auto tests = kernels::prove(device, only("phong"), SelfTestForm::brief);
    ASSERT_EQ(tests.size(), 2U);
    EXPECT_FALSE(tests[0].passed());
    EXPECT_TRUE(tests[1].passed()) << failures(tests[1]);
    EXPECT_FALSE(device.supports(Precision::double_precision));
    EXPECT_EQ(device.refusal(Precision::double_precision), tests[0].reason());
    EXPECT_TRUE(device.usable());
    EXPECT_EQ(device.best_precision(), Precision::single_precision);
    EXPECT_EQ(kernels::prove(device, only("phong"), SelfTestForm::brief).size(), 1U) << "a withdrawn one is not tested";
    EXPECT_THROW((void)kernels::self_test(device, only("phong"), Precision::double_precision, SelfTestForm::brief),
                 PrecisionError);
}

TEST(SelfTests, FitsUseThePrecisionThatIsLeft) {
    Engine device;
    if (!device.device().has_double) GTEST_SKIP() << "the device lacks double precision";
    device.withdraw(Precision::double_precision, "double is out of order");
    const Model& model = variant("ward");
    const auto directions = scan_directions({15, 60}, 10);
    EXPECT_THROW((void)kernels::evaluate(device, model, Precision::double_precision, {0.3, 0.2, 0.2}, directions, true),
                 PrecisionError);
    const optim::Dataset dataset{
        "x", optim::Unit::per_steradian, {make_channel(directions, model_values(model, {0.3, 0.2, 0.2}, directions))}};
    optim::ModelRequest request;
    request.family = catalogue().find("ward");
    optim::Fitter fitter(device, 1);
    const optim::Report report = fitter.fit(dataset, {request}, {});
    EXPECT_EQ(report.precision, Precision::single_precision);
    ASSERT_EQ(report.channels[0].fits.size(), 1U);
    EXPECT_NEAR(report.channels[0].fits[0].parameters[2].value, 0.2, 1e-3);

    optim::FitOptions options;
    options.precision = Precision::double_precision;
    try {
        (void)fitter.fit(dataset, {request}, options);
        FAIL() << "fitted in a precision that was withdrawn";
    } catch (const PrecisionError& error) {
        EXPECT_STREQ(error.what(), "double is out of order");
    }
    device.withdraw(Precision::single_precision, "so is single");
    EXPECT_FALSE(device.usable());
    try {
        (void)fitter.fit(dataset, {request}, {});
        FAIL() << "fitted in no precision";
    } catch (const PrecisionError& error) {
        EXPECT_STREQ(error.what(), "double is out of order; so is single");
    }
}

TEST(SelfTests, ADeviceThatIsWorseThanSingleIsNotUsable) {
    Engine device;
    for (const SelfTest& test : kernels::prove(device, phong_with("1.00001 * p.n * l"), SelfTestForm::brief))
        EXPECT_FALSE(test.passed());
    EXPECT_FALSE(device.usable());
    EXPECT_THROW((void)device.best_precision(), PrecisionError);
}

TEST(SelfTests, ResultsThatAreNotFiniteFail) {
    Engine device;
    const auto families = phong_with("p.n * l / (l - l) * (l - l)");
    const SelfTest test = kernels::self_test(device, families, device.best_precision(), SelfTestForm::brief);
    EXPECT_FALSE(test.passed());
    EXPECT_EQ(test.models[0].value.eps, std::numeric_limits<double>::infinity());
}

TEST(SelfTests, ACompilerThatFailsIsAFailure) {
    Engine device;
    const auto families = phong_with("no_such_function(p.n * l)");
    const SelfTest test = kernels::self_test(device, families, device.best_precision(), SelfTestForm::brief);
    EXPECT_FALSE(test.passed());
    EXPECT_THAT(test.models[0].failures(), testing::ElementsAre(HasSubstr("no_such_function")));
    EXPECT_THAT(test.reason(), AllOf(HasSubstr("phong cannot be computed"), Not(HasSubstr("no_such"))));
}

TEST(SelfTests, AModelOfAUsersHasNoPoints) {
    const std::string text = R"(/*{"title": "t", "source": "s", "formula": "f",
        "parameters": [{"name": "k", "unit": "1", "min": 0, "max": 1, "scale": "linear", "doc": "albedo"}],
        "terms": [{"name": "diffuse", "factor": "k"}], "traits": {"reciprocal": true}}*/
        this is not compiled)";
    const std::vector<kernels::Family> families{kernels::parse_family("mine", "mine.cl", text)};
    Engine device;
    for (const SelfTest& test : kernels::prove(device, families, SelfTestForm::whole)) {
        ASSERT_EQ(test.models.size(), 1U);
        EXPECT_EQ(test.models[0].points, 0U);
        EXPECT_TRUE(test.passed()) << "it neither passes nor fails";
    }
    EXPECT_TRUE(device.usable());
}

}  // namespace
}  // namespace brdfit::tests
