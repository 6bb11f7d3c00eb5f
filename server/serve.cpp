#include "server/serve.h"

#include <unistd.h>

#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <stop_token>
#include <thread>

#include <spdlog/spdlog.h>

#include "api/response.h"
#include "kernels/model.h"
#include "server/http.h"
#include "server/job_metrics.h"
#include "server/routes.h"
#include "server/store.h"
#include "server/supervisor.h"

namespace brdfit::server {
namespace {

/// What its workers are told of the service's options.
std::vector<std::string> worker_arguments(const ServeOptions& options, const std::filesystem::path& store) {
    std::vector<std::string> words{
        "--store", store.string(), "--device", options.engine.device, "--threads", std::to_string(options.threads)};
    if (!options.engine.build_options.empty()) words.push_back("--build-options=" + options.engine.build_options);
    if (!options.engine.cache || options.engine.cache->empty()) words.emplace_back("--no-cache");
    else words.insert(words.end(), {"--cache", options.engine.cache->string()});
    for (const std::filesystem::path& folder : options.model_folders)
        words.insert(words.end(), {"--models", folder.string()});
    return words;
}

}  // namespace

std::filesystem::path default_store() {
    const auto folder = [](const char* variable) {
        const char* value = std::getenv(variable);
        return std::filesystem::path(value == nullptr ? "" : value);
    };
    if (const auto data = folder("XDG_DATA_HOME"); data.is_absolute()) return data / "brdfit" / "brdfit.db";
    if (const auto home = folder("HOME"); home.is_absolute()) return home / ".local/share/brdfit/brdfit.db";
    throw std::runtime_error("there is no HOME to keep jobs in: say where with --store");
}

void serve(const ServeOptions& options) {
    set_log_format(options.log_format);
    sigset_t signals;
    sigemptyset(&signals);
    sigaddset(&signals, SIGTERM);
    sigaddset(&signals, SIGINT);
    pthread_sigmask(SIG_BLOCK, &signals, nullptr);  // inherited by every thread: one waits for them

    const kernels::Catalogue catalogue(options.model_folders);
    const std::filesystem::path path =
        std::filesystem::absolute(options.store.empty() ? default_store() : options.store);
    SqliteOptions store_options{path.string()};
    SupervisorOptions supervisor_options{options.workers, worker_arguments(options, path), {}};
    if (options.keep.count() > 0) supervisor_options.retention.keep = options.keep;
    if (options.most_bytes > 0) store_options.most_bytes = options.most_bytes;
    supervisor_options.retention.most_bytes = store_options.most_bytes;
    const std::unique_ptr<JobStore> store = open_sqlite(store_options);
    std::stop_source stop;
    Supervisor supervisor(catalogue, *store, std::move(supervisor_options));
    const Routes routes(catalogue, *store, supervisor, stop.get_token(), options.http.limits.largest_body);
    HttpServer http(routes, options.http);
    http.metrics().add_source([&store] { return job_figures(*store); });
    http.metrics().add_source([&supervisor] { return worker_figures(supervisor); });
    const int port = http.bind(options.host, options.port);  // a taken port is told before a compiler runs

    enum class Phase { starting, serving, abandoned };
    std::atomic<Phase> phase = Phase::starting;
    const auto enter = [&phase](Phase next) {  // from the start; false if the other thread was quicker
        Phase expected = Phase::starting;
        return phase.compare_exchange_strong(expected, next);
    };
    std::atomic<bool> ended = false;
    std::jthread waiter([&](const std::stop_token& served) {
        int signal = 0;
        sigwait(&signals, &signal);
        if (!ended) spdlog::info("stopping on signal {}", signal);
        pthread_sigmask(SIG_UNBLOCK, &signals, nullptr);  // the next one ends the process
        stop.request_stop();
        supervisor.stop();  // meanwhile requests are answered whose fits are soon done
        if (!enter(Phase::abandoned) && !ended) http.stop();
        while (!served.stop_requested()) std::this_thread::sleep_for(std::chrono::milliseconds(5));  // to take that one
    });
    const auto give_up = [&] {  // without a signal: the waiter waits for one
        ended = true;
        ::kill(::getpid(), SIGTERM);
    };
    try {
        supervisor.start(stop.get_token());
    } catch (...) {
        if (enter(Phase::abandoned)) give_up();
        throw;
    }
    if (!enter(Phase::serving)) return;
    const auto device = supervisor.known_device();
    std::printf("brdfit %s listens on http://%s:%d, computing on %s\n", api::version().c_str(), options.host.c_str(),
                port, device ? device->name.c_str() : "nothing yet: no worker runs");
    std::fflush(stdout);
    http.serve();
    if (!stop.stop_requested()) {
        give_up();
        throw std::runtime_error("the listening socket failed");
    }
}

}  // namespace brdfit::server
