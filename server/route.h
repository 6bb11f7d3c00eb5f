/// One row of the table by which requests are answered and by which the contract is published.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "api/openapi.h"
#include "api/problem.h"
#include "server/message.h"

namespace brdfit::server {

/// A request that met its row.
struct Call {
    const Request& request;
    std::vector<std::string> path;  ///< what stands for the names of the template, in their order
};

struct Route {
    api::Operation operation;
    std::function<Response(const Call&)> answer;  ///< throws api::Refusal
};

/// Refuses a query parameter where there is none.
void refuse_query(const Request& request);

/// Refuses a body of another type than these of the operation; returns which it is.
std::string body_type(const Request& request, std::initializer_list<std::string_view> accepted);

/// A refusal with one error.
api::Refusal invalid(const std::string& pointer, const std::string& code, const std::string& detail);

}  // namespace brdfit::server
