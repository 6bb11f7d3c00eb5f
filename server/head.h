/// The head of an HTTP/1 request, read strictly: what is framed in two ways is framed in none.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <string_view>

#include "api/problem.h"
#include "server/routes.h"

namespace brdfit::server {

inline constexpr std::size_t kLargestHead = std::size_t{64} << 10;
inline constexpr std::size_t kLongestRequestLine = 8192;
inline constexpr std::size_t kMostHeaders = 100;

/// Finds the end of a head in bytes that come piece by piece, each of which it looks at once.
class HeadScanner {
public:
    /// input: all bytes since the request's first. The head's size with the empty line that ends it, once it is there.
    std::optional<std::size_t> find_end(std::string_view input);
    /// Why no head can come of what has been looked at, if so.
    [[nodiscard]] std::optional<api::Problem> problem() const;

private:
    std::size_t looked_at_ = 0;
    std::size_t line_ = 0;  ///< bytes of the line so far, without its end
    bool in_headers_ = false;
    bool after_cr_ = false;
    bool malformed_ = false;
};

struct Head {
    std::string method;
    std::string target;  ///< path and query as sent; an absolute one without scheme and authority
    Headers headers;
    std::optional<std::size_t> length;  ///< of the body, if it is told
    bool chunked = false;
    bool is_http_1_0 = false;
    bool keep_alive = true;
    bool expects_continue = false;
    /// Why the request is not to be served, if so: its body must not be read and its connection not be used again.
    std::optional<api::Problem> problem;

    [[nodiscard]] bool has_body() const { return chunked || length.value_or(0) > 0; }
    /// The target up to its query, as sent.
    [[nodiscard]] std::string_view path() const { return std::string_view(target).substr(0, target.find('?')); }
};

/// The refusal of a body of more bytes.
api::Problem too_large(std::size_t largest_body);

/// text: up to and with the empty line. Where there is a problem, what was read before it stands in the head.
Head read_head(std::string_view text, std::size_t largest_body);

}  // namespace brdfit::server
