/// What holds of every refusal of a reader.
#pragma once

#include <optional>
#include <string>

#include <nlohmann/json.hpp>

#include "api/problem.h"
#include "tests/fuzz/fuzz.h"

namespace brdfit::fuzz {

/// The problem of the refusal that the call throws, if it throws one. Any other exception ends the process.
template <class Call>
std::optional<api::Problem> refusal_of(const Call& call) {
    try {
        call();
        return std::nullopt;
    } catch (const api::Refusal& refusal) {
        return refusal.problem();
    }
}

/// Each error has its place and its words, and the answer is JSON whatever stood in the request.
inline void check_refusal(const api::Problem& problem, std::string_view text) {
    require(problem.type.status == 400 || problem.type.status == 422, "status " + std::to_string(problem.type.status));
    require(!problem.errors.empty() && problem.errors.size() <= api::kMostErrors, "1 to 50 errors");
    for (const api::FieldError& error : problem.errors) {
        require(!error.code.empty() && !error.detail.empty(), "an error without words");
        require(error.line.has_value() == error.column.has_value(), "a line comes with its column");
        require(error.line.value_or(1) > 0 && error.column.value_or(1) > 0, "lines and columns count from 1");
        require(problem.type.status == 422 || error.line.has_value(),
                "the text is at fault: " + error.code + " where?");
        for (const char* word : {"exception", "parse error", "std::"})
            require(error.detail.find(word) == std::string::npos || text.find(word) != std::string_view::npos,
                    "an exception's words: " + error.detail);
        (void)nlohmann::json::json_pointer(error.pointer);
    }
    (void)nlohmann::json::parse(api::to_json(problem, "/", "id"));
}

/// An error in a field names one that is there, or one that its parent lacks.
inline void check_pointers(const api::Problem& problem, const nlohmann::json& document) {
    for (const api::FieldError& error : problem.errors) {
        const nlohmann::json::json_pointer pointer(error.pointer);
        require(document.contains(pointer) || document.contains(pointer.parent_pointer()),
                error.pointer + " is not in the request");
    }
}

}  // namespace brdfit::fuzz
