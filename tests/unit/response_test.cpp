/// Answers as JSON text.
#include "api/response.h"

#include <cmath>
#include <limits>
#include <numeric>
#include <string>

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "api/problem.h"
#include "tests/support.h"

namespace brdfit::api {
namespace {

using Json = nlohmann::ordered_json;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::Not;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

std::vector<std::string> keys(const Json& object) {
    std::vector<std::string> result;
    for (const auto& [key, value] : object.items()) result.push_back(key);
    return result;
}

optim::Report report() {
    optim::Fit fit;
    fit.rank = 1;
    fit.model = "lafortune";
    fit.lobes = 2;
    fit.parameters = {{"k_d", "1", 0.5, 0.25, false, false, {{0.25, 0.75}}},
                      {"n_1", "1", 30, {}, true, false},
                      {"tau", "um", 2, {}, false, true}};
    fit.loss = 0.125;
    fit.relative_loss = 0.5;
    fit.rmse = 0.0625;
    fit.log10_rmse = 0.75;
    fit.aicc = -10;
    fit.bic = -9;
    fit.scans = {{15, 0.1, 0.2}};
    fit.search = {16, 15, 900, optim::StopReason::roundoff, 0.5, {{0.5, 3, {{"k_d", 0.25}}}}};
    fit.held_out = optim::HeldOut{0.5, {}, 0.25, {{15, 0.5, {}}}};
    fit.correlations = {{"a", "b"}, {1, 0.5, 0.5, 1}};
    const optim::NoiseRecord noise{optim::NoiseSource::estimated, 0.25, 0.125, 0.0625};
    optim::ChannelReport channel{{"grün & 1/2", 550, {{{15, 30, 0}, 1, {}}}}, {fit}, {}, {}};
    channel.noise = noise;
    return {"a surface",
            optim::Unit::per_steradian,
            7,
            {"a device", "a platform", "1.0", "gpu", true, 4},
            kernels::Precision::double_precision,
            {channel}};
}

/// One that passed, one that failed in two ways.
std::vector<kernels::SelfTest> self_tests() {
    return {{kernels::Precision::double_precision,
             kernels::SelfTestForm::brief,
             {{"ward", 0, 8, {2.5, "somewhere"}, {32, "alpha at x"}, "", 3.5}, {"mine", 0, 0, {}, {}, "", 0}}},
            {kernels::Precision::single_precision,
             kernels::SelfTestForm::whole,
             {{"lafortune", 2, 50, {1, "y"}, {kInfinity, "n at x"}, "", 2},
              {"ward", 0, 0, {}, {}, "a driver's words", 4}}}};
}

Json answer(const optim::Report& r) {
    const std::string text = to_json(r, "an-id");
    EXPECT_EQ(text.back(), '\n');
    return Json::parse(text);
}

TEST(Response, HasItsMembersInOrder) {
    const Json body = answer(report());
    EXPECT_THAT(keys(body), ElementsAre("id", "state", "version", "seed", "device", "dataset", "channels", "links"));
    EXPECT_THAT(keys(body["device"]), ElementsAre("name", "platform", "type", "precision"));
    EXPECT_THAT(keys(body["links"]), ElementsAre("self", "result", "plots"));
    const Json& channel = body["channels"][0];
    EXPECT_THAT(keys(channel), ElementsAre("name", "wavelength_nm", "samples", "loss", "noise", "fits", "failures"));
    const Json& fit = channel["fits"][0];
    EXPECT_THAT(keys(fit),
                ElementsAre("rank", "model", "lobes", "parameters", "loss", "relative_loss", "rmse", "log10_rmse",
                            "aicc", "bic", "held_out", "scans", "correlations", "search", "links"));
    EXPECT_THAT(keys(fit["parameters"]), ElementsAre("k_d", "n_1", "tau"));
    EXPECT_THAT(keys(fit["search"]), ElementsAre("starts", "agreed", "evaluations", "stop_reason", "time_s", "rivals"));
}

TEST(Response, SaysWhatTheReportSays) {
    const Json body = answer(report());
    EXPECT_EQ(body["id"], "an-id");
    EXPECT_EQ(body["state"], "succeeded");
    EXPECT_EQ(body["version"], version());
    EXPECT_EQ(body["seed"], 7);
    EXPECT_EQ(body["device"],
              Json::parse(R"({"name": "a device", "platform": "a platform", "type": "gpu", "precision": "double"})"));
    EXPECT_EQ(body["dataset"], Json::parse(R"({"name": "a surface", "unit": "1/sr"})"));
    const Json& fit = body["channels"][0]["fits"][0];
    EXPECT_EQ(fit["parameters"], Json::parse(R"({
        "k_d": {"value": 0.5, "std_error": 0.25, "interval_95": [0.25, 0.75], "unit": "1", "at_bound": false},
        "n_1": {"value": 30.0, "std_error": null, "interval_95": null, "unit": "1", "at_bound": true},
        "tau": {"value": 2.0, "std_error": null, "interval_95": null, "unit": "um", "at_bound": false, "fixed": true}})"));
    EXPECT_EQ(fit["scans"], Json::parse(R"([{"theta_i_deg": 15.0, "rmse": 0.1, "log10_rmse": 0.2}])"));
    EXPECT_EQ(fit["search"], Json::parse(R"({"starts": 16, "agreed": 15, "evaluations": 900,
        "stop_reason": "roundoff", "time_s": 0.5,
        "rivals": [{"loss": 0.5, "agreed": 3, "parameters": {"k_d": 0.25}}]})"));
    EXPECT_EQ(fit["held_out"], Json::parse(R"({"rmse": 0.5, "log10_rmse": null, "loss": 0.25,
        "angles": [{"theta_i_deg": 15.0, "rmse": 0.5, "log10_rmse": null}]})"));
    EXPECT_EQ(fit["correlations"], Json::parse(R"({"names": ["a", "b"], "matrix": [[1.0, 0.5], [0.5, 1.0]]})"));
    EXPECT_EQ(body["channels"][0]["noise"],
              Json::parse(R"({"relative": 0.25, "floor": 0.125, "uncertainty": 0.0625, "source": "estimated"})"));
    EXPECT_EQ(body["links"], Json::parse(R"({"self": "/v1/fits/an-id", "result": "/v1/fits/an-id/result", "plots": {
        "brdf": "/v1/fits/an-id/plots/brdf.svg", "residual": "/v1/fits/an-id/plots/residual.svg",
        "summary": "/v1/fits/an-id/plots/summary.svg"}})"));
}

TEST(Response, TellsPhysicsRequirementsAndCost) {
    optim::Report r = report();
    optim::Fit& fit = r.channels[0].fits[0];
    fit.albedo = {{15, 0.5, 1e-6}, {75, {}, kInfinity}};
    fit.physics = optim::Physics{false, {0, 80}, 1.5, 75, true, true};
    fit.constrained =
        optim::Constrained{{optim::Requirement::energy_conserving, optim::Requirement::nonnegative}, 0.0625};
    fit.cost = kernels::Cost{{}, 2.5, kernels::OperationCounts{"x", 1, 2, 3, 4, 5}};
    const Json json = answer(r)["channels"][0]["fits"][0];
    EXPECT_EQ(json["albedo"], Json::parse(R"([{"theta_i_deg": 15.0, "value": 0.5, "error": 1e-6},
        {"theta_i_deg": 75.0, "value": null, "error": null}])"));
    EXPECT_EQ(json["physics"], Json::parse(R"({"energy_conserving": false, "theta_i_deg": [0.0, 80.0],
        "max_albedo": 1.5, "at_theta_i_deg": 75.0,
        "reciprocal": true, "nonnegative": true})"));
    EXPECT_EQ(json["constrained"], Json::parse(R"({"require": ["energy_conserving", "nonnegative"],
        "loss_without": 0.0625, "loss_ratio": 2.0})"));
    EXPECT_EQ(json["cost"],
              Json::parse(R"({"single_ns": null, "double_ns": 2.5, "under_load": false, "operations": {"add": 1.0,
        "multiply": 2.0, "fma": 3.0, "divide": 4.0, "sqrt": 5.0}})"));
}

