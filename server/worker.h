/// `brdfit worker`: a process that computes the jobs of a store.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "kernels/engine.h"

namespace brdfit::server {

/// Which jobs a worker takes.
enum class Lane {
    any,
    interactive,  ///< only those that somebody waits for: it is never busy with others
};

struct WorkerOptions {
    std::string store;  ///< file of the job store
    int channel = -1;   ///< descriptor of a socket to the front end; -1: started by hand
    std::string owner;  ///< its own name among all workers; empty: it makes one up
    Lane lane = Lane::any;
    int niceness = 0;
    kernels::EngineOptions engine{};
    std::vector<std::filesystem::path> model_folders{};
    unsigned threads = 0;  ///< searches at once; 0: one a core
};

/// Computes jobs until SIGTERM, SIGINT, or the front end says stop or ends. Then it claims no more, ends what somebody
/// waits for if that takes no longer than four seconds, and gives the rest back. Call it on the main thread before
/// others exist. Throws what engine, catalogue and store throw.
void work(const WorkerOptions& options);

}  // namespace brdfit::server
