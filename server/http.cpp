#include "server/http.h"

#include <arpa/inet.h>
#include <malloc.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <ctime>
#include <optional>
#include <stdexcept>
#include <string_view>
#include <utility>

#include <httplib.h>
#include <spdlog/spdlog.h>
#include <boost/algorithm/string/predicate.hpp>

#include "api/problem.h"
#include "server/api_keys.h"
#include "server/log.h"

namespace brdfit::server {
namespace {

/// Blocks from this size on go back to the system when they are freed: bodies and answers.
constexpr int kLargeBlock = 1 << 20;
/// What a client that comes too early is told to wait, in seconds.
constexpr const char* kRetryAfter = "1";

bool is_request_id(std::string_view id) {
    const auto ok = [](unsigned char c) { return std::isalnum(c) != 0 || c == '.' || c == '_' || c == '-'; };
    return !id.empty() && id.size() <= 64 && std::all_of(id.begin(), id.end(), ok);
}

bool is_health(std::string_view path) { return path.starts_with("/health/"); }

/// What everybody may see: whether the service works, and what it is.
bool is_public(std::string_view path) {
    return is_health(path) || path == "/" || path == "/openapi.json" || path == "/docs";
}

/// Whether a request may hold its thread for long, doing nothing.
bool may_wait(const Request& request) {
    return (request.method != "GET" && request.method != "HEAD" && request.method != "OPTIONS") ||
           boost::algorithm::icontains(request.header("Prefer"), "wait");
}

/// Of clients that have no name it is the address that counts.
const std::string& client_of(const Exchange& exchange) {
    return exchange.tenant.empty() ? exchange.address : exchange.tenant;
}

std::string date_now() {
    const std::time_t now = std::time(nullptr);
    std::tm parts{};
    ::gmtime_r(&now, &parts);
    std::array<char, 32> text{};
    return {text.data(), std::strftime(text.data(), text.size(), "%a, %d %b %Y %H:%M:%S GMT", &parts)};
}

/// The library reads a request line from here and writes an answer.
class Bytes final : public httplib::Stream {
public:
    Bytes(std::string input, const std::string& address, std::string& output)
        : input_(std::move(input)), address_(address), output_(output) {}

    [[nodiscard]] bool is_readable() const override { return true; }
    [[nodiscard]] bool is_writable() const override { return true; }
    ssize_t read(char* to, size_t size) override {
        const size_t count = std::min(size, input_.size() - read_);
        std::copy_n(input_.data() + read_, count, to);
        read_ += count;
        return static_cast<ssize_t>(count);
    }
    ssize_t write(const char* from, size_t size) override {
        output_.append(from, size);
        return static_cast<ssize_t>(size);
    }
    void get_remote_ip_and_port(std::string& ip, int& port) const override { ip = address_, port = 0; }
    void get_local_ip_and_port(std::string& ip, int& port) const override { ip = "", port = 0; }
    [[nodiscard]] socket_t socket() const override { return -1; }

private:
    std::string input_;
    const std::string& address_;
    std::string& output_;
    size_t read_ = 0;
};

/// What is answered to the request that the library has just read. The library calls back without saying for which
/// connection: each runs on a thread of its own.
using Answer = std::function<void(const httplib::Request&, httplib::Response&)>;
thread_local const Answer* answer_now = nullptr;

/// The library, without its sockets and threads: it reads request lines and writes the heads of answers. Bodies,
/// framing and limits are Listener's.
class Library final : public httplib::Server {
public:
    Library() {
        // The stock options share the port with a second server (SO_REUSEPORT), which then answers half of the
        // requests.
        set_socket_options([](socket_t socket) {
            const int yes = 1;
            ::setsockopt(socket, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
        });
        set_pre_routing_handler([](const httplib::Request& from, httplib::Response& to) {
            (*answer_now)(from, to);
            return HandlerResponse::Handled;
        });
        set_post_routing_handler([](const httplib::Request&, httplib::Response& to) {
            if (to.get_header_value("Connection") == "close") to.headers.erase("Keep-Alive");
            if (to.status != 204 && to.status != 304) return;
            for (const char* of_a_body : {"Content-Length", "Content-Type"}) to.headers.erase(of_a_body);
        });
    }
    /// The listening socket, once it is bound; it is the caller's then.
    socket_t take_socket() { return svr_sock_.exchange(INVALID_SOCKET); }
    /// Reads the request line, has it answered, and appends the answer to output; false if it cannot be read.
    bool process(const std::string& request_line, const std::string& address, bool last, const Answer& answer,
                 std::string& output) {
        Bytes bytes(request_line + "\r\n\r\n", address, output);
        answer_now = &answer;
        bool closed = false;
        const bool done = process_request(bytes, last, closed, nullptr);
        answer_now = nullptr;
        return done;
    }
};

/// The target as the library must get it: a `?` within the query, which it would take for a second one, is escaped; a
/// `/` that was escaped in the path stays so, as it is part of a name there.
std::string unambiguous(std::string target) {
    for (std::size_t at = 0; (at = target.find('%', at)) < target.find('?'); ++at)
        if (boost::algorithm::iequals(target.substr(at, 3), "%2f")) target.replace(at, 3, "%252F");
    const std::size_t query = target.find('?');
    for (std::size_t at = query; at != std::string::npos;) {
        at = target.find('?', at + 1);
        if (at != std::string::npos) target.replace(at, 1, "%3F");
    }
    return target;
}

}  // namespace

bool is_loopback(const std::string& host) {
    in_addr address{};
    if (::inet_pton(AF_INET, host.c_str(), &address) == 1) return (ntohl(address.s_addr) >> 24U) == 127;
    return host == "localhost" || host == "::1";
}

struct HttpServer::Impl final : Service {
    Impl(Handler handler_in, const HttpOptions& options)
        : handler(std::move(handler_in)),
          rate(options.rate),
          waiting(options.waiting, "requests at once that may wait"),
          streams(options.streams, "streams at once"),
          listener(options.limits, *this, metrics) {
        if (!options.api_keys.empty()) keys.emplace(options.api_keys);
        library.set_keep_alive_max_count(options.limits.most_requests);
        library.set_keep_alive_timeout(
            std::chrono::duration_cast<std::chrono::seconds>(options.limits.idle_time).count());
        ::mallopt(M_MMAP_THRESHOLD, kLargeBlock);
    }

