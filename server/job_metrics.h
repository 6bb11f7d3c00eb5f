/// What Prometheus is told of jobs and of those who compute.
#pragma once

#include <vector>

#include "server/metrics.h"
#include "server/store.h"
#include "server/supervisor.h"

namespace brdfit::server {

/// Jobs by state, and what the store takes; nothing while the store cannot be read.
std::vector<Metrics::Figure> job_figures(JobStore& store);

/// Worker processes.
std::vector<Metrics::Figure> worker_figures(const Supervisor& supervisor);

}  // namespace brdfit::server
