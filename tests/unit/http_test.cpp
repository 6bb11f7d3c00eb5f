/// Connections with deadlines of milliseconds, chunks, places, metrics. Attacks on the whole service:
/// tests/http/guard.py.
#include "server/http.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <map>
#include <regex>
#include <set>
#include <sstream>
#include <string>
#include <thread>

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "server/chunks.h"
#include "server/head.h"

namespace brdfit::server {
namespace {

using namespace std::chrono_literals;
using std::chrono::milliseconds;
using std::chrono::steady_clock;
using testing::HasSubstr;
using testing::StartsWith;

/// A peer that speaks bytes.
class Peer {
public:
    explicit Peer(int port, int receive_buffer = 0) : socket_(::socket(AF_INET, SOCK_STREAM, 0)) {
        if (receive_buffer > 0) ::setsockopt(socket_, SOL_SOCKET, SO_RCVBUF, &receive_buffer, sizeof receive_buffer);
        sockaddr_in address{};
        address.sin_family = AF_INET;
        address.sin_port = htons(static_cast<std::uint16_t>(port));
        address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        EXPECT_EQ(::connect(socket_, reinterpret_cast<sockaddr*>(&address), sizeof address), 0);
        const timeval patience{5, 0};
        ::setsockopt(socket_, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    }
    ~Peer() { ::close(socket_); }
    Peer(const Peer&) = delete;
    Peer& operator=(const Peer&) = delete;

    bool send(std::string_view text) const {
        return ::send(socket_, text.data(), text.size(), MSG_NOSIGNAL) == static_cast<ssize_t>(text.size());
    }
    /// What comes next; empty when the server has closed.
    [[nodiscard]] std::string receive() const {
        std::array<char, 65536> buffer{};
        const ssize_t got = ::recv(socket_, buffer.data(), buffer.size(), 0);
        return {buffer.data(), static_cast<std::size_t>(std::max<ssize_t>(got, 0))};
    }
    [[nodiscard]] std::string receive_all() const {
        std::string all;
        for (std::string more = receive(); !more.empty(); more = receive()) all += more;
        return all;
    }

private:
    int socket_;
};

class HttpServerTest : public testing::Test {
protected:
    void start(HttpServer::Handler handler) {
        options_.limits.head_time = options_.limits.body_time = options_.limits.idle_time = options_.limits.write_time =
            options_.limits.linger_time = time_;
        server_ = std::make_unique<HttpServer>(std::move(handler), options_);
        port_ = server_->bind("127.0.0.1", 0);
        thread_ = std::thread([this] { server_->serve(); });
    }
    void stop() {
        if (!thread_.joinable()) return;
        server_->stop();
        thread_.join();
    }
    void TearDown() override { stop(); }
    /// Waits until the metrics say so.
    bool metrics_say(const std::string& line) const {
        for (int i = 0; i < 300; ++i, std::this_thread::sleep_for(10ms))
            if (server_->metrics().text().find(line) != std::string::npos) return true;
        return false;
    }
    static Response echo(const Request& request) { return {200, "text/plain", request.method + request.body}; }

