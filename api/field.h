/// A request field is declared once: its key, whether it must be there, what it means, how it is read. Reading, the
/// error texts and the list of valid names follow from the same row.
#pragma once

#include <cmath>
#include <cstdint>
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

namespace brdfit::api {

/// Where in a request a value stands, and the errors found so far.
class Place {
public:
    Place(std::vector<FieldError>& errors, std::string pointer) : errors_(errors), pointer_(std::move(pointer)) {}

    [[nodiscard]] Place at(std::string_view key) const { return {errors_, pointer_ + "/" + pointer_part(key)}; }
    [[nodiscard]] Place at(std::size_t index) const { return at(std::to_string(index)); }
    void fail(std::string code, std::string detail) const {
        if (errors_.size() < kMostErrors) errors_.push_back({pointer_, std::move(code), std::move(detail), {}, {}});
    }
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
    std::function<void(const nlohmann::json&, const Place&, T&)> read;
};

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
        const auto field = std::find_if(fields.begin(), fields.end(), [&](const auto& f) { return f.key == key; });
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

inline std::optional<std::string> read_text(const nlohmann::json& value, const Place& place,
                                            std::size_t longest = 200) {
    if (!value.is_string()) {
        place.fail("wrong_type", "must be a string");
        return std::nullopt;
    }
    std::string text = value.get<std::string>();
    if (text.size() > longest) {
        place.fail("too_long", "at most " + std::to_string(longest) + " bytes");
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

}  // namespace brdfit::api
