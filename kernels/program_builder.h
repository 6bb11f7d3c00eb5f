/// From program texts to programs: from the disk where they are kept there, else built. Included by .cpp files of
/// kernels/ only.
#pragma once

#include <sys/types.h>

#include <exception>
#include <map>
#include <mutex>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "kernels/opencl.h"
#include "kernels/program_cache.h"

namespace brdfit::kernels {

/// What goes to the device's compiler.
struct ProgramSource {
    std::string text;
    std::string flags;
};

/// A text that the compiler refused; what() is the compiler's log.
class CompilerRefusal : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

/// One device's builds. Safe to use from several threads.
///
/// PoCL ends the process where its compiler, or the disk that it writes to, fails. So it works in processes of its own
/// where EngineOptions::builder is set, several at once; this process only loads what they have built.
class ProgramBuilder {
public:
    ProgramBuilder(const cl::Context& context, const cl::Device& device, const EngineOptions& options);

    /// Throws CompilerRefusal, cl::Error, and DeviceError where a process that built ended.
    cl::Program program(const ProgramSource& source);
    /// Builds what is not on the disk, in as many processes as there are cores. What fails is left to program() to
    /// tell.
    void build_ahead(std::span<const ProgramSource> sources);
    /// From any thread: ends the processes that build, and lets no more begin.
    void stop();
    /// The key of an entry that holds for this device, its driver and its processor only.
    [[nodiscard]] CacheKey key(std::string_view kind, std::string_view text, std::string_view flags) const;
    [[nodiscard]] const ProgramCache& cache() const { return cache_; }

private:
    void build_apart(std::span<const ProgramSource> sources);
    void run_processes(std::span<const ProgramSource> sources, std::size_t count);
    [[nodiscard]] cl::Program load(const std::vector<unsigned char>& binary, const std::string& flags) const;

    cl::Context context_;
    cl::Device device_;
    ProgramCache cache_;
    bool private_driver_cache_ = false;
    bool compiles_apart_ = false;
    std::string builder_;
    std::string wanted_device_;
    std::string identity_;   ///< device, driver, processor
    std::mutex stop_mutex_;  ///< guards the two below
    bool stopped_ = false;
    std::vector<pid_t> processes_;  ///< that build
    std::mutex mutex_;              ///< guards what is below; processes that build are waited for under it
    std::map<std::string, std::vector<unsigned char>> built_;  ///< by other processes, until they are loaded; by key
    std::map<std::string, std::exception_ptr> failed_;         ///< why a process gave no program; by key
};

/// Sets the process up before its first OpenCL call: PoCL's compiler gets a folder of its own. Its cache is shared by
/// all programs of a user, and a damaged or full one ends the process.
void set_up_private_driver_cache();

}  // namespace brdfit::kernels
