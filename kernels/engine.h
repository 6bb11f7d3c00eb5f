/// An OpenCL device and the programs built for it.
#pragma once

#include <filesystem>
#include <memory>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/model.h"
#include "kernels/precision.h"

namespace brdfit::kernels {

struct DeviceInfo {
    std::string name;
    std::string platform;
    std::string version;  ///< of the driver
    std::string type;     ///< "cpu", "gpu" or "accelerator"
    bool has_double = false;
    unsigned compute_units = 1;
    bool runs_inline = false;  ///< a launch runs in the thread that asks for it, as on PoCL's "basic"

    bool operator==(const DeviceInfo&) const = default;
};

/// No usable device, or an OpenCL call that failed; what() names the call and the code.
class DeviceError : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

/// A model's text that the device's compiler refused; what() holds its log, which names the .cl file and the line.
class BuildError : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

/// A precision that the device lacks or that was withdrawn; what() says why, in words for a user.
class PrecisionError : public std::runtime_error {
public:
    using std::runtime_error::runtime_error;
};

struct EngineOptions {
    /// "auto" (a GPU with double precision, else a CPU, else any), "cpu", "gpu", or a part of the device's name.
    std::string device = "auto";
    /// Samples a work-item holds in a SIMD register: 1, 2, 4, 8 or 16. Unset: what kernels/tuning.h found and `cache`
    /// holds, else the device's native width; 1 on a GPU.
    std::optional<unsigned> lanes{};
    /// Further options for the device's OpenCL compiler, separated by spaces, e.g. "-cl-fast-relaxed-math". Whether the
    /// results still hold is what kernels/selftest.h tells.
    std::string build_options{};
    /// The folder where builds are kept from one run to the next; an empty path keeps none, and builds anew. Unset:
    /// what the driver itself keeps counts, as PoCL does in ~/.cache/pocl; a damaged or full cache of PoCL's then ends
    /// the process.
    std::optional<std::filesystem::path> cache{};
    /// The executable that calls build_programs() when run as `builder build-programs DEVICE FOLDER`. With it and
    /// `cache` PoCL compiles in processes of its own, several at once. Empty: in this process.
    std::string builder{};
    /// Kernels that give a work-item a slice of a candidate's samples, for devices with more work-items than a batch
    /// has candidates; else it takes a whole candidate. Results agree to rounding. Unset: slices unless the device is a
    /// CPU.
    std::optional<bool> sliced{};
    /// Every candidate is launched alone and waited for: what batching is measured against.
    bool one_by_one = false;
};

/// One device with a cache of programs by (model, precision, accuracy). Safe to use from several threads; create the
/// first one before other threads exist, as PoCL does not survive two threads making a process's first OpenCL call
/// together.
class Engine {
public:
    /// Throws DeviceError.
    explicit Engine(const EngineOptions& options = {});
    ~Engine();
    Engine(const Engine&) = delete;
    Engine& operator=(const Engine&) = delete;

    [[nodiscard]] const DeviceInfo& device() const;
    /// Whether searches should have launches under way at the same time instead of a thread each.
    [[nodiscard]] bool overlaps() const;
    /// The most precise arithmetic that may be used. Throws PrecisionError if none may.
    [[nodiscard]] Precision best_precision() const;
    /// The quickest arithmetic that may be used: single where it may. Throws PrecisionError if none may.
    [[nodiscard]] Precision quickest_precision() const;
    /// Whether the device has that precision and it was not withdrawn.
    [[nodiscard]] bool supports(Precision precision) const;
    /// Whether some precision may be used.
    [[nodiscard]] bool usable() const;
    /// Why a precision may not be used, in words for a user; nothing if it may.
    [[nodiscard]] std::optional<std::string> refusal(Precision precision) const;
    /// The precision may not be used from now on, for that reason. Evaluators that exist keep working.
    void withdraw(Precision precision, std::string reason);
    /// Builds the program of the model unless it is cached. Throws PrecisionError, BuildError, DeviceError.
    void prepare(const Model& model, Precision precision, Accuracy accuracy = Accuracy::full);
    /// Builds the programs of all variants at once where EngineOptions::builder is set, for prepare() to find. Throws
    /// nothing but std::bad_alloc: prepare() tells what failed.
    void build_ahead(std::span<const Family> families, std::span<const Precision> precisions);
    /// From any thread: ends build_ahead() soon, whoever called it; what it has not built is built no more.
    void stop_building();
    /// Samples a work-item holds in a SIMD register.
    [[nodiscard]] unsigned lanes(Precision precision) const;

    struct Impl;
    [[nodiscard]] Impl& impl() const { return *impl_; }

private:
    std::unique_ptr<Impl> impl_;
};

/// Every OpenCL device of this machine, in the order `auto` prefers them. Empty if there is none.
std::vector<DeviceInfo> list_devices();

/// The work of a builder process, see EngineOptions::builder: builds what the folder asks for and leaves the binaries
/// there. Throws DeviceError.
void build_programs(const std::string& device, const std::filesystem::path& folder);

/// The whole kernel text of a model, as it goes to the compiler.
std::string program_text(const Model& model, Precision precision, unsigned lanes, Accuracy accuracy = Accuracy::full,
                         bool sliced = false);

/// The kernels of kernels/hemisphere.h for a model, likewise.
std::string hemisphere_text(const Model& model, Precision precision, unsigned lanes);

}  // namespace brdfit::kernels
