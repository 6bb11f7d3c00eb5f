/// How far a fit has come: its tasks write, others read.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <deque>
#include <limits>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

namespace brdfit::optim {

/// Of one model on one channel. Written by one task at a time, read from any thread.
class TaskProgress {
public:
    /// Candidates were evaluated; the smallest of their losses, squared and relative to that of f = 0.
    void evaluated(std::size_t candidates, double relative_loss2) {
        evaluations_ += candidates;
        if (relative_loss2 < best_) best_ = relative_loss2;
    }
    /// A step of the search is over.
    void stepped() { ++steps_; }
    /// There is a fit of this relative loss, or none.
    void finish(std::optional<double> relative_loss) {
        if (relative_loss) best_ = *relative_loss * *relative_loss;
        done_ = true;
    }

    [[nodiscard]] bool done() const { return done_; }
    [[nodiscard]] std::size_t evaluations() const { return evaluations_; }
    /// Rises with every step, below 1 until the end: how many there will be depends on what is found.
    [[nodiscard]] double fraction() const {
        constexpr double kUsual = 6;  // steps
        return done_ ? 1.0 : static_cast<double>(steps_) / (static_cast<double>(steps_) + kUsual);
    }
    /// Of the best candidate so far; none before the first.
    [[nodiscard]] std::optional<double> relative_loss() const {
        const double best = best_;
        if (!(best < std::numeric_limits<double>::max())) return std::nullopt;
        return std::sqrt(std::max(0.0, best));
    }

private:
    std::atomic<std::size_t> evaluations_ = 0;
    std::atomic<unsigned> steps_ = 0;
    std::atomic<double> best_ = std::numeric_limits<double>::max();
    std::atomic<bool> done_ = false;
};

/// Of a whole fit. Safe to use from several threads.
class Progress {
public:
    struct Task {
        std::string channel;
        std::string model;
        bool done = false;
        double fraction = 0;
        std::size_t evaluations = 0;
        std::optional<double> relative_loss{};
    };

    /// Of a further task; lives as long as this object.
    TaskProgress& add(std::string channel, std::string model) {
        const std::lock_guard lock(mutex_);
        Entry& entry = entries_.emplace_back();
        entry.channel = std::move(channel);
        entry.model = std::move(model);
        return entry.progress;
    }
    /// Tasks in the order they were added.
    [[nodiscard]] std::vector<Task> tasks() const {
        const std::lock_guard lock(mutex_);
        std::vector<Task> tasks;
        for (const Entry& e : entries_)
            tasks.push_back({e.channel, e.model, e.progress.done(), e.progress.fraction(), e.progress.evaluations(),
                             e.progress.relative_loss()});
        return tasks;
    }

private:
    struct Entry {
        std::string channel;
        std::string model;
        TaskProgress progress;
    };
    mutable std::mutex mutex_;
    std::deque<Entry> entries_;
};

}  // namespace brdfit::optim