    static constexpr const char* kGet = "GET / HTTP/1.1\r\nHost: x\r\n\r\n";
    static constexpr const char* kPost = "POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n\r\n";
    milliseconds time_ = 200ms;  ///< for each step of a connection
    HttpOptions options_;
    std::unique_ptr<HttpServer> server_;
    int port_ = 0;
    std::thread thread_;
};

TEST_F(HttpServerTest, HeadsAndBodiesHaveADeadlineThatNoByteMoves) {
    start(echo);
    for (const std::string begin : {"GET / HTTP/1.1\r\nX: ", kPost}) {
        const Peer peer(port_);
        const auto from = steady_clock::now();
        std::atomic<bool> done = false;
        std::thread drip([&] {
            (void)peer.send(begin);
            while (!done && peer.send("x")) std::this_thread::sleep_for(20ms);
        });
        EXPECT_THAT(peer.receive_all(), StartsWith("HTTP/1.1 408 "));
        const auto time = steady_clock::now() - from;
        done = true;
        drip.join();
        EXPECT_GE(time, 200ms);
        EXPECT_LT(time, 2s);
    }
}

TEST_F(HttpServerTest, ConnectionsThatSayNothingAreClosedWithoutAWord) {
    start(echo);
    EXPECT_EQ(Peer(port_).receive_all(), "");
    const Peer used(port_);
    ASSERT_TRUE(used.send(kGet));
    EXPECT_THAT(used.receive(), StartsWith("HTTP/1.1 200 "));
    EXPECT_EQ(used.receive_all(), "");
    EXPECT_TRUE(metrics_say("brdfit_http_connections_closed_total{reason=\"idle\"} 2\n"));
}

TEST_F(HttpServerTest, WhoDoesNotReadIsDropped) {
    options_.limits.write_rate = std::size_t{64} << 20;
    start([](const Request&) { return Response{200, "text/plain", std::string(std::size_t{8} << 20, 'x')}; });
    const Peer deaf(port_, 4096);
    ASSERT_TRUE(deaf.send(kGet));
    EXPECT_TRUE(metrics_say("brdfit_http_connections_closed_total{reason=\"write_timeout\"} 1\n"));
}

TEST_F(HttpServerTest, AnswersThatNobodyReadsTakeSoMuchMemory) {
    options_.limits.write_rate = 1;
    start([](const Request&) { return Response{200, "text/plain", std::string(std::size_t{8} << 20, 'x')}; });
    std::vector<std::unique_ptr<Peer>> deaf;
    for (int i = 0; i < 5; ++i) {
        deaf.push_back(std::make_unique<Peer>(port_, 4096));
        ASSERT_TRUE(deaf.back()->send(kGet));
    }
    EXPECT_TRUE(metrics_say("brdfit_http_connections_closed_total{reason=\"evicted\"}"));
    const Peer other(port_);
    ASSERT_TRUE(other.send("HEAD / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"));
    EXPECT_THAT(other.receive_all(), StartsWith("HTTP/1.1 200 "));
}

TEST_F(HttpServerTest, TheNewestConnectionDisplacesTheOneThatWaitedLongest) {
    time_ = 20s;
    options_.limits.most_connections = 20;  // ten of one peer
    start(echo);
    const Peer first(port_);
    std::vector<std::unique_ptr<Peer>> others;
    for (int i = 0; i < 10; ++i) others.push_back(std::make_unique<Peer>(port_));
    const std::string told = first.receive_all();
    EXPECT_THAT(told, StartsWith("HTTP/1.1 503 "));
    EXPECT_THAT(told, HasSubstr("Retry-After: 1\r\n"));
    ASSERT_TRUE(others.back()->send(kGet));
    EXPECT_THAT(others.back()->receive(), StartsWith("HTTP/1.1 200 "));
}

TEST_F(HttpServerTest, AStreamEndsWithItsClientOrTheService) {
    std::atomic<int> open = 0;
    start([&open](const Request&) {
        Response response{200, "text/event-stream", ""};
        response.stream = [&open](Stream& to) {
            ++open;
            while (to.open() && to.write(": ping\n\n")) std::this_thread::sleep_for(10ms);
            if (to.stopping()) to.write("event: bye\n\n");
            --open;
        };
        return response;
    });
    {
        const Peer peer(port_);
        ASSERT_TRUE(peer.send(kGet));
        std::string begin = peer.receive();
        while (begin.find("ping") == std::string::npos) begin += peer.receive();
        EXPECT_THAT(begin, HasSubstr("Content-Type: text/event-stream\r\n"));
        EXPECT_THAT(begin, HasSubstr("Connection: close\r\n"));
        EXPECT_EQ(begin.find("Content-Length"), std::string::npos);
        EXPECT_EQ(open, 1);
    }
    for (int i = 0; i < 200 && open > 0; ++i) std::this_thread::sleep_for(10ms);
    EXPECT_EQ(open, 0) << "the client has gone";
    const Peer peer(port_);
    ASSERT_TRUE(peer.send(kGet));
    std::string all = peer.receive();
    std::thread stopping([this] { server_->stop(); });
    all += peer.receive_all();
    stopping.join();
    EXPECT_THAT(all, testing::EndsWith("event: bye\n\n"));
    stop();
}

TEST_F(HttpServerTest, StreamsHaveTheirNumber) {
    options_.streams = {3, 2};
    std::atomic<bool> go_on = true;
    start([&](const Request&) {
        Response response{200, "text/event-stream", ""};
        response.stream = [&](Stream& to) {
            while (go_on && to.open()) std::this_thread::sleep_for(5ms);
        };
        return response;
    });
    const Peer one(port_);
    const Peer two(port_);
    for (const Peer* peer : {&one, &two}) {
        ASSERT_TRUE(peer->send(kGet));
        EXPECT_THAT(peer->receive(), StartsWith("HTTP/1.1 200 "));
    }
    const Peer three(port_);
    ASSERT_TRUE(three.send(kGet));
    const std::string told = three.receive();
    EXPECT_THAT(told, StartsWith("HTTP/1.1 429 "));
    EXPECT_THAT(told, HasSubstr("Retry-After: "));
    EXPECT_THAT(told, HasSubstr("/problems/too-many-requests"));
    go_on = false;
}

TEST_F(HttpServerTest, HeadersReachTheHandlerAsTheyWereSent) {
    Request seen;
    start([&seen](const Request& request) {
        seen = request;
        return Response{204, "application/json", "", {}};
    });
    const Peer peer(port_);
    ASSERT_TRUE(peer.send("GET /a%20b?c=d%26e HTTP/1.1\r\nhost: x\r\nPREFER: a\r\nPrefer: b\r\nX: %0d%0a\r\n\r\n"));
    const std::string answer = peer.receive();
    EXPECT_EQ(seen.header("prefer"), "a, b");
    EXPECT_EQ(seen.header("x"), "%0d%0a");
    EXPECT_EQ(seen.header("y"), "");
    EXPECT_EQ(seen.path, "/a b");
    EXPECT_EQ(seen.query.find("c")->second, "d&e");
    EXPECT_EQ(seen.address, "127.0.0.1");
    EXPECT_EQ(answer.find("Content-Length"), std::string::npos) << "204 has no content";
    stop();
}

TEST_F(HttpServerTest, OthersReachItOnlyWithKeys) {
    EXPECT_TRUE(is_loopback("127.1.2.3"));
    EXPECT_TRUE(is_loopback("::1"));
    for (const char* host : {"0.0.0.0", "127.example.com", "::", "10.0.0.1", ""})
        EXPECT_FALSE(is_loopback(host)) << host;
    HttpServer server(HttpServer::Handler(echo), {});
    EXPECT_THROW(server.bind("0.0.0.0", 0), std::runtime_error);
}

/// The rules of Prometheus's text format, version 0.0.4, for what there is in ours.
TEST_F(HttpServerTest, MetricsAreInPrometheusTextFormat) {
    start(echo);
    server_->metrics().add_source([] {
        return std::vector<Metrics::Figure>{{"brdfit_jobs", "Jobs by \\state", {{"state", "a\"b\\\n"}}, 2.5, false},
                                            {"brdfit_jobs", "Jobs by \\state", {{"state", "running"}}, 1, false}};
    });
    const Peer peer(port_);
    ASSERT_TRUE(peer.send(kGet));
    (void)peer.receive();
    ASSERT_TRUE(peer.send("GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"));
    const std::string answer = peer.receive_all();
    EXPECT_THAT(answer, HasSubstr("Content-Type: text/plain; version=0.0.4; charset=utf-8\r\n"));
    std::istringstream lines(answer.substr(answer.find("\r\n\r\n") + 4));
    const std::regex comment(R"(# (HELP|TYPE) ([a-zA-Z_:][a-zA-Z0-9_:]*) (.+))");
    const std::regex sample(
        R"re(([a-zA-Z_:][a-zA-Z0-9_:]*)(\{([a-zA-Z_][a-zA-Z0-9_]*="([^"\\\n]|\\["\\n])*",?)*\})? (\S+))re");
    std::map<std::string, std::string> types;
    std::set<std::string> seen;
    std::string family;
    std::map<std::string, double> values;
    for (std::string line; std::getline(lines, line);) {
        std::smatch match;
        if (std::regex_match(line, match, comment)) {
            if (match[1] == "TYPE") {
                EXPECT_TRUE(types.emplace(match[2], match[3]).second) << "twice: " << line;
                family = match[2];
            }
            continue;
        }
        ASSERT_TRUE(std::regex_match(line, match, sample)) << line;
        const std::string name = match[1];
        EXPECT_EQ(name.substr(0, family.size()), family) << "stands apart: " << line;
        const std::set<std::string> suffixes = types[family] == "histogram"
                                                   ? std::set<std::string>{"_bucket", "_sum", "_count"}
                                                   : std::set<std::string>{""};
        EXPECT_THAT(suffixes, testing::Contains(name.substr(family.size()))) << line;
        EXPECT_EQ(types[family] == "counter", family.ends_with("_total")) << line;
        EXPECT_TRUE(seen.insert(line.substr(0, line.rfind(' '))).second) << "twice: " << line;
        const double value = std::stod(match[5]);
        EXPECT_TRUE(std::isfinite(value)) << line;
        values[line.substr(0, line.rfind(' '))] = value;
    }
    EXPECT_EQ(values[R"(brdfit_jobs{state="a\"b\\\n"})"], 2.5);
    EXPECT_EQ(values[R"(brdfit_http_requests_total{method="GET",route="none",status="200"})"], 1);
    EXPECT_EQ(values[R"(brdfit_http_request_duration_seconds_bucket{route="none",le="+Inf"})"],
              values[R"(brdfit_http_request_duration_seconds_count{route="none"})"]);
    EXPECT_EQ(values["brdfit_http_requests_in_flight"], 1) << "this one";
    EXPECT_GT(values["process_resident_memory_bytes"], 1e6);
}

TEST(ChunkReaderTest, PiecesOfAnySizeAreTheSameBody) {
    const std::string sent = "5;x=y\r\nhello\r\n0c \r\n, chunk\r\nend\r\n0\r\nTrailer: 1\r\n\r\n";
    for (std::size_t size = 1; size <= sent.size(); ++size) {
        ChunkReader reader;
        std::string body;
        auto state = ChunkReader::State::more;
        for (std::size_t at = 0; at < sent.size(); at += size) {
            std::string_view piece = std::string_view(sent).substr(at, size);
            ASSERT_EQ(state, ChunkReader::State::more);
            state = reader.read(piece, body, 100);
            EXPECT_TRUE(piece.empty());
        }
        EXPECT_EQ(state, ChunkReader::State::whole);
        EXPECT_EQ(body, "hello, chunk\r\nend");
    }
}

TEST(ChunkReaderTest, TakesUpToTheLargestBodyAndLeavesWhatFollows) {
    std::string body;
    std::string_view sent = "5\r\nhello\r\n0\r\n\r\nGET";
    EXPECT_EQ(ChunkReader().read(sent, body, 5), ChunkReader::State::whole);
    EXPECT_EQ(sent, "GET");
    body.clear();
    sent = "3\r\nabc\r\n3\r\nabc\r\n";
    EXPECT_EQ(ChunkReader().read(sent, body, 5), ChunkReader::State::too_large);
}

TEST(HeadScannerTest, FindsTheEndByteByByte) {
    const std::string head = "\r\nGET / HTTP/1.1\r\nHost: x\r\n\r\n";
    HeadScanner scanner;
    for (std::size_t size = 1; size < head.size(); ++size)
        ASSERT_FALSE(scanner.find_end(std::string_view(head).substr(0, size))) << size;
    EXPECT_EQ(scanner.find_end(head + "more"), head.size());
    EXPECT_FALSE(scanner.problem());
}

TEST(PlacesTest, AreGivenBack) {
    Places places({3, 2}, "places");
    auto a = places.take("a");
    {
        const auto second = places.take("a");
        EXPECT_EQ(places.take("a").problem->type.status, 429);
        const auto b = places.take("b");
        EXPECT_EQ(places.take("c").problem->type.status, 503);
    }
    EXPECT_FALSE(places.take("a").problem);
    a.place.reset();
    const auto b = places.take("b");
    EXPECT_FALSE(places.take("b").problem);
}

TEST(RateTest, LetsABurstThroughAndThenSoManyASecond) {
    Rate rate(10);
    Rate::Clock::time_point now{};
    int allowed = 0;
    for (int i = 0; i < 100; ++i) allowed += rate.allows("a", now) ? 1 : 0;
    EXPECT_EQ(allowed, 20);
    EXPECT_TRUE(rate.allows("b", now));
    now += 500ms;
    for (int i = 0; i < 100; ++i) allowed += rate.allows("a", now) ? 1 : 0;
    EXPECT_EQ(allowed, 25);
}

}  // namespace
}  // namespace brdfit::server
