/// Direction pairs, and the columns of numbers that kernels read for each.
#pragma once

#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/precision.h"

namespace brdfit::kernels {

/// A pair of directions. Angles in degrees.
struct Direction {
    double theta_i_deg = 0;  ///< incidence, [0, 90)
    double theta_r_deg = 0;  ///< exitance, (-90, 90); positive = specular side
    double phi_deg = 0;      ///< azimuth of the exitant direction from the specular half-plane

    bool operator==(const Direction&) const = default;
};

/// The same pair with |phi| <= 90 degrees: the form in which no column cancels. Models are isotropic, so the sign of
/// phi does not matter.
Direction canonical(const Direction& direction);

/// What the columns of one canonical direction are made of.
struct Angles {
    explicit Angles(const Direction& direction);

    long double sin_i, sin_r, cos_i, cos_r, cos_phi;
    long double lift;               ///< sin theta_i sin theta_r sin^2(phi/2): 0 in the plane of incidence
    long double cos_sum_of_angles;  ///< cos(theta_i + |theta_r|)
    long double sin_half_difference, sin_half_sum;  ///< of (theta_r -+ theta_i)/2
    long double cos_half_sum;
};

/// One geometry column: a member of the kernels' struct Geometry. Of a value that kernels subtract from its like, a
/// second column holds what rounding takes off it.
struct GeometryColumn {
    enum class Part { rounded, remainder };

    std::string_view name;
    std::string_view doc;
    long double (*value)(const Angles&);  ///< without cancellation
    Part part = Part::rounded;

    /// What kernels of a precision read of value().
    [[nodiscard]] double rounded(long double exact, Precision precision) const;
    [[nodiscard]] double read(const Angles& angles, Precision precision) const {
        return rounded(value(angles), precision);
    }
};

/// All columns, in the order of the struct's members.
std::span<const GeometryColumn> geometry_columns();

/// The kernels' struct Geometry and the macro COLUMNS.
std::string geometry_prelude();

}  // namespace brdfit::kernels
