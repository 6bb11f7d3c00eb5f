/// Refusals: what is wrong with a request, and where (RFC 9457, application/problem+json).
#pragma once

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

/// A key as a part of a pointer: "~" and "/" escaped.
std::string pointer_part(std::string_view key);

/// An answer that is not a result. Texts are for the client: no exception's, path's or driver's words.
struct Problem {
    int status = 500;
    std::string type;  ///< a short name; "/problems/<type>" on the wire
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

/// The body; title is the status's phrase.
std::string to_json(const Problem& problem, const std::string& instance, const std::string& request_id);

}  // namespace brdfit::api
