#include "server/worker.h"

#include <pthread.h>
#include <sys/prctl.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <csignal>
#include <cstdlib>
#include <deque>
#include <list>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <stop_token>
#include <thread>

#include <spdlog/spdlog.h>

#include "api/archive.h"
#include "api/evaluate.h"
#include "api/problem.h"
#include "api/progress.h"
#include "api/request.h"
#include "api/response.h"
#include "kernels/evaluator.h"
#include "kernels/model.h"
#include "kernels/selftest.h"
#include "optim/fit.h"
#include "optim/progress.h"
#include "server/channel.h"
#include "server/store.h"

namespace brdfit::server {
namespace {

using namespace std::chrono_literals;
using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr milliseconds kLease = 30s;
constexpr milliseconds kBeat = 250ms;         ///< between heartbeats, each with progress
constexpr milliseconds kSoonest = 50ms;       ///< ... when woken
constexpr milliseconds kPoll = 1000ms;        ///< for jobs that nobody told of
constexpr milliseconds kLastMoments = 5s;     ///< a job that goes on so long after its stop ends the process
constexpr milliseconds kOverdue = 60s;        ///< ... or so long after its time limit
constexpr milliseconds kLastWork = 4s;        ///< for interactive jobs when the worker stops
constexpr milliseconds kReturn = 3s;          ///< for searches to heed a stop
constexpr milliseconds kSettling = 5s;        ///< between measurements of costs on a loaded machine, at first ...
constexpr milliseconds kSettlingMost = 600s;  ///< ... and at most

void log(const kernels::SelfTest& test) {
    if (test.passed()) return;
    spdlog::error("{}", test.reason());
    for (const kernels::ModelTest& model : test.models)
        for (const std::string& failure : model.failures())
            spdlog::error("{}: {}", kernels::variant_name(model.model, model.lobes), failure);
}

/// Proves the precisions of an engine one after the other.
class SelfTester {
public:
    SelfTester(kernels::Engine& engine, std::span<const kernels::Family> families)
        : engine_(engine), families_(families) {
        for (const Precision precision : {Precision::double_precision, Precision::single_precision})
            if (engine.supports(precision)) left_.push_back(precision);
    }

    /// Up to the first one that passes, the most precise ones first.
    void prove_best() {
        bool passed = false;
        while (!passed && !left_.empty()) passed = prove_next();
    }
    void prove_others() {
        while (!left_.empty()) (void)prove_next();
    }
    [[nodiscard]] api::DeviceFacts facts() const {
        const auto refusal = [&](Precision precision) { return engine_.refusal(precision); };
        return {engine_.device(), found_, left_.empty(), refusal(Precision::single_precision),
                refusal(Precision::double_precision)};
    }

private:
    using Precision = kernels::Precision;

    bool prove_next() {
        const Precision precision = left_.front();
        left_.erase(left_.begin());
        found_.push_back(kernels::prove(engine_, families_, precision, kernels::SelfTestForm::brief));
        log(found_.back());
        return found_.back().passed();
    }

