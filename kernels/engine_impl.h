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
    std::optional<unsigned> forced_lanes;
    std::mutex mutex;                             // guards programs; PoCL's compiler runs under it, one at a time
    std::map<std::string, cl::Program> programs;  // by program text and precision

    [[nodiscard]] unsigned lanes(Precision precision) const;
    /// Throws BuildError, DeviceError.
    cl::Program program(const Model& model, Precision precision);
};

/// DeviceError with the call's name and the code's.
DeviceError device_error(const cl::Error& error);

}  // namespace brdfit::kernels