TEST(Response, TellsWhatLessWorkWouldHaveChanged) {
    optim::Report r = report();
    EXPECT_FALSE(answer(r)["channels"][0]["fits"][0].contains("ledger"));
    using optim::LessWork;
    r.channels[0].fits[0].ledger = {
        {LessWork::single_precision, 1.0, 900, 0.25, {}, optim::LedgerLine::Shift{"k_d", 0.5, 0.25}},
        {LessWork::draft, 1.5, 300, 0.125, 1, {}},
        {LessWork::stop_after_exchange, {}, 200, {}, {}, {}},
        {LessWork::standard, 1.0, 9, 0.125, {}, optim::LedgerLine::Shift{"n_1", {}, kInfinity}}};
    EXPECT_EQ(answer(r)["channels"][0]["fits"][0]["ledger"], Json::parse(R"([
        {"change": "precision single", "loss_ratio": 1.0, "evaluations": 900, "time_s": 0.25,
         "largest_shift": {"parameter": "k_d", "std_errors": 0.5, "relative": 0.25}},
        {"change": "effort draft", "loss_ratio": 1.5, "evaluations": 300, "time_s": 0.125, "lobes": 1},
        {"change": "stop after exchange", "loss_ratio": null, "evaluations": 200},
        {"change": "effort standard", "loss_ratio": 1.0, "evaluations": 9, "time_s": 0.125,
         "largest_shift": {"parameter": "n_1", "std_errors": null, "relative": null}}])"));
}

