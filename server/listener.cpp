#include "server/listener.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <limits>
#include <mutex>
#include <set>
#include <stdexcept>
#include <thread>
#include <tuple>
#include <unordered_map>
#include <utility>
#include <vector>

#include <spdlog/spdlog.h>

#include "server/chunks.h"

namespace brdfit::server {
namespace {

/// Named, as clang 14 forgets a member of what problem_type() gives within braces.
constexpr api::ProblemType kBusy = api::problem_type("busy");

using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

/// Connections that the kernel keeps for us before we accept them.
constexpr int kBacklog = 1024;
/// Descriptors left to everything else: files, workers, the device.
constexpr std::size_t kDescriptorsOfOthers = 128;
/// The most bytes of heads that are coming and of answers that are going, all connections together.
constexpr std::size_t kMostHeld = std::size_t{24} << 20;
/// How long a body may be made to wait for room.
constexpr milliseconds kPauseTime{30000};
/// From where on a buffer that is empty is given back.
constexpr std::size_t kLargeBuffer = 16384;

class Descriptor {
public:
    explicit Descriptor(int number = -1) : number_(number) {}
    ~Descriptor() { reset(); }
    Descriptor(Descriptor&& other) noexcept : number_(std::exchange(other.number_, -1)) {}
    Descriptor& operator=(Descriptor&& other) noexcept {
        reset(std::exchange(other.number_, -1));
        return *this;
    }
    void reset(int number = -1) {
        if (number_ >= 0) ::close(number_);
        number_ = number;
    }
    [[nodiscard]] int get() const { return number_; }

private:
    int number_;
};

std::string name_of(const sockaddr_storage& peer) {
    std::array<char, INET6_ADDRSTRLEN> text{};
    if (peer.ss_family == AF_INET)
        ::inet_ntop(AF_INET, &reinterpret_cast<const sockaddr_in&>(peer).sin_addr, text.data(), text.size());
    else if (peer.ss_family == AF_INET6)
        ::inet_ntop(AF_INET6, &reinterpret_cast<const sockaddr_in6&>(peer).sin6_addr, text.data(), text.size());
    return text.data();
}

/// Sends what the socket takes at once; false if the peer is gone.
bool send_some(int socket, std::string_view bytes, std::size_t& sent) {
    while (sent < bytes.size()) {
        const ssize_t count = ::send(socket, bytes.data() + sent, bytes.size() - sent, MSG_NOSIGNAL);
        if (count >= 0) sent += static_cast<std::size_t>(count);
        else if (errno == EAGAIN || errno == EWOULDBLOCK) return true;
        else if (errno != EINTR) return false;
    }
    return true;
}

/// A socket that is written to bit by bit, from a request's thread.
class Wire final : public Stream {
public:
    Wire(int socket, std::string& before, milliseconds patience, const std::atomic<bool>& stopping)
        : socket_(socket), before_(before), patience_(patience), stopping_(stopping) {}

    bool write(std::string_view bytes) override {
        const std::string before = std::exchange(before_, {});  // the head of the answer
        return send_all(before) && send_all(bytes);
    }
    [[nodiscard]] bool open() const override {
        pollfd peer{socket_, POLLRDHUP, 0};
        return !failed_ && !stopping_ && ::poll(&peer, 1, 0) == 0;
    }
    [[nodiscard]] bool stopping() const override { return stopping_; }

private:
    bool send_all(std::string_view bytes) {
        std::size_t sent = 0;
        Clock::time_point end = Clock::now() + patience_;
        while (!failed_) {
            failed_ = !send_some(socket_, bytes, sent);
            if (sent == bytes.size()) break;
            if (stopping_) end = std::min(end, Clock::now() + milliseconds(1000));
            pollfd peer{socket_, POLLOUT, 0};
            (void)::poll(&peer, 1, 100);
            failed_ = failed_ || Clock::now() >= end;
        }
        return !failed_;
    }

