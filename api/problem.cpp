#include "api/problem.h"

#include <nlohmann/json.hpp>

#include "api/json.h"

namespace brdfit::api {
std::string pointer_part(std::string_view key) {
    constexpr std::size_t kLongest = 200;
    const bool is_long = key.size() > kLongest;
    if (is_long) {
        key = key.substr(0, kLongest);
        while (!key.empty() && (static_cast<unsigned char>(key.back()) & 0xC0U) == 0x80U) key.remove_suffix(1);
        if (!key.empty() && static_cast<unsigned char>(key.back()) >= 0xC0U) key.remove_suffix(1);  // its first byte
    }
    std::string out;
    for (const char c : key) out += c == '~' ? std::string("~0") : c == '/' ? std::string("~1") : std::string(1, c);
    return is_long ? out + "…" : out;
}

Refusal invalid_fields(std::vector<FieldError> errors) {
    const FieldError& first = errors.front();
    std::string detail = first.pointer.empty() ? first.detail : first.pointer + ": " + first.detail;
    return Refusal({problem_type("invalid-request"), std::move(detail), std::move(errors)});
}

std::string to_json(const Problem& problem, const std::string& instance, const std::string& request_id) {
    nlohmann::ordered_json body{{"type", "/problems/" + std::string(problem.type.name)},
                                {"title", problem.type.title},
                                {"status", problem.type.status},
                                {"detail", problem.detail},
                                {"instance", instance},
                                {"request_id", request_id}};
    for (const FieldError& error : problem.errors) {
        nlohmann::ordered_json entry{{"pointer", error.pointer}, {"code", error.code}, {"detail", error.detail}};
        if (error.line) entry["line"] = *error.line;
        if (error.column) entry["column"] = *error.column;
        body["errors"].push_back(std::move(entry));
    }
    return line_of(body);
}

std::string to_json(const ProblemType& type) {
    return nlohmann::ordered_json{{"type", "/problems/" + std::string(type.name)},
                                  {"title", type.title},
                                  {"status", type.status},
                                  {"doc", type.doc}}
               .dump() +
           "\n";
}

}  // namespace brdfit::api
