// Fibres of one thread: they take turns where they wait, and every task comes to its end.

#include "optim/broker.h"

#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <future>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace brdfit::tests {
namespace {

using optim::Broker;

/// A launch that is over when the test says so, from whichever thread.
class Launch : public kernels::Underway {
public:
    void when_over(void (*done)(void*), void* context) override {
        const std::lock_guard lock(mutex_);
        done_ = done;
        context_ = context;
        waited_for_.notify_all();
    }
    void end() {
        std::unique_lock lock(mutex_);
        waited_for_.wait(lock, [&] { return done_ != nullptr; });
        done_(context_);
    }

private:
    std::mutex mutex_;
    std::condition_variable waited_for_;
    void (*done_)(void*) = nullptr;
    void* context_ = nullptr;
};

/// Over before anyone waits.
class Over : public kernels::Underway {
    void when_over(void (*done)(void*), void* context) override { done(context); }
};

class Refused : public kernels::Underway {
    void when_over(void (*)(void*), void*) override { throw std::runtime_error("no callback"); }
};

void wait_for(kernels::Underway& work) { kernels::waiter_of_thread()->wait(work); }

template <typename Work>
std::future<void> post(Broker& broker, Work work, std::size_t size = 1) {
    std::packaged_task<void()> task(std::move(work));
    auto future = task.get_future();
    broker.post(std::move(task), size);
    return future;
}

TEST(Broker, ThreadsWithoutOneHaveNoWaiter) { EXPECT_EQ(kernels::waiter_of_thread(), nullptr); }

TEST(Broker, TasksThatWaitLetOthersRunAndGoOnWhenTheirLaunchIsOver) {
    Broker broker({});
    Launch first, second;
    std::string order;
    auto a = post(broker, [&] {
        order += 'a';
        wait_for(first);
        order += 'A';
    });
    auto b = post(broker, [&] {
        order += 'b';
        wait_for(second);
        order += 'B';
    });
    post(broker, [&] { order += 'c'; }).get();
    EXPECT_EQ(order, "abc");
    second.end();
    b.get();
    first.end();
    a.get();
    EXPECT_EQ(order, "abcBA");
}

TEST(Broker, TasksTakeTurnsManyTimes) {
    Broker broker({});
    constexpr int kTasks = 200;
    constexpr int kTurns = 100;
    std::size_t turns = 0;  // unguarded: all in one thread
    std::vector<std::future<void>> tasks;
    for (int i = 0; i < kTasks; ++i)
        tasks.push_back(post(broker, [&turns] {
            volatile char deep[4 << 20];  // a stack like a thread's
            deep[0] = 1;
            EXPECT_EQ(deep[0], 1);
            for (int turn = 0; turn < kTurns; ++turn) {
                Over over;
                wait_for(over);
                ++turns;
            }
        }));
    for (auto& task : tasks) task.get();
    EXPECT_EQ(turns, static_cast<std::size_t>(kTasks) * kTurns);
}

TEST(Broker, WhatATaskThrowsGoesToItsFutureAlone) {
    Broker broker({});
    Launch launch;
    auto waits = post(broker, [&] {
        try {
            wait_for(launch);
            throw std::runtime_error("later");
        } catch (const std::runtime_error& error) {
            throw std::logic_error(std::string("after ") + error.what());
        }
    });
    auto fails = post(broker, [] { throw std::out_of_range("at once"); });
    auto refused = post(broker, [] {
        Refused work;
        wait_for(work);
    });
    EXPECT_THROW(fails.get(), std::out_of_range);
    EXPECT_THROW(refused.get(), std::runtime_error);
    launch.end();
    EXPECT_THROW(waits.get(), std::logic_error);
    post(broker, [] {}).get();
}

TEST(Broker, EndsWhenAllTasksHaveEnded) {
    Launch launch;
    std::atomic<int> ended = 0;
    std::thread device([&] {
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
        launch.end();
    });
    {
        Broker broker({1, 100});
        for (int i = 0; i < 3; ++i)
            (void)post(broker, [&, i] {
                if (i == 0) wait_for(launch);
                ++ended;
            });
    }
    EXPECT_EQ(ended, 3);
    device.join();
}

TEST(Broker, BeginsNoMoreThanItsLimits) {
    Broker broker({3, 10});
    Launch launches[6];
    std::atomic<int> begun = 0;
    std::vector<std::future<void>> tasks;
    for (const std::size_t size : {1U, 1U, 1U, 9U, 2U, 50U})
        tasks.push_back(post(
            broker, [&, i = tasks.size()] { ++begun, wait_for(launches[i]); }, size));
    const auto becomes = [&](int count) {
        for (int i = 0; i < 1000 && begun < count; ++i) std::this_thread::sleep_for(std::chrono::milliseconds(1));
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
        return begun == count;
    };
    EXPECT_TRUE(becomes(3));  // three at once
    launches[0].end();
    EXPECT_TRUE(becomes(3));  // 2 + 9 are too large
    launches[1].end();
    EXPECT_TRUE(becomes(4));
    launches[2].end();
    EXPECT_TRUE(becomes(4));  // 9 + 2
    launches[3].end();
    EXPECT_TRUE(becomes(5));
    launches[4].end();
    EXPECT_TRUE(becomes(6));  // the largest, alone
    launches[5].end();
    for (auto& task : tasks) task.get();
}

}  // namespace
}  // namespace brdfit::tests
