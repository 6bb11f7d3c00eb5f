#include "optim/broker.h"

#include <utility>

#include <boost/context/fiber.hpp>  // stacks of their own
#include <boost/context/protected_fixedsize_stack.hpp>

namespace brdfit::optim {
namespace {

/// As a thread's own stack: a driver's compiler may run on it. Only what is touched takes memory.
constexpr std::size_t kStackBytes = std::size_t{8} << 20;

}  // namespace

struct Broker::Fibre {
    Fibre(Broker& broker_in, Posted posted_in) : broker(broker_in), posted(std::move(posted_in)) {}

    Broker& broker;
    Posted posted;
    boost::context::fiber code;  ///< where it goes on; empty when it is over
    boost::context::fiber back;  ///< where the broker goes on
};

/// Gives the thread to others until work is over.
class Broker::Yield : public kernels::Waiter {
public:
    void wait(kernels::Underway& work) override {
        Fibre& fibre = *running;
        work.when_over(
            [](void* context) {
                Fibre& over = *static_cast<Fibre*>(context);
                over.broker.wake(over);
            },
            &fibre);
        fibre.back = std::move(fibre.back).resume();
    }

    Fibre* running = nullptr;
};

Broker::Broker(Limits limits) : limits_(limits), thread_([this] { run(); }) {}

Broker::~Broker() {
    {
        const std::lock_guard lock(mutex_);
        ending_ = true;
        changed_.notify_one();
    }
    thread_.join();
}

void Broker::post(std::packaged_task<void()> task, std::size_t size) {
    const std::lock_guard lock(mutex_);
    posted_.push_back({std::move(task), size});
    changed_.notify_one();
}

void Broker::wake(Fibre& fibre) {
    const std::lock_guard lock(mutex_);
    ready_.push_back(&fibre);
    changed_.notify_one();  // under the lock: the broker may be gone once it is released
}

Broker::Fibre* Broker::next() {
    std::unique_lock lock(mutex_);
    const auto may_begin = [&] {
        return !posted_.empty() &&
               (fibres_.empty() || (fibres_.size() < limits_.tasks && size_ + posted_.front().size <= limits_.size));
    };
    changed_.wait(lock, [&] { return !ready_.empty() || may_begin() || (ending_ && fibres_.empty()); });
    if (!ready_.empty()) {  // first: the older a task is, the sooner it shall be done
        Fibre* const fibre = ready_.front();
        ready_.pop_front();
        return fibre;
    }
    if (!may_begin()) return nullptr;
    Fibre& fibre = fibres_.emplace_back(*this, std::move(posted_.front()));
    posted_.pop_front();
    size_ += fibre.posted.size;
    return &fibre;
}

void Broker::run() {
    Yield yield;
    const kernels::WaiterScope scope(yield);
    while (Fibre* const fibre = next()) {
        if (!fibre->code)
            fibre->code =
                boost::context::fiber(std::allocator_arg, boost::context::protected_fixedsize_stack(kStackBytes),
                                      [fibre](boost::context::fiber&& back) {
                                          fibre->back = std::move(back);
                                          fibre->posted.task();  // keeps what it throws
                                          return std::move(fibre->back);
                                      });
        yield.running = fibre;
        fibre->code = std::move(fibre->code).resume();
        if (fibre->code) continue;
        size_ -= fibre->posted.size;
        fibres_.remove_if([&](const Fibre& other) { return &other == fibre; });
    }
}

}  // namespace brdfit::optim
