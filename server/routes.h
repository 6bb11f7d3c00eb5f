/// What the service answers, apart from HTTP's plumbing.
#pragma once

#include <cstddef>
#include <map>
#include <optional>
#include <stop_token>
#include <string>
#include <vector>

#include "api/problem.h"
#include "api/request.h"
#include "kernels/model.h"
#include "kernels/precision.h"
#include "server/compute.h"
#include "server/store.h"

namespace brdfit::server {

/// The most bytes a request's body may have.
inline constexpr std::size_t kLargestBody = std::size_t{32} << 20;

struct Request {
    std::string method;
    std::string path;  ///< decoded, without the query
    api::Query query;
    std::string content_type;  ///< as sent, with its parameters
    std::string body;
    std::string id;  ///< X-Request-Id
};

struct Response {
    int status = 200;
    std::string content_type = "application/json";
    std::string body;
    std::map<std::string, std::string> headers{};
};

/// Content types that POST on this path accepts, for Accept-Post; empty where nothing is posted.
std::string accepted_types(const std::string& path);

class Routes {
public:
    Routes(const kernels::Catalogue& catalogue, JobStore& store, Compute& compute, std::stop_token stop)
        : catalogue_(catalogue), store_(store), compute_(compute), stop_(std::move(stop)) {}

    /// Never throws: what goes wrong is a problem+json answer, and a line in the log.
    [[nodiscard]] Response handle(const Request& request) const;

private:
    [[nodiscard]] Response dispatch(const Request& request) const;
    [[nodiscard]] Response post_fit(const Request& request) const;
    [[nodiscard]] Response post_evaluate(const Request& request) const;
    [[nodiscard]] Response get_ready() const;
    /// Refuses a precision that may not be used.
    void require_proven(std::optional<kernels::Precision> precision) const;
    [[nodiscard]] Response get_models(const std::string& name) const;
    [[nodiscard]] Response get_result(const std::string& id) const;
    [[nodiscard]] Response get_plot(const std::string& id, const std::string& file, const api::Query& query) const;

    const kernels::Catalogue& catalogue_;
    JobStore& store_;
    Compute& compute_;
    std::stop_token stop_;
};

/// A problem as an answer.
Response problem_response(const api::Problem& problem, const Request& request);

}  // namespace brdfit::server
