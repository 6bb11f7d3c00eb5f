/// Requests as plain types.
#pragma once

#include <functional>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/model.h"
#include "optim/fit.h"

namespace brdfit::api {

struct FitRequest {
    optim::Dataset dataset;
    std::vector<optim::ModelRequest> models;
    optim::FitOptions options;

    bool operator==(const FitRequest&) const = default;
};

/// Query parameters of a request whose body is not JSON.
using Query = std::multimap<std::string, std::string>;

/// POST /v1/fits with application/json. Throws Refusal: 400 for what is not JSON, 422 with a pointer for each field
/// that is refused.
FitRequest read_fit_request(std::string_view body, const kernels::Catalogue& catalogue);

/// POST /v1/fits with text/csv: the dataset in the body, everything else in the query: models (names, separated by
/// commas), unit, name, and the options by their names. Throws Refusal (422), with the line for each row refused.
FitRequest read_fit_request_csv(std::string_view body, const Query& query, const kernels::Catalogue& catalogue);

}  // namespace brdfit::api
