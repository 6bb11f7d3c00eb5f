/// Refusals: what is wrong with a request, and where (RFC 9457, application/problem+json).
#pragma once

#include <array>
#include <cstddef>
#include <exception>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace brdfit::api {

/// One thing wrong with a request.
struct FieldError {
    std::string pointer;                  ///< RFC 6901, e.g. "/dataset/channels/0/brdf/3"; empty for CSV
    std::string code;                     ///< for programs, e.g. "unknown_key"
    std::string detail;                   ///< for people
    std::optional<std::size_t> line{};    ///< of the text, from 1
    std::optional<std::size_t> column{};  ///< byte within the line, from 1; for CSV the field, from 1
};

/// A key as a part of a pointer: "~" and "/" escaped; of a very long one the beginning.
std::string pointer_part(std::string_view key);

/// A kind of problem, as it is documented.
struct ProblemType {
    std::string_view name;  ///< "/problems/<name>" is its URI
    int status = 500;
    std::string_view title;
    std::string_view doc;
    unsigned retry_after_s = 0;  ///< after which it may have gone; 0: it will not by itself
};

/// Every kind that there is.
inline constexpr auto kProblemTypes = std::to_array<ProblemType>({
    {"bad-request", 400, "The request is not HTTP as it should be", "its framing or a header is malformed"},
    {"invalid-json", 400, "The body is not JSON", "also for a key that stands twice, deep nesting and a NUL byte"},
    {"invalid-header", 400, "A header cannot be used", "Prefer, Idempotency-Key or Last-Event-ID is malformed"},
    {"invalid-cursor", 400, "The cursor is none of ours", "take it from next_cursor, for the same list"},
    {"unauthorized", 401, "An API key is needed", "none was sent, or an unknown one"},
    {"forbidden", 403, "This is not allowed", "the API key does not cover it"},
    {"not-found", 404, "There is nothing at this path", "see /openapi.json for what there is"},
    {"unknown-model", 404, "There is no such model", "see /v1/models"},
    {"unknown-dataset", 404, "There is no such dataset", "it never was, or it was removed"},
    {"unknown-fit", 404, "There is no such fit", "the id is none of ours"},
    {"unknown-plot", 404, "There is no such plot", "there are brdf.svg, residual.svg and summary.svg"},
    {"method-not-allowed", 405, "The method is not for this resource", "Allow names those that are"},
    {"not-acceptable", 406, "Accept leaves no form of the answer", "the detail names the forms"},
    {"request-timeout", 408, "The request took too long to arrive", "head or body did not come in time", 1},
    {"not-finished", 409, "The fit has not ended", "wait for it at /v1/fits/{id} or its events", 1},
    {"no-result", 409, "The fit ended without a result", "it failed or was cancelled; /v1/fits/{id} tells why"},
    {"in-flight", 409, "The first request of this Idempotency-Key has not ended", "ask again later", 1},
    {"dataset-in-use", 409, "A fit that has not ended uses the dataset", "cancel it, or wait", 5},
    {"gone", 410, "The fit was removed", "by DELETE, or as it was too old"},
    {"length-required", 411, "The length of the body must be told", "by Content-Length or in chunks"},
    {"precondition-failed", 412, "The resource is not as the request expects it", "If-Match or If-Unmodified-Since"},
    {"too-large", 413, "The body is too large", "GET /v1 tells the limit"},
    {"uri-too-long", 414, "The URI is too long", "options fit into a body"},
    {"unsupported-media-type", 415, "The body's type is not accepted", "Accept-Post names those that are"},
    {"expectation-failed", 417, "What is expected cannot be", "Expect may be 100-continue alone"},
    {"invalid-request", 422, "Something in the request is refused", "errors has the place of each mistake"},
    {"key-reused", 422, "The Idempotency-Key was used for another request", "use a new key"},
    {"too-many-requests", 429, "Too many requests", "slow down", 1},
    {"head-too-large", 431, "The request's head is too large", "at most 64 KB"},
    {"internal", 500, "An error of the service", "it has been logged under the request_id"},
    {"device", 500, "The OpenCL device failed", "every time that the fit was tried"},
    {"poison-job", 500, "The fit ended its worker every time", "it is kept, and not tried again"},
    {"not-implemented", 501, "There is no such method or coding", "GET, HEAD, POST, DELETE; chunked"},
    {"http-version-not-supported", 505, "The version of HTTP is not spoken here", "HTTP/1.1 and HTTP/1.0 are"},
    {"unavailable", 503, "The service cannot do this now", "the store is full or busy", 5},
    {"no-worker", 503, "Nobody computes at the moment", "workers are being started", 1},
    {"busy", 503, "The service has too much to do", "connections or jobs are at their limit", 1},
    {"stopping", 503, "The service is stopping", "another, or the same one started anew, will answer", 5},
    {"unfit-device", 503, "The device failed its self-test", "/health/ready tells where"},
});

/// The kind of that name; one that is not in the table does not compile.
consteval ProblemType problem_type(std::string_view name) {
    for (const ProblemType& type : kProblemTypes)
        if (type.name == name) return type;
    throw "no such problem type";
}
/// The first kind of that status, else the internal one.
constexpr ProblemType problem_type_of(int status) {
    for (const ProblemType& type : kProblemTypes)
        if (type.status == status) return type;
    return problem_type("internal");
}

/// An answer that is not a result. Texts are for the client: no exception's, path's or driver's words.
struct Problem {
    ProblemType type = problem_type("internal");
    std::string detail;
    std::vector<FieldError> errors{};  ///< at most kMostErrors are kept
};

inline constexpr std::size_t kMostErrors = 50;

/// A request that is refused.
class Refusal : public std::exception {
public:
    explicit Refusal(Problem problem) : problem_(std::move(problem)) {}
    [[nodiscard]] const Problem& problem() const { return problem_; }
    [[nodiscard]] const char* what() const noexcept override { return problem_.detail.c_str(); }

private:
    Problem problem_;
};

/// Refuses a request's fields: 422. There is at least one error, of which the first is the detail.
Refusal invalid_fields(std::vector<FieldError> errors);

/// The body.
std::string to_json(const Problem& problem, const std::string& instance, const std::string& request_id);
/// What a kind means.
std::string to_json(const ProblemType& type);

}  // namespace brdfit::api
