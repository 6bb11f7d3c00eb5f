/// An unknown of a fit on the scale on which its estimate is most nearly normal.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <optional>

#include "kernels/model.h"

namespace brdfit::optim {

enum class Own {
    linear,
    logarithm,
    square,  ///< of a parameter that the model is even in: at 0 it has no slope
};

/// One unknown on its own scale, z.
struct Coordinate {
    std::optional<std::size_t> parameter;  ///< none: the scale of relative data
    Own own;
    double p;  ///< its value, in the model's unit

    [[nodiscard]] double z(double value) const {
        return own == Own::logarithm ? std::log(value) : own == Own::square ? value * value : value;
    }
    [[nodiscard]] double value(double z) const {
        return own == Own::logarithm ? std::exp(z) : own == Own::square ? std::sqrt(std::max(z, 0.0)) : z;
    }
    /// d value/d z at a value.
    [[nodiscard]] double slope(double value) const {
        return own == Own::logarithm ? value : own == Own::square ? 0.5 / value : 1.0;
    }
    /// What counts as a large step of z.
    [[nodiscard]] double size(const kernels::Model& model) const {
        if (own == Own::logarithm) return 1;
        const kernels::Parameter& declared = model.parameters[*parameter];
        const double least = 1e-2 * std::min(declared.max - declared.min, 1.0);
        return std::max(std::abs(z(p)), z(least));
    }
};

}  // namespace brdfit::optim
