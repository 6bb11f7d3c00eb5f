/// A queue and what goes through it: numbers to the device and back, launches. Included by .cpp files of kernels/ only.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "kernels/engine_impl.h"

namespace brdfit::kernels {

/// Bytes of a `scalar`.
std::size_t size_of(Precision precision);

/// Filled as it is made: no command that would wait behind others' launches.
cl::Buffer constant_buffer(const cl::Context& context, Precision precision, std::vector<double> values);

/// Buffers hold `scalar`s; the host side is double. One conversion each way, here. Everything throws cl::Error. Where
/// the calling thread has a Waiter (kernels/waiting.h), what would block is left to it.
struct Transfers {
    Transfers(Engine& engine, Precision precision);
    Transfers(Engine& engine, Precision precision, cl::CommandQueue queue);

    /// Makes the buffer at least that many scalars large.
    void reserve(cl::Buffer& buffer, std::size_t scalars) const;
    /// `values` must stay as they are until the next download() returns.
    void upload(cl::Buffer& buffer, std::span<const double> values);
    /// Returns when all that was enqueued is over.
    void download(const cl::Buffer& buffer, std::span<double> values);
    /// Does `work`, which enqueues and downloads; if it fails, nothing is left under way in this object's memory.
    template <typename Work>
    void guarded(const Work& work) {
        try {
            work();
        } catch (...) {
            ::clFinish(queue());  // that it fails, too, is no news
            failed = true;
            throw;
        }
    }
    /// Work-items of a launch on a CPU, always the same number: PoCL 3.1 keeps a loaded kernel for each width of grid
    /// but looks only at the kernel when it lets go of one, and two widths in two threads end the process
    /// ("found->ref_count > 0"). It is one where that runs in this thread, other threads run other launches.
    [[nodiscard]] std::size_t cpu_width() const;

    Engine::Impl& shared;
    Precision precision;
    cl::CommandQueue queue;
    bool failed = false;  ///< something that was guarded

private:
    void read(const cl::Buffer& buffer, std::size_t bytes, void* to);

    std::vector<float> single_up, single_down;  // staging for conversions
};

}  // namespace brdfit::kernels
