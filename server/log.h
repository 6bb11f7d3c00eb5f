/// The log: lines on standard error.
#pragma once

#include <cstdint>

#include "api/log_line.h"

namespace brdfit::server {

enum class LogFormat : std::uint8_t { text, json };

/// For all lines from now on, those of spdlog included. What a client put into one cannot end it, nor turn its text
/// around: bytes that are not printable ASCII are escaped.
void set_log_format(LogFormat format);

void log_request(const api::RequestLine& line);

}  // namespace brdfit::server
