/// POST /v1/evaluate: a model's values and slopes at given parameters and directions.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "api/schema.h"
#include "kernels/engine.h"
#include "kernels/evaluator.h"
#include "kernels/geometry.h"
#include "kernels/model.h"

namespace brdfit::api {

inline constexpr std::size_t kMostRows = 100'000;  ///< of a request

struct EvaluateRequest {
    const kernels::Model* model = nullptr;
    std::vector<double> parameters;  ///< in the model's units, in its order
    std::vector<double> units;       ///< what one unit on the wire is in the model's unit, for each parameter
    std::vector<kernels::Direction> directions;
    std::optional<kernels::Precision> precision{};  ///< none: the best the device has
    bool gradient = false;
};

/// Throws Refusal, as read_fit_request does. Every parameter of the model must be given, within its domain; a model
/// with lobes has as many as `lobes` says, or as the parameters name.
EvaluateRequest read_evaluate_request(std::string_view body, const kernels::Catalogue& catalogue);

schema::Json evaluate_request_schema();

/// { "values": [...], "gradient": { name: [...] } } with 17 significant digits, 9 in single precision: enough to give
/// back the same bits. Slopes are by the parameters as they are on the wire.
std::string to_json(const EvaluateRequest& request, const kernels::Values& values, kernels::Precision precision);

}  // namespace brdfit::api