TEST(Response, TellsWhatEffortAndPrecisionBuy) {
    using kernels::Precision;
    optim::TradeBench bench;
    bench.seeds = 8;
    bench.cells = {{"a surface", "lafortune", optim::Effort::draft, optim::Arithmetic::single_alone, 8, 0.25, 0.5, 100,
                    0.125, 0.75, 0.875}};
    bench.shifts = {{"a surface", "ward", optim::Arithmetic::single_search, 7, "alpha", 0.5, 0.25},
                    {"a surface", "ward", optim::Arithmetic::single_alone, 0, "", {}, {}}};
    bench.series = {{"a surface", Precision::single_precision, "search", {}, 0.5, 2},
                    {"a surface", Precision::double_precision, "dial", 8, kInfinity, 3}};
    const Json json = Json::parse(to_json(report().device, bench));
    EXPECT_EQ(json["device"]["name"], "a device");
    EXPECT_EQ(json["seeds"], 8);
    EXPECT_EQ(json["cells"], Json::parse(R"([{"dataset": "a surface", "model": "lafortune", "effort": "draft",
        "precision": "single alone", "seeds": 8, "wall_s": 0.25, "cpu_s": 0.5, "evaluations": 100.0,
        "distance": 0.125, "worst_distance": 0.75, "success": 0.875
}])"));
    EXPECT_EQ(json["shifts"], Json::parse(R"([{"dataset": "a surface", "model": "ward", "precision": "single",
        "seeds": 7, "parameter": "alpha", "std_errors": 0.5, "relative": 0.25}, {"dataset": "a surface", "model": "ward",
        "precision": "single alone", "seeds": 0, "parameter": null, "std_errors": null, "relative": null}])"));
    EXPECT_EQ(json["series"], Json::parse(R"([{"dataset": "a surface", "precision": "single", "accuracy": "search",
        "log_epsilon": null, "error": 0.5, "ns": 2.0}, {"dataset": "a surface", "precision": "double",
        "accuracy": "dial", "log_epsilon": 8.0, "error": null, "ns": 3.0}])"));
}

TEST(Response, LeavesOutWhatDoesNotApply) {
    optim::Report r = report();
    optim::ChannelReport& channel = r.channels[0];
    channel.channel.wavelength_nm.reset();
    channel.fits[0].lobes = 0;
    const Json body = answer(r);
    EXPECT_FALSE(body["channels"][0].contains("wavelength_nm"));
    EXPECT_FALSE(body["channels"][0].contains("warnings"));
    for (const char* key : {"lobes", "scale", "warnings"}) EXPECT_FALSE(body["channels"][0]["fits"][0].contains(key));
    channel.fits[0].scale = 3;
    channel.fits[0].warnings = {"a"};
    channel.warnings = {"b"};
    const Json more = answer(r)["channels"][0];
    EXPECT_EQ(more["fits"][0]["scale"], 3.0);
    EXPECT_EQ(more["fits"][0]["warnings"], Json::array({"a"}));
    EXPECT_EQ(more["warnings"], Json::array({"b"}));
}

