#include "server/supervisor.h"

#include <fcntl.h>
#include <spawn.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <condition_variable>
#include <csignal>
#include <cstring>
#include <future>
#include <list>
#include <map>
#include <mutex>
#include <stdexcept>
#include <system_error>
#include <thread>

#include <spdlog/spdlog.h>

#include "api/archive.h"
#include "api/evaluate.h"
#include "api/problem.h"
#include "server/channel.h"

namespace brdfit::server {
namespace {

using namespace std::chrono_literals;
using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr int kChannel = 3;    ///< a worker's descriptor
constexpr int kNiceness = 10;  ///< of those that take batch jobs
constexpr milliseconds kTend = 1s;
constexpr milliseconds kPrune = 60s;
constexpr milliseconds kSilence = 30s;    ///< a worker that does not answer for so long is killed: a lease is as long
constexpr milliseconds kStandstill = 3s;  ///< ... or, if it was stopped within a transaction, so that nobody can write
constexpr milliseconds kObedience = 6s;   ///< ... or whose job was cancelled that long ago; it ends itself before
constexpr milliseconds kStop = 8s;
constexpr milliseconds kFirstPause{100};  ///< before a worker is started again; doubled if it was not ready
constexpr milliseconds kLongestPause = 30s;
constexpr unsigned kTries = 3;            ///< before the service begins without a worker
constexpr milliseconds kForFacts = 5s;    ///< what a worker has told, or that one is there, is awaited so long
constexpr milliseconds kForWorker = 20s;  ///< ... and a worker that may be asked
constexpr milliseconds kForAnswer = 60s;

api::Refusal unavailable() {
    return api::Refusal({api::problem_type("no-worker"), "nobody computes at the moment; try again", {}});
}

/// Ends of a socket pair.
std::pair<int, int> socket_pair() {
    std::array<int, 2> ends{};
    if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends.data()) != 0)
        throw std::system_error(errno, std::system_category(), "no socket for a worker");
    return {ends[0], ends[1]};
}

/// Starts this program anew, its end of the channel as kChannel. It is ended with the calling thread.
pid_t spawn(const std::vector<std::string>& words, int channel) {
    std::vector<char*> pointers;
    for (const std::string& word : words) pointers.push_back(const_cast<char*>(word.c_str()));
    pointers.push_back(nullptr);
    posix_spawn_file_actions_t files;
    posix_spawn_file_actions_init(&files);
    posix_spawn_file_actions_addopen(&files, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
    // Its log is ours, and nobody reads what it might print.
    posix_spawn_file_actions_adddup2(&files, STDERR_FILENO, STDOUT_FILENO);
    posix_spawn_file_actions_adddup2(&files, channel, kChannel);
    posix_spawn_file_actions_addclosefrom_np(&files, kChannel + 1);
    posix_spawnattr_t attributes;
    posix_spawnattr_init(&attributes);
    // A group of its own: Ctrl-C is for the front end, which then stops its workers.
    posix_spawnattr_setpgroup(&attributes, 0);
    posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETPGROUP);
    pid_t id = 0;
    const int error = ::posix_spawn(&id, "/proc/self/exe", &files, &attributes, pointers.data(), environ);
    posix_spawnattr_destroy(&attributes);
    posix_spawn_file_actions_destroy(&files);
    if (error != 0) throw std::system_error(error, std::system_category(), "a worker cannot be started");
    return id;
}

std::string how_it_ended(int status) {
    if (WIFSIGNALED(status)) return "signal " + std::to_string(WTERMSIG(status));
    return "status " + std::to_string(WEXITSTATUS(status));
}

/// Whether a signal has stopped it, as SIGSTOP does or a debugger, and it does not go on.
bool is_stopped(pid_t id) {
    siginfo_t info{};
    return ::waitid(P_PID, static_cast<id_t>(id), &info, WSTOPPED | WNOHANG | WNOWAIT) == 0 && info.si_pid == id;
}

