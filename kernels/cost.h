/// What an evaluation of a model costs a renderer on a device: measured once, kept beside the builds.
#pragma once

#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/engine.h"
#include "kernels/model.h"

namespace brdfit::kernels {

/// Operations of an evaluation in double precision: of those that its value needs, the mean over typical parameters and
/// a goniometer's directions. Exponentials and logarithms are polynomials and count as what they are made of;
/// comparisons, selections and operations on bits do not count. Counted by tests/numerics/operation_counts_generator.
struct OperationCounts {
    std::string_view model;  ///< "phong", or "lafortune_2" with two lobes
    double add = 0;          ///< and subtractions
    double multiply = 0;
    double fma = 0;  ///< x y + z in one
    double divide = 0;
    double sqrt = 0;
};

/// Of a built-in model; nothing for others.
std::optional<OperationCounts> operation_counts(const Model& model);

/// Nanoseconds of an evaluation: f at one pair of directions that are given as unit vectors, value only, the model's
/// geometry formed anew, with the parameters at hand; the mean over typical parameters and a goniometer's directions,
/// with SIMD lanes full; on a CPU of one core, on another device of the whole of it. The shortest of many repetitions.
struct Cost {
    std::optional<double> single_ns{};  ///< none where the precision may not be used
    std::optional<double> double_ns{};
    std::optional<OperationCounts> operations{};
};

/// Costs on one engine: constant once they are known. Safe to use from several threads.
class CostBook {
public:
    explicit CostBook(Engine& engine) : engine_(engine) {}

    /// From memory, or from the engine's cache folder, or measured, which may take a compiler's seconds and is kept in
    /// both. Throws BuildError, DeviceError.
    Cost cost(const Model& model);

private:
    std::optional<double> nanoseconds(const Model& model, Precision precision);

    Engine& engine_;
    std::mutex mutex_;  ///< guards what is below, and is held while one is measured
    std::map<std::pair<std::string, Precision>, double> known_;  ///< by variant_name()
};

/// Measures anew: what CostBook keeps. Throws PrecisionError, BuildError, DeviceError.
double measure_cost_ns(Engine& engine, const Model& model, Precision precision);

}  // namespace brdfit::kernels
