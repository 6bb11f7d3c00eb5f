#include "server/routes.h"

#include <algorithm>
#include <optional>
#include <utility>

#include <spdlog/spdlog.h>
#include <boost/algorithm/string/split.hpp>

#include "server/headers.h"

namespace brdfit::server {
namespace {

using api::Problem;
using api::Refusal;
using api::problem_type;

std::vector<std::string> parts_of(std::string_view path) {
    std::vector<std::string> parts;
    const std::string_view rest = path.substr(std::min<std::size_t>(1, path.size()));
    boost::algorithm::split(parts, rest, [](char c) { return c == '/'; });
    return parts;
}

/// What stands for the names of a template, if the path is of its form.
std::optional<std::vector<std::string>> match(const std::vector<std::string>& parts, std::string_view path) {
    const std::vector<std::string> wanted = parts_of(path);
    if (wanted.size() != parts.size()) return std::nullopt;
    std::vector<std::string> names;
    for (std::size_t i = 0; i < parts.size(); ++i)
        if (wanted[i].starts_with('{')) names.push_back(parts[i]);
        else if (wanted[i] != parts[i]) return std::nullopt;
    return names;
}

/// What is known of a GET's answer before: 304, or 412.
void heed_conditions(const Request& request, Response& response) {
    const auto tag = response.headers.find("ETag");
    if (tag == response.headers.end() || response.status != 200) return;
    require_match(request, tag->second);
    if (!is_known(request, tag->second)) return;
    response.status = 304;
    response.body.clear();
}

}  // namespace

Routes::Routes(const kernels::Catalogue& catalogue, JobStore& store, Compute& compute, const std::stop_token& stop)
    : fits_(catalogue, store, compute, stop), datasets_(store), service_(catalogue, compute, kLargestBody, stop) {
    for (auto& routes : {fits_.routes(), datasets_.routes(), service_.routes()})
        table_.insert(table_.end(), routes.begin(), routes.end());
    std::vector<const api::Operation*> operations;
    for (const Route& route : table_) operations.push_back(&route.operation);
    service_.publish(operations);
}

Response Routes::refusal(const Problem& problem, const Request& request) const {
    Response response;
    response.status = problem.type.status;
    response.content_type = "application/problem+json";
    response.body = api::to_json(problem, request.path, request.id);
    if (problem.type.retry_after_s > 0) response.headers["Retry-After"] = std::to_string(problem.type.retry_after_s);
    if (problem.type.status == 415)
        if (std::string types = accepted_types(request.path); !types.empty())
            response.headers["Accept-Post"] = std::move(types);
    if (problem.type.status == 405) {
        const std::vector<std::string> parts = parts_of(request.path);
        std::string& allow = response.headers["Allow"];
        for (const Route& route : table_)
            if (match(parts, route.operation.path))
                allow += (allow.empty() ? "" : ", ") + std::string(route.operation.method) +
                         (route.operation.method == "GET" ? ", HEAD" : "");
    }
    return response;
}

std::string Routes::accepted_types(const std::string& path) const {
    const std::vector<std::string> parts = parts_of(path);
    std::string types;
    for (const Route& route : table_)
        if (route.operation.method == "POST" && match(parts, route.operation.path))
            for (const api::Content& body : route.operation.bodies)
                types += (types.empty() ? "" : ", ") + std::string(body.type);
    return types;
}

bool Routes::takes_body(const std::string& path) const { return !accepted_types(path).empty(); }

Response Routes::handle(const Request& request) const {
    std::string route;
    Response response = answer(request, route);
    response.route = std::move(route);
    return response;
}

Response Routes::answer(const Request& request, std::string& route) const {
    try {
        return dispatch(request, route);
    } catch (const Refusal& refused) {
        return refusal(refused.problem(), request);
    } catch (const StoreError& error) {
        spdlog::error("{} {} request {}: the store: {}", request.method, route, request.id, error.what());
        const bool full = error.kind == StoreError::Kind::full;
        return refusal({problem_type("unavailable"),
                        full ? "there is no room for more" : "what is kept cannot be reached now", {}},
                       request);
    } catch (const std::exception& error) {
        spdlog::error("{} {} request {}: {}", request.method, route, request.id, error.what());
        return refusal({problem_type("internal"), "an error of the service; it has been logged", {}}, request);
    }
}

Response Routes::dispatch(const Request& request, std::string& route) const {
    const std::vector<std::string> parts = parts_of(request.path);
    const std::string_view method = request.method == "HEAD" ? "GET" : std::string_view(request.method);
    for (const Route& row : table_) {
        auto names = match(parts, row.operation.path);
        if (!names) continue;
        route = row.operation.path;
        if (row.operation.method != method) continue;
        Response response = row.answer({request, std::move(*names)});
        if (method == "GET") heed_conditions(request, response);
        return response;
    }
    if (!route.empty())
        throw Refusal({problem_type("method-not-allowed"), request.method + " is not for this resource", {}});
    throw Refusal({problem_type("not-found"), "there is nothing at this path", {}});
}

}  // namespace brdfit::server
