/// What the engine shares with the evaluator. Included by .cpp files of kernels/ only.
#pragma once

#include <map>
#include <mutex>

#include "kernels/engine.h"
#include "kernels/opencl.h"

namespace brdfit::kernels {

struct Engine::Impl {
    cl::Device device;
    cl::Context context;
    DeviceInfo info;
    EngineOptions options;
    std::mutex mutex;                             // guards programs; PoCL's compiler runs under it, one at a time
    std::map<std::string, cl::Program> programs;  // by program text
    mutable std::mutex withdrawn_mutex;           // guards withdrawn; not held while the compiler runs
    std::map<Precision, std::string> withdrawn;   // why

    [[nodiscard]] unsigned lanes(Precision precision) const;
    [[nodiscard]] std::optional<std::string> refusal(Precision precision) const;
    /// Throws PrecisionError, BuildError, DeviceError.
    cl::Program program(const Model& model, Precision precision, Accuracy accuracy);
};

/// DeviceError with the call's name and the code's.
DeviceError device_error(const cl::Error& error);

}  // namespace brdfit::kernels
