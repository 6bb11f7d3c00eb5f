#include "server/job.h"

namespace brdfit::server {

std::size_t size_of(const Job& job) {
    std::size_t bytes = sizeof job + job.result.size();
    for (const optim::ChannelReport& channel : job.report.channels) {
        bytes += channel.channel.samples.size() * sizeof(optim::Sample);
        for (const optim::Fit& fit : channel.fits) {
            bytes += sizeof fit + fit.values.size() * sizeof(double);
            for (const optim::Fit::Curve& curve : fit.curves) bytes += 2 * curve.brdf.size() * sizeof(double);
        }
    }
    return bytes;
}

void MemoryJobStore::put(std::shared_ptr<const Job> job) {
    const std::lock_guard lock(mutex_);
    size_ += size_of(*job);
    order_.push_back(job->id);
    jobs_[job->id] = std::move(job);
    while (size_ > capacity_ && order_.size() > 1) {
        const auto oldest = jobs_.find(order_.front());
        size_ -= size_of(*oldest->second);
        jobs_.erase(oldest);
        order_.pop_front();
    }
}

std::shared_ptr<const Job> MemoryJobStore::find(const std::string& id) const {
    const std::lock_guard lock(mutex_);
    const auto it = jobs_.find(id);
    return it == jobs_.end() ? nullptr : it->second;
}

}  // namespace brdfit::server
