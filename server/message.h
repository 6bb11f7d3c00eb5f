/// Requests and answers, apart from HTTP's plumbing.
#pragma once

#include <functional>
#include <map>
#include <string>
#include <string_view>

#include "api/problem.h"
#include "api/query.h"

namespace brdfit::server {

/// Names of headers: their case does not count.
struct HeaderOrder {
    using is_transparent = void;
    bool operator()(std::string_view a, std::string_view b) const;
};
using Headers = std::map<std::string, std::string, HeaderOrder>;

struct Request {
    std::string method;
    std::string path;  ///< decoded, without the query
    api::Query query;
    std::string content_type;  ///< as sent, with its parameters
    std::string body;
    std::string id;         ///< X-Request-Id
    Headers headers{};      ///< all of them; one that was sent several times is joined by ", "
    std::string tenant{};   ///< name of the API key; empty where no keys are asked for
    std::string address{};  ///< of the peer

    /// A header's value, empty if it was not sent.
    [[nodiscard]] std::string_view header(std::string_view name) const;
};

/// Where an answer goes that is written bit by bit, such as server-sent events. Used by one thread, the connection's.
class Stream {
public:
    virtual ~Stream() = default;
    /// Sends at once. False if the client is gone or takes nothing for seconds, or the service stops: then return.
    virtual bool write(std::string_view bytes) = 0;
    /// Whether write() would go on; sees at once that the client has closed.
    [[nodiscard]] virtual bool open() const = 0;
    /// Whether the service stops: say goodbye within a second, and return.
    [[nodiscard]] virtual bool stopping() const = 0;
};

struct Response {
    int status = 200;
    std::string content_type = "application/json";
    std::string body;
    std::map<std::string, std::string> headers{};
    std::string route{};  ///< the path's template, such as /v1/fits/{id}, for metrics; empty where nothing is
    /// If set, called in place of sending `body`, after the headers, on the connection's thread; not for HEAD. The
    /// answer ends when it returns, and the connection with it. It looks at open() at least once a second.
    std::function<void(Stream&)> stream{};
};

/// A problem as an answer.
Response problem_response(const api::Problem& problem, const Request& request);

}  // namespace brdfit::server
