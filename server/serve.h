/// `brdfit serve`: the service, from options to exit status.
#pragma once

#include <filesystem>
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
    unsigned threads = 0;  ///< searches at once; 0: one a core
    HttpOptions http{};
    LogFormat log_format = LogFormat::text;
};

/// Serves until SIGTERM or SIGINT; a second signal ends the process at once. Call it on the main thread before others
/// exist. Throws std::runtime_error for options that cannot be met, and what engine and catalogue throw.
void serve(const ServeOptions& options);

}  // namespace brdfit::server
