/// Strict JSON: what nlohmann's parser lets pass and a service must not.
#pragma once

#include <string_view>

#include <nlohmann/json_fwd.hpp>

namespace brdfit::api {

/// Parses a document. Refused (Refusal, 400) beyond what is not JSON: nesting deeper than 16, a key twice in an object,
/// a NUL byte; and (422) a number too large for a double, and more members, elements or values than any request has,
/// before they take memory. Errors have their pointer, line and column.
nlohmann::json parse_json(std::string_view text);

}  // namespace brdfit::api
