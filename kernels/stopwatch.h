/// The clock of benchmarks.
#pragma once

#include <algorithm>
#include <chrono>
#include <ctime>
#include <limits>

#include "kernels/engine.h"

namespace brdfit::kernels {

/// Seconds since some moment: processor time where a launch takes a CPU's, which other programs do not lengthen (of
/// this thread, or of the process where a driver has threads); elsewhere of the wall clock.
inline double stopwatch_s(const DeviceInfo& device) {
    if (device.type != "cpu")
        return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
    timespec time{};
    ::clock_gettime(device.runs_inline ? CLOCK_THREAD_CPUTIME_ID : CLOCK_PROCESS_CPUTIME_ID, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

/// The shortest time of a call [s], of those that fit into `each`, three at least.
template <class Work>
double shortest_s(const DeviceInfo& device, std::chrono::duration<double> each, Work work) {
    using Clock = std::chrono::steady_clock;
    double shortest = std::numeric_limits<double>::infinity();
    const auto end = Clock::now() + each;
    for (int i = 0; i < 3 || Clock::now() < end; ++i) {
        const double start = stopwatch_s(device);
        work();
        shortest = std::min(shortest, stopwatch_s(device) - start);
    }
    return shortest;
}

}  // namespace brdfit::kernels