    int socket_;
    std::string& before_;
    milliseconds patience_;
    const std::atomic<bool>& stopping_;
    bool failed_ = false;
};

/// What a connection does.
enum class State : std::uint8_t {
    lingering,  ///< its last answer is sent: what still comes is thrown away
    head,       ///< waits for a request, or the rest of its head
    body,
    writing,
    busy,  ///< is another thread's
    closed
};

struct Connection {
    std::uint64_t id = 0;
    Descriptor socket;
    std::string address;
    State state = State::head;
    Clock::time_point since;     ///< of the state
    Clock::time_point deadline;  ///< of the state
    std::string input;           ///< bytes that came and were not looked at
    HeadScanner scanner;
    ChunkReader chunks;
    Exchange exchange;
    std::size_t requests = 0;
    std::size_t sent = 0;        ///< bytes of the answer
    std::size_t held = 0;        ///< bytes of input and answer, as counted
    std::size_t body_held = 0;   ///< bytes of the body, as counted
    bool paused = false;         ///< its body waits for room
    bool reset = false;          ///< the peer is gone
    std::string why = "served";  ///< it is lingering
};

}  // namespace

class Listener::Loop {
public:
    Loop(const Limits& limits, Service& service, Metrics& metrics)
        : limits_(limits),
          service_(service),
          metrics_(metrics),
          epoll_(::epoll_create1(EPOLL_CLOEXEC)),
          wake_(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)),
          spare_(::open("/dev/null", O_RDONLY | O_CLOEXEC)) {
        if (epoll_.get() < 0 || wake_.get() < 0) throw std::runtime_error("there are no file descriptors left");
        watch(EPOLL_CTL_ADD, wake_.get(), EPOLLIN, kWake);
    }

    void run(int socket);
    void stop() {
        stopping_ = true;
        wake();
    }
    [[nodiscard]] bool stopping() const { return stopping_; }

private:
    static constexpr std::uint64_t kListening = 0;
    static constexpr std::uint64_t kWake = 1;

    void watch(int operation, int descriptor, std::uint32_t events, std::uint64_t id) const {
        epoll_event event{};
        event.events = events;
        event.data.u64 = id;
        ::epoll_ctl(epoll_.get(), operation, descriptor, &event);
    }
    /// Waits for one event of a connection.
    void await(Connection& c, std::uint32_t events) const {
        watch(EPOLL_CTL_MOD, c.socket.get(), events | EPOLLONESHOT, c.id);
    }
    void wake() const {
        const std::uint64_t one = 1;
        (void)!::write(wake_.get(), &one, sizeof one);
    }
    static void enter(Connection& c, State state, Clock::duration time) {
        c.state = state;
        c.since = Clock::now();
        c.deadline = c.since + time;
    }

    // ---- who is let in ----
    void accept_some();
    void turn_away(int socket);
    /// Closes the connection that has waited longest, for a step that others wait for less; of one address if one is
    /// named. False if all are being answered.
    bool evict(const std::string* address, bool holding = false);
    void close(Connection& c, const std::string& why);

    // ---- steps of a connection ----
    void read(Connection& c);
    /// Looks at what has come. Whether more is to come.
    bool advance(Connection& c);
    bool take_head(Connection& c, std::size_t size);
    bool take_body(Connection& c);
    /// Answers with a problem. Whether the connection then waits for a request.
    bool refuse(Connection& c, const api::Problem& problem, bool last);
    /// Whether the answer is sent and the connection waits for a request.
    bool flush(Connection& c);
    void go_on(Connection& c) {
        if (advance(c)) await(c, EPOLLIN);
    }
    void expire(Connection& c);
    void sweep();
    void count_held(Connection& c);
    /// Half of the largest body is room for all; beyond that the oldest one alone goes on.
    [[nodiscard]] bool must_pause(const Connection& c) const;
    void resume();
    void begin_stop();

    // ---- threads ----
    void dispatch(Connection& c);
    void serve();
    void take_answered();
    void end_threads();

    const Limits limits_;
    Service& service_;
    Metrics& metrics_;
    Descriptor epoll_;
    Descriptor wake_;
    Descriptor spare_;  ///< given up for a moment to turn a connection away when there are no more
    Descriptor listening_;
    std::atomic<bool> stopping_ = false;
    bool stop_begun_ = false;
    std::size_t most_connections_ = 0;

    std::uint64_t next_id_ = 2;
    std::unordered_map<std::uint64_t, std::unique_ptr<Connection>> connections_;
    std::vector<std::unique_ptr<Connection>> closed_;  ///< kept to the end of the turn, in which they may be spoken of
    std::unordered_map<std::string, std::size_t> addresses_;
    std::set<std::uint64_t> bodies_;   ///< connections whose bodies come
    std::size_t held_ = 0;             ///< bytes of heads and answers
    std::size_t bodies_held_ = 0;      ///< bytes of bodies, those being answered included
    std::size_t bodies_answered_ = 0;  ///< bytes of bodies being answered
    bool room_ = false;                ///< some of these were given back
    Clock::time_point swept_;
    std::array<char, 65536> buffer_{};

