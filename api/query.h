/// Queries of a URL, read by the same tables of fields as JSON.
#pragma once

#include <map>
#include <span>
#include <string>
#include <vector>

#include "api/field.h"

namespace brdfit::api {

using Query = std::multimap<std::string, std::string>;

/// A query parameter, for the published document.
struct QueryParameter {
    std::string_view key;
    std::string_view doc;
    schema::Json schema;
};

/// A parameter's text as the JSON its schema asks for: an array is separated by commas; where a number is asked for, a
/// text that is none stays a text, and is refused as such.
nlohmann::json query_value(const std::string& text, const schema::Json& schema);

/// Reads a query by a table of fields; unknown and repeated parameters are errors.
template <class T>
void read_query(const Query& query, const Place& place, std::span<const Field<T>> fields, T& out) {
    nlohmann::json object = nlohmann::json::object();
    for (const auto& [key, value] : query) {
        if (query.count(key) > 1) {
            if (!object.contains(key)) place.at(key).fail("duplicate_key", "the query parameter stands twice");
            object[key] = nullptr;
            continue;
        }
        const auto is_key = [&name = key](const Field<T>& field) { return field.key == name; };
        const auto field = std::find_if(fields.begin(), fields.end(), is_key);
        object[key] = field == fields.end() ? nlohmann::json(value) : query_value(value, field->schema);
    }
    for (auto it = object.begin(); it != object.end();) it = it->is_null() ? object.erase(it) : std::next(it);
    read_object<T>(object, place, fields, out);
}

template <class T>
std::vector<QueryParameter> parameters_of(const std::vector<Field<T>>& fields) {
    std::vector<QueryParameter> parameters;
    for (const Field<T>& field : fields) parameters.push_back({field.key, field.doc, field.schema});
    return parameters;
}

}  // namespace brdfit::api
