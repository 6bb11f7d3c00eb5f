/// Many searches in one thread: while the device works for one, the others go on.
#pragma once

#include <condition_variable>
#include <cstddef>
#include <deque>
#include <future>
#include <list>
#include <mutex>
#include <thread>
#include <vector>

#include "kernels/waiting.h"

namespace brdfit::optim {

/// Runs tasks as fibres of one thread. A task that waits for a launch is put aside and goes on when that is over, so
/// launches of many tasks are under way together, enqueued before any is waited for. Tasks must not wait within a catch
/// block: fibres share their thread's stack of caught exceptions. Safe to use from several threads.
class Broker {
public:
    struct Limits {
        std::size_t tasks = 256;          ///< at once
        std::size_t size = 256UL * 1024;  ///< sum of their sizes at once; a larger task runs alone
    };

    explicit Broker(Limits limits);
    /// Runs what was posted to its end.
    ~Broker();
    Broker(const Broker&) = delete;
    Broker& operator=(const Broker&) = delete;

    /// Tasks begin in the order they are posted. What one throws goes to its future.
    void post(std::packaged_task<void()> task, std::size_t size);

private:
    struct Fibre;
    class Yield;
    struct Posted {
        std::packaged_task<void()> task;
        std::size_t size;
    };

    void run();
    /// A fibre whose launch is over, or one with the next task; waits for either. None at the end.
    Fibre* next();
    void wake(Fibre& fibre);

    Limits limits_;
    std::list<Fibre> fibres_;  ///< of the thread alone
    std::size_t size_ = 0;     ///< theirs
    std::mutex mutex_;         ///< guards what is below
    std::condition_variable changed_;
    std::deque<Posted> posted_;
    std::deque<Fibre*> ready_;
    bool ending_ = false;
    std::thread thread_;
};

}  // namespace brdfit::optim
