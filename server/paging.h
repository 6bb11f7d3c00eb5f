/// Pages of the store's lists.
#pragma once

#include <stdexcept>

#include "api/listing.h"
#include "api/problem.h"
#include "server/store.h"

namespace brdfit::server {

inline PageRequest page_of(const api::ListQuery& query) { return {query.limit, query.cursor}; }

/// A page of the store's. Throws Refusal (invalid-cursor).
template <class List>
auto list_page(const List& list) {
    try {
        return list();
    } catch (const std::invalid_argument&) {
        throw api::Refusal({api::problem_type("invalid-cursor"), "the cursor is none of ours", {}});
    }
}

}  // namespace brdfit::server
