/// JSON Schema (2020-12) of single values, as OpenAPI 3.1 has it: for the tables that declare fields.
#pragma once

#include <cmath>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "api/samples.h"

namespace brdfit::api::schema {

using Json = nlohmann::ordered_json;  // members in the order people read them

inline Json text() { return {{"type", "string"}}; }
/// A text that read_text() takes.
inline Json name() { return {{"type", "string"}, {"maxLength", kLongestName}}; }
inline Json formatted(std::string_view format) { return {{"type", "string"}, {"format", format}}; }
/// One of these texts.
template <class Names>
Json one_of(const Names& names) {
    Json json = text();
    for (const auto& name : names) json["enum"].push_back(name);
    return json;
}
inline Json anything() { return Json::object(); }
inline Json boolean() { return {{"type", "boolean"}}; }
inline Json number() { return {{"type", "number"}}; }
/// A number that a rule lets pass.
inline Json number(const Rule& range) {
    Json json = number();
    if (std::isfinite(range.low)) json[range.low_open ? "exclusiveMinimum" : "minimum"] = range.low;
    if (std::isfinite(range.high)) json[range.high_open ? "exclusiveMaximum" : "maximum"] = range.high;
    return json;
}
inline Json whole(double least, double most) { return {{"type", "integer"}, {"minimum", least}, {"maximum", most}}; }
inline Json count() { return {{"type", "integer"}, {"minimum", 0}}; }
inline Json constant(Json value) { return {{"const", std::move(value)}}; }
inline Json array(Json items) { return {{"type", "array"}, {"items", std::move(items)}}; }
inline Json array(Json items, std::size_t least, std::size_t most) {
    Json json = array(std::move(items));
    json["minItems"] = least;
    json["maxItems"] = most;
    return json;
}
/// An object whose keys are names that a client or a model chose.
inline Json map_of(Json values) { return {{"type", "object"}, {"additionalProperties", std::move(values)}}; }
inline Json named(std::string_view component) { return {{"$ref", "#/components/schemas/" + std::string(component)}}; }
inline Json any_of(std::vector<Json> schemas) { return {{"anyOf", std::move(schemas)}}; }
inline Json or_null(Json schema) { return any_of({std::move(schema), {{"type", "null"}}}); }

/// One of the names of a table of choices (api/names.h), with what each means.
template <class Table>
Json choice(const Table& table) {
    Json json = text();
    std::string docs;
    for (const auto& entry : table) {
        json["enum"].push_back(entry.name);
        docs += (docs.empty() ? "" : "; ") + std::string(entry.name) + ": " + std::string(entry.doc);
    }
    json["description"] = docs;
    return json;
}

/// The schema with a meaning put before what it says of itself.
inline Json described(Json json, std::string_view doc) {
    const std::string own = json.value("description", "");
    json["description"] = std::string(doc) + (own.empty() ? "" : ". " + own);
    return json;
}
inline Json with_default(Json json, Json value) {
    json["default"] = std::move(value);
    return json;
}

/// A member of an answer; `required`: whether it is always there.
struct Member {
    std::string_view key;
    Json schema;
    std::string_view doc{};
    bool required = true;
};
/// An object of an answer: clients must expect more members than are told here.
inline Json object(std::vector<Member> members) {
    Json json{{"type", "object"}, {"properties", Json::object()}};
    Json required = Json::array();
    for (Member& member : members) {
        json["properties"][std::string(member.key)] =
            member.doc.empty() ? std::move(member.schema) : described(std::move(member.schema), member.doc);
        if (member.required) required.push_back(member.key);
    }
    if (!required.empty()) json["required"] = std::move(required);
    return json;
}

}  // namespace brdfit::api::schema
