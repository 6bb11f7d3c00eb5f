#include "server/http.h"

#include <algorithm>
#include <charconv>
#include <optional>
#include <stdexcept>

#include <httplib.h>
#include <spdlog/spdlog.h>

#include "api/problem.h"

namespace brdfit::server {
namespace {

/// Threads that wait on sockets: a request that fits holds one, so more than there are cores.
constexpr std::size_t kThreads = 32;
constexpr time_t kTimeout_s = 5;

bool is_request_id(const std::string& id) {
    const auto ok = [](unsigned char c) { return std::isalnum(c) != 0 || c == '.' || c == '_' || c == '-'; };
    return !id.empty() && id.size() <= 64 && std::all_of(id.begin(), id.end(), ok);
}

/// Control characters of a client do not reach the log.
std::string printable(std::string text) {
    for (char& c : text)
        if (static_cast<unsigned char>(c) < 0x20 || c == 0x7f) c = '?';
    return text;
}

Request request_of(const httplib::Request& from) {
    Request request;
    request.method = from.method;
    request.path = from.path;
    request.query = {from.params.begin(), from.params.end()};
    request.content_type = from.get_header_value("Content-Type");
    request.id = from.get_header_value("X-Request-Id");
    if (!is_request_id(request.id)) request.id = make_job_id();
    return request;
}

void answer(const Request& request, Response response, httplib::Response& to) {
    to.status = response.status;
    to.set_content(std::move(response.body), response.content_type);
    to.set_header("X-Request-Id", request.id);
    to.set_header("X-Content-Type-Options", "nosniff");
    for (const auto& [name, value] : response.headers) to.set_header(name, value);
}

/// Why a body must not be read, if so: before a byte of it is taken.
std::optional<api::Problem> bad_framing(const httplib::Request& request) {
    const std::string length = request.get_header_value("Content-Length");
    const bool chunked = request.has_header("Transfer-Encoding");
    if (length.empty() && !chunked) return api::Problem{411, "length-required", "Content-Length must be given", {}};
    if (request.has_header("Content-Encoding"))
        return api::Problem{415, "unsupported-media-type", "the body must not be compressed", {}};
    std::size_t bytes = 0;
    const auto [end, error] = std::from_chars(length.data(), length.data() + length.size(), bytes);
    if (!length.empty() && (error == std::errc::invalid_argument || end != length.data() + length.size()))
        return api::Problem{400, "bad-request", "Content-Length must be a number", {}};
    if (error == std::errc::result_out_of_range || bytes > kLargestBody)
        return api::Problem{
            413, "too-large", "the body may have at most " + std::to_string(kLargestBody) + " bytes", {}};
    return std::nullopt;
}

}  // namespace

struct HttpServer::Impl {
    explicit Impl(const Routes& routes_in) : routes(routes_in) {
        server.new_task_queue = [] { return new httplib::ThreadPool(kThreads); };
        server.set_read_timeout(kTimeout_s);
        server.set_write_timeout(kTimeout_s);
        server.set_keep_alive_timeout(kTimeout_s);
        server.set_tcp_nodelay(true);
        // The stock options share the port with a second server (SO_REUSEPORT), which then answers half of the
        // requests.
        server.set_socket_options([](socket_t socket) {
            const int yes = 1;
            ::setsockopt(socket, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
        });
        const httplib::Server::Handler plain = [this](const httplib::Request& from, httplib::Response& to) {
            const Request request = request_of(from);
            respond(request, routes.handle(request), to);
        };
        server.Get(".*", plain);
        server.Options(".*", plain);
        server.Delete(".*", plain);
        const httplib::Server::HandlerWithContentReader with_body =
            [this](const httplib::Request& from, httplib::Response& to, const httplib::ContentReader& read) {
                Request request = request_of(from);
                if (const auto problem = bad_framing(from))
                    return respond(request, problem_response(*problem, request), to);
                if (from.is_multipart_form_data()) {
                    const api::Problem problem{415, "unsupported-media-type", "a form is not accepted", {}};
                    return respond(request, problem_response(problem, request), to);
                }
                const bool whole = read([&](const char* data, std::size_t size) {
                    if (request.body.size() + size > kLargestBody) return false;  // chunked bodies tell no length
                    request.body.append(data, size);
                    return true;
                });
                if (!whole) {
                    const api::Problem problem{
                        413,
                        "too-large",
                        "the body is incomplete or has more than " + std::to_string(kLargestBody) + " bytes",
                        {}};
                    return respond(request, problem_response(problem, request), to);
                }
                respond(request, routes.handle(request), to);
            };
        server.Post(".*", with_body);
        server.Put(".*", with_body);
        server.Patch(".*", with_body);
        // What the library refuses itself (a bad request line, a URI too long) has no body yet.
        server.set_error_handler([](const httplib::Request& from, httplib::Response& to) {
            if (!to.body.empty()) return;
            const Request request = request_of(from);
            const int status = to.status;
            answer(request, problem_response({status, "http", "the request cannot be served", {}}, request), to);
        });
    }

    void respond(const Request& request, Response response, httplib::Response& to) const {
        spdlog::info("{} {} {} request {}", request.method, printable(request.path), response.status, request.id);
        answer(request, std::move(response), to);
    }

    const Routes& routes;
    httplib::Server server;
};

HttpServer::HttpServer(const Routes& routes) : impl_(std::make_unique<Impl>(routes)) {}
HttpServer::~HttpServer() = default;

int HttpServer::bind(const std::string& host, int port) {
    const int bound = port == 0                                ? impl_->server.bind_to_any_port(host)
                      : impl_->server.bind_to_port(host, port) ? port
                                                               : -1;
    if (bound < 0) throw std::runtime_error("cannot bind " + host + ":" + std::to_string(port) + ": is it in use?");
    return bound;
}

void HttpServer::serve() { impl_->server.listen_after_bind(); }

void HttpServer::stop() { impl_->server.stop(); }

}  // namespace brdfit::server
