#include "server/paging.h"

#include "api/response.h"

namespace brdfit::server {

std::string next_link(const Request& request, const std::string& cursor) {
    std::string url = request.path + "?cursor=" + api::url_encoded(cursor);
    for (const auto& [key, value] : request.query)
        if (key != "cursor") url += "&" + api::url_encoded(key) + "=" + api::url_encoded(value);
    return "<" + url + ">; rel=\"next\"";
}

}  // namespace brdfit::server
