/// What an evaluation of a model costs a renderer on a device: measured, and kept beside the builds.
#pragma once

#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
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
/// with SIMD lanes full, in a loop over many; on a CPU of one core, in its processor time, on another device of the
/// whole of it. The shortest of repetitions that are spread over time.
struct Cost {
    std::optional<double> single_ns{};  ///< none where the precision may not be used
    std::optional<double> double_ns{};
    std::optional<OperationCounts> operations{};
    bool under_load = false;  ///< measured beside other work, and maybe too high: to be measured again
};

/// Costs on one engine. Safe to use from several threads.
class CostBook {
public:
    /// The models that it is asked for must outlive it.
    explicit CostBook(Engine& engine) : engine_(engine) {}

    /// From memory, or from the engine's cache folder, or measured, all that are missing in one session of some 0.2 s
    /// after a compiler's seconds, and kept in both. What was measured under load elsewhere is measured again, once.
    /// Throws BuildError, DeviceError.
    std::vector<Cost> costs(std::span<const Model* const> models);
    Cost cost(const Model& model);
    /// Measures what is known under load once more; the lower figures count. Returns whether all that is known is
    /// settled, and stays as it is. Throws as costs() does.
    bool settle();

private:
    struct Entry {
        const Model* model = nullptr;
        double ns = 0;
        bool under_load = false;
    };
    using Key = std::pair<std::string, Precision>;  ///< by variant_name()

    std::optional<Entry> known(const Key& key) const;
    void measure(const std::vector<std::pair<Key, const Model*>>& wanted);

    Engine& engine_;
    std::mutex measuring_;      ///< one session at a time, so that none is another's load
    mutable std::mutex mutex_;  ///< guards what is below
    std::map<Key, Entry> known_;
};

/// The clock of costs, for one model. Not for two threads at once.
class CostMeter {
public:
    /// Throws PrecisionError, BuildError, DeviceError.
    CostMeter(Engine& engine, const Model& model, Precision precision);
    ~CostMeter();
    CostMeter(CostMeter&&) noexcept;
    CostMeter& operator=(CostMeter&&) noexcept;

    /// Times every evaluation again, for a millisecond at least. Throws DeviceError.
    void repeat();
    /// Nanoseconds of an evaluation (see Cost), by the shortest time of each part in all repetitions; infinite before
    /// the first.
    [[nodiscard]] double ns() const;

private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

/// A figure, and whether it was measured beside other work.
struct MeasuredCost {
    double ns = 0;
    bool under_load = false;
};

/// Measures anew, all in turns, so that repetitions of each are spread over the time of all. Throws DeviceError.
std::vector<MeasuredCost> measure(Engine& engine, std::span<CostMeter> meters);

}  // namespace brdfit::kernels
