/// POST /v1/evaluate: requests read and refused, values that give back the same bits.
#include "api/evaluate.h"

#include <cmath>
#include <string>

#include <gtest/gtest.h>
#include <nlohmann/json.hpp>

#include "tests/support.h"
#include "tests/unit/refused.h"

namespace brdfit::api {
namespace {

using nlohmann::json;
using tests::catalogue;

json whole() {
    return json::parse(R"({"model": "he_torrance", "wavelength_nm": 500, "precision": "double", "gradient": true,
      "parameters": {"sigma": 0.25, "tau": 2.5, "n": 1.5, "k": 0.25, "rho_ud": 0.5},
      "geometry": {"theta_i_deg": [30, 45], "theta_r_deg": [-20, 89.5], "phi_deg": [0, 10]}})");
}

EvaluateRequest read(const json& request) { return read_evaluate_request(request.dump(), catalogue()); }

std::vector<std::string> refused(const std::string& pointer, const json& value) {
    json request = whole();
    request[json::json_pointer(pointer)] = value;
    return errors_of(refusal_of([&] { (void)read(request); }));
}

TEST(Evaluate, ReadsLengthsInWavelengthsAndDirections) {
    const EvaluateRequest request = read(whole());
    EXPECT_EQ(request.model->name, "he_torrance");
    EXPECT_EQ(request.parameters, (std::vector<double>{0.5, 5, 1.5, 0.25, 0.5}));
    EXPECT_EQ(request.directions, (std::vector<kernels::Direction>{{30, -20, 0}, {45, 89.5, 10}}));
    EXPECT_EQ(request.precision, kernels::Precision::double_precision);
    EXPECT_TRUE(request.gradient);
}

TEST(Evaluate, TakesTheLobesThatTheParametersName) {
    const json two = json::parse(R"({"model": "lafortune", "geometry": {"theta_i_deg": [1], "theta_r_deg": [2]},
      "parameters": {"k_d": 0, "c_xy_1": -1, "c_z_1": 1, "n_1": 9, "c_xy_2": -1, "c_z_2": 1, "n_2": 3}})");
    EXPECT_EQ(read(two).model->repeats, 2U);
    json one = two;
    one["lobes"] = 1;
    EXPECT_EQ(errors_of(refusal_of([&] { (void)read(one); })).size(), 3U) << "the second lobe's parameters are unknown";
}

TEST(Evaluate, RefusesWithAPointer) {
    using Errors = std::vector<std::string>;
    EXPECT_EQ(refused("/model", "blinn"), Errors{"/model unknown_model"});
    EXPECT_EQ(refused("/model", ""), Errors{"/model unknown_model"});
    EXPECT_EQ(refused("/parameters/tau", 1.7e308), Errors{"/parameters/tau out_of_range"}) << "infinite in wavelengths";
    EXPECT_EQ(refused("/parameters/m", 1), Errors{"/parameters/m unknown_parameter"});
    EXPECT_EQ(refused("/parameters/k", -1), Errors{"/parameters/k out_of_range"});
    EXPECT_EQ(refused("/parameters/k", "1"), Errors{"/parameters/k wrong_type"});
    EXPECT_EQ(refused("/geometry/phi_deg", json::array({1})), Errors{"/geometry/phi_deg ragged"});
    EXPECT_EQ(refused("/geometry/theta_r_deg", json::array({1, 90})), Errors{"/geometry/theta_r_deg/1 out_of_range"});
    EXPECT_EQ(refused("/geometry/theta_r_deg", 1), Errors{"/geometry/theta_r_deg wrong_type"});
    EXPECT_EQ(refused("/gradient", 1), Errors{"/gradient wrong_type"});
    EXPECT_EQ(refused("/precision", "half"), Errors{"/precision unknown_value"});
    EXPECT_EQ(refused("/lobes", 2), Errors{"/lobes unknown_key"});
    json request = whole();
    request["parameters"].erase("tau");
    EXPECT_EQ(errors_of(refusal_of([&] { (void)read(request); })), Errors{"/parameters/tau missing"});
}

TEST(Evaluate, NamesTheDomainInTheUnitOfTheRequest) {
    json request = whole();
    request["parameters"]["tau"] = -1;
    EXPECT_EQ(refusal_of([&] { (void)read(request); }).errors.at(0).detail, "the model is defined from 0 to 500000 um");
}

TEST(Evaluate, RefusesMoreRowsThanTheLimit) {
    json request = whole();
    request["geometry"] = {{"theta_i_deg", std::vector<double>(kMostRows + 1, 10.0)},
                           {"theta_r_deg", std::vector<double>(kMostRows + 1, 10.0)}};
    EXPECT_EQ(errors_of(refusal_of([&] { (void)read(request); })),
              (std::vector<std::string>{"/geometry/theta_i_deg too_many", "/geometry/theta_r_deg too_many"}));
    request["geometry"]["theta_i_deg"] = {10.0};
    EXPECT_EQ(errors_of(refusal_of([&] { (void)read(request); })),
              std::vector<std::string>{"/geometry/theta_r_deg too_many"});
}

TEST(Evaluate, NumbersGiveBackTheSameBits) {
    const EvaluateRequest request = read(whole());
    for (const auto precision : {kernels::Precision::double_precision, kernels::Precision::single_precision}) {
        const kernels::Values values =
            kernels::evaluate(tests::engine(), *request.model, precision, request.parameters, request.directions, true);
        const json answer = json::parse(to_json(request, values, precision));
        for (std::size_t j = 0; j < 2; ++j) {
            const double read_back = answer["values"][j].get<double>();
            if (precision == kernels::Precision::double_precision) EXPECT_EQ(read_back, values.f[j]);
            else EXPECT_EQ(static_cast<float>(read_back), static_cast<float>(values.f[j]));
        }
        // By the wire's unit: d/d(sigma in um) = 2 d/d(sigma in wavelengths) at 500 nm.
        EXPECT_NEAR(answer["gradient"]["sigma"][0].get<double>(), 2 * values.by_parameter[0],
                    1e-6 * std::abs(values.by_parameter[0]));
    }
}

}  // namespace
}  // namespace brdfit::api
