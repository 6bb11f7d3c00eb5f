/// Jobs and datasets that are kept, as JSON; results as CSV. Texts that the store kept are spliced in, not trusted:
/// what is no JSON object counts as absent.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "api/problem.h"
#include "optim/dataset.h"

namespace brdfit::api {

/// A fit that has been taken. Times are RFC 3339.
struct FitStatus {
    std::string id;
    std::string_view state;
    bool done = false;
    std::optional<std::string> dataset{};
    std::optional<std::size_t> queue_position{};
    unsigned attempt = 0;
    std::string progress{};  ///< JSON, or empty
    std::string error{};     ///< JSON of a problem, or empty
    std::string created{};
    std::optional<std::string> started{};
    std::optional<std::string> ended{};
};
std::string to_json(const FitStatus& status);
/// A page of a list; `next`: cursor of the next one.
std::string page_json(std::span<const FitStatus> items, const std::optional<std::string>& next);

/// The problem that a job's error tells, as the answer to a request; the internal one if it tells none.
struct FailedFit {
    int status = 500;
    std::string body;
};
FailedFit failed_fit(std::string_view error, const std::string& instance, const std::string& request_id);

/// Data of a server-sent event: `body` is the state's name, or JSON.
std::string event_json(std::string_view kind, std::string_view body, const std::string& at);

/// The ranked fits of a result (its JSON) as text/csv: a row for each parameter of each fit.
std::string result_csv(std::string_view result);

/// What a dataset holds, as JSON: the answer of its validation, and what lists show. Each channel has samples.
std::string summary_json(const optim::Dataset& dataset);

struct StoredDataset {
    std::string id;
    std::string summary;  ///< of summary_json()
    std::size_t bytes = 0;
    std::string created{};
};
std::string to_json(const StoredDataset& dataset);
/// With the measurements: `body` is JSON.
std::string to_json(const StoredDataset& dataset, std::string_view body);
std::string page_json(std::span<const StoredDataset> items, const std::optional<std::string>& next);

}  // namespace brdfit::api