    // ---- what the listener asks ----

    std::optional<api::Problem> admit(Exchange& exchange) override {
        const std::string_view path = exchange.head.path();
        if (keys) {
            const auto sent = exchange.head.headers.find("Authorization");
            const auto name = sent == exchange.head.headers.end() ? std::nullopt : keys->name_of(sent->second);
            if (!name && !is_public(path))
                return api::Problem{
                    api::problem_type("unauthorized"), "an API key is needed: Authorization: Bearer KEY", {}};
            exchange.tenant = name.value_or("");
        }
        if (!is_health(path) && !rate.allows(client_of(exchange), std::chrono::steady_clock::now()))
            return api::Problem{
                api::problem_type("too-many-requests"), "a client may not send so many requests a second", {}};
        return std::nullopt;
    }

    void refuse(Exchange& exchange, const api::Problem& problem) override {
        Request request = request_of(exchange);
        request.path = exchange.head.path();
        const Response response = problem_response(problem, request);
        write(exchange, request.method == "HEAD" ? "HEAD / HTTP/1.1" : "GET / HTTP/1.1", response, request.id);
        conclude(exchange, request, response, response.body.size());
    }

    void answer(Exchange& exchange) override {
        metrics.add_requests(1);
        try {
            Request request = request_of(exchange);
            Response response;
            std::optional<Places::Taken> place;
            const auto respond = [&](const httplib::Request& from, httplib::Response& to) {
                request.path = from.path;
                request.query = {from.params.begin(), from.params.end()};
                response = respond_to(exchange, request, place);
                fill(exchange, response, request.id, to);
            };
            const Head& head = exchange.head;
            const std::string line = head.method + " " + unambiguous(head.target) + " HTTP/1.1";
            if (!library.process(line, exchange.address, exchange.last, respond, exchange.output))
                throw std::runtime_error("the library cannot read a request line");
            const std::size_t bytes = finish_stream(exchange, request, response);
            conclude(exchange, request, response, bytes);
        } catch (const std::exception& error) {
            spdlog::error("{}: {}", exchange.head.target, error.what());
            exchange.last = true;
            if (exchange.output.empty())
                refuse(exchange, {api::problem_type("internal"), "an error of the service; it has been logged", {}});
        }
        metrics.add_requests(-1);
    }

    // ---- parts of that ----

    /// All but path and query, which the library decodes; the body is moved.
    static Request request_of(Exchange& exchange) {
        Request request;
        request.method = exchange.head.method;
        request.headers = std::move(exchange.head.headers);
        request.body = std::move(exchange.body);
        request.content_type = request.header("Content-Type");
        request.id = request.header("X-Request-Id");
        if (!is_request_id(request.id)) request.id = make_job_id();
        request.tenant = exchange.tenant;
        request.address = exchange.address;
        return request;
    }

    /// place: kept as long as the answer takes.
    Response respond_to(const Exchange& exchange, const Request& request, std::optional<Places::Taken>& place) {
        if (request.path == "/metrics") return metrics_response(request);
        if (may_wait(request)) {
            place = waiting.take(client_of(exchange));
            if (place->problem) return problem_response(*place->problem, request);
        }
        Response response = handler(request);
        if (!response.stream) return response;
        place = streams.take(client_of(exchange));
        return place->problem ? problem_response(*place->problem, request) : response;
    }

