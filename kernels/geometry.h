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

/// What the columns of one canonical direction are made of. Angles of both directions and the azimuth are at most 90.
class Angles {
public:
    explicit Angles(const Direction& direction);
    /// Those of another direction; what does not change is not formed again.
    void turn(const Direction& direction);

    long double sin_i = 0, sin_r = 0, cos_i = 0, cos_r = 0, cos_phi = 0;
    long double lift = 0;                                   ///< sin theta_i sin theta_r sin^2(phi/2): 0 in the plane
    long double sin_half_difference = 0, sin_half_sum = 0;  ///< of (theta_r -+ theta_i)/2
    long double cos_half_sum = 0;
    [[nodiscard]] long double cos_sum_of_angles() const;  ///< cos(theta_i + |theta_r|)

private:
    double theta_i_deg_, phi_deg_;
    long double theta_r_deg_ = 0, sin2_half_phi_ = 0;
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
    [[nodiscard]] double read(const Angles& angles, Precision precision) const {
        const long double exact = value(angles);
        const bool single = precision == Precision::single_precision;
        const double nearest = single ? static_cast<double>(static_cast<float>(exact)) : static_cast<double>(exact);
        return part == Part::rounded ? nearest : static_cast<double>(exact - nearest);
    }
};

/// All columns, in the order of the struct's members.
std::span<const GeometryColumn> geometry_columns();

/// The kernels' struct Geometry and the macro COLUMNS.
std::string geometry_prelude();

}  // namespace brdfit::kernels
