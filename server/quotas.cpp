#include "server/quotas.h"

#include <algorithm>

namespace brdfit::server {
namespace {

/// Clients that are remembered before those are forgotten that have not come for a while.
constexpr std::size_t kMostClients = 4096;

}  // namespace

Places::Taken Places::take(const std::string& client) {
    const std::lock_guard lock(mutex_);
    std::size_t& of_client = by_client_[client];
    const auto refuse = [&](const api::ProblemType& type, const std::string& detail) {
        if (of_client == 0) by_client_.erase(client);
        return Taken{nullptr, api::Problem{type, detail, {}}};
    };
    if (of_client >= share_.each)
        return refuse(api::problem_type("too-many-requests"),
                      "a client may have " + std::to_string(share_.each) + " " + what_);
    if (taken_ >= share_.all)
        return refuse(api::problem_type("busy"), "the service has as many " + what_ + " as it can have");
    ++taken_;
    ++of_client;
    return {Place(this, GiveBack{client}), std::nullopt};
}

void Places::give_back(const std::string& client) {
    const std::lock_guard lock(mutex_);
    --taken_;
    if (--by_client_[client] == 0) by_client_.erase(client);
}

bool Rate::allows(const std::string& client, Clock::time_point now) {
    if (per_second_ <= 0) return true;
    const double most = std::max(1.0, 2 * per_second_);
    const std::lock_guard lock(mutex_);
    const auto left = [&](const Bucket& bucket) {
        return std::min(most, bucket.left + per_second_ * std::chrono::duration<double>(now - bucket.filled).count());
    };
    if (buckets_.size() >= kMostClients)
        std::erase_if(buckets_, [&](const auto& entry) { return left(entry.second) >= most; });
    Bucket& bucket = buckets_.try_emplace(client, Bucket{most, now}).first->second;
    bucket = {left(bucket), now};
    if (bucket.left < 1) return false;
    bucket.left -= 1;
    return true;
}

}  // namespace brdfit::server
