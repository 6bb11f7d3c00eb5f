/// HTTP for what answers requests: the library, limits, keys, metrics, the log.
#pragma once

#include <cstddef>
#include <filesystem>
#include <functional>
#include <memory>
#include <string>

#include "server/listener.h"
#include "server/metrics.h"
#include "server/quotas.h"
#include "server/routes.h"

namespace brdfit::server {

struct HttpOptions {
    Limits limits{};
    std::filesystem::path api_keys{};  ///< file of ApiKeys; empty: nobody is asked for a key
    double rate = 0;                   ///< requests a second of a client, health apart; 0: as many as come
    Share waiting{224, 128};           ///< requests at once that may wait: whatever posts, or prefers to wait
    Share streams{128, 32};            ///< answers at once that are written bit by bit
};

/// Whether only this machine reaches the address.
bool is_loopback(const std::string& host);

class HttpServer {
public:
    using Handler = std::function<Response(const Request&)>;

    /// handler: called on many threads; must not throw. Throws std::runtime_error where the keys cannot be read.
    explicit HttpServer(Handler handler, const HttpOptions& options = {});
    explicit HttpServer(const Routes& routes, const HttpOptions& options = {})
        : HttpServer([&routes](const Request& request) { return routes.handle(request); }, options) {}
    ~HttpServer();

    /// Binds the address; port 0 takes a free one. Returns the port. Throws std::runtime_error if it is taken, or is
    /// one that others reach while nobody is asked for a key.
    int bind(const std::string& host, int port);
    /// Serves until stop() is called, or the socket fails, which is logged.
    void serve();
    /// From any thread: ends serve() when running requests are answered.
    void stop();

    /// What GET /metrics tells; for others to add to.
    Metrics& metrics();

private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

}  // namespace brdfit::server
