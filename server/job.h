/// Fit jobs and where they are kept.
#pragma once

#include <cstddef>
#include <deque>
#include <memory>
#include <mutex>
#include <string>
#include <unordered_map>

#include "optim/report.h"

namespace brdfit::server {

/// A fit that has been answered: immutable.
struct Job {
    std::string id;          ///< UUID version 7
    optim::Report report;    ///< what plots are drawn from
    std::string result;      ///< the answer's body
    bool succeeded = false;  ///< some model was fitted
};

/// A new job's name: time-ordered and unguessable.
std::string make_job_id();

/// Keeps finished jobs. Safe to use from several threads.
class JobStore {
public:
    virtual ~JobStore() = default;
    virtual void put(std::shared_ptr<const Job> job) = 0;
    /// nullptr if there is none, or no longer.
    [[nodiscard]] virtual std::shared_ptr<const Job> find(const std::string& id) const = 0;
};

/// About how many bytes a job takes in memory.
std::size_t size_of(const Job& job);

/// In memory: the latest jobs, as many as `capacity` bytes hold and at least one, the oldest dropped first; gone with
/// the process.
class MemoryJobStore final : public JobStore {
public:
    explicit MemoryJobStore(std::size_t capacity) : capacity_(capacity) {}
    void put(std::shared_ptr<const Job> job) override;
    [[nodiscard]] std::shared_ptr<const Job> find(const std::string& id) const override;

private:
    std::size_t capacity_;
    std::size_t size_ = 0;
    mutable std::mutex mutex_;
    std::deque<std::string> order_;
    std::unordered_map<std::string, std::shared_ptr<const Job>> jobs_;
};

}  // namespace brdfit::server
