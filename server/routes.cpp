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
using api::problem_type;
using api::Refusal;

std::vector<std::string> parts_of(std::string_view path) {
    std::vector<std::string> parts;
    const std::string_view rest = path.substr(std::min<std::size_t>(1, path.size()));
    boost::algorithm::split(parts, rest, [](char c) { return c == '/'; });
    return parts;
}

/// What stands for the names of a template, if the path is of its form.
std::optional<std::vector<std::string>> match(const std::vector<std::string>& parts,
                                              const std::vector<std::string>& wanted) {
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

Routes::Routes(const kernels::Catalogue& catalogue, JobStore& store, Compute& compute, const std::stop_token& stop,
               std::size_t largest_body)
    : fits_(catalogue, store, compute, stop), datasets_(store), about_(catalogue, store, compute, largest_body, stop) {
    for (auto& routes : {fits_.routes(), datasets_.routes(), about_.routes()})
        for (const Route& route : routes) table_.push_back({route, parts_of(route.operation.path)});
    std::vector<const api::Operation*> operations;
    for (const Row& row : table_) operations.push_back(&row.route.operation);
    const std::vector<api::Operation> elsewhere = About::elsewhere();
    for (const api::Operation& operation : elsewhere) operations.push_back(&operation);
    about_.publish(operations);
}

Response Routes::refusal(const Problem& problem, const Request& request) const {
    Response response = problem_response(problem, request);
    const auto list = [](std::string& names, std::string_view name) {
        names += (names.empty() ? "" : ", ") + std::string(name);
    };
    const int status = problem.type.status;
    if (status != 405 && status != 415) return response;
    const std::vector<std::string> parts = parts_of(request.path);
    std::string allowed, accepted;
    for (const Row& row : table_) {
        if (!match(parts, row.parts)) continue;
        list(allowed, row.route.operation.method);
        if (row.route.operation.method == "GET") list(allowed, "HEAD");
        for (const api::Content& body : row.route.operation.bodies) list(accepted, body.type);
    }
    if (status == 405) response.headers["Allow"] = allowed;
    else if (!accepted.empty()) response.headers["Accept-Post"] = accepted;
    return response;
}

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
                        full ? "there is no room for more" : "what is kept cannot be reached now",
                        {}},
                       request);
    } catch (const std::exception& error) {
        spdlog::error("{} {} request {}: {}", request.method, route, request.id, error.what());
        return refusal({problem_type("internal"), "an error of the service; it has been logged", {}}, request);
    }
}

Response Routes::dispatch(const Request& request, std::string& route) const {
    const std::vector<std::string> parts = parts_of(request.path);
    const std::string_view method = request.method == "HEAD" ? "GET" : std::string_view(request.method);
    for (const Row& row : table_) {
        auto names = match(parts, row.parts);
        if (!names) continue;
        route = row.route.operation.path;
        if (row.route.operation.method != method) continue;
        Response response = row.route.answer({request, std::move(*names)});
        if (method == "GET") heed_conditions(request, response);
        return response;
    }
    if (!route.empty())
        throw Refusal({problem_type("method-not-allowed"), request.method + " is not for this resource", {}});
    throw Refusal({problem_type("not-found"), "there is nothing at this path", {}});
}

}  // namespace brdfit::server
