/// Progress of a fit as JSON: of a status, and of the events of a job.
#pragma once

#include <string>
#include <vector>

#include "optim/progress.h"

namespace brdfit::api {

/// "fraction" of the work, "models_done" of "models" (one of each channel), "evaluations", "evaluations_per_s", and in
/// "best" what each has reached, those under way first, at most 100.
std::string progress_json(const std::vector<optim::Progress::Task>& tasks, double evaluations_per_s);

/// A model that is done: its channel and, if it was fitted, its relative loss.
std::string model_done_json(const optim::Progress::Task& task);

}  // namespace brdfit::api
