/// Connections: who is let in, how long each step may take, and how much memory all of them may hold.
#pragma once

#include <chrono>
#include <cstddef>
#include <memory>
#include <optional>
#include <string>

#include "api/problem.h"
#include "server/head.h"
#include "server/metrics.h"
#include "server/routes.h"

namespace brdfit::server {

struct Limits {
    using Milliseconds = std::chrono::milliseconds;
    std::size_t largest_body = kLargestBody;  ///< bytes
    /// Connections at once, of one peer half as many. The one that has been waiting longest makes room for a new one.
    std::size_t most_connections = 1024;
    std::size_t most_requests = 1000;  ///< of a connection
    std::size_t threads = 256;         ///< requests being answered at once, those that wait included
    // Absolute: no byte that comes in between gives more time.
    Milliseconds head_time{5000};    ///< from the head's first byte, or the connection's start, to its end
    Milliseconds body_time{20000};   ///< from the end of the head
    Milliseconds idle_time{30000};   ///< between two requests
    Milliseconds write_time{10000};  ///< for an answer, and more for its length:
    std::size_t write_rate = std::size_t{64} << 10;  ///< bytes a second
    Milliseconds linger_time{2000};  ///< for the peer to read the last answer before the connection is reset
    Milliseconds stop_time{5000};    ///< for requests that are coming and answers that are going, once it stops
};

/// One request and its answer, as bytes.
struct Exchange {
    Head head;
    std::string body;
    std::string address;  ///< of the peer
    std::string tenant;
    std::string output;                           ///< the answer as it goes out
    bool last = false;                            ///< the connection ends with this answer
    std::chrono::steady_clock::time_point begun;  ///< when the request was there
    Stream* stream = nullptr;                     ///< to write to without waiting for the end of answer()
};

/// What a listener asks.
class Service {
public:
    virtual ~Service() = default;
    /// On the listener's thread, so without waiting: whether the request may send its body and be answered. Sets the
    /// tenant.
    virtual std::optional<api::Problem> admit(Exchange& exchange) = 0;
    /// As admit: writes a refusal to exchange.output.
    virtual void refuse(Exchange& exchange, const api::Problem& problem) = 0;
    /// On any thread: writes the answer to exchange.output, or bit by bit to exchange.stream what follows it.
    virtual void answer(Exchange& exchange) = 0;
};

/// Waits for bytes of all connections on one thread, and has a thread answer a request only when all of it is there:
/// who sends or reads slowly holds a socket and a few bytes.
class Listener {
public:
    Listener(const Limits& limits, Service& service, Metrics& metrics);
    ~Listener();

    /// Serves what connects to the socket, which it closes, until stop(). Throws std::runtime_error if the socket
    /// fails.
    void run(int socket);
    /// From any thread, also before run(): no more connections; run() returns when all requests are answered.
    void stop();
    [[nodiscard]] bool stopping() const;

private:
    class Loop;
    std::unique_ptr<Loop> loop_;
};

}  // namespace brdfit::server
