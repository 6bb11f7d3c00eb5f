/// What headers of a request ask for, and headers of answers.
#pragma once

#include <chrono>
#include <initializer_list>
#include <optional>
#include <string>
#include <string_view>

#include "server/message.h"
#include "server/store.h"

namespace brdfit::server {

inline constexpr std::string_view kJson = "application/json";
inline constexpr std::string_view kCsv = "text/csv";
inline constexpr std::string_view kHtml = "text/html";
inline constexpr std::string_view kSvg = "image/svg+xml";
inline constexpr std::string_view kEventStream = "text/event-stream";

/// The longest that an answer may be waited for.
inline constexpr std::chrono::seconds kLongestWait{60};

/// A type without its parameters, in lower case.
std::string media_type(std::string_view content_type);

/// Prefer (RFC 7240), as far as we know it.
struct Preferences {
    std::optional<std::chrono::seconds> wait{};  ///< at most kLongestWait
    bool respond_async = false;
};
/// Throws Refusal (invalid-header) for a wait that is no whole number; unknown preferences are passed over.
Preferences preferences(const Request& request);

/// The one of the offered types that Accept likes best, the first where it does not mind. Throws Refusal
/// (not-acceptable) where it wants none of them.
std::string_view accepted(const Request& request, std::initializer_list<std::string_view> offered);

/// Whether a list of a header, such as Cache-Control, has that element; case does not count.
bool lists(std::string_view header, std::string_view element);

/// A strong entity tag of these bytes.
std::string entity_tag(std::string_view bytes);

/// Throws Refusal (precondition-failed) if If-Match or If-Unmodified-Since asks for another state of the resource.
void require_match(const Request& request, std::string_view tag, std::optional<StoreTime> modified = {});
/// Whether If-None-Match names the tag: the client has this already.
bool is_known(const Request& request, std::string_view tag);

/// "2026-11-22T12:47:55.123Z" and "Sun, 22 Nov 2026 12:47:55 GMT".
std::string rfc3339(StoreTime time);
std::string http_date(StoreTime time);

}  // namespace brdfit::server
