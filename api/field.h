/// A request field is declared once: its key, whether it must be there, what it means, what it may hold, how it is
/// read. Reading, the error texts, the list of valid names and the schema that is published follow from the same row.
#pragma once

#include <algorithm>
#include <cstddef>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "api/names.h"
#include "api/problem.h"
#include "api/samples.h"
#include "api/schema.h"
#include "kernels/model.h"

namespace brdfit::api {

/// Where in a request a value stands, and the errors found so far.
class Place {
public:
    Place(std::vector<FieldError>& errors, std::string pointer) : errors_(errors), pointer_(std::move(pointer)) {}

    [[nodiscard]] Place at(std::string_view key) const { return {errors_, pointer_ + "/" + pointer_part(key)}; }
    [[nodiscard]] Place at(std::size_t index) const { return at(std::to_string(index)); }
    [[nodiscard]] Place within(const std::string& parent) const { return {errors_, parent + pointer_}; }
    void fail(std::string code, std::string detail) const {
        if (errors_.size() < kMostErrors) errors_.push_back({pointer_, std::move(code), std::move(detail), {}, {}});
    }
    /// Whether no further error would be kept: what is left need not be read.
    [[nodiscard]] bool is_full() const { return errors_.size() >= kMostErrors; }
    [[nodiscard]] const std::string& pointer() const { return pointer_; }

private:
    std::vector<FieldError>& errors_;
    std::string pointer_;
};

template <class T>
struct Field {
    std::string_view key;
    bool required;
    std::string_view doc;
    schema::Json schema;  ///< without the doc
    std::function<void(const nlohmann::json&, const Place&, T&)> read;
};

/// The schema of an object that read_object() reads.
template <class T>
schema::Json schema_of(const std::vector<Field<T>>& fields) {
    schema::Json json{{"type", "object"}, {"properties", schema::Json::object()}};
    for (const Field<T>& field : fields) {
        json["properties"][std::string(field.key)] = schema::described(field.schema, field.doc);
        if (field.required) json["required"].push_back(field.key);
    }
    json["additionalProperties"] = false;
    return json;
}

/// Reads an object by its table of fields; unknown keys and missing required ones are errors.
template <class T>
void read_object(const nlohmann::json& value, const Place& place, std::span<const Field<T>> fields, T& out) {
    if (!value.is_object()) {
        place.fail("wrong_type", "must be an object");
        return;
    }
    const auto names = [&] {
        std::string text;
        for (const Field<T>& field : fields) text += (text.empty() ? "" : ", ") + std::string(field.key);
        return text;
    };
    for (const auto& [key, member] : value.items()) {
        if (place.is_full()) return;
        const auto field =
            std::find_if(fields.begin(), fields.end(), [&name = key](const auto& f) { return f.key == name; });
        if (field == fields.end()) place.at(key).fail("unknown_key", "unknown key; valid are: " + names());
        else field->read(member, place.at(key), out);
    }
    for (const Field<T>& field : fields)
        if (field.required && !value.contains(field.key))
            place.at(field.key).fail("missing", "must be given: " + std::string(field.doc));
}

/// Readers of single values: nullopt after an error.
inline std::optional<double> read_number(const nlohmann::json& value, const Place& place) {
    if (!value.is_number()) {
        place.fail("wrong_type", "must be a number");
        return std::nullopt;
    }
    return value.get<double>();
}

inline std::optional<bool> read_flag(const nlohmann::json& value, const Place& place) {
    if (value.is_boolean()) return value.get<bool>();
    place.fail("wrong_type", "must be true or false");
    return std::nullopt;
}

inline std::optional<std::string> read_text(const nlohmann::json& value, const Place& place,
                                            std::size_t longest = kLongestName) {
    if (!value.is_string()) {
        place.fail("wrong_type", "must be a string");
        return std::nullopt;
    }
    std::string text = value.get<std::string>();
    if (text.size() > longest) {
        place.fail("too_long", "at most " + std::to_string(longest) + " bytes");
        return std::nullopt;
    }
    if (!is_utf8(text)) {
        place.fail("not_utf8", "the text is not UTF-8");
        return std::nullopt;
    }
    return text;
}

template <class Table>
auto read_choice(const nlohmann::json& value, const Place& place, const Table& table)
    -> decltype(choice_of(table, "")) {
    const auto text = read_text(value, place);
    if (!text) return std::nullopt;
    const auto choice = choice_of(table, *text);
    if (!choice) place.fail("unknown_value", "must be one of: " + names_of(table));
    return choice;
}

inline bool is_auto(const nlohmann::json& value) {
    return value.is_string() && value.get_ref<const std::string&>() == "auto";
}

/// None for "auto", and after an error.
inline std::optional<kernels::Precision> read_precision(const nlohmann::json& value, const Place& place) {
    if (is_auto(value)) return std::nullopt;
    if (value.is_string() && !choice_of(kPrecisions, value.get_ref<const std::string&>())) {
        place.fail("unknown_value", "must be one of: auto, " + names_of(kPrecisions));
        return std::nullopt;
    }
    return read_choice(value, place, kPrecisions);
}

inline schema::Json precision_schema() {
    schema::Json json = schema::choice(kPrecisions);
    json["enum"].insert(json["enum"].begin(), "auto");
    json["description"] = "auto: the best the device has; " + json["description"].get<std::string>();
    json["default"] = "auto";
    return json;
}

/// The number of lobes, if the model has lobes and that many.
inline std::optional<std::size_t> read_lobes(const nlohmann::json& value, const Place& place,
                                             const kernels::Family& family) {
    if (!family.repeat) {
        place.fail("unknown_key", "the model " + family.name + " has no lobes to choose");
        return std::nullopt;
    }
    const auto least = static_cast<double>(family.repeat->min);
    const auto most = static_cast<double>(family.repeat->max);
    if (!value.is_number_integer() || value.get<double>() < least || value.get<double>() > most) {
        place.fail("out_of_range", "must be a whole number from " + std::to_string(family.repeat->min) + " to " +
                                       std::to_string(family.repeat->max) + ", or \"auto\" in a fit");
        return std::nullopt;
    }
    return value.get<std::size_t>();
}

/// Refuses a name that is no parameter of the model; false then.
inline bool is_parameter(const Place& place, const kernels::Model& model, const std::string& name) {
    if (model.find(name)) return true;
    std::string names;
    for (const kernels::Parameter& p : model.parameters) names += (names.empty() ? "" : ", ") + p.name;
    place.at(name).fail("unknown_parameter", "the model has no such parameter; it has: " + names);
    return false;
}

/// Whether a column is as long as theta_r_deg.
inline bool same_length(const Place& place, std::string_view key, std::size_t length, std::size_t expected) {
    if (length == expected) return true;
    place.at(key).fail("ragged",
                       "has " + std::to_string(length) + " elements where theta_r_deg has " + std::to_string(expected));
    return false;
}

/// Throws Refusal (422) with these errors, if there are any.
inline void refuse_if_any(std::vector<FieldError> errors) {
    if (!errors.empty()) throw invalid_fields(std::move(errors));
}

inline std::optional<double> read_checked(const nlohmann::json& value, const Place& place, const Rule& bad) {
    const auto number = read_number(value, place);
    if (!number) return std::nullopt;
    if (const auto reason = bad(*number)) {
        place.fail("out_of_range", *reason);
        return std::nullopt;
    }
    return number;
}

/// A column: an array of numbers. An element that is refused is 0; the request is refused anyway.
inline std::vector<double> read_column(const nlohmann::json& value, const Place& place, const Rule& bad) {
    if (!value.is_array()) {
        place.fail("wrong_type", "must be an array of numbers");
        return {};
    }
    std::vector<double> column;
    column.reserve(value.size());
    for (std::size_t i = 0; i < value.size(); ++i)
        column.push_back(read_checked(value[i], place.at(i), bad).value_or(0));
    return column;
}

}  // namespace brdfit::api
