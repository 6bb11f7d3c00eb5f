/// Requests: read as plain values, or refused with a pointer for each mistake.
#include "api/request.h"

#include <string>

#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "tests/support.h"
#include "tests/unit/refused.h"

namespace brdfit::api {
namespace {

using nlohmann::json;
using optim::Interval;
using optim::Sample;
using tests::catalogue;

/// A request with everything in it.
json whole() {
    return json::parse(R"({
      "dataset": {"name": "white plastic", "unit": "relative", "channels": [
        {"name": "green", "wavelength_nm": 550,
         "scans": [{"theta_i_deg": 15, "theta_r_deg": [-30, 0, 30], "brdf": [0.1, -0.2, 3], "sigma": [1, 2, 3]}],
         "samples": {"theta_i_deg": [5, 6], "phi_i_deg": [0, 10], "theta_r_deg": [30, 40], "phi_r_deg": [180, 70],
                     "brdf": [0.4, 0.5], "sigma": [4, 5]}},
        {"wavelength_nm": 650.5, "scans": [{"theta_i_deg": 0, "theta_r_deg": [1, 2, 3, 4], "brdf": [1, 2, 3, 4], "sigma": [1, 1, 1, 1]}]}]},
      "models": ["ward", {"name": "lafortune", "lobes": 1, "fixed": {"k_d": 0}, "bounds": {"n_1": [1, 500]}},
                 {"name": "lafortune", "lobes": "auto", "fixed": {"n_1": 2}}],
      "options": {"loss": "chi2", "effort": "thorough", "precision": "single", "seed": 9007199254740991, "time_limit_s": 2.5}
    })");
}

FitRequest read(const json& request) { return read_fit_request(request.dump(), catalogue()); }

/// Sets what stands at a pointer and expects the refusal's errors.
void expect_refused(const std::string& pointer, const json& value, const std::vector<std::string>& errors) {
    SCOPED_TRACE(pointer + " = " + value.dump().substr(0, 80));
    json request = whole();
    request[json::json_pointer(pointer)] = value;
    const Problem problem = refusal_of([&] { (void)read(request); });
    EXPECT_EQ(problem.type.status, 422);
    EXPECT_EQ(errors_of(problem), errors);
}
/// The same where the value itself is what is wrong.
void expect_code(const std::string& pointer, const json& value, const std::string& code) {
    expect_refused(pointer, value, {pointer + " " + code});
}

void expect_missing(const std::string& parent, const std::string& key, const std::string& error) {
    SCOPED_TRACE(parent + "/" + key);
    json request = whole();
    request[json::json_pointer(parent)].erase(key);
    EXPECT_EQ(errors_of(refusal_of([&] { (void)read(request); })), std::vector{error});
}

const std::string kChannel = "/dataset/channels/0";
const std::string kScan = kChannel + "/scans/0";
const std::string kSamples = kChannel + "/samples";

TEST(Request, ReadsEverything) {
    const kernels::Family* ward = catalogue().find("ward");
    const kernels::Family* lafortune = catalogue().find("lafortune");
    FitRequest expected;
    expected.dataset = {
        "white plastic",
        optim::Unit::relative,
        {{"green",
          550,
          {Sample{{5, 30, 0}, 0.4, 4}, Sample{{6, -40, 60}, 0.5, 5}, Sample{{15, -30, 0}, 0.1, 1},
           Sample{{15, 0, 0}, -0.2, 2}, Sample{{15, 30, 0}, 3, 3}}},
         {"650.5nm",
          650.5,
          {Sample{{0, 1, 0}, 1, 1}, Sample{{0, 2, 0}, 2, 1}, Sample{{0, 3, 0}, 3, 1}, Sample{{0, 4, 0}, 4, 1}}}}};
    expected.models = {{ward, {}, {}, {}},
                       {lafortune, 1, {{"k_d", 0}}, {{"n_1", Interval{1, 500}}}},
                       {lafortune, {}, {{"n_1", 2}}, {}}};
    expected.options = {optim::Loss::chi2, optim::Effort::thorough, kernels::Precision::single_precision,
                        9007199254740991U, std::chrono::duration<double>(2.5)};
    const FitRequest request = read(whole());
    EXPECT_EQ(request.dataset, expected.dataset);
    EXPECT_EQ(request.models, expected.models);
    EXPECT_EQ(request.options, expected.options);
}

TEST(Request, HasDefaults) {
    const FitRequest request = read(json::parse(
        R"({"dataset": {"channels": [{"scans": [{"theta_i_deg": 0, "theta_r_deg": [1], "brdf": [2]}]}]}})"));
    EXPECT_EQ(request.dataset, (optim::Dataset{"", optim::Unit::per_steradian, {{"1", {}, {{{0, 1, 0}, 2, {}}}}}}));
    EXPECT_EQ(request.options, optim::FitOptions{});
    ASSERT_EQ(request.models.size(), catalogue().families().size());
    for (std::size_t i = 0; i < request.models.size(); ++i)
        EXPECT_EQ(request.models[i], (optim::ModelRequest{&catalogue().families()[i], {}, {}, {}}));
}

TEST(Request, ReadsRequirementsAndWhetherToJudgeAndToKeepALedger) {
    json body = whole();
    body["options"]["require"] = {"nonnegative", "energy_conserving"};
    EXPECT_FALSE(read(body).options.ledger);
    body["options"]["judge"] = false;
    body["options"]["ledger"] = true;
    const FitRequest request = read(body);
    using optim::Requirement;
    EXPECT_EQ(request.options.require,
              (std::vector<Requirement>{Requirement::nonnegative, Requirement::energy_conserving}));
    EXPECT_FALSE(request.options.judge);
    EXPECT_TRUE(request.options.ledger);
}

TEST(Request, RefusesUnknownKeys) {
    for (const std::string& parent : {std::string(), std::string("/dataset"), kChannel, kScan, kSamples,
                                      std::string("/models/1"), std::string("/options")})
        expect_code(parent + "/nmae", 1, "unknown_key");
    expect_code("/models/1/fixed/n", 1, "unknown_parameter");
    expect_code("/models/1/bounds/n_2", {1, 2}, "unknown_parameter");
    expect_refused("/models/0", {{"name", "ward"}, {"lobes", 1}}, {"/models/0/lobes unknown_key"});
    expect_code("/models/0", "wart", "unknown_model");
    expect_code("/models/1/name", "wart", "unknown_model");
}

TEST(Request, NamesWhatWouldBeValid) {
    json request = whole();
    request["options"]["los"] = "l2";
    request["models"][0] = "wart";
    const Problem problem = refusal_of([&] { (void)read(request); });
    ASSERT_EQ(problem.errors.size(), 2U);
    EXPECT_NE(problem.errors[0].detail.find("lambert, phong, ward"), std::string::npos);
    EXPECT_NE(problem.errors[1].detail.find("robust_threshold, effort, precision, seed, time_limit_s"),
              std::string::npos);
}

TEST(Request, RefusesWhatIsMissing) {
    expect_missing("", "dataset", "/dataset missing");
    expect_missing("/dataset", "channels", "/dataset/channels missing");
    for (const char* key : {"theta_i_deg", "theta_r_deg", "brdf"}) {
        expect_missing(kScan, key, kScan + "/" + key + " missing");
        expect_missing(kSamples, key, kSamples + "/" + key + " missing");
    }
    expect_missing(kSamples, "phi_r_deg", kSamples + "/phi_r_deg missing");
    expect_missing("/models/1", "name", "/models/1/name missing");
    expect_code(kChannel, {{"name", "x"}}, "missing");
}

TEST(Request, RefusesWrongTypes) {
    for (const char* text : {"1", "[]", "null", "\"x\""}) {
        const Problem problem = refusal_of([&] { (void)read_fit_request(text, catalogue()); });
        EXPECT_EQ(problem.type.status, 422);
        EXPECT_EQ(problem.errors.at(0).code, "wrong_type");
    }
    const json null;
    for (const std::string& pointer : {std::string("/dataset"),
                                       std::string("/dataset/name"),
                                       std::string("/dataset/unit"),
                                       std::string("/dataset/channels"),
                                       kChannel,
                                       kChannel + "/name",
                                       kChannel + "/wavelength_nm",
                                       kChannel + "/scans",
                                       kScan,
                                       kScan + "/theta_i_deg",
                                       kScan + "/brdf/1",
                                       kSamples,
                                       kSamples + "/phi_i_deg/0",
                                       std::string("/models"),
                                       std::string("/models/0"),
                                       std::string("/models/1/fixed/k_d"),
                                       std::string("/models/1/bounds/n_1"),
                                       std::string("/options"),
                                       std::string("/options/loss"),
                                       std::string("/options/seed"),
                                       std::string("/options/time_limit_s")})
        expect_code(pointer, null, "wrong_type");
    expect_code("/models", json::array(), "wrong_type");
    expect_code("/models", json(std::vector<std::string>(51, "ward")), "wrong_type");
    expect_code("/dataset/channels", json::array(), "wrong_type");
    expect_code("/models/1/bounds/n_1", {1}, "wrong_type");
    expect_code("/models/1/bounds/n_1", {1, "2"}, "wrong_type");
    expect_code("/models/1/fixed", json::array(), "wrong_type");
    expect_code("/dataset", "an id", "unknown_dataset");
}

TEST(Request, RefusesValues) {
    expect_code("/dataset/unit", "sr", "unknown_value");
    expect_code("/options/loss", "l3", "unknown_value");
    expect_code("/options/robust", "tukey", "unknown_value");
    expect_code("/options/robust_threshold", 0.1, "out_of_range");
    expect_code("/options/cos_theta_r_exponent", 4.1, "out_of_range");
    expect_code("/options/effort", "", "unknown_value");
    expect_code("/options/precision", "half", "unknown_value");
    expect_code("/options/require", "reciprocal", "wrong_type");
    expect_refused("/options/require", {"reciprocal", "fast"}, {"/options/require/1 unknown_value"});
    expect_refused("/options/require", {"reciprocal", "reciprocal"}, {"/options/require/1 duplicate"});
    expect_code("/options/judge", 1, "wrong_type");
    expect_code("/options/ledger", "all", "wrong_type");
    expect_code("/dataset/name", std::string(201, 'x'), "too_long");
    // In wavelengths too large for a double, in either channel; and an interval that is.
    const std::string tau = "/models/2/fixed/tau out_of_range";
    expect_refused("/models/2", {{"name", "he_torrance"}, {"fixed", {{"tau", 1.7e308}}}}, {tau, tau});
    const std::string c_z = "/models/1/bounds/c_z_1 out_of_range";
    expect_refused("/models/1/bounds", {{"c_z_1", {-1e308, 1e308}}}, {c_z, c_z});
    for (const double seed : {-1.0, 0.5, 9007199254740992.0}) expect_code("/options/seed", seed, "out_of_range");
    for (const double limit : {0.0, -1.0, 3600.5}) expect_code("/options/time_limit_s", limit, "out_of_range");
    for (const json& lobes : {json(0), json(4), json(1.0), json("two"), json(true), json()})
        expect_code("/models/1/lobes", lobes, "out_of_range");
    for (const double angle : {-1.0, 90.0, 1e300}) {
        expect_code(kScan + "/theta_i_deg", angle, "out_of_range");
        expect_code(kSamples + "/theta_i_deg/1", angle, "out_of_range");
    }
    for (const double angle : {-90.0, 90.0}) expect_code(kScan + "/theta_r_deg/2", angle, "out_of_range");
    expect_code(kSamples + "/phi_r_deg/1", 360.5, "out_of_range");
    expect_code(kScan + "/brdf/0", -2e30, "out_of_range");
    for (const double sigma : {0.0, -1.0}) expect_code(kScan + "/sigma/1", sigma, "out_of_range");
    for (const double nm : {0.0, 2e7}) expect_code(kChannel + "/wavelength_nm", nm, "out_of_range");
}

TEST(Request, RefusesRaggedColumns) {
    for (const char* key : {"brdf", "sigma"}) expect_code(kScan + "/" + key, {1, 2}, "ragged");
    for (const char* key : {"theta_i_deg", "phi_i_deg", "phi_r_deg", "brdf", "sigma"})
        expect_code(kSamples + "/" + key, {1, 2, 3}, "ragged");
    expect_refused(kScan, {{"theta_i_deg", 1}, {"theta_r_deg", json::array()}, {"brdf", json::array()}},
                   {kScan + "/theta_r_deg empty"});
    expect_code(kChannel, {{"scans", json::array()}}, "empty");
}

TEST(Request, RefusesWhatDoesNotGoTogether) {
    // One negative angle, and the signs of all are meaningful.
    expect_refused(kSamples + "/theta_r_deg/0", -30,
                   {kSamples + "/theta_r_deg/0 contradiction", kSamples + "/theta_r_deg/1 contradiction"});
    expect_code("/dataset/channels/1/name", "green", "duplicate");
    expect_code("/models/1/bounds/n_1", {500, 1}, "out_of_range");
    expect_code("/models/1/bounds/n_1", {5, 5}, "out_of_range");
    expect_refused("/models/1/bounds/n_1", {-1, 5},
                   {"/models/1/bounds/n_1 out_of_range", "/models/1/bounds/n_1 out_of_range"});
    expect_refused("/models/1/fixed/k_d", -0.5,
                   {"/models/1/fixed/k_d out_of_range", "/models/1/fixed/k_d out_of_range"});
    expect_refused("/models/1/fixed/n_1", 5, {"/models/1/bounds/n_1 contradiction"});
    expect_missing(kScan, "sigma", "/options/loss needs_sigma");
    for (const char* key : {"cos_theta_i_exponent", "cos_theta_r_exponent", "robust_threshold"})  // beside chi2
        expect_code(std::string("/options/") + key, 2, "contradiction");
    expect_refused("/options", {{"loss", "cosine_l2"}, {"cos_theta_r_exponent", 1}},
                   {"/options/cos_theta_r_exponent contradiction"});
    expect_refused("/models/0", "he_torrance", {"/dataset/channels/1 too_few_samples"});
}

TEST(Request, TakesExponentsAndRobustForms) {
    json request = whole();
    request["options"] = {
        {"loss", "cosine"}, {"cos_theta_r_exponent", -1}, {"robust", "huber"}, {"robust_threshold", 2}};
    const optim::Criterion loss = read(request).options.loss;
    EXPECT_EQ(loss.kind, optim::Loss::cosine);
    EXPECT_EQ(loss.cos_theta_i_power(), 0);
    EXPECT_EQ(loss.cos_theta_r_power(), -1);
    EXPECT_EQ(loss.robust, optim::Robust::huber);
    EXPECT_EQ(loss.threshold(), 2);
    // At grazing angles a negative exponent would leave a sample alone.
    request["dataset"]["channels"][0]["scans"][0]["theta_r_deg"][0] = -89.5;
    EXPECT_EQ(errors_of(refusal_of([&] { (void)read(request); })),
              std::vector<std::string>{"/options/cos_theta_r_exponent out_of_range"});
    request["options"]["cos_theta_r_exponent"] = 1;
    EXPECT_NO_THROW((void)read(request));
}

TEST(Request, CountsSamplesAgainstFreeParameters) {
    json request = whole();
    request["models"] = {{{"name", "he_torrance"}, {"fixed", {{"k", 0}}}}};
    EXPECT_NO_THROW((void)read(request));
}

TEST(Request, TellsAllMistakesButNoMoreThanFifty) {
    json request = whole();
    request["models"] = json(std::vector<std::string>(49, "x"));
    for (std::size_t i = 1; i < 50; ++i) request["options"][std::string(i, 'y')] = 1;
    const Problem problem = refusal_of([&] { (void)read(request); });
    EXPECT_EQ(problem.errors.size(), kMostErrors);
    EXPECT_EQ(problem.errors.front().pointer, "/models/0");
    EXPECT_EQ(problem.errors.back().pointer, "/options/y");
}

TEST(Request, ReadsAScene) {
    json request = whole();
    request["scene"] = json::object();
    EXPECT_EQ(read(request).options.scene, optim::Scene{});
    request["scene"] = {{"theta_i_deg", {0, 60}},
                        {"theta_r_deg", {0, 70}},
                        {"outside_weight", 0.5},
                        {"tolerance_log10", 0.1},
                        {"max_ns_per_evaluation", 5}};
    EXPECT_EQ(read(request).options.scene, (optim::Scene{{0, 60}, {0, 70}, 0.5, 0.1, 5.0}));
}

TEST(Request, RefusesABadScene) {
    expect_refused("/scene", {{"theta_i", {0, 60}}}, {"/scene/theta_i unknown_key"});
    expect_code("/scene", 5, "wrong_type");
    expect_refused("/scene", {{"theta_i_deg", {60, 0}}}, {"/scene/theta_i_deg out_of_range"});
    expect_refused("/scene", {{"theta_i_deg", {-1, 60}}}, {"/scene/theta_i_deg/0 out_of_range"});
    expect_refused("/scene", {{"theta_i_deg", {0, 91}}}, {"/scene/theta_i_deg/1 out_of_range"});
    expect_refused("/scene", {{"theta_r_deg", {0}}}, {"/scene/theta_r_deg wrong_type"});
    for (const double weight : {-0.1, 1.0})
        expect_refused("/scene", {{"outside_weight", weight}}, {"/scene/outside_weight out_of_range"});
    for (const double tolerance : {0.0, -1.0, 11.0})
        expect_refused("/scene", {{"tolerance_log10", tolerance}}, {"/scene/tolerance_log10 out_of_range"});
    expect_refused("/scene", {{"max_ns_per_evaluation", 0}}, {"/scene/max_ns_per_evaluation out_of_range"});
    expect_refused("/scene", {{"theta_i_deg", {20, 90}}}, {"/scene empty", "/scene empty"});
}

TEST(Request, ReadsASimplerFormOfAModel) {
    json request = whole();
    request["models"] = {{{"name", "ward"}, {"submodel", "no diffuse term"}}};
    const kernels::Family* ward = catalogue().find("ward");
    EXPECT_EQ(read(request).models.front().submodel, ward->submodel("no diffuse term"));
    expect_refused("/models/0", {{"name", "ward"}, {"submodel", "real index"}}, {"/models/0/submodel unknown_value"});
    expect_refused("/models/0", {{"name", "lambert"}, {"submodel", "x"}}, {"/models/0/submodel unknown_value"});
    expect_refused("/models/0", {{"name", "ward"}, {"submodel", "no diffuse term"}, {"fixed", {{"rho_d", 0.1}}}},
                   {"/models/0/fixed/rho_d contradiction"});
    expect_refused("/models/0", {{"name", "ward"}, {"submodel", "no diffuse term"}, {"bounds", {{"rho_d", {0, 1}}}}},
                   {"/models/0/bounds/rho_d contradiction"});
}

TEST(Request, RefusesWhatIsNotJson) {
    EXPECT_EQ(refusal_of([] { (void)read_fit_request("{", catalogue()); }).type.status, 400);
}

// ---- CSV with its query ----

const std::string kCsv = "theta_i_deg,theta_r_deg,brdf_per_sr,sigma\n1,2,3,1\n1,3,3,1\n1,4,3,1\n";

TEST(CsvRequest, ReadsTheQuery) {
    const FitRequest request = read_fit_request_csv(kCsv,
                                                    {{"models", "ward,lambert"},
                                                     {"name", "12"},
                                                     {"unit", "relative"},
                                                     {"loss", "chi2"},
                                                     {"effort", "draft"},
                                                     {"precision", "double"},
                                                     {"seed", "7"},
                                                     {"time_limit_s", "1.5"},
                                                     {"judge", "false"},
                                                     {"rank_by", "bic"}},
                                                    catalogue());
    EXPECT_EQ(request.dataset.name, "12");
    EXPECT_EQ(request.dataset.unit, optim::Unit::relative);
    ASSERT_EQ(request.models.size(), 2U);
    EXPECT_EQ(request.models[0], (optim::ModelRequest{catalogue().find("ward"), {}, {}, {}}));
    EXPECT_EQ(request.options, (optim::FitOptions{optim::Loss::chi2,
                                                  optim::Effort::draft,
                                                  kernels::Precision::double_precision,
                                                  7,
                                                  std::chrono::duration<double>(1.5),
                                                  {},
                                                  false,
                                                  optim::RankBy::bic}));
}

TEST(CsvRequest, EqualsTheSameRequestInJson) {
    EXPECT_EQ(read_fit_request_csv(kCsv, {{"models", "ward"}, {"name", "x"}}, catalogue()),
              read(json::parse(R"({"dataset": {"name": "x", "channels": [{"scans": [{"theta_i_deg": 1,
                  "theta_r_deg": [2, 3, 4], "brdf": [3, 3, 3], "sigma": [1, 1, 1]}]}]}, "models": ["ward"]})")));
}