    kernels::Engine& engine_;
    std::span<const kernels::Family> families_;
    std::vector<Precision> left_;
    std::vector<kernels::SelfTest> found_;
};

/// Costs of every model, from the cache or measured; with those of simpler forms where `all`.
std::vector<api::ModelCost> costs_of(optim::Fitter& fitter, const kernels::Catalogue& catalogue, bool all) {
    std::vector<const kernels::Model*> models;
    for (const kernels::Family& family : catalogue.families()) {
        const auto texts = family.texts();
        models.insert(models.end(), texts.begin(),
                      all ? texts.end() : texts.begin() + static_cast<std::ptrdiff_t>(family.variants.size()));
    }
    const std::vector<kernels::Cost> found = fitter.costs().costs(models);
    std::vector<api::ModelCost> costs;
    for (std::size_t i = 0; i < models.size(); ++i)
        costs.push_back(
            {models[i]->name, models[i]->repeats, found[i].single_ns, found[i].double_ns, found[i].under_load});
    return costs;
}

/// What a fit with a scene would wait for: costs of every model, and the programs of simpler forms. Costs that were
/// measured beside other work are measured again while `idle`, at ever longer intervals. Calls `tell` when costs are
/// known, of whole models first, and whenever they change.
template <class Idle, class Tell>
void prepare_scenes(optim::Fitter& fitter, const kernels::Catalogue& catalogue, const std::stop_token& stop, Idle idle,
                    Tell tell) try {
    if (stop.stop_requested()) return;
    tell(false);
    for (const kernels::Family& family : catalogue.families())
        for (const kernels::Submodel& submodel : family.submodels) {
            if (stop.stop_requested()) return;
            fitter.warm_up(submodel);
        }
    if (stop.stop_requested()) return;
    tell(true);
    std::mutex mutex;
    std::unique_lock lock(mutex);
    std::condition_variable_any stopped;
    for (auto pause = kSettling; !stopped.wait_for(lock, stop, pause, [&] { return stop.stop_requested(); });) {
        if (!idle()) continue;
        const bool settled = fitter.costs().settle();
        tell(true);
        if (settled) return;
        pause = std::min(2 * pause, kSettlingMost);
    }
} catch (const std::exception& error) {
    if (!stop.stop_requested()) spdlog::error("costs were not measured: {}", error.what());
}

std::string problem_json(const api::Problem& problem, const std::string& id) {
    return api::to_json(problem, "/v1/fits/" + id, "");
}

class Worker {
public:
    Worker(const WorkerOptions& options, const kernels::Catalogue& catalogue, kernels::Engine& engine,
           optim::Fitter& fitter, JobStore& store, Channel* channel)
        : options_(options),
          owner_(options.owner.empty() ? make_job_id() : options.owner),
          catalogue_(catalogue),
          engine_(engine),
          fitter_(fitter),
          store_(store),
          channel_(channel) {}

    /// Returns when it has stopped.
    void run(const std::stop_token& stop);
    [[nodiscard]] bool idle() {
        const std::lock_guard lock(mutex_);
        return running_.empty();
    }
    /// From any thread.
    void wake();
    void answer_ping() {
        pinged_ = true;
        wake();
    }
    void ask(std::string question);

private:
    /// A job under way.
    struct Running {
        explicit Running(Claimed claimed_in) : claimed(std::move(claimed_in)) {}
        Claimed claimed;
        optim::Progress progress;
        std::stop_source stop;
        const Clock::time_point begun = Clock::now();
        std::atomic<Clock::duration> time_limit = Clock::duration::max() / 4;
        std::mutex telling;      ///< guards what is below
        std::vector<bool> told;  ///< models of which an event has told that they are done
        std::size_t evaluations = 0;
        Clock::time_point looked = begun;
        Clock::time_point beaten = begun;
        Clock::time_point kept = begun;              ///< when the lease was last renewed
        std::optional<Clock::time_point> stopped{};  ///< when it was asked to
        std::string progress_text;
        bool lost = false;  ///< the lease: nothing that it finds counts
        bool cancelled = false;
        bool given_back = false;  ///< as the worker stops
    };

    void slot();
    /// Waits for a job to claim; none when the worker stops.
    std::shared_ptr<Running> next();
    void compute(Running& job);
    Ending fit(Running& job);
    void finish(Running& job, const Ending& ending);
    void beat();
    void beat(Running& job);
    void beats();
    void questions();
    std::string evaluate(std::string_view body);
    void ask_to_stop(Running& job) {
        if (!job.stopped) job.stopped = Clock::now();
        job.stop.request_stop();
    }
    void tell(const std::string& job) {
        if (channel_ != nullptr) channel_->send(Channel::Kind::changed, job);
    }
    std::vector<std::shared_ptr<Running>> running() {
        const std::lock_guard lock(mutex_);
        return {running_.begin(), running_.end()};
    }

    const WorkerOptions& options_;
    const std::string owner_;
    const kernels::Catalogue& catalogue_;
    kernels::Engine& engine_;
    optim::Fitter& fitter_;
    JobStore& store_;
    Channel* channel_;

