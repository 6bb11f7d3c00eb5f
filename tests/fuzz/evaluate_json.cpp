// POST /v1/evaluate: any bytes are a model with all its parameters in their domain and directions, or a refusal.

#include <cmath>

#include "api/evaluate.h"
#include "api/json.h"
#include "tests/fuzz/refusal.h"

using namespace brdfit;

namespace {

void check(const api::EvaluateRequest& request) {
    fuzz::require(request.model != nullptr, "a model");
    const std::size_t n = request.model->parameters.size();
    fuzz::require(request.parameters.size() == n && request.units.size() == n, "every parameter, and its unit");
    for (std::size_t i = 0; i < n; ++i) {
        const kernels::Parameter& p = request.model->parameters[i];
        const double value = request.parameters[i];
        fuzz::require(std::isfinite(value) && value >= p.domain_min && value <= p.domain_max, p.name);
        fuzz::require(std::isfinite(request.units[i]) && request.units[i] > 0, "unit of " + p.name);
    }
    fuzz::require(!request.directions.empty() && request.directions.size() <= api::kMostRows, "1 to 100000 rows");
    for (const kernels::Direction& d : request.directions)
        for (const kernels::GeometryColumn& column : kernels::geometry_columns())
            fuzz::require(std::isfinite(column.read(kernels::Angles(kernels::canonical(d)),
                                                    kernels::Precision::double_precision)),
                          std::string(column.name));
    kernels::Values values;
    values.f.assign(request.directions.size(), NAN);  // not finite: null
    values.by_parameter.assign(request.directions.size() * n, 1e308);
    (void)api::parse_json(api::to_json(request, values, kernels::Precision::double_precision));
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    const std::string_view text = fuzz::text_of(data, size);
    api::EvaluateRequest request;
    const auto problem = fuzz::refusal_of([&] { request = api::read_evaluate_request(text, fuzz::catalogue()); });
    if (!problem) {
        check(request);
        return 0;
    }
    fuzz::check_refusal(*problem, text);
    nlohmann::json document;
    if (!fuzz::refusal_of([&] { document = api::parse_json(text); })) fuzz::check_pointers(*problem, document);
    return 0;
}
