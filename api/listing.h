/// Lists in pages: what their queries ask for.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "api/query.h"

namespace brdfit::api {

struct ListQuery {
    std::optional<std::string> state{};    ///< of fits: one of kFitStates
    std::optional<std::string> dataset{};  ///< of fits: id of the stored one
    std::size_t limit = 50;                ///< entries of a page, 1..1000
    std::optional<std::string> cursor{};   ///< digits, and what joins them
};

/// The query of a list of fits, or of datasets. Throws Refusal (invalid-request, invalid-cursor).
ListQuery read_fit_list(const Query& query);
ListQuery read_dataset_list(const Query& query);
std::vector<QueryParameter> fit_list_query();
std::vector<QueryParameter> dataset_list_query();

/// Link: the same list from the cursor on.
std::string next_link(const std::string& path, const Query& query, const std::string& cursor);

}  // namespace brdfit::api
