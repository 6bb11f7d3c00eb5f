#include "server/job_metrics.h"

#include <chrono>
#include <map>
#include <string>
#include <utility>

#include <spdlog/spdlog.h>

namespace brdfit::server {

std::vector<Metrics::Figure> job_figures(JobStore& store) try {
    const Counts counts = store.counts();
    std::vector<Metrics::Figure> figures;
    const auto add = [&](const char* name, const char* help, double value,
                         std::map<std::string, std::string> labels = {}) {
        figures.push_back({name, help, std::move(labels), value, false});
    };
    const auto add_jobs = [&](JobState state, std::size_t count, std::map<std::string, std::string> labels = {}) {
        labels["state"] = std::string(name_of(state));
        add("brdfit_jobs", "Jobs that are kept, by state; of running ones some may be cancelling",
            static_cast<double>(count), std::move(labels));
    };
    add_jobs(JobState::queued, counts.queued_interactive, {{"priority", "interactive"}});
    add_jobs(JobState::queued, counts.queued_batch, {{"priority", "batch"}});
    add_jobs(JobState::running, counts.running);
    add_jobs(JobState::succeeded, counts.succeeded);
    add_jobs(JobState::failed, counts.failed);
    add_jobs(JobState::cancelled, counts.cancelled);
    add("brdfit_jobs_oldest_queued_seconds", "How long the oldest queued job has waited, 0 if none is queued",
        std::chrono::duration<double>(counts.oldest_queued).count());
    add("brdfit_datasets", "Datasets that are kept", static_cast<double>(counts.datasets));
    add("brdfit_store_bytes", "Size of the store on disk", static_cast<double>(counts.bytes));
    return figures;
} catch (const StoreError& error) {
    spdlog::error("the store: {}", error.what());
    return {};
}

std::vector<Metrics::Figure> worker_figures(const Supervisor& supervisor) {
    const Supervisor::Processes processes = supervisor.processes();
    return {
        {"brdfit_workers_ready", "Worker processes that take jobs", {}, static_cast<double>(processes.ready), false},
        {"brdfit_workers_ended_total",
         "Worker processes that have ended, and were started again",
         {},
         static_cast<double>(processes.ended),
         true}};
}

}  // namespace brdfit::server
