#include "server/http.h"

#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <charconv>
#include <chrono>
#include <functional>
#include <optional>
#include <stdexcept>
#include <thread>

#include <httplib.h>
#include <spdlog/spdlog.h>

#include "api/problem.h"
#include "server/store.h"

namespace brdfit::server {
namespace {

/// Threads that wait on sockets: a request that fits holds one, so more than there are cores.
constexpr std::size_t kThreads = 32;
constexpr std::size_t kRequestsOfAConnection = 1000;

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

void answer(const Request& request, const Response& response, httplib::Response& to) {
    to.status = response.status;
    to.set_content(response.body, response.content_type);
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

/// A connection with limits: a head of at most 64 KB that comes within 5 s, a body within 20 s.
class Connection final : public httplib::Stream {
public:
    explicit Connection(socket_t socket) : socket_(socket) {}

    void begin_head() { limit(kLargestHead, kHeadTime); }
    void begin_body() { limit(2 * kLargestBody, kBodyTime); }  // chunks have their own framing
    /// Waits for the next request; false if none comes while the server runs.
    [[nodiscard]] bool wait(const std::function<bool()>& is_running) const {
        if (begin_ < end_) return true;
        const Clock::time_point until = Clock::now() + kIdleTime;
        while (is_running() && Clock::now() < until)
            if (poll_for(POLLIN, std::chrono::milliseconds(100))) return true;
        return false;
    }
    /// Takes what the peer still sends, for a moment, so that it reads our answer before the connection is reset.
    void drain() {
        ::shutdown(socket_, SHUT_WR);
        begin_ = end_ = 0;
        limit(4 * kLargestBody, std::chrono::seconds(2));
        std::array<char, 4096> sink{};
        while (read(sink.data(), sink.size()) > 0) {
        }
    }

    [[nodiscard]] bool is_readable() const override { return begin_ < end_ || poll_for(POLLIN, left()); }
    [[nodiscard]] bool is_writable() const override { return poll_for(POLLOUT, kWriteTime); }
    ssize_t read(char* to, size_t size) override {
        if (begin_ == end_) {
            if (allowed_ == 0 || !poll_for(POLLIN, left())) return -1;
            const ssize_t got = ::recv(socket_, buffer_.data(), std::min(buffer_.size(), allowed_), 0);
            if (got <= 0) return got;
            allowed_ -= static_cast<size_t>(got);
            begin_ = 0;
            end_ = static_cast<size_t>(got);
        }
        const size_t count = std::min(size, end_ - begin_);
        std::copy_n(buffer_.data() + begin_, count, to);
        begin_ += count;
        return static_cast<ssize_t>(count);
    }
    ssize_t write(const char* from, size_t size) override {
        return is_writable() ? ::send(socket_, from, size, MSG_NOSIGNAL) : -1;
    }
    void get_remote_ip_and_port(std::string& ip, int& port) const override { ip = "", port = 0; }
    void get_local_ip_and_port(std::string& ip, int& port) const override { ip = "", port = 0; }
    [[nodiscard]] socket_t socket() const override { return socket_; }

private:
    using Clock = std::chrono::steady_clock;
    using Milliseconds = std::chrono::milliseconds;
    static constexpr std::size_t kLargestHead = std::size_t{64} << 10;
    static constexpr Milliseconds kHeadTime{5000};
    static constexpr Milliseconds kBodyTime{20000};
    static constexpr Milliseconds kIdleTime{5000};
    static constexpr Milliseconds kWriteTime{5000};

    void limit(std::size_t bytes, Milliseconds time) {
        allowed_ = bytes;
        deadline_ = Clock::now() + time;
    }
    [[nodiscard]] Milliseconds left() const {
        return std::max(Milliseconds(0), std::chrono::duration_cast<Milliseconds>(deadline_ - Clock::now()));
    }
    [[nodiscard]] bool poll_for(short events, Milliseconds time) const {
        pollfd descriptor{socket_, events, 0};
        return ::poll(&descriptor, 1, static_cast<int>(time.count())) > 0;
    }

    socket_t socket_;
    std::array<char, 16384> buffer_{};
    size_t begin_ = 0;
    size_t end_ = 0;
    std::size_t allowed_ = 0;
    Clock::time_point deadline_{};
};

/// Set by a handler that refuses a request without reading its body, which the connection then still holds: the library
/// serves a connection in one thread and would take the body for the next request.
thread_local bool body_left_unread = false;

/// The library's server over our connections. A request that asks for a range gets the whole; one whose body must not
/// be read is the connection's last.
class LimitedServer final : public httplib::Server {
    bool process_and_close_socket(socket_t socket) override {
        Connection connection(socket);
        bool last = false;
        for (std::size_t left = keep_alive_max_count_; left > 0 && !last; --left) {
            if (!connection.wait([this] { return svr_sock_ != INVALID_SOCKET; })) break;
            connection.begin_head();
            bool closed = false;
            body_left_unread = false;
            const bool served = process_request(connection, left == 1, closed, [&](httplib::Request& request) {
                request.ranges.clear();
                connection.begin_body();
            });
            last = !served || closed || body_left_unread;
            if (body_left_unread) connection.drain();
        }
        ::shutdown(socket, SHUT_RDWR);
        ::close(socket);
        return true;
    }
};

}  // namespace

struct HttpServer::Impl {
    explicit Impl(const Routes& routes_in) : routes(routes_in) {
        server.new_task_queue = [] { return new httplib::ThreadPool(kThreads); };
        server.set_keep_alive_max_count(kRequestsOfAConnection);
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
                const auto refuse_unread = [&](const api::Problem& problem) {
                    body_left_unread = true;
                    to.set_header("Connection", "close");
                    respond(request, problem_response(problem, request), to);
                };
                if (const auto problem = bad_framing(from)) return refuse_unread(*problem);
                if (from.is_multipart_form_data())
                    return refuse_unread({415, "unsupported-media-type", "a form is not accepted", {}});
                bool too_large = false;  // chunked bodies tell no length
                const bool whole = read([&](const char* data, std::size_t size) {
                    too_large = request.body.size() + size > kLargestBody;
                    if (too_large) return false;
                    request.body.append(data, size);
                    return true;
                });
                if (too_large)
                    return refuse_unread(
                        {413, "too-large", "the body may have at most " + std::to_string(kLargestBody) + " bytes", {}});
                if (!whole) return refuse_unread({400, "bad-request", "the body is incomplete", {}});
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

    void respond(const Request& request, const Response& response, httplib::Response& to) const {
        spdlog::info("{} {} {} request {}", request.method, printable(request.path), response.status, request.id);
        answer(request, response, to);
    }

    const Routes& routes;
    LimitedServer server;
    std::atomic<bool> stopping = false;
    std::atomic<bool> finished = false;
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

void HttpServer::serve() {
    if (!impl_->stopping) impl_->server.listen_after_bind();
    impl_->finished = true;
}

void HttpServer::stop() {
    impl_->stopping = true;
    // The library forgets a stop that comes before it listens.
    while (!impl_->finished && !impl_->server.is_running()) std::this_thread::sleep_for(std::chrono::milliseconds(1));
    impl_->server.stop();
}

}  // namespace brdfit::server