TEST(Response, SaysUnderWhichLoss) {
    optim::Report r = report();
    EXPECT_EQ(answer(r)["channels"][0]["loss"], Json::parse(R"({"name": "cosine_l2", "robust": "none"})"));
    EXPECT_FALSE(answer(r)["channels"][0]["fits"][0].contains("outliers"));
    r.loss = optim::Loss::cosine;
    r.loss.cos_theta_i_exponent = 0.5;
    r.loss.robust = optim::Robust::cauchy;
    r.channels[0].robust_scale = 0.25;
    std::vector<std::size_t> samples(150);
    std::iota(samples.begin(), samples.end(), std::size_t{3});
    r.channels[0].fits[0].outliers = optim::Outliers{samples, 0.5};
    const Json channel = answer(r)["channels"][0];
    EXPECT_EQ(channel["loss"], Json::parse(R"({"name": "cosine", "cos_theta_i_exponent": 0.5,
        "cos_theta_r_exponent": 1.0, "robust": "cauchy", "robust_threshold": 2.385, "robust_scale": 0.25})"));
    const Json outliers = channel["fits"][0]["outliers"];
    EXPECT_EQ(outliers["count"], 150);
    EXPECT_EQ(outliers["fraction"], 0.5);
    EXPECT_EQ(outliers["samples"].size(), 100U);
    EXPECT_EQ(outliers["samples"][0], 3);
}

TEST(Response, NeverWritesANumberThatIsNotFinite) {
    optim::Report r = report();
    optim::Fit& fit = r.channels[0].fits[0];
    fit.parameters[0].value = kNan;
    fit.parameters[0].std_error = kInfinity;
    fit.scale = -kInfinity;
    fit.loss = fit.relative_loss = fit.rmse = fit.bic = kNan;
    fit.log10_rmse.reset();
    fit.aicc = kInfinity;
    fit.scans = {{15, kNan, kInfinity}};
    fit.search.time_s = kNan;
    const Json body = answer(r)["channels"][0]["fits"][0];
    for (const char* key : {"scale", "loss", "relative_loss", "rmse", "log10_rmse", "aicc", "bic"})
        EXPECT_TRUE(body[key].is_null()) << key;
    EXPECT_TRUE(body["parameters"]["k_d"]["value"].is_null());
    EXPECT_TRUE(body["parameters"]["k_d"]["std_error"].is_null());
    EXPECT_TRUE(body["scans"][0]["rmse"].is_null());
    EXPECT_TRUE(body["scans"][0]["log10_rmse"].is_null());
    EXPECT_TRUE(body["search"]["time_s"].is_null());
}

TEST(Response, NamesTheChannelInLinksIfThereAreSeveral) {
    optim::Report r = report();
    EXPECT_EQ(answer(r)["channels"][0]["fits"][0]["links"]["plot"], "/v1/fits/an-id/plots/brdf.svg?models=lafortune");
    r.channels.push_back(r.channels[0]);
    EXPECT_EQ(answer(r)["channels"][1]["fits"][0]["links"]["plot"],
              "/v1/fits/an-id/plots/brdf.svg?models=lafortune&channel=gr%C3%BCn%20%26%201%2F2");
}

TEST(Response, HasFailedIfNoModelFits) {
    optim::Report r = report();
    r.channels[0].fits.clear();
    r.channels[0].failures = {{"ward", "a reason", "a driver's words"}};
    const std::string text = to_json(r, "an-id");
    const Json body = Json::parse(text);
    EXPECT_EQ(body["state"], "failed");
    EXPECT_EQ(body["channels"][0]["failures"], Json::parse(R"([{"model": "ward", "reason": "a reason"}])"));
    EXPECT_THAT(text, Not(HasSubstr("driver's")));
}

