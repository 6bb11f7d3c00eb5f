/// What the engine shares with the evaluator. Included by .cpp files of kernels/ only.
#pragma once

#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <tuple>
#include <vector>

#include "kernels/engine.h"
#include "kernels/opencl.h"
#include "kernels/program_builder.h"

namespace brdfit::kernels {

struct Engine::Impl {
    cl::Device device;
    cl::Context context;
    DeviceInfo info;
    EngineOptions options;
    std::optional<ProgramBuilder> builder;  // set from the constructor on
    std::mutex mutex;                       // guards programs
    /// What a program is for.
    enum class Purpose { full_accuracy, search_accuracy, hemisphere };
    /// By what differs in their texts, which are long: header and text of the model.
    std::map<std::tuple<Precision, Purpose, std::string, std::string>, cl::Program> programs;
    std::mutex spare_mutex;  // guards spare, spare_bytes
    /// Queues, kernels and buffers that evaluators of a program have left for the next ones.
    std::map<cl_program, std::vector<std::shared_ptr<void>>> spare;
    std::size_t spare_bytes = 0;                 ///< of all those buffers
    mutable std::mutex withdrawn_mutex;          // guards withdrawn; not held while the compiler runs
    std::map<Precision, std::string> withdrawn;  // why

    std::map<Precision, unsigned> lanes_chosen;  // set from the constructor on

    [[nodiscard]] bool sliced() const { return options.sliced.value_or(info.type != "cpu"); }
    [[nodiscard]] unsigned native_lanes(Precision precision) const;
    [[nodiscard]] unsigned lanes(Precision precision) const { return lanes_chosen.at(precision); }
    [[nodiscard]] std::optional<std::string> refusal(Precision precision) const;
    [[nodiscard]] ProgramSource source(const Model& model, Precision precision, Accuracy accuracy) const;
    [[nodiscard]] ProgramSource hemisphere_source(const Model& model, Precision precision) const;
    /// These throw PrecisionError, BuildError, DeviceError.
    cl::Program program(const Model& model, Precision precision, Accuracy accuracy);
    cl::Program hemisphere_program(const Model& model, Precision precision);

private:
    [[nodiscard]] std::string flags(Precision precision) const;
    cl::Program program(const Model& model, Precision precision, Purpose purpose);
};

/// What tune() has kept for this device, if anything; see kernels/tuning.h.
std::optional<unsigned> kept_lanes(const ProgramBuilder& builder, Precision precision);

/// The device of EngineOptions::device. Throws DeviceError.
cl::Device choose_device(const std::string& wanted);

/// DeviceError with the call's name and the code's.
DeviceError device_error(const cl::Error& error);

}  // namespace brdfit::kernels
