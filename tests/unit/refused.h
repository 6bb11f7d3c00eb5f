/// What a test says of a refusal.
#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "api/problem.h"

namespace brdfit::api {

/// The problem of the refusal that the call throws.
inline Problem refusal_of(const std::function<void()>& call) {
    try {
        call();
    } catch (const Refusal& refusal) {
        return refusal.problem();
    }
    ADD_FAILURE() << "is not refused";
    return {};
}

/// Pointer and code of each error, "pointer code".
inline std::vector<std::string> errors_of(const Problem& problem) {
    std::vector<std::string> result;
    for (const FieldError& error : problem.errors) result.push_back(error.pointer + " " + error.code);
    return result;
}

/// Line, column and code of each error, "line:column code".
inline std::vector<std::string> places_of(const Problem& problem) {
    std::vector<std::string> result;
    for (const FieldError& error : problem.errors)
        result.push_back(std::to_string(error.line.value_or(0)) + ":" + std::to_string(error.column.value_or(0)) + " " +
                         error.code);
    return result;
}

}  // namespace brdfit::api
