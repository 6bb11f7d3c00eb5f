#include "api/listing.h"

#include <algorithm>
#include <cmath>

#include "api/field.h"
#include "api/response.h"

namespace brdfit::api {
namespace {

using nlohmann::json;

constexpr Rule kLimit{1, false, 1000, false, "limit must be a whole number from 1 to 1000"};

const std::vector<Field<ListQuery>> kPageFields{
    {"limit", false, "entries of a page",
     schema::with_default(schema::whole(kLimit.low, kLimit.high), ListQuery{}.limit),
     [](const json& v, const Place& p, ListQuery& out) {
         const auto number = read_checked(v, p, kLimit);
         if (number && *number != std::floor(*number)) p.fail("out_of_range", std::string(kLimit.rule));
         else if (number) out.limit = static_cast<std::size_t>(*number);
     }},
    {"cursor", false, "next_cursor of the page before", schema::text(),
     [](const json& v, const Place& p, ListQuery& out) { out.cursor = read_text(v, p); }},
};

const std::vector<Field<ListQuery>> kFitListFields = [] {
    std::vector<Field<ListQuery>> fields{
        {"state", false, "only fits in this state", schema::one_of(kFitStates),
         [](const json& v, const Place& p, ListQuery& out) {
             out.state = read_text(v, p);
             if (!out.state || std::find(kFitStates.begin(), kFitStates.end(), *out.state) != kFitStates.end()) return;
             std::string names;
             for (const std::string_view state : kFitStates) names += (names.empty() ? "" : ", ") + std::string(state);
             p.fail("unknown_value", "must be one of: " + names);
         }},
        {"dataset", false, "only fits of this stored dataset", schema::name(),
         [](const json& v, const Place& p, ListQuery& out) { out.dataset = read_text(v, p); }}};
    fields.insert(fields.end(), kPageFields.begin(), kPageFields.end());
    return fields;
}();

ListQuery read(const Query& query, std::span<const Field<ListQuery>> fields) {
    std::vector<FieldError> errors;
    ListQuery list;
    read_query<ListQuery>(query, Place(errors, ""), fields, list);
    refuse_if_any(std::move(errors));
    if (list.cursor &&
        (list.cursor->empty() || list.cursor->find_first_not_of("0123456789abcdef.-") != std::string::npos))
        throw Refusal({problem_type("invalid-cursor"), "the cursor is none of ours", {}});
    return list;
}

}  // namespace

ListQuery read_fit_list(const Query& query) { return read(query, kFitListFields); }
ListQuery read_dataset_list(const Query& query) { return read(query, kPageFields); }
std::vector<QueryParameter> fit_list_query() { return parameters_of(kFitListFields); }
std::vector<QueryParameter> dataset_list_query() { return parameters_of(kPageFields); }

std::string next_link(const std::string& path, const Query& query, const std::string& cursor) {
    std::string url = path + "?cursor=" + url_encoded(cursor);
    for (const auto& [key, value] : query)
        if (key != "cursor") url += "&" + url_encoded(key) + "=" + url_encoded(value);
    return "<" + url + ">; rel=\"next\"";
}

}  // namespace brdfit::api
