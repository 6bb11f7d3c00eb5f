#include "server/message.h"

#include <locale>

#include <boost/algorithm/string/predicate.hpp>

namespace brdfit::server {

bool HeaderOrder::operator()(std::string_view a, std::string_view b) const {
    return boost::algorithm::ilexicographical_compare(a, b, std::locale::classic());
}

std::string_view Request::header(std::string_view name) const {
    const auto found = headers.find(name);
    return found == headers.end() ? std::string_view() : found->second;
}

Response problem_response(const api::Problem& problem, const Request& request) {
    Response response;
    response.status = problem.type.status;
    response.content_type = "application/problem+json";
    response.body = api::to_json(problem, request.path, request.id);
    if (problem.type.retry_after_s > 0) response.headers["Retry-After"] = std::to_string(problem.type.retry_after_s);
    return response;
}

}  // namespace brdfit::server
