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

/// Either of them as one text, for whoever fits it later: read_job() makes the same request of it. The request has been
/// read without a refusal.
std::string job_text(std::string_view json_body);
std::string job_text_csv(std::string_view csv_body, const Query& query);
/// `dataset`: the body of a stored dataset that the request refers to, or empty. Throws Refusal.
FitRequest read_job(std::string_view text, std::string_view dataset, const kernels::Catalogue& catalogue);

}  // namespace brdfit::api
