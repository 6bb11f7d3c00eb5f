/// HTTP for Routes: sockets, limits, headers.
#pragma once

#include <memory>
#include <string>

#include "server/routes.h"

namespace brdfit::server {

class HttpServer {
public:
    explicit HttpServer(const Routes& routes);
    ~HttpServer();

    /// Binds the address; port 0 takes a free one. Returns the port. Throws std::runtime_error if it is taken.
    int bind(const std::string& host, int port);
    /// Serves until stop() is called.
    void serve();
    /// From any thread: ends serve() when running requests are answered.
    void stop();

private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

}  // namespace brdfit::server
