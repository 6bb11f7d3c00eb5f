#include "server/serve.h"

#include <unistd.h>

#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <future>
#include <span>
#include <stdexcept>
#include <stop_token>
#include <thread>

#include <spdlog/spdlog.h>

#include "api/response.h"
#include "kernels/engine.h"
#include "kernels/model.h"
#include "kernels/selftest.h"
#include "optim/fit.h"
#include "server/http.h"
#include "server/local.h"
#include "server/routes.h"
#include "server/store.h"

namespace brdfit::server {
namespace {

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
    /// The rest. All that was found.
    std::vector<kernels::SelfTest> prove_others() {
        while (!left_.empty()) (void)prove_next();
        return std::move(found_);
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

}  // namespace

void serve(const ServeOptions& options) {
    set_log_format(options.log_format);
    sigset_t signals;
    sigemptyset(&signals);
    sigaddset(&signals, SIGTERM);
    sigaddset(&signals, SIGINT);
    pthread_sigmask(SIG_BLOCK, &signals, nullptr);  // inherited by every thread: one waits for them

    const kernels::Catalogue catalogue(options.model_folders);
    kernels::Engine engine(options.engine);
    char folder[] = "/tmp/brdfit.XXXXXX";
    const auto store = open_sqlite({std::string(::mkdtemp(folder)) + "/store"});
    const unsigned threads = options.threads != 0 ? options.threads : std::thread::hardware_concurrency();
    optim::Fitter fitter(engine, threads);
    std::stop_source stop;
    std::promise<std::vector<kernels::SelfTest>> self_tests;
    LocalCompute compute(catalogue, fitter, self_tests.get_future().share());
    const LocalWorkers workers(catalogue, fitter, *store, 8);
    const Routes routes(catalogue, *store, compute, stop.get_token(), options.http.limits.largest_body);
    HttpServer http(routes, options.http);
    const int port = http.bind(options.host, options.port);  // a taken port is told before the compiler runs
    // Fits are possible when one precision is proven; the other is while the first requests come.
    SelfTester tester(engine, catalogue.families());
    tester.prove_best();
    if (engine.usable())
        for (const kernels::Family& family : catalogue.families()) fitter.warm_up(family);
    const std::jthread others([&] { self_tests.set_value(tester.prove_others()); });
    const auto stop_building = [&] { engine.stop_building(); };
    const std::stop_callback stopped(stop.get_token(), stop_building);

    std::atomic<bool> signalled = false;
    std::jthread waiter([&](const std::stop_token& served) {
        int signal = 0;
        sigwait(&signals, &signal);
        signalled = true;
        spdlog::info("stopping on signal {}", signal);
        pthread_sigmask(SIG_UNBLOCK, &signals, nullptr);  // the next one ends the process
        stop.request_stop();
        http.stop();
        while (!served.stop_requested()) std::this_thread::sleep_for(std::chrono::milliseconds(5));  // to take that one
    });
    std::printf("brdfit %s listens on http://%s:%d, computing on %s\n", api::version().c_str(), options.host.c_str(),
                port, engine.device().name.c_str());
    std::fflush(stdout);
    http.serve();
    if (!signalled) {  // then the socket failed, and the waiter waits still
        ::kill(::getpid(), SIGTERM);
        throw std::runtime_error("the listening socket failed");
    }
}

}  // namespace brdfit::server
