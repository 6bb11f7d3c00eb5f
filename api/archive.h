/// Values that cross from the process that computes to the one that answers, as bytes. Doubles come back with all bits.
/// Both are of one build: a service reads what it wrote itself, and of another version's reports what they share.
#pragma once

#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/engine.h"
#include "kernels/selftest.h"
#include "optim/report.h"

namespace brdfit::api {

/// Of a report what its plots are drawn from: samples, values, curves, ranks, losses, errors of scans, failures, what
/// is recommended.
std::string archive(const optim::Report& report);
/// Throws std::invalid_argument for what is no such archive.
optim::Report read_archive(std::string_view bytes);

/// What an evaluation of a model costs, see kernels::Cost.
struct ModelCost {
    std::string model;
    std::size_t lobes = 0;  ///< 0 for a model without lobes
    std::optional<double> single_ns{};
    std::optional<double> double_ns{};
    bool under_load = false;
};

/// What a worker tells of its device.
struct DeviceFacts {
    kernels::DeviceInfo device;
    std::vector<kernels::SelfTest> self_tests;  ///< those that have ended
    bool complete = false;                      ///< all of them have
    /// Why a precision may not be used; nothing if it may, or is not tested yet.
    std::optional<std::string> single_refusal{};
    std::optional<std::string> double_refusal{};
    std::vector<ModelCost> costs{};  ///< empty until they are measured

    [[nodiscard]] const std::optional<std::string>& refusal(kernels::Precision precision) const {
        return precision == kernels::Precision::double_precision ? double_refusal : single_refusal;
    }
    [[nodiscard]] bool usable() const { return !single_refusal || !double_refusal; }
};
std::string archive(const DeviceFacts& facts);
/// Throws std::invalid_argument.
DeviceFacts read_device_facts(std::string_view bytes);

}  // namespace brdfit::api
