/// How much of the service one client may take.
#pragma once

#include <chrono>
#include <cstddef>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>

#include "api/problem.h"

namespace brdfit::server {

/// A share of something that there is so much of: places for all, and for one client.
struct Share {
    std::size_t all = 0;
    std::size_t each = 0;
};

/// Places that clients hold for a while. Safe to use from several threads.
class Places {
public:
    /// what: of which there are so many, for people.
    Places(Share share, std::string what) : share_(share), what_(std::move(what)) {}

    struct GiveBack {
        std::string client;
        void operator()(Places* places) const { places->give_back(client); }
    };
    /// Given back when it goes.
    using Place = std::unique_ptr<Places, GiveBack>;
    /// A place, or why there is none: 429 where the client has its share, 503 where all are taken.
    struct Taken {
        Place place;
        std::optional<api::Problem> problem{};
    };
    [[nodiscard]] Taken take(const std::string& client);

private:
    void give_back(const std::string& client);

    Share share_;
    std::string what_;
    std::mutex mutex_;
    std::size_t taken_ = 0;
    std::map<std::string, std::size_t> by_client_;
};

/// Requests a second of each client, with twice as many at once. Safe to use from several threads.
class Rate {
public:
    using Clock = std::chrono::steady_clock;
    /// per_second: 0 for no limit.
    explicit Rate(double per_second) : per_second_(per_second) {}

    /// Whether the client may have one more now.
    [[nodiscard]] bool allows(const std::string& client, Clock::time_point now);

private:
    struct Bucket {
        double left = 0;
        Clock::time_point filled{};
    };
    double per_second_;
    std::mutex mutex_;
    std::map<std::string, Bucket> buckets_;
};

}  // namespace brdfit::server