using Answer = std::optional<std::string>;  ///< none: the worker is gone, or could not answer

}  // namespace

struct Supervisor::Impl {
    struct Worker {
        unsigned number = 0;
        // Of the process that runs now; guarded by the mutex.
        std::string owner{};
        pid_t id = 0;
        std::shared_ptr<Channel> channel{};
        bool ready = false;
        Clock::time_point heard{};
        std::map<std::uint64_t, std::promise<Answer>> questions{};
    };

    Impl(const kernels::Catalogue& catalogue_in, JobStore& store_in, SupervisorOptions options_in)
        : catalogue(catalogue_in), store(store_in), options(std::move(options_in)) {
        for (unsigned i = 0; i < std::max(1U, options.workers); ++i) workers.emplace_back().number = i;
    }

    // ---- one worker ----

    void keep(Worker& worker) {
        milliseconds pause = kFirstPause;
        while (true) {
            {
                std::unique_lock lock(mutex);
                changed.wait(lock, [&] { return stopping || worker.number == 0 || rest_may_start; });
                if (stopping) return;
            }
            bool was_ready = false;
            try {
                was_ready = run(worker);
            } catch (const std::exception& error) {
                spdlog::error("worker {}: {}", worker.number, error.what());
            }
            std::unique_lock lock(mutex);
            ++ends;
            rest_may_start = true;
            changed.notify_all();
            if (was_ready) pause = kFirstPause;  // a job that ended it is given up after three times
            if (changed.wait_for(lock, pause, [&] { return stopping; })) return;
            pause = std::min(2 * pause, kLongestPause);
        }
    }

    /// From the start of a process to its end; whether it took jobs.
    bool run(Worker& worker) {
        const auto [ours, theirs] = socket_pair();
        const auto channel = std::make_shared<Channel>(ours);
        const std::string owner = make_job_id();
        std::vector<std::string> words{"brdfit", "worker", "--channel", std::to_string(kChannel), "--owner", owner};
        if (workers.size() > 1 && worker.number == 0) words.insert(words.end(), {"--lane", "interactive"});
        if (worker.number > 0) words.insert(words.end(), {"--nice", std::to_string(kNiceness)});
        words.insert(words.end(), options.arguments.begin(), options.arguments.end());
        pid_t id = 0;
        try {
            id = spawn(words, theirs);
        } catch (...) {
            ::close(theirs);
            throw;
        }
        ::close(theirs);
        {
            const std::lock_guard lock(mutex);
            worker.owner = owner;
            worker.id = id;
            worker.channel = channel;
            worker.heard = Clock::now();
            if (stopping) channel->send(Channel::Kind::stop);
        }
        while (auto message = channel->receive()) hear(worker, *message);
        return bury(worker);
    }

    void hear(Worker& worker, const Channel::Message& message) {
        switch (message.kind) {
            case Channel::Kind::facts: {
                api::DeviceFacts told = api::read_device_facts(message.body);
                const std::lock_guard lock(mutex);
                worker.ready = true;
                worker.heard = Clock::now();
                rest_may_start = rest_may_start || told.complete;
                const bool knows_more =
                    !facts || !facts->complete || (told.complete && told.costs.size() >= facts->costs.size());
                if (knows_more) facts = std::move(told);
                changed.notify_all();
                break;
            }
            case Channel::Kind::failed: {
                spdlog::error("worker {} cannot start: {}", worker.number, message.body);
                const std::lock_guard lock(mutex);
                if (failure.empty()) failure = message.body;
                changed.notify_all();
                break;
            }
            case Channel::Kind::changed: store.changes().tell(message.body); break;
            case Channel::Kind::pong: {
                const std::lock_guard lock(mutex);
                worker.heard = Clock::now();
                changed.notify_all();
                break;
            }
            case Channel::Kind::evaluated: {
                std::uint64_t number = 0;
                if (message.body.size() <= sizeof number) return;
                std::memcpy(&number, message.body.data(), sizeof number);
                const bool good = message.body[sizeof number] == '\1';
                if (!good) spdlog::error("an evaluation: {}", message.body.substr(sizeof number + 1));
                const std::lock_guard lock(mutex);
                const auto question = worker.questions.find(number);
                if (question == worker.questions.end()) return;
                question->second.set_value(good ? Answer(message.body.substr(sizeof number + 1)) : std::nullopt);
                worker.questions.erase(question);
                break;
            }
            default: break;
        }
    }