    [[nodiscard]] Response metrics_response(const Request& request) const {
        Response response;
        if (request.method == "GET" || request.method == "HEAD") {
            response.content_type = Metrics::kContentType;
            response.body = metrics.text();
        } else {
            response = problem_response(
                {api::problem_type("method-not-allowed"), request.method + " is not for this resource", {}}, request);
            response.headers["Allow"] = "GET, HEAD";
        }
        response.route = "/metrics";
        return response;
    }

    void fill(const Exchange& exchange, const Response& response, const std::string& id, httplib::Response& to) const {
        to.status = response.status;
        to.set_header("Date", date_now());
        to.set_header("X-Request-Id", id);
        to.set_header("X-Content-Type-Options", "nosniff");
        to.set_header("Accept-Ranges", "none");
        if (exchange.head.is_http_1_0 && !exchange.last) to.set_header("Connection", "keep-alive");
        if (response.status == 429 || response.status == 503) to.headers.emplace("Retry-After", kRetryAfter);
        if (response.status == 401) to.set_header("WWW-Authenticate", "Bearer");
        for (const auto& [name, value] : response.headers) {
            to.headers.erase(name);
            to.set_header(name, value);
        }
        if (!response.stream) return to.set_content(response.body, response.content_type);
        to.set_header("Connection", "close");  // the end of the connection is that of the body
        // Content without a length: the library writes the head alone, and we what follows.
        to.set_content_provider(response.content_type, [](std::size_t, httplib::DataSink& sink) {
            sink.done();
            return true;
        });
    }

    void write(Exchange& exchange, const std::string& line, const Response& response, const std::string& id) {
        const Answer respond = [&](const httplib::Request&, httplib::Response& to) {
            fill(exchange, response, id, to);
        };
        (void)library.process(line, exchange.address, exchange.last, respond, exchange.output);
    }

    /// Counts what goes by.
    class CountedStream final : public Stream {
    public:
        explicit CountedStream(Stream& to) : to_(to) {}
        bool write(std::string_view bytes) override {
            bytes_ += bytes.size();
            return to_.write(bytes);
        }
        [[nodiscard]] bool open() const override { return to_.open(); }
        [[nodiscard]] bool stopping() const override { return to_.stopping(); }
        [[nodiscard]] std::size_t bytes() const { return bytes_; }

    private:
        Stream& to_;
        std::size_t bytes_ = 0;
    };

    /// Writes a streamed answer. Bytes of the answer's body.
    std::size_t finish_stream(Exchange& exchange, const Request& request, const Response& response) {
        if (!response.stream) return response.body.size();
        exchange.last = true;
        if (request.method == "HEAD") return 0;
        metrics.add_streams(1);
        CountedStream to(*exchange.stream);
        if (to.write("")) response.stream(to);  // the head goes at once
        metrics.add_streams(-1);
        return to.bytes();
    }

    /// Counts and logs an answer.
    void conclude(const Exchange& exchange, const Request& request, const Response& response, std::size_t bytes) {
        const bool was_read = !exchange.head.method.empty();  // else a connection was refused, not a request
        const std::chrono::duration<double> time =
            was_read ? std::chrono::steady_clock::now() - exchange.begun : std::chrono::steady_clock::duration{};
        metrics.count(
            {was_read ? request.method : "none", response.route, response.status, time, request.body.size(), bytes});
        if (was_read)
            log_request({request.method, std::string(exchange.head.path()), response.status, bytes, 1000 * time.count(),
                         request.id, request.tenant, request.address});
    }

    Handler handler;
    Metrics metrics;
    std::optional<ApiKeys> keys;
    Rate rate;
    Places waiting;
    Places streams;
    Library library;
    Listener listener;
    int socket = -1;
};

HttpServer::HttpServer(Handler handler, const HttpOptions& options)
    : impl_(std::make_unique<Impl>(std::move(handler), options)) {}
HttpServer::~HttpServer() {
    if (impl_->socket >= 0) ::close(impl_->socket);
}

int HttpServer::bind(const std::string& host, int port) {
    if (!impl_->keys && !is_loopback(host))
        throw std::runtime_error("without --api-keys the service binds loopback addresses only, not " + host);
    const int bound = port == 0                                 ? impl_->library.bind_to_any_port(host)
                      : impl_->library.bind_to_port(host, port) ? port
                                                                : -1;
    if (bound < 0) throw std::runtime_error("cannot bind " + host + ":" + std::to_string(port) + ": is it in use?");
    impl_->socket = impl_->library.take_socket();
    return bound;
}

void HttpServer::serve() {
    try {
        impl_->listener.run(std::exchange(impl_->socket, -1));
    } catch (const std::runtime_error& error) {
        spdlog::error("{}", error.what());
    }
}

void HttpServer::stop() { impl_->listener.stop(); }
Metrics& HttpServer::metrics() { return impl_->metrics; }

}  // namespace brdfit::server
