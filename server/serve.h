/// `brdfit serve`: the service, from options to exit status.
#pragma once

#include <chrono>
#include <cstddef>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "server/http.h"
#include "server/log.h"

namespace brdfit::server {

struct ServeOptions {
    std::string host = "127.0.0.1";  ///< a loopback address, unless there are keys
    int port = 8080;                 ///< 0: a free one
    kernels::EngineOptions engine{};
    std::vector<std::filesystem::path> model_folders{};
    unsigned threads = 0;                                     ///< searches at once in a worker; 0: one a core
    unsigned workers = 2;                                     ///< processes that compute
    std::filesystem::path store{};                            ///< file; empty: default_store()
    std::chrono::seconds keep = std::chrono::hours(30 * 24);  ///< how long ended jobs are kept; 0: for ever
    std::size_t most_bytes = 10'000'000'000;                  ///< of the store; 0: no limit
    HttpOptions http{};
    LogFormat log_format = LogFormat::text;
};

/// $XDG_DATA_HOME/brdfit/brdfit.db, or ~/.local/share/brdfit/brdfit.db. Throws std::runtime_error where neither is set.
std::filesystem::path default_store();

/// Serves until SIGTERM or SIGINT; a second signal ends the process at once. Call it on the main thread before others
/// exist. Throws std::runtime_error for options that cannot be met, and what store, catalogue and workers throw.
void serve(const ServeOptions& options);

}  // namespace brdfit::server