    std::mutex mutex_;  ///< for what follows
    std::condition_variable queued_;
    std::deque<Connection*> queue_;
    std::vector<Connection*> answered_;
    std::vector<std::thread> threads_;
    std::size_t idle_ = 0;
    bool ending_ = false;
};

void Listener::Loop::run(int socket) {
    listening_.reset(socket);
    ::fcntl(socket, F_SETFL, O_NONBLOCK);
    if (::listen(socket, kBacklog) != 0) throw std::runtime_error("the listening socket failed");
    rlimit files{};
    if (::getrlimit(RLIMIT_NOFILE, &files) == 0) {
        const rlim_t wanted = limits_.most_connections + 2 * kDescriptorsOfOthers;
        if (files.rlim_cur < wanted) {
            files.rlim_cur = std::min(files.rlim_max, wanted);
            (void)::setrlimit(RLIMIT_NOFILE, &files);
        }
    }
    most_connections_ = limits_.most_connections;
    if (::getrlimit(RLIMIT_NOFILE, &files) == 0 && files.rlim_cur != RLIM_INFINITY)
        most_connections_ = std::min<std::size_t>(
            most_connections_, std::max<std::size_t>(files.rlim_cur, 2 * kDescriptorsOfOthers) - kDescriptorsOfOthers);
    watch(EPOLL_CTL_ADD, socket, EPOLLIN, kListening);

    const milliseconds tick = std::clamp(limits_.head_time / 50, milliseconds(5), milliseconds(100));
    std::array<epoll_event, 256> events{};
    while (!stop_begun_ || !connections_.empty()) {
        const int count = ::epoll_wait(epoll_.get(), events.data(), static_cast<int>(events.size()),
                                       connections_.empty() ? -1 : static_cast<int>(tick.count()));
        for (int i = 0; i < count; ++i) {
            const std::uint64_t id = events[static_cast<std::size_t>(i)].data.u64;  // packed: no reference to it
            if (id == kListening) accept_some();
            if (id == kWake) {
                std::uint64_t times = 0;
                (void)!::read(wake_.get(), &times, sizeof times);
                take_answered();
            }
            const auto found = connections_.find(id);
            if (found == connections_.end()) continue;
            Connection& c = *found->second;
            try {
                if (c.state == State::writing) {
                    if (flush(c)) go_on(c);
                } else {
                    read(c);
                }
            } catch (const std::bad_alloc&) {
                close(c, "no_memory");
            }
        }
        if (stopping_ && !stop_begun_) begin_stop();
        sweep();
        if (std::exchange(room_, false)) resume();
        closed_.clear();
    }
    end_threads();
}

// ---- who is let in ----

