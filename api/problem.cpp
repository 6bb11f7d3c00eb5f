#include "api/problem.h"

#include <map>

#include <nlohmann/json.hpp>

namespace brdfit::api {
namespace {

const char* title(int status) {
    static const std::map<int, const char*> titles{{400, "Bad Request"},
                                                   {404, "Not Found"},
                                                   {405, "Method Not Allowed"},
                                                   {409, "Conflict"},
                                                   {411, "Length Required"},
                                                   {413, "Content Too Large"},
                                                   {415, "Unsupported Media Type"},
                                                   {422, "Unprocessable Content"},
                                                   {500, "Internal Server Error"},
                                                   {503, "Service Unavailable"}};
    const auto it = titles.find(status);
    return it == titles.end() ? "Error" : it->second;
}

}  // namespace

std::string pointer_part(std::string_view key) {
    std::string out;
    for (const char c : key) out += c == '~' ? std::string("~0") : c == '/' ? std::string("~1") : std::string(1, c);
    return out;
}

std::string to_json(const Problem& problem, const std::string& instance, const std::string& request_id) {
    nlohmann::ordered_json body{{"type", "/problems/" + problem.type},
                                {"title", title(problem.status)},
                                {"status", problem.status},
                                {"detail", problem.detail},
                                {"instance", instance},
                                {"request_id", request_id}};
    for (const FieldError& error : problem.errors) {
        nlohmann::ordered_json entry{{"pointer", error.pointer}, {"code", error.code}, {"detail", error.detail}};
        if (error.line) entry["line"] = *error.line;
        if (error.column) entry["column"] = *error.column;
        body["errors"].push_back(std::move(entry));
    }
    // A client's bytes may stand in a message: what is not UTF-8 is replaced, not thrown at.
    return body.dump(-1, ' ', false, nlohmann::ordered_json::error_handler_t::replace) + "\n";
}

}  // namespace brdfit::api
