/// Whether a device computes well enough: its values and slopes at hard points against their references.
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <vector>

#include "kernels/engine.h"
#include "kernels/model.h"

namespace brdfit::kernels {

/// The largest error that passes. Its unit is eps (1 + cond), eps = 2^-53 or 2^-24, cond = sum |p df/dp|/|f|: relative
/// to |f| for a value, to max(|df/dp|, |f/p|) for a slope.
inline constexpr double kLargestError_eps = 32;

enum class SelfTestForm {
    brief,  ///< a handful of points a model: for every start
    whole,
};

/// A worst error and where it was.
struct WorstError {
    double eps = 0;  ///< infinite where a result was not finite
    std::string
        where;  ///< parameters and angles in hexadecimal floats, and what they are in decimals; empty for no error
};

/// One model, with its number of lobes, in one precision.
struct ModelTest {
    std::string model;
    std::size_t lobes = 0;   ///< 0 for a model without lobes
    std::size_t points = 0;  ///< compared; 0 for a model that has none, such as a user's: it neither passes nor fails
    WorstError value;
    WorstError slope;
    std::string refusal;  ///< why nothing could be computed, in the device's words; empty if it could
    double time_ms = 0;   ///< with the build of its program

    [[nodiscard]] bool passed() const;
    /// A line for each thing wrong, with the worst points; for whoever looks after the device.
    [[nodiscard]] std::vector<std::string> failures() const;
};

struct SelfTest {
    Precision precision{};
    SelfTestForm form{};
    std::vector<ModelTest> models;

    [[nodiscard]] bool passed() const;
    [[nodiscard]] double time_ms() const;
    /// Why it did not pass, for a user: the models that failed, and by how much; empty if it passed.
    [[nodiscard]] std::string reason() const;
};

/// Compares every variant of the families that has points. What the device throws is a failure of that model. Throws
/// PrecisionError.
SelfTest self_test(Engine& engine, std::span<const Family> families, Precision precision, SelfTestForm form);

/// The same, and withdraws the precision if it fails.
SelfTest prove(Engine& engine, std::span<const Family> families, Precision precision, SelfTestForm form);

/// Proves each precision that may be used, double first.
std::vector<SelfTest> prove(Engine& engine, std::span<const Family> families, SelfTestForm form);

}  // namespace brdfit::kernels
