#include "server/route.h"

#include <algorithm>

#include "server/headers.h"

namespace brdfit::server {

api::Refusal invalid(const std::string& pointer, const std::string& code, const std::string& detail) {
    return api::Refusal(
        {api::problem_type("invalid-request"), pointer + ": " + detail, {{pointer, code, detail, {}, {}}}});
}

void refuse_query(const Request& request) {
    if (!request.query.empty())
        throw invalid("/" + api::pointer_part(request.query.begin()->first), "unknown_key",
                      "there are no query parameters here");
}

std::string body_type(const Request& request, std::initializer_list<std::string_view> accepted) {
    std::string type = media_type(request.content_type);
    if (std::find(accepted.begin(), accepted.end(), type) != accepted.end()) return type;
    std::string names;
    for (const std::string_view name : accepted) names += (names.empty() ? "" : ", ") + std::string(name);
    throw api::Refusal({api::problem_type("unsupported-media-type"), "the body must be " + names, {}});
}

}  // namespace brdfit::server
