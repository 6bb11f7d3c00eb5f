#include "api/log_line.h"

#include <nlohmann/json.hpp>

namespace brdfit::api {
namespace {

using nlohmann::ordered_json;

/// Control characters and all that is not ASCII are escaped, bytes that are no text replaced.
std::string dump(const ordered_json& line) { return line.dump(-1, ' ', true, ordered_json::error_handler_t::replace); }

}  // namespace

std::string to_json(const std::string& time, const RequestLine& line) {
    return dump({{"time", time},
                 {"level", "info"},
                 {"message", "request"},
                 {"method", line.method},
                 {"path", line.path},
                 {"status", line.status},
                 {"bytes", line.bytes},
                 {"ms", line.ms},
                 {"request_id", line.id},
                 {"tenant", line.tenant},
                 {"remote", line.remote}});
}

std::string to_json(const std::string& time, const std::string& level, const std::string& message) {
    return dump({{"time", time}, {"level", level}, {"message", message}});
}

}  // namespace brdfit::api