    /// Its channel is closed: it has ended, or it must. Whether it took jobs.
    bool bury(Worker& worker) {
        siginfo_t info{};
        const auto ended = [&](int more) {
            info = {};
            return ::waitid(P_PID, static_cast<id_t>(worker.id), &info, WEXITED | WNOWAIT | more) == 0 &&
                   info.si_pid != 0;
        };
        for (int i = 0; i < 200 && !ended(WNOHANG); ++i) std::this_thread::sleep_for(10ms);
        if (!ended(WNOHANG)) ::kill(worker.id, SIGKILL);
        while (!ended(0) && errno == EINTR) {
        }
        int status = 0;
        bool expected = false;
        bool was_ready = false;
        std::string owner;
        {
            const std::lock_guard lock(mutex);  // nobody kills it any more: the number may be another's soon
            ::waitpid(worker.id, &status, 0);
            expected = stopping || !failure.empty();
            worker.id = 0;
            was_ready = std::exchange(worker.ready, false);
            worker.channel = nullptr;
            owner = std::exchange(worker.owner, "");
            for (auto& [number, question] : worker.questions) question.set_value(std::nullopt);
            worker.questions.clear();
        }
        if (!expected) spdlog::warn("worker {} ended with {}", worker.number, how_it_ended(status));
        try {
            store.bury(owner);
        } catch (const StoreError& error) {  // its leases run out
            spdlog::error("the store: {}", error.what());
        }
        store.changes().tell(kQueue);
        return was_ready;
    }

    // ---- all of them ----

    void for_each_channel(const auto& work) {
        std::vector<std::shared_ptr<Channel>> channels;
        {
            const std::lock_guard lock(mutex);
            for (const Worker& worker : workers)
                if (worker.channel && worker.ready) channels.push_back(worker.channel);
        }
        for (const auto& channel : channels) work(*channel);
    }

    void wake() {
        Changes::Watch queue(store.changes(), kQueue);
        while (!store.changes().closed())
            if (queue.wait(kTend)) for_each_channel([](Channel& channel) { channel.hint(Channel::Kind::wake); });
    }

    void tend() {
        Clock::time_point pruned{};
        std::unique_lock lock(mutex);
        while (!changed.wait_for(lock, kTend, [&] { return stopping; })) {
            lock.unlock();
            try {
                store.tend();
                if (Clock::now() - pruned >= kPrune) {
                    pruned = Clock::now();
                    store.prune(options.retention);
                }
                for (const JobStore::Stuck& stuck : store.stuck(kObedience))
                    kill_if([&](const Worker& worker) { return worker.owner == stuck.owner; }, "does not end a job");
            } catch (const StoreError& error) {
                spdlog::error("the store: {}", error.what());
            }
            for_each_channel([](Channel& channel) { channel.hint(Channel::Kind::ping); });
            const auto now = Clock::now();
            kill_if([&](const Worker& worker) { return worker.ready && now - worker.heard > kSilence; },
                    "does not answer");
            const auto stands_still = [now](const Worker& worker) {
                return worker.ready && now - worker.heard > kStandstill && is_stopped(worker.id);
            };
            if (any(stands_still) && !store_takes())
                kill_if(stands_still, "stands still and keeps others from writing");
            lock.lock();
        }
    }

