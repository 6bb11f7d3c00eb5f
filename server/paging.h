/// Lists in pages: the query's limit and cursor, and the link to the next page.
#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "api/field.h"
#include "api/query.h"
#include "server/message.h"
#include "server/store.h"

namespace brdfit::server {

inline constexpr api::Rule kPageLimit{1, false, 1000, false, "limit must be a whole number from 1 to 1000"};

/// Fields of a list's query; Query has a member `page`.
template <class Query>
api::Field<Query> page_limit_field() {
    return {"limit", false, "entries of a page",
            api::schema::with_default(api::schema::whole(kPageLimit.low, kPageLimit.high), PageRequest{}.limit),
            [](const nlohmann::json& v, const api::Place& p, Query& out) {
                const auto number = api::read_checked(v, p, kPageLimit);
                if (number && *number != std::floor(*number)) p.fail("out_of_range", std::string(kPageLimit.rule));
                else if (number) out.page.limit = static_cast<std::size_t>(*number);
            }};
}
template <class Query>
api::Field<Query> page_cursor_field() {
    return {"cursor", false, "next_cursor of the page before", api::schema::text(),
            [](const nlohmann::json& v, const api::Place& p, Query& out) { out.page.cursor = api::read_text(v, p); }};
}

/// Throws Refusal.
template <class Query>
Query read_list_query(const Request& request, const std::vector<api::Field<Query>>& fields) {
    std::vector<api::FieldError> errors;
    Query query;
    api::read_query<Query>(request.query, api::Place(errors, ""), fields, query);
    api::refuse_if_any(std::move(errors));
    // Cursors are digits, and what joins them.
    if (query.page.cursor &&
        (query.page.cursor->empty() || query.page.cursor->find_first_not_of("0123456789abcdef.-") != std::string::npos))
        throw api::Refusal({api::problem_type("invalid-cursor"), "the cursor is none of ours", {}});
    return query;
}

/// A page of the store's. Throws Refusal (invalid-cursor).
template <class List>
auto list_page(const List& list) {
    try {
        return list();
    } catch (const std::invalid_argument&) {
        throw api::Refusal({api::problem_type("invalid-cursor"), "the cursor is none of ours", {}});
    }
}

/// Link: the same list from the cursor on.
std::string next_link(const Request& request, const std::string& cursor);

}  // namespace brdfit::server