    std::mutex claiming_;
    std::mutex mutex_;                  ///< guards what is below
    std::condition_variable work_;      ///< for slots
    std::condition_variable beat_now_;  ///< for the thread of heartbeats
    std::condition_variable ended_;     ///< a job has
    std::condition_variable asked_;
    std::list<std::shared_ptr<Running>> running_;
    std::deque<std::string> questions_;
    unsigned calls_ = 0;  ///< wakes that no slot has heeded yet
    bool woken_ = false;  ///< for the thread of heartbeats
    bool alone_ = false;  ///< the job under way may end the process: no other beside it
    bool stopping_ = false;
    bool ended_all_ = false;
    bool unsynced_ = false;
    std::atomic<bool> pinged_ = false;
};

void Worker::wake() {
    const std::lock_guard lock(mutex_);
    ++calls_;
    woken_ = true;
    work_.notify_one();
    beat_now_.notify_one();
}

void Worker::ask(std::string question) {
    const std::lock_guard lock(mutex_);
    questions_.push_back(std::move(question));
    asked_.notify_one();
}

std::shared_ptr<Worker::Running> Worker::next() {
    while (true) {
        {
            const std::lock_guard one(claiming_);
            std::unique_lock lock(mutex_);
            if (stopping_) return nullptr;
            const bool busy = !running_.empty();
            if (!(busy && alone_) && engine_.usable()) {
                lock.unlock();
                std::optional<Claimed> claimed;
                try {
                    claimed = store_.claim(owner_, {kLease, true, options_.lane == Lane::any, busy});
                } catch (const StoreError& error) {
                    spdlog::error("no job can be claimed: {}", error.what());
                }
                lock.lock();
                if (claimed) {
                    alone_ = claimed->attempt > 1;
                    running_.push_back(std::make_shared<Running>(std::move(*claimed)));
                    work_.notify_one();  // there may be more
                    return running_.back();
                }
            }
        }
        std::unique_lock lock(mutex_);
        work_.wait_for(lock, kPoll, [this] { return stopping_ || calls_ > 0; });
        if (calls_ > 0) --calls_;
    }
}

void Worker::slot() {
    while (const auto job = next()) {
        tell(job->claimed.lease.job);
        compute(*job);
        const std::lock_guard lock(mutex_);
        running_.remove(job);
        alone_ = false;
        unsynced_ = woken_ = true;
        beat_now_.notify_one();
        ended_.notify_all();
    }
}

Ending Worker::fit(Running& job) {
    const std::string& id = job.claimed.lease.job;
    const api::FitRequest request = api::read_job(job.claimed.request, job.claimed.dataset, catalogue_);
    job.time_limit = std::chrono::duration_cast<Clock::duration>(request.options.time_limit);
    const optim::Report report =
        fitter_.fit(request.dataset, request.models, request.options, job.stop.get_token(), &job.progress);
    bool any = false;
    for (const optim::ChannelReport& channel : report.channels) {
        any = any || !channel.fits.empty();
        for (const optim::Failure& failure : channel.failures)
            spdlog::warn("fit {} channel {} model {}: {}: {}", id, channel.channel.name, failure.model, failure.reason,
                         failure.detail);
    }
    Ending ending;
    ending.state = any ? JobState::succeeded : JobState::failed;
    ending.result = api::to_json(report, id);
    ending.figures = api::archive(report);
    return ending;
}

void Worker::compute(Running& job) {
    const Lease& lease = job.claimed.lease;
    const auto failed = [&](const api::Problem& problem) {
        Ending ending;
        ending.state = JobState::failed;
        ending.error = problem_json(problem, lease.job);
        finish(job, ending);
    };
    try {
        finish(job, fit(job));
    } catch (const api::Refusal& refusal) {
        failed(refusal.problem());
    } catch (const kernels::PrecisionError& error) {
        failed({api::problem_type("unfit-device"), error.what(), {}});
    } catch (const kernels::DeviceError& error) {
        spdlog::error("fit {}: {}", lease.job, error.what());
        try {
            store_.retry(lease, problem_json({api::problem_type("device"), "the OpenCL device failed", {}}, lease.job));
        } catch (const StoreError& trouble) {
            spdlog::error("fit {}: {}", lease.job, trouble.what());  // the lease runs out
        }
    } catch (const std::exception& error) {
        spdlog::error("fit {}: {}", lease.job, error.what());
        failed({api::problem_type("internal"), "an error of the service; it has been logged", {}});
    }
    tell(lease.job);
}

void Worker::finish(Running& job, const Ending& found) {
    Ending ending = found;
    while (true) {
        {
            const std::lock_guard lock(job.telling);
            if (job.lost) return;
            if (job.stopped && !job.given_back) ending = {JobState::cancelled, "", "", "", {}};
            const auto tasks = job.progress.tasks();
            job.told.resize(tasks.size(), false);
            ending.models_done.clear();
            for (std::size_t i = 0; i < tasks.size(); ++i)
                if (tasks[i].done && !job.told[i]) ending.models_done.push_back(api::model_done_json(tasks[i]));
        }
        try {
            if (job.given_back) store_.release(job.claimed.lease);
            else store_.finish(job.claimed.lease, ending);
            return;
        } catch (const StoreError& error) {
            spdlog::error("fit {}: its result cannot be kept yet: {}", job.claimed.lease.job, error.what());
            std::unique_lock lock(mutex_);
            if (ended_.wait_for(lock, 1s, [this] { return stopping_; })) return;
        }
    }
}

void Worker::beat(Running& job) {
    const auto now = Clock::now();
    const Lease& lease = job.claimed.lease;
    bool told = false;
    {
        const std::lock_guard lock(job.telling);
        try {
            const auto tasks = job.progress.tasks();
            job.told.resize(tasks.size(), false);
            std::size_t evaluations = 0;
            for (std::size_t i = 0; i < tasks.size(); ++i) {
                evaluations += tasks[i].evaluations;
                if (!tasks[i].done || job.told[i] || job.lost) continue;
                store_.add_event(lease, EventKind::model_done, api::model_done_json(tasks[i]));
                job.told[i] = told = true;
            }
            std::string text;
            if (evaluations != job.evaluations) {
                const double seconds = std::chrono::duration<double>(now - job.looked).count();
                text = api::progress_json(tasks, static_cast<double>(evaluations - job.evaluations) / seconds);
                job.evaluations = evaluations;
                job.looked = now;
                told = true;
            }
            const Beat answer = store_.heartbeat(lease, kLease, text);
            if (answer.mine) job.kept = now;
            job.lost = job.lost || !answer.mine;
            job.cancelled = answer.cancel_requested;
        } catch (const StoreError& error) {
            spdlog::error("fit {}: no heartbeat: {}", lease.job, error.what());
            if (now - job.kept > kLease) job.lost = true;
        }
        if (job.lost || job.cancelled) ask_to_stop(job);
        // Nothing but the end of the process ends a search that does not heed: others of its jobs are tried again.
        if ((job.stopped && now - *job.stopped > kLastMoments) || now - job.begun > job.time_limit.load() + kOverdue) {
            spdlog::critical("fit {} does not end: this worker does", lease.job);
            std::_Exit(1);
        }
    }
    if (told) tell(lease.job);
}

void Worker::beats() {
    Clock::time_point tended{};
    while (true) {
        bool sync = false;
        {
            std::unique_lock lock(mutex_);
            beat_now_.wait_for(lock, kBeat, [this] { return woken_ || ended_all_; });
            if (ended_all_) return;
            woken_ = false;
            sync = std::exchange(unsynced_, false);
        }
        if (pinged_.exchange(false)) channel_->send(Channel::Kind::pong);
        for (const auto& job : running()) {
            if (Clock::now() - job->beaten < kSoonest) continue;
            beat(*job);
            job->beaten = Clock::now();
        }
        try {
            if (sync) store_.sync();
            if (channel_ == nullptr && Clock::now() - tended >= kPoll) {
                tended = Clock::now();
                store_.tend();
            }
        } catch (const StoreError& error) {
            spdlog::error("the store: {}", error.what());
        }
    }
}

std::string Worker::evaluate(std::string_view body) {
    const api::EvaluateRequest request = api::read_evaluate_request(body, catalogue_);
    const kernels::Precision precision = request.precision.value_or(engine_.best_precision());
    const kernels::Values values =
        kernels::evaluate(engine_, *request.model, precision, request.parameters, request.directions, request.gradient);
    return api::to_json(request, values, precision);
}

void Worker::questions() {
    constexpr std::size_t kNumber = 8;  // bytes
    while (true) {
        std::string question;
        {
            std::unique_lock lock(mutex_);
            asked_.wait(lock, [this] { return ended_all_ || !questions_.empty(); });
            if (questions_.empty()) return;
            question = std::move(questions_.front());
            questions_.pop_front();
        }
        std::string answer = question.substr(0, kNumber);
        try {
            const std::string text = evaluate(std::string_view(question).substr(kNumber));
            answer += '\1' + text;
        } catch (const std::exception& error) {
            answer += std::string(1, '\0') + error.what();
        }
        channel_->send(Channel::Kind::evaluated, answer);
    }
}

void Worker::run(const std::stop_token& stop) {
    const unsigned most = engine_.overlaps() ? 16 : std::max(4U, std::thread::hardware_concurrency());
    std::vector<std::jthread> slots;
    for (unsigned i = 0; i < most; ++i) slots.emplace_back([this] { slot(); });
    std::jthread heart([this] { beats(); });
    std::jthread clerk([this] { questions(); });

    std::unique_lock lock(mutex_);
    std::condition_variable_any stopped;
    stopped.wait(lock, stop, [] { return false; });
    stopping_ = true;
    work_.notify_all();
    ended_.notify_all();
    const auto give_back = [&](bool interactive_too) {
        for (const auto& job : running_) {
            if (!interactive_too && job->claimed.priority == Priority::interactive) continue;
            const std::lock_guard telling(job->telling);
            if (!job->stopped) job->given_back = true;
            ask_to_stop(*job);
        }
    };
    const auto none = [this] { return running_.empty(); };
    give_back(false);
    ended_.wait_for(lock, kLastWork, none);
    give_back(true);
    if (!ended_.wait_for(lock, kReturn, none)) std::_Exit(0);  // its leases are given back by others
    ended_all_ = true;
    beat_now_.notify_all();
    asked_.notify_all();
}

}  // namespace

void work(const WorkerOptions& options) {
    sigset_t signals;
    sigemptyset(&signals);
    sigaddset(&signals, SIGTERM);
    sigaddset(&signals, SIGINT);
    pthread_sigmask(SIG_BLOCK, &signals, nullptr);  // inherited by every thread: one waits for them
    std::unique_ptr<Channel> channel;
    std::atomic<bool> stopping = false;
    if (options.channel >= 0) {
        channel = std::make_unique<Channel>(options.channel);
        ::prctl(PR_SET_PDEATHSIG, SIGKILL);  // nobody would hear of what it does
    }
    if (options.niceness != 0 && ::nice(options.niceness) < 0) spdlog::warn("the priority cannot be lowered");
    try {
        const kernels::Catalogue catalogue(options.model_folders);
        kernels::Engine engine(options.engine);
        const auto store = open_sqlite({options.store});
        const unsigned threads = options.threads != 0 ? options.threads : std::thread::hardware_concurrency();
        optim::Fitter fitter(engine, threads);
        Worker worker(options, catalogue, engine, fitter, *store, channel.get());

        std::stop_source stop;
        const auto stop_building = [&] {
            stopping = true;
            engine.stop_building();
        };
        const std::stop_callback stopped(stop.get_token(), stop_building);
        std::jthread listener([&] {
            while (channel) {
                const auto message = channel->receive();
                if (!message || message->kind == Channel::Kind::stop) break;
                if (message->kind == Channel::Kind::wake) worker.wake();
                if (message->kind == Channel::Kind::ping) worker.answer_ping();
                if (message->kind == Channel::Kind::evaluate) worker.ask(message->body);
            }
            if (channel) stop.request_stop();
        });
        struct HangUp {  // so that the listener ends before it is waited for, whatever happens
            Channel* channel;
            ~HangUp() {
                if (channel != nullptr) channel->stop_receiving();
            }
        } const hang_up{channel.get()};
        std::jthread waiter([&](const std::stop_token& ended) {
            const timespec often{0, 50'000'000};
            while (!ended.stop_requested())
                if (sigtimedwait(&signals, nullptr, &often) > 0) stop.request_stop();
        });
        const auto tell_facts = [&](const SelfTester& tester, std::vector<api::ModelCost> costs = {}) {
            api::DeviceFacts facts = tester.facts();
            facts.costs = std::move(costs);
            if (channel) channel->send(Channel::Kind::facts, api::archive(facts));
        };
        SelfTester tester(engine, catalogue.families());
        tester.prove_best();
        if (engine.usable())
            for (const kernels::Family& family : catalogue.families())
                if (!stop.stop_requested()) fitter.warm_up(family);
        tell_facts(tester);
        if (!channel) spdlog::info("takes jobs from {}, computing on {}", options.store, engine.device().name);
        {
            const std::jthread others([&] {
                tester.prove_others();
                tell_facts(tester);
                if (engine.usable())
                    prepare_scenes(
                        fitter, catalogue, stop.get_token(), [&] { return worker.idle(); },
                        [&](bool all) { tell_facts(tester, costs_of(fitter, catalogue, all)); });
            });
            worker.run(stop.get_token());
            engine.stop_building();
        }
    } catch (const std::exception& error) {
        if (stopping) return;  // what was cut short
        if (!channel) throw;
        channel->send(Channel::Kind::failed, error.what());
    }
}

}  // namespace brdfit::server