    bool any(const auto& condition) {
        const std::lock_guard lock(mutex);
        return std::any_of(workers.begin(), workers.end(), condition);
    }
    bool store_takes() try {
        store.probe();
        return true;
    } catch (const StoreError&) {
        return false;
    }

    void kill_if(const auto& condition, const char* why) {
        const std::lock_guard lock(mutex);
        for (const Worker& worker : workers)
            if (worker.id != 0 && condition(worker)) {
                spdlog::error("worker {} {}: it is killed", worker.number, why);
                ::kill(worker.id, SIGKILL);
            }
    }

    void stop() {
        {
            const std::lock_guard lock(mutex);
            if (std::exchange(stopping, true)) return;
            for (const Worker& worker : workers)
                if (worker.channel) worker.channel->send(Channel::Kind::stop);
            changed.notify_all();
        }
        {
            std::unique_lock lock(mutex);
            const auto gone = [&] {
                return std::all_of(workers.begin(), workers.end(), [](const Worker& w) { return w.id == 0; });
            };
            for (const Clock::time_point until = Clock::now() + kStop; !gone() && Clock::now() < until;)
                changed.wait_for(lock, 20ms);
        }
        kill_if([](const Worker&) { return true; }, "does not stop");
        keepers.clear();
        store.changes().close();
        waker = {};
        tender = {};
    }

    // ---- questions ----

    /// What the condition makes of the facts, as soon as they are there.
    template <class Condition>
    api::DeviceFacts known(const Condition& enough) {
        std::unique_lock lock(mutex);
        changed.wait_for(lock, kForFacts, [&] { return facts || stopping; });
        changed.wait(lock, [&] { return stopping || !facts || enough(*facts) || !anybody(); });
        if (!facts) throw unavailable();
        return *facts;
    }
    /// A worker is there or may soon be.
    [[nodiscard]] bool anybody() const {
        return std::any_of(workers.begin(), workers.end(), [](const Worker& w) { return w.ready; });
    }

    /// Asks a worker that has been heard since then.
    Answer ask(std::string_view body, Clock::time_point since) {
        const auto can_tell = [since](const Worker& w) { return w.ready && w.channel && w.heard >= since; };
        const auto find = [&] { return std::find_if(workers.begin(), workers.end(), can_tell); };
        std::future<Answer> answer;
        std::shared_ptr<Channel> channel;
        std::uint64_t number = 0;
        {
            std::unique_lock lock(mutex);
            changed.wait_for(lock, kForWorker, [&] { return stopping || find() != workers.end(); });
            const auto worker = find();
            if (stopping || worker == workers.end()) throw unavailable();
            number = ++questions;
            answer = worker->questions[number].get_future();
            channel = worker->channel;
        }
        std::string question(sizeof number, '\0');
        std::memcpy(question.data(), &number, sizeof number);
        channel->send(Channel::Kind::evaluate, question.append(body));
        if (answer.wait_for(kForAnswer) != std::future_status::ready) return std::nullopt;
        return answer.get();
    }

    const kernels::Catalogue& catalogue;
    JobStore& store;
    SupervisorOptions options;

    std::mutex mutex;
    std::condition_variable changed;
    std::list<Worker> workers;
    std::optional<api::DeviceFacts> facts;  ///< the latest; workers of one front end have the same device
    std::string failure;                    ///< why a worker refused to start
    std::uint64_t ends = 0;                 ///< of worker processes
    std::uint64_t questions = 0;
    bool rest_may_start = false;
    bool stopping = false;

    std::jthread waker;
    std::jthread tender;
    std::vector<std::jthread> keepers;
};

Supervisor::Supervisor(const kernels::Catalogue& catalogue, JobStore& store, SupervisorOptions options)
    : impl_(std::make_unique<Impl>(catalogue, store, std::move(options))) {}

Supervisor::~Supervisor() { impl_->stop(); }

