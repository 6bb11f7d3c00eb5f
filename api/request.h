/// Requests as plain types.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "api/query.h"
#include "api/schema.h"
#include "kernels/model.h"
#include "optim/fit.h"

namespace brdfit::api {

struct FitRequest {
    optim::Dataset dataset;
    std::vector<optim::ModelRequest> models;
    optim::FitOptions options;

    bool operator==(const FitRequest&) const = default;
};

/// Bodies of stored datasets, by id; nullopt if there is none.
using DatasetSource = std::function<std::optional<std::string>(const std::string& id)>;

/// POST /v1/fits with application/json. Throws Refusal: 400 for what is not JSON, 422 with a pointer for each field
/// that is refused.
FitRequest read_fit_request(std::string_view body, const kernels::Catalogue& catalogue,
                            const DatasetSource& datasets = {});

/// POST /v1/fits with text/csv: the dataset in the body, everything else in the query: models (names, separated by
/// commas), unit, name, and the options by their names. Throws Refusal (422), with the line for each row refused.
FitRequest read_fit_request_csv(std::string_view body, const Query& query, const kernels::Catalogue& catalogue);

/// A request that is to become a job.
struct PostedFit {
    std::optional<kernels::Precision> precision;  ///< that it asks for
    /// The request as one text, whatever the order of its keys and its blanks: what a job keeps and read_job() reads.
    std::string text;
    std::optional<std::string> dataset;  ///< id of the stored dataset that it names
};
PostedFit read_posted_fit(std::string_view body, const kernels::Catalogue& catalogue, const DatasetSource& datasets);
PostedFit read_posted_fit_csv(std::string_view body, const Query& query, const kernels::Catalogue& catalogue);

/// What PostedFit::text says; `dataset`: the body of the stored dataset that it names, if it does. Throws Refusal.
FitRequest read_job(std::string_view text, std::string_view dataset, const kernels::Catalogue& catalogue);

/// POST /v1/datasets with application/json or text/csv (query: name, unit): each channel has samples. Throws Refusal.
optim::Dataset read_dataset(std::string_view body);
optim::Dataset read_dataset_csv(std::string_view body, const Query& query);

/// What all of these accept, for the published document.
schema::Json dataset_schema();
schema::Json fit_request_schema();
std::vector<QueryParameter> dataset_query();
std::vector<QueryParameter> fit_query();

}  // namespace brdfit::api