TEST(Response, ReplacesWhatIsNotUtf8) {
    optim::Report r = report();
    r.dataset = "a\xff";
    EXPECT_EQ(answer(r)["dataset"]["name"], "a\xEF\xBF\xBD");
}

TEST(Response, ListsTheModels) {
    const Json list = Json::parse(to_json(tests::catalogue()));
    ASSERT_EQ(list["models"].size(), tests::catalogue().families().size());
    for (std::size_t i = 0; i < list["models"].size(); ++i) {
        const kernels::Family& family = tests::catalogue().families()[i];
        EXPECT_EQ(list["models"][i]["name"], family.name);
        EXPECT_EQ(list["models"][i], Json::parse(to_json(family)));
        EXPECT_EQ(list["models"][i]["parameters"].size(), family.variants.back().parameters.size());
        EXPECT_EQ(list["models"][i].contains("options"), family.repeat.has_value());
    }
}

TEST(Response, SaysWhatTheServiceIs) {
    const Json body = Json::parse(service_json(report().device, self_tests(), 1024));
    EXPECT_THAT(keys(body), ElementsAre("name", "version", "device", "selftest", "limits", "links"));
    EXPECT_EQ(body["selftest"], Json::parse(to_json(self_tests())));
    EXPECT_EQ(body["limits"]["body_bytes"], 1024);
}

TEST(Response, SaysWhatTheSelfTestsFound) {
    EXPECT_EQ(Json::parse(to_json(self_tests())), Json::parse(R"({"largest_error_eps": 32.0, "precisions": [
        {"precision": "double", "form": "brief", "passed": true, "time_ms": 3.5, "models": [
            {"model": "ward", "points": 8, "value": {"eps": 2.5}, "slope": {"eps": 32.0}, "passed": true, "time_ms": 3.5},
            {"model": "mine", "points": 0, "time_ms": 0.0}]},
        {"precision": "single", "form": "whole", "passed": false,
         "reason": "the device failed the self-test in single precision (32 eps are allowed): lafortune (2) is off by inf eps, ward cannot be computed",
         "time_ms": 6.0, "models": [
            {"model": "lafortune", "lobes": 2, "points": 50, "value": {"eps": 1.0}, "slope": {"eps": null, "at": "n at x"},
             "passed": false, "time_ms": 2.0},
            {"model": "ward", "points": 0, "passed": false, "time_ms": 4.0}]}]})"));
    EXPECT_THAT(to_json(self_tests()), Not(HasSubstr("driver's")));
    const Json ready = Json::parse(ready_json(self_tests(), true));
    EXPECT_EQ(ready["status"], "ready");
    EXPECT_EQ(ready["selftest"], Json::parse(to_json(self_tests())));
    EXPECT_EQ(Json::parse(ready_json(self_tests(), false))["status"], "unfit");
}

TEST(Problem, HasTheMembersOfRfc9457) {
    const Json body = Json::parse(
        to_json(Problem{problem_type("invalid-request"), "x", {{"/a~1b", "c", "d", {}, {}}, {"", "e", "f", 3, 4}}},
                "/v1/fits", "r"));
    EXPECT_EQ(
        body,
        Json::parse(
            R"({"type": "/problems/invalid-request", "title": "Something in the request is refused", "status": 422,
        "detail": "x", "instance": "/v1/fits", "request_id": "r", "errors": [
        {"pointer": "/a~1b", "code": "c", "detail": "d"},
        {"pointer": "", "code": "e", "detail": "f", "line": 3, "column": 4}]})"));
    EXPECT_FALSE(Json::parse(to_json(Problem{problem_type("not-found"), "x", {}}, "/", "r")).contains("errors"));
}

TEST(Problem, SurvivesBytesThatAreNotUtf8) {
    EXPECT_NO_THROW((void)to_json(Problem{problem_type("not-found"), "\xff", {}}, "/\xfe", "r"));
}

TEST(Problem, EscapesPointers) {
    EXPECT_EQ(pointer_part("a/b~c"), "a~1b~0c");
    EXPECT_EQ(pointer_part(""), "");
}

}  // namespace
}  // namespace brdfit::api
