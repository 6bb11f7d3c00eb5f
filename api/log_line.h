/// Lines of the log as JSON.
#pragma once

#include <cstddef>
#include <string>

namespace brdfit::api {

/// A request that was answered.
struct RequestLine {
    std::string method;
    std::string path;  ///< as sent: escaped
    int status = 200;
    std::size_t bytes = 0;  ///< of the answer's body
    double ms = 0;
    std::string id;
    std::string tenant;  ///< may be empty
    std::string remote;  ///< address of the peer
};

/// Without the line's end; ASCII alone. time: RFC 3339.
std::string to_json(const std::string& time, const RequestLine& line);
/// Anything else. level: as info, warning, error.
std::string to_json(const std::string& time, const std::string& level, const std::string& message);

}  // namespace brdfit::api
