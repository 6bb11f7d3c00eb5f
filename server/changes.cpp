#include "server/changes.h"

#include <utility>

namespace brdfit::server {

Changes::Watch::Watch(Changes& changes, std::string key) : changes_(changes), key_(std::move(key)) {
    const std::lock_guard lock(changes_.mutex_);
    Entry& entry = changes_.entries_[key_];
    ++entry.watches;
    seen_ = entry.changes;
}

Changes::Watch::~Watch() {
    const std::lock_guard lock(changes_.mutex_);
    const auto entry = changes_.entries_.find(key_);
    if (--entry->second.watches == 0) changes_.entries_.erase(entry);
}

bool Changes::Watch::wait(std::chrono::milliseconds time) {
    std::unique_lock lock(changes_.mutex_);
    Entry& entry = changes_.entries_.at(key_);
    entry.changed.wait_for(lock, time, [&] { return changes_.closed_ || entry.changes != seen_; });
    return std::exchange(seen_, entry.changes) != entry.changes;
}

void Changes::tell(const std::string& key) {
    const std::lock_guard lock(mutex_);
    const auto entry = entries_.find(key);
    if (entry == entries_.end()) return;
    ++entry->second.changes;
    entry->second.changed.notify_all();
}

void Changes::close() {
    const std::lock_guard lock(mutex_);
    closed_ = true;
    for (auto& [key, entry] : entries_) entry.changed.notify_all();
}

bool Changes::closed() const {
    const std::lock_guard lock(mutex_);
    return closed_;
}

}  // namespace brdfit::server
