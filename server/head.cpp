#include "server/head.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <vector>

#include <boost/algorithm/string/predicate.hpp>
#include <boost/algorithm/string/trim.hpp>

#include "server/headers.h"

namespace brdfit::server {
namespace {

using api::Problem;

Problem bad_request(std::string detail) { return {api::problem_type("bad-request"), std::move(detail), {}}; }

bool is_token(std::string_view text) {
    const auto ok = [](unsigned char c) {
        return std::isalnum(c) != 0 ||
               std::string_view("!#$%&'*+-.^_`|~").find(static_cast<char>(c)) != std::string::npos;
    };
    return !text.empty() && std::all_of(text.begin(), text.end(), ok);
}

bool is_hex(char c) { return std::isxdigit(static_cast<unsigned char>(c)) != 0; }

/// Method, target and version.
std::optional<Problem> read_request_line(std::string_view line, Head& head) {
    const std::size_t first = line.find(' ');
    const std::size_t last = line.rfind(' ');
    if (first == std::string_view::npos || first == last) return bad_request("the request line has three parts");
    const std::string_view method = line.substr(0, first);
    std::string_view target = line.substr(first + 1, last - first - 1);
    const std::string_view version = line.substr(last + 1);
    if (!is_token(method)) return bad_request("the method is none");
    head.method = method;
    if (!std::all_of(target.begin(), target.end(), [](char c) { return c > ' ' && c < 0x7f && c != '#'; }))
        return bad_request("the target holds characters that must be escaped");
    for (const std::string_view scheme : {"http://", "https://"}) {
        if (!boost::algorithm::istarts_with(target, scheme)) continue;
        target.remove_prefix(scheme.size());
        const std::size_t path = target.find_first_of("/?");
        target.remove_prefix(std::min(path, target.size()));
        if (!target.starts_with('/')) head.target = "/";
        break;
    }
    head.target += target;
    if (version.size() != 8 || !version.starts_with("HTTP/")) return bad_request("the request line ends with HTTP/1.1");
    if (version != "HTTP/1.1" && version != "HTTP/1.0")
        return Problem{api::problem_type("http-version-not-supported"), "HTTP/1.1 and HTTP/1.0 are spoken here", {}};
    head.is_http_1_0 = version == "HTTP/1.0";
    static constexpr std::array<std::string_view, 7> kMethods{"GET",   "HEAD",   "POST",   "PUT",
                                                              "PATCH", "DELETE", "OPTIONS"};
    if (std::find(kMethods.begin(), kMethods.end(), head.method) == kMethods.end())
        return Problem{api::problem_type("not-implemented"), "there is no such method here", {}};
    if (!head.target.starts_with('/')) return bad_request("the target is a path");
    const std::string_view path = head.path();
    for (std::size_t i = 0; i < path.size(); ++i) {
        if (path[i] != '%') continue;
        if (i + 2 >= path.size() || !is_hex(path[i + 1]) || !is_hex(path[i + 2]))
            return bad_request("the path has a % that no two hexadecimal digits follow");
        if (path.substr(i, 3) == "%00") return bad_request("the path has a NUL byte");
    }
    return std::nullopt;
}

std::optional<Problem> read_header(std::string_view line, Head& head) {
    const std::size_t colon = line.find(':');
    if (colon == std::string_view::npos ||
        !is_token(line.substr(0, colon)))  // nor a blank before the colon, nor a fold
        return bad_request("a header is not a name, a colon and a value");
    std::string value(line.substr(colon + 1));
    boost::algorithm::trim_if(value, [](char c) { return c == ' ' || c == '\t'; });
    const auto [entry, is_new] = head.headers.try_emplace(std::string(line.substr(0, colon)), value);
    if (is_new) return std::nullopt;
    for (const std::string_view once : {"Host", "Content-Length", "Transfer-Encoding", "Content-Type", "Authorization"})
        if (boost::algorithm::iequals(entry->first, once))
            return bad_request(std::string(once) + " is given more than once");
    entry->second += ", " + value;
    return std::nullopt;
}

/// How long the body is, and whether it may come.
std::optional<Problem> read_framing(Head& head, std::size_t largest_body) {
    const auto find = [&](std::string_view name) -> const std::string* {
        const auto found = head.headers.find(name);
        return found == head.headers.end() ? nullptr : &found->second;
    };
    if (find("Host") == nullptr && !head.is_http_1_0) return bad_request("Host must be given");
    const std::string* length = find("Content-Length");
    if (const std::string* encoding = find("Transfer-Encoding")) {
        if (length != nullptr) return bad_request("Content-Length and Transfer-Encoding exclude each other");
        if (head.is_http_1_0) return bad_request("HTTP/1.0 has no Transfer-Encoding");
        if (!boost::algorithm::iequals(*encoding, "chunked"))
            return Problem{api::problem_type("not-implemented"), "the one Transfer-Encoding is chunked", {}};
        head.chunked = true;
    }
    if (length != nullptr) {
        const bool digits = !length->empty() && std::all_of(length->begin(), length->end(),
                                                            [](unsigned char c) { return std::isdigit(c) != 0; });
        if (!digits) return bad_request("Content-Length must be a number");
        std::size_t bytes = 0;
        const auto [end, error] = std::from_chars(length->data(), length->data() + length->size(), bytes);
        if (error != std::errc{} || bytes > largest_body) return too_large(largest_body);
        head.length = bytes;
    } else if (!head.chunked && !head.path().ends_with("/cancel") &&  // which takes none, and curl -X POST tells none
               (head.method == "POST" || head.method == "PUT" || head.method == "PATCH")) {
        return Problem{api::problem_type("length-required"), "Content-Length must be given", {}};
    }
    if (const std::string* encoding = find("Content-Encoding"))
        if (!boost::algorithm::iequals(*encoding, "identity"))
            return Problem{api::problem_type("unsupported-media-type"), "the body must not be compressed", {}};
    if (const std::string* expected = find("Expect")) {
        if (!boost::algorithm::iequals(*expected, "100-continue"))
            return Problem{api::problem_type("expectation-failed"), "nothing but 100-continue can be expected", {}};
        head.expects_continue = !head.is_http_1_0;
    }
    return std::nullopt;
}

}  // namespace

Problem too_large(std::size_t largest_body) {
    return {api::problem_type("too-large"), "the body may have at most " + std::to_string(largest_body) + " bytes", {}};
}

std::optional<std::size_t> HeadScanner::find_end(std::string_view input) {
    while (looked_at_ < input.size() && !malformed_) {
        const char c = input[looked_at_++];
        if (c == '\n') {
            malformed_ = !after_cr_;
            after_cr_ = false;
            if (line_ == 0 && in_headers_) return looked_at_;
            in_headers_ = in_headers_ || line_ > 0;  // empty lines before the request line are passed over
            line_ = 0;
        } else {
            malformed_ = after_cr_ || c == 0x7f || (c >= 0 && c < ' ' && c != '\t' && c != '\r');
            after_cr_ = c == '\r';
            if (!after_cr_) ++line_;
        }
    }
    return std::nullopt;
}

std::optional<Problem> HeadScanner::problem() const {
    if (malformed_) return bad_request("a head is lines of text that end with CR LF");
    if (!in_headers_ && line_ > kLongestRequestLine)
        return Problem{api::problem_type("uri-too-long"),
                       "a request line may have at most " + std::to_string(kLongestRequestLine) + " bytes",
                       {}};
    if (looked_at_ > kLargestHead)
        return Problem{api::problem_type("head-too-large"),
                       "the request's head may have at most " + std::to_string(kLargestHead) + " bytes",
                       {}};
    return std::nullopt;
}

Head read_head(std::string_view text, std::size_t largest_body) {
    Head head;
    const auto next_line = [&] {
        const std::size_t end = text.find("\r\n");
        const std::string_view line = text.substr(0, end);
        text.remove_prefix(end + 2);
        return line;
    };
    std::string_view line;
    while (line.empty()) line = next_line();
    if (line.size() > kLongestRequestLine) {
        head.problem = Problem{api::problem_type("uri-too-long"),
                               "a request line may have at most " + std::to_string(kLongestRequestLine) + " bytes",
                               {}};
        return head;
    }
    head.problem = read_request_line(line, head);
    std::size_t count = 0;
    while (!(line = next_line()).empty()) {  // after a problem as well: an answer tells the request's id
        std::optional<Problem> problem;
        if (++count > kMostHeaders)
            problem = Problem{api::problem_type("head-too-large"),
                              "a request may have at most " + std::to_string(kMostHeaders) + " headers",
                              {}};
        else problem = read_header(line, head);
        if (!head.problem) head.problem = std::move(problem);
        if (count > kMostHeaders) break;
    }
    if (!head.problem) head.problem = read_framing(head, largest_body);
    const auto connection = head.headers.find("Connection");
    const std::string_view options = connection == head.headers.end() ? std::string_view() : connection->second;
    head.keep_alive = head.is_http_1_0 ? lists(options, "keep-alive") : !lists(options, "close");
    return head;
}

}  // namespace brdfit::server
