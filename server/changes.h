/// Who waits for a job is woken when something happens to it.
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <string>
#include <unordered_map>

namespace brdfit::server {

/// Wakes waiters by key. Told by the store for what this process does, and by whoever hears of others' work; a change
/// made by a process that tells nobody is found by looking again at the end of `time`. Safe to use from several
/// threads.
class Changes {
public:
    /// Look at the store after making one of these, then wait: a change between the two is not missed.
    class Watch {
    public:
        Watch(Changes& changes, std::string key);
        ~Watch();
        Watch(const Watch&) = delete;
        Watch& operator=(const Watch&) = delete;
        /// True if there was a change since the last wait() or the watch's making; false after `time`, or when closed.
        bool wait(std::chrono::milliseconds time);

    private:
        Changes& changes_;
        std::string key_;
        std::uint64_t seen_ = 0;
    };

    void tell(const std::string& key);
    /// No wait() lasts any longer, ever: the service stops.
    void close();
    [[nodiscard]] bool closed() const;

private:
    struct Entry {
        std::size_t watches = 0;
        std::uint64_t changes = 0;
        std::condition_variable changed;
    };
    mutable std::mutex mutex_;
    std::unordered_map<std::string, Entry> entries_;  ///< of keys with a watch
    bool closed_ = false;
};

}  // namespace brdfit::server
