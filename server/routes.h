/// What the service answers, apart from HTTP's plumbing.
#pragma once

#include <cstddef>
#include <functional>
#include <future>
#include <map>
#include <memory>
#include <optional>
#include <stop_token>
#include <string>
#include <string_view>
#include <vector>

#include "api/problem.h"
#include "api/request.h"
#include "kernels/model.h"
#include "kernels/selftest.h"
#include "optim/fit.h"
#include "server/job.h"

namespace brdfit::server {

/// The most bytes a request's body may have, unless an option says otherwise.
inline constexpr std::size_t kLargestBody = std::size_t{32} << 20;

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
    /// Sends at once. False if the client is gone or takes nothing for seconds: then return.
    virtual bool write(std::string_view bytes) = 0;
    /// Whether to go on: the client has not closed its side, and the service does not stop.
    [[nodiscard]] virtual bool open() const = 0;
    /// Whether the service stops: write what is left to say within a second, and return.
    [[nodiscard]] virtual bool stopping() const = 0;
};

struct Response {
    int status = 200;
    std::string content_type = "application/json";
    std::string body;
    std::map<std::string, std::string> headers{};
    std::string route{};  ///< the path's template, such as /v1/fits/*, for metrics; empty where nothing is
    /// If set, called in place of sending `body`, after the headers, on the connection's thread; not for HEAD. The
    /// answer ends when it returns, and the connection with it. It looks at open() at least once a second.
    std::function<void(Stream&)> stream{};
};

/// Content types that POST on this path accepts, for Accept-Post; empty where nothing is posted.
std::string accepted_types(const std::string& path);

class Routes {
public:
    /// self_tests: what they found. By the first request those of the best precision have ended; who asks for another,
    /// or for what they found, waits for all. largest_body: bytes, as clients are told.
    Routes(const kernels::Catalogue& catalogue, optim::Fitter& fitter, JobStore& store,
           std::shared_future<std::vector<kernels::SelfTest>> self_tests, std::stop_token stop,
           std::size_t largest_body = kLargestBody)
        : catalogue_(catalogue),
          fitter_(fitter),
          store_(store),
          self_tests_(std::move(self_tests)),
          stop_(std::move(stop)),
          largest_body_(largest_body) {}

    /// Never throws: what goes wrong is a problem+json answer, and a line in the log.
    [[nodiscard]] Response handle(const Request& request) const;

private:
    /// route: set to the template of the path as soon as that is known.
    [[nodiscard]] Response answer(const Request& request, std::string& route) const;
    [[nodiscard]] Response dispatch(const Request& request, std::string& route) const;
    [[nodiscard]] Response post_fit(const Request& request) const;
    [[nodiscard]] Response post_evaluate(const Request& request) const;
    [[nodiscard]] Response get_ready() const;
    /// The precision asked for, or the best; refused where it may not be used.
    [[nodiscard]] kernels::Precision proven(std::optional<kernels::Precision> wanted, const std::string& pointer) const;
    [[nodiscard]] Response get_models(const std::string& name) const;
    [[nodiscard]] Response get_result(const std::string& id) const;
    [[nodiscard]] Response get_plot(const std::string& id, const std::string& file, const api::Query& query) const;
    [[nodiscard]] std::shared_ptr<const Job> job(const std::string& id) const;

    const kernels::Catalogue& catalogue_;
    optim::Fitter& fitter_;
    JobStore& store_;
    std::shared_future<std::vector<kernels::SelfTest>> self_tests_;
    std::stop_token stop_;
    std::size_t largest_body_;
};

/// A problem as an answer.
Response problem_response(const api::Problem& problem, const Request& request);

}  // namespace brdfit::server
