/// Whether other work shares the machine while something is timed.
#pragma once

#include <chrono>

#include "kernels/engine.h"

namespace brdfit::kernels {

/// Watches the processors from its making on, for a thread that works all the time.
class LoadWatch {
public:
    explicit LoadWatch(const DeviceInfo& device);

    /// The part of all processors' time that went to other threads and programs since then, in [0, 1]: from the
    /// system's count, which moves in steps of 10 ms; without one, the part of the wall clock's time that this thread
    /// did not get. 0 for a device that is not a CPU.
    [[nodiscard]] double others() const;

private:
    const DeviceInfo& device_;
    std::chrono::steady_clock::time_point start_;
    double busy_s_;
    double own_s_;
};

}  // namespace brdfit::kernels