void Listener::Loop::accept_some() {
    for (int i = 0; i < 256; ++i) {
        sockaddr_storage peer{};
        socklen_t size = sizeof peer;
        const int socket =
            ::accept4(listening_.get(), reinterpret_cast<sockaddr*>(&peer), &size, SOCK_NONBLOCK | SOCK_CLOEXEC);
        if (socket < 0) {
            if (errno == EINTR || errno == ECONNABORTED) continue;
            if (errno == EAGAIN || errno == EWOULDBLOCK) return;
            if (errno == EMFILE || errno == ENFILE) {
                if (evict(nullptr)) continue;
                spare_.reset();
                const int last = ::accept(listening_.get(), nullptr, nullptr);
                if (last >= 0) turn_away(last);
                spare_.reset(::open("/dev/null", O_RDONLY | O_CLOEXEC));
                if (last >= 0) continue;
            }
            std::this_thread::sleep_for(milliseconds(1));  // out of memory, or of everyone's descriptors
            return;
        }
        metrics_.count_accepted();
        std::string address = name_of(peer);
        const auto known = addresses_.find(address);
        const bool one_too_many = known != addresses_.end() && known->second >= most_connections_ / 2;
        if ((one_too_many && !evict(&address)) || (connections_.size() >= most_connections_ && !evict(nullptr))) {
            turn_away(socket);
            continue;
        }
        const int yes = 1;
        ::setsockopt(socket, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
        auto connection = std::make_unique<Connection>();
        Connection& c = *connection;
        c.id = next_id_++;
        c.socket.reset(socket);
        c.address = std::move(address);
        ++addresses_[c.address];
        enter(c, State::head, limits_.head_time);
        watch(EPOLL_CTL_ADD, socket, EPOLLIN | EPOLLONESHOT, c.id);
        connections_.emplace(c.id, std::move(connection));
        metrics_.add_connections(1);
    }
}

void Listener::Loop::turn_away(int socket) {
    const Descriptor owned(socket);
    Exchange exchange;
    exchange.last = true;
    service_.refuse(exchange, {kBusy, "the service has as many connections as it can have", {}});
    (void)!::recv(socket, buffer_.data(), buffer_.size(), MSG_DONTWAIT);  // unread bytes would reset the connection
    (void)!::send(socket, exchange.output.data(), exchange.output.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
    ::shutdown(socket, SHUT_WR);
    metrics_.count_closed("turned_away");
}

bool Listener::Loop::evict(const std::string* address, bool holding) {
    Connection* victim = nullptr;
    for (const auto& [id, c] : connections_) {
        if (c->state == State::busy || (address != nullptr && c->address != *address)) continue;
        if (holding && (c->held == 0 || c->state == State::body)) continue;
        if (victim == nullptr || std::tie(c->state, c->since) < std::tie(victim->state, victim->since))
            victim = c.get();
    }
    if (victim == nullptr) return false;
    if ((victim->state == State::head && (victim->requests == 0 || !victim->input.empty())) ||
        victim->state == State::body) {
        Exchange exchange;
        exchange.last = true;
        service_.refuse(exchange, {kBusy, "the service has as many connections as it can have", {}});
        (void)!::recv(victim->socket.get(), buffer_.data(), buffer_.size(), 0);
        std::size_t sent = 0;
        (void)send_some(victim->socket.get(), exchange.output, sent);
        ::shutdown(victim->socket.get(), SHUT_WR);
    }
    close(*victim, victim->state == State::lingering ? victim->why : "evicted");
    return true;
}

void Listener::Loop::close(Connection& c, const std::string& why) {
    metrics_.count_closed(why);
    metrics_.add_connections(-1);
    c.state = State::closed;
    held_ -= std::exchange(c.held, 0);
    room_ = room_ || c.body_held > 0;
    bodies_held_ -= std::exchange(c.body_held, 0);
    bodies_.erase(c.id);
    if (--addresses_[c.address] == 0) addresses_.erase(c.address);
    c.socket.reset();
    const auto found = connections_.find(c.id);
    closed_.push_back(std::move(found->second));
    connections_.erase(found);
}

// ---- steps of a connection ----

void Listener::Loop::read(Connection& c) {
    for (int i = 0; i < 16; ++i) {
        const ssize_t got = ::recv(c.socket.get(), buffer_.data(), buffer_.size(), 0);
        if (got < 0 && errno == EINTR) continue;
        if (got < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) break;
        if (got <= 0) {
            if (c.state == State::lingering) close(c, c.why);
            else close(c, got < 0 ? "reset" : c.input.empty() && c.state == State::head ? "by_peer" : "incomplete");
            return;
        }
        if (c.state == State::lingering) continue;
        if (c.state == State::head && c.input.empty() && c.requests > 0) enter(c, State::head, limits_.head_time);
        c.input.append(buffer_.data(), static_cast<std::size_t>(got));
        const bool more = advance(c);
        if (c.state != State::closed && c.state != State::busy) count_held(c);
        if (!more || c.state == State::closed) return;
    }
    await(c, EPOLLIN);
}

bool Listener::Loop::advance(Connection& c) {
    while (c.state == State::head) {
        const auto size = c.scanner.find_end(c.input);
        const auto problem = c.scanner.problem();
        if (problem) {
            c.exchange = {};
            return refuse(c, *problem, true);
        }
        if (!size) return true;
        if (take_head(c, *size)) continue;
        if (c.state != State::body) return false;
    }
    return c.state == State::body && take_body(c);
}

/// Whether the connection waits for a request again: this one was refused.
bool Listener::Loop::take_head(Connection& c, std::size_t size) {
    c.exchange = {};
    Exchange& exchange = c.exchange;
    exchange.address = c.address;
    exchange.begun = Clock::now();
    exchange.head = read_head(std::string_view(c.input).substr(0, size), limits_.largest_body);
    c.input.erase(0, size);
    if (c.input.empty() && c.input.capacity() > kLargeBuffer) c.input.shrink_to_fit();
    c.scanner = {};
    ++c.requests;
    const Head& head = exchange.head;
    if (head.problem) return refuse(c, *head.problem, true);
    exchange.last = !head.keep_alive || c.requests >= limits_.most_requests;
    if (const auto problem = service_.admit(exchange)) return refuse(c, *problem, exchange.last || head.has_body());
    if (!head.has_body()) {
        dispatch(c);
        return false;
    }
    enter(c, State::body, limits_.body_time);
    c.chunks = {};
    bodies_.insert(c.id);
    if (head.expects_continue && c.input.empty()) {
        std::size_t sent = 0;
        (void)send_some(c.socket.get(), "HTTP/1.1 100 Continue\r\n\r\n", sent);
    }
    return false;
}

/// Whether more of the body is to come, and may.
bool Listener::Loop::take_body(Connection& c) {
    Exchange& exchange = c.exchange;
    std::string_view input = c.input;
    auto state = ChunkReader::State::more;
    if (exchange.head.chunked) state = c.chunks.read(input, exchange.body, limits_.largest_body);
    else {
        const std::size_t length = *exchange.head.length;
        const std::size_t taken = std::min(input.size(), length - exchange.body.size());
        if (exchange.body.size() + taken > kLargeBuffer) exchange.body.reserve(length);
        exchange.body += input.substr(0, taken);
        input.remove_prefix(taken);
        if (exchange.body.size() == length) state = ChunkReader::State::whole;
    }
    c.input.erase(0, c.input.size() - input.size());
    bodies_held_ += exchange.body.size() - c.body_held;
    c.body_held = exchange.body.size();
    switch (state) {
        case ChunkReader::State::whole: dispatch(c); return false;
        case ChunkReader::State::malformed:
            return refuse(c, {api::problem_type("bad-request"), "the chunks of the body are malformed", {}}, true);
        case ChunkReader::State::too_large: return refuse(c, too_large(limits_.largest_body), true);
        case ChunkReader::State::more: break;
    }
    if (!must_pause(c)) return true;
    c.paused = true;
    c.deadline = Clock::now() + kPauseTime;
    return false;
}

bool Listener::Loop::refuse(Connection& c, const api::Problem& problem, bool last) {
    bodies_.erase(c.id);
    room_ = room_ || c.body_held > 0;
    bodies_held_ -= std::exchange(c.body_held, 0);
    c.exchange.body = {};
    c.exchange.address = c.address;
    c.exchange.last = last;
    c.sent = 0;
    service_.refuse(c.exchange, problem);
    return flush(c);
}

bool Listener::Loop::flush(Connection& c) {
    std::string& output = c.exchange.output;
    if (c.reset || !send_some(c.socket.get(), output, c.sent)) {
        close(c, "reset");
        return false;
    }
    if (c.sent < output.size()) {
        if (c.state != State::writing)
            enter(c, State::writing,
                  limits_.write_time + milliseconds(1000) * static_cast<long>(output.size() / limits_.write_rate));
        await(c, EPOLLOUT);
        count_held(c);
        return false;
    }
    output = {};
    c.sent = 0;
    if (c.exchange.last || stopping_) {
        ::shutdown(c.socket.get(), SHUT_WR);
        c.input = {};
        enter(c, State::lingering, limits_.linger_time);
        await(c, EPOLLIN);
        count_held(c);
        return false;
    }
    enter(c, State::head, c.input.empty() ? limits_.idle_time : limits_.head_time);
    count_held(c);
    return c.state == State::head;
}

void Listener::Loop::expire(Connection& c) {
    switch (c.state) {
        case State::head:
            if (c.input.empty()) return close(c, "idle");
            c.exchange = {};
            c.why = "head_timeout";
            refuse(c, {api::problem_type("request-timeout"), "the request's head did not come in time", {}}, true);
            break;
        case State::body:
            c.why = c.paused ? "no_room" : "body_timeout";
            if (c.paused) refuse(c, {kBusy, "the service has no room for the body", {}}, true);
            else refuse(c, {api::problem_type("request-timeout"), "the request's body did not come in time", {}}, true);
            break;
        case State::lingering: return close(c, c.why);
        default: {
            const linger at_once{1, 0};  // what the kernel holds for a peer that does not read is dropped
            ::setsockopt(c.socket.get(), SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
            close(c, "write_timeout");
        }
    }
}

void Listener::Loop::sweep() {
    const Clock::time_point now = Clock::now();
    if (now - swept_ < milliseconds(5)) return;
    swept_ = now;
    std::vector<Connection*> late;
    for (const auto& [id, c] : connections_)
        if (c->state != State::busy && c->deadline <= now) late.push_back(c.get());
    for (Connection* c : late)
        if (c->state != State::closed) expire(*c);
}

void Listener::Loop::count_held(Connection& c) {
    const std::size_t held = c.input.size() + c.exchange.output.size();
    held_ += held - c.held;
    c.held = held;
    while (held_ > kMostHeld && evict(nullptr, true)) {
    }
}

bool Listener::Loop::must_pause(const Connection& c) const {
    const std::size_t most = limits_.largest_body / 2;
    if (bodies_held_ <= most) return false;
    return bodies_answered_ > most || *bodies_.begin() != c.id;
}

void Listener::Loop::resume() {
    for (const std::uint64_t id : bodies_) {
        Connection& c = *connections_.at(id);
        if (!c.paused || must_pause(c)) continue;
        c.paused = false;
        c.deadline = Clock::now() + limits_.body_time;
        await(c, EPOLLIN);
    }
}

void Listener::Loop::begin_stop() {
    stop_begun_ = true;
    listening_.reset();
    const Clock::time_point end = Clock::now() + limits_.stop_time;
    std::vector<Connection*> waiting;
    for (const auto& [id, c] : connections_) {
        if (c->state == State::head && c->input.empty()) waiting.push_back(c.get());
        c->deadline = std::min(c->deadline, end);
    }
    for (Connection* c : waiting) close(*c, "stopped");
}

// ---- threads ----

void Listener::Loop::dispatch(Connection& c) {
    enter(c, State::busy, {});
    held_ -= std::exchange(c.held, 0);
    bodies_.erase(c.id);
    bodies_answered_ += c.body_held;
    c.exchange.begun = Clock::now();
    const std::lock_guard lock(mutex_);
    queue_.push_back(&c);
    if (queue_.size() > idle_ && threads_.size() < limits_.threads) try {
            threads_.emplace_back([this] { serve(); });
        } catch (const std::system_error&) {
            if (threads_.empty()) throw;  // else the ones there are take it in turn
        }
    queued_.notify_one();
}

void Listener::Loop::serve() {
    std::unique_lock lock(mutex_);
    for (;;) {
        ++idle_;
        queued_.wait(lock, [&] { return ending_ || !queue_.empty(); });
        --idle_;
        if (queue_.empty()) return;
        Connection& c = *queue_.front();
        queue_.pop_front();
        lock.unlock();
        Exchange& exchange = c.exchange;
        Wire wire(c.socket.get(), exchange.output, limits_.write_time, stopping_);
        exchange.stream = &wire;
        service_.answer(exchange);
        exchange.stream = nullptr;
        exchange.body = {};
        c.sent = 0;
        c.reset = !send_some(c.socket.get(), exchange.output, c.sent);
        lock.lock();
        answered_.push_back(&c);
        if (answered_.size() == 1) wake();
    }
}

void Listener::Loop::take_answered() {
    std::vector<Connection*> answered;
    {
        const std::lock_guard lock(mutex_);
        answered.swap(answered_);
    }
    for (Connection* c : answered) {
        room_ = room_ || c->body_held > 0;
        bodies_answered_ -= c->body_held;
        bodies_held_ -= std::exchange(c->body_held, 0);
        if (flush(*c)) go_on(*c);
    }
}

void Listener::Loop::end_threads() {
    {
        const std::lock_guard lock(mutex_);
        ending_ = true;
    }
    queued_.notify_all();
    for (std::thread& thread : threads_) thread.join();
    threads_.clear();
}

Listener::Listener(const Limits& limits, Service& service, Metrics& metrics)
    : loop_(std::make_unique<Loop>(limits, service, metrics)) {}
Listener::~Listener() = default;
void Listener::run(int socket) { loop_->run(socket); }
void Listener::stop() { loop_->stop(); }
bool Listener::stopping() const { return loop_->stopping(); }

}  // namespace brdfit::server
