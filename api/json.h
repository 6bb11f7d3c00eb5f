/// Strict JSON: what nlohmann's parser lets pass and a service must not.
#pragma once

#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include <nlohmann/json_fwd.hpp>

#include "api/problem.h"

namespace brdfit::api {

/// What is wrong with the fields of a document of which the end is still to come.
using Critic = std::function<std::vector<FieldError>(const nlohmann::json&)>;

/// Parses a document. Refused (Refusal, 400) beyond what is not JSON: nesting deeper than 16, a key twice in an object,
/// a NUL byte; and (422) a number too large for a double, a string or number beyond 1 MiB, more than 4 MiB of strings,
/// and more members, elements or values than any request has, before they take memory. Errors have their pointer, line
/// and column.
///
/// A document that grows large is shown to the critic now and then, and refused (422) as soon as something is wrong
/// with it that what follows cannot mend: only what is measurements may take the memory of measurements.
nlohmann::json parse_json(std::string_view text, const Critic& critic = {});

/// In one line. Bytes of a client that are not UTF-8 are replaced.
std::string text_of(const nlohmann::ordered_json& value);
/// The same with the line's end.
std::string line_of(const nlohmann::ordered_json& value);

}  // namespace brdfit::api