void Supervisor::start(const std::stop_token& stop) {
    Impl& impl = *impl_;
    const std::stop_callback stopped(stop, [&impl] { impl.changed.notify_all(); });
    std::unique_lock lock(impl.mutex);
    if (impl.stopping) return;  // else stop() finds all threads there: it may come from another thread at any time
    impl.waker = std::jthread([&impl] { impl.wake(); });
    impl.tender = std::jthread([&impl] { impl.tend(); });
    for (Impl::Worker& worker : impl.workers) impl.keepers.emplace_back([&impl, &worker] { impl.keep(worker); });
    while (!stop.stop_requested() && !impl.facts && impl.failure.empty() && impl.ends < kTries)
        impl.changed.wait_for(lock, 50ms);
    if (!impl.failure.empty()) throw std::runtime_error(impl.failure);
}

void Supervisor::stop() { impl_->stop(); }

std::optional<kernels::DeviceInfo> Supervisor::known_device() const {
    const std::lock_guard lock(impl_->mutex);
    if (!impl_->facts) return std::nullopt;
    return impl_->facts->device;
}

Supervisor::Processes Supervisor::processes() const {
    const std::lock_guard lock(impl_->mutex);
    const auto ready = std::count_if(impl_->workers.begin(), impl_->workers.end(),
                                     [](const Impl::Worker& worker) { return worker.ready; });
    return {static_cast<std::size_t>(ready), impl_->ends};
}

kernels::DeviceInfo Supervisor::device() const {
    return impl_->known([](const api::DeviceFacts&) { return true; }).device;
}

std::vector<kernels::SelfTest> Supervisor::self_tests() const {
    return impl_->known([](const api::DeviceFacts& facts) { return facts.complete; }).self_tests;
}

std::vector<kernels::Cost> Supervisor::costs(const kernels::Family& family) const {
    const std::lock_guard lock(impl_->mutex);
    std::vector<kernels::Cost> costs;
    if (!impl_->facts) return costs;
    for (const kernels::Model* model : family.texts())
        for (const api::ModelCost& cost : impl_->facts->costs)
            if (cost.model == model->name && cost.lobes == model->repeats)
                costs.push_back({cost.single_ns, cost.double_ns, kernels::operation_counts(*model), cost.under_load});
    return costs;
}

bool Supervisor::usable() const {
    std::unique_lock lock(impl_->mutex);
    // One that ended is soon there again.
    impl_->changed.wait_for(lock, kForFacts, [this] { return impl_->stopping || impl_->anybody(); });
    return impl_->facts && impl_->facts->usable() && impl_->anybody();
}

std::optional<std::string> Supervisor::refusal(kernels::Precision precision) const {
    // By the time that there are facts, the best precision is tested.
    return impl_
        ->known([&](const api::DeviceFacts& facts) {
            return facts.complete || facts.refusal(precision) ||
                   std::any_of(facts.self_tests.begin(), facts.self_tests.end(),
                               [&](const kernels::SelfTest& test) { return test.precision == precision; });
        })
        .refusal(precision);
}

std::string Supervisor::evaluate(std::string_view body) {
    const api::EvaluateRequest request = api::read_evaluate_request(body, impl_->catalogue);
    const api::DeviceFacts facts = impl_->known([](const api::DeviceFacts&) { return true; });
    if (!facts.usable())
        throw api::Refusal(
            {api::problem_type("unfit-device"), "the device failed its self-test; /health/ready tells where", {}});
    if (request.precision)
        if (const auto reason = refusal(*request.precision))
            throw api::Refusal({api::problem_type("invalid-request"),
                                "/precision: " + *reason,
                                {{"/precision", "unsupported", *reason, {}, {}}}});
    if (auto answer = impl_->ask(body, {})) return *answer;
    // Others may have ended with the first, unnoticed yet.
    if (auto answer = impl_->ask(body, Clock::now())) return *answer;
    throw unavailable();
}

}  // namespace brdfit::server
