/// Figures of the running service, in Prometheus's text format.
#pragma once

#include <chrono>
#include <cstddef>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace brdfit::server {

/// Safe to use from several threads.
class Metrics {
public:
    /// A figure that another part of the service keeps, as of now.
    struct Figure {
        std::string name;  ///< brdfit_<what>_<unit>; ends with _total if it only grows
        std::string help;
        std::map<std::string, std::string> labels{};
        double value = 0;
        bool only_grows = false;
    };
    struct Served {
        std::string method;
        std::string route;  ///< template of the path; empty where nothing is
        int status = 200;
        std::chrono::duration<double> time{};  ///< from the request's last byte to the answer's first
        std::size_t received = 0;              ///< bytes of the request's body
        std::size_t sent = 0;                  ///< bytes of the answer's body
    };

    Metrics();
    ~Metrics();

    /// Asked at every reading, on the reading's thread. All figures of a name come from one source.
    void add_source(std::function<std::vector<Figure>()> source);

    void count(const Served& served);
    void count_accepted();
    /// why: one of a few words, such as "idle" or "head_timeout".
    void count_closed(const std::string& why);
    /// What goes up and down.
    void add_connections(int change);
    void add_requests(int change);
    void add_streams(int change);

    static constexpr const char* kContentType = "text/plain; version=0.0.4; charset=utf-8";
    [[nodiscard]] std::string text() const;

private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

}  // namespace brdfit::server