TEST(CsvRequest, ReadsAScene) {
    const FitRequest request = read_fit_request_csv(
        kCsv, {{"models", "lambert"}, {"scene.theta_r_deg", "2,3"}, {"scene.tolerance_log10", "0.1"}}, catalogue());
    EXPECT_EQ(request.options.scene, (optim::Scene{{0, 90}, {2, 3}, 0, 0.1, {}}));
}

TEST(CsvRequest, RefusesTheQuery) {
    const auto errors = [](const Query& query) {
        return errors_of(refusal_of([&] { (void)read_fit_request_csv(kCsv, query, catalogue()); }));
    };
    using Errors = std::vector<std::string>;
    EXPECT_EQ(errors({{"model", "ward"}}), Errors{"/model unknown_key"});
    EXPECT_EQ(errors({{"models", "ward,,wart"}}), (Errors{"/models/1 unknown_model", "/models/2 unknown_model"}));
    EXPECT_EQ(errors({{"unit", "sr"}}), Errors{"/unit unknown_value"});
    EXPECT_EQ(errors({{"seed", "x"}}), Errors{"/options/seed wrong_type"});
    EXPECT_EQ(errors({{"scene.theta", "1"}}), Errors{"/scene.theta unknown_key"});
    EXPECT_EQ(errors({{"scene.theta_i_deg", "0,x"}}), Errors{"/scene.theta_i_deg/1 wrong_type"});
    EXPECT_EQ(errors({{"seed", "1e999"}}), Errors{"/options/seed wrong_type"});
    EXPECT_EQ(errors({{"time_limit_s", "nan"}}), Errors{"/options/time_limit_s wrong_type"});
    EXPECT_EQ(errors({{"models", "he_torrance"}}), Errors{"/dataset/channels/0 too_few_samples"});
    EXPECT_EQ(errors({{"judge", "1"}}), Errors{"/options/judge wrong_type"});
    EXPECT_EQ(errors({{"rank_by", "luck"}}), Errors{"/options/rank_by unknown_value"});
    EXPECT_EQ(errors({{"models", "ward"}, {"rank_by", "held_out"}, {"judge", "false"}}),
              Errors{"/options/rank_by contradiction"});
    EXPECT_EQ(errors({{"seed", "1"}, {"seed", "2"}}).front(), "/seed duplicate_key");
}

}  // namespace
}  // namespace brdfit::api
