#include "kernels/geometry.h"

#include <array>
#include <cmath>
#include <numbers>

namespace brdfit::kernels {
namespace {

constexpr double kRadian = std::numbers::pi / 180;

double sqr(double x) { return x * x; }
double sin_deg(double degrees) { return std::sin(degrees * kRadian); }
/// Accurate near 90 degrees, where cos of the rounded radians is not.
double cos_deg(double degrees) {
    const double a = std::abs(degrees);
    return a < 45 ? std::cos(a * kRadian) : std::sin((90 - a) * kRadian);
}
double tan_abs_deg(double degrees) { return std::abs(sin_deg(degrees)) / cos_deg(degrees); }

double sin_i(const Direction& d) { return sin_deg(d.theta_i_deg); }
double sin_r(const Direction& d) { return sin_deg(d.theta_r_deg); }
double cos_i(const Direction& d) { return cos_deg(d.theta_i_deg); }
double cos_r(const Direction& d) { return cos_deg(d.theta_r_deg); }
/// sin^2(phi/2) sin theta_i sin theta_r: what leaving the plane of incidence adds. Exactly 0 within it.
double lift(const Direction& d) { return d.phi_deg == 0 ? 0.0 : sin_i(d) * sin_r(d) * sqr(sin_deg(d.phi_deg / 2)); }
/// Differences and sums are formed in degrees: exact for nearby angles.
double sin_half_difference(const Direction& d) { return sin_deg((d.theta_r_deg - d.theta_i_deg) / 2); }
double half_sum(const Direction& d) { return (d.theta_r_deg + d.theta_i_deg) / 2; }

/// From the complements, which are exact near 90 degrees where the sum is not.
double cos_half_sum(const Direction& d) {
    const double m = half_sum(d);
    return m < 45 ? std::cos(m * kRadian) : sin_deg(((90 - d.theta_i_deg) + (90 - d.theta_r_deg)) / 2);
}

double one_minus_cos_alpha(const Direction& d) { return 2 * (sqr(sin_half_difference(d)) + lift(d)); }
double tangential_sum_squared(const Direction& d) {
    return sqr(2 * cos_half_sum(d) * sin_half_difference(d)) + 4 * lift(d);
}
double cos_sum(const Direction& d) { return cos_i(d) + cos_r(d); }

double log_cos_alpha(const Direction& d) {
    const double q = one_minus_cos_alpha(d);
    if (q < 0.5) return std::log1p(-q);
    const double c = d.theta_r_deg > 0 ? cos_i(d) * cos_r(d) + sin_i(d) * sin_r(d) * cos_deg(d.phi_deg)
                                       : cos_deg(d.theta_r_deg - d.theta_i_deg) - 2 * lift(d);
    return c > 0 ? std::log(c) : -1e30;
}
double tan2(const Direction& d) { return tangential_sum_squared(d) / sqr(cos_sum(d)); }
double cd2(const Direction& d) { return sqr(cos_half_sum(d)) + lift(d); }
double sd2(const Direction& d) { return sqr(sin_deg(half_sum(d))) - lift(d); }
double hxy(const Direction& d) { return -sin_i(d) * sin_r(d) * cos_deg(d.phi_deg); }

constexpr std::array kColumns{
    GeometryColumn{"ci", "cos theta_i", cos_i},
    GeometryColumn{"cr", "cos theta_r", cos_r},
    GeometryColumn{"cs", "cos theta_i + cos theta_r", cos_sum},
    GeometryColumn{"ti", "tan theta_i", [](const Direction& d) { return tan_abs_deg(d.theta_i_deg); }},
    GeometryColumn{"tr", "tan |theta_r|", [](const Direction& d) { return tan_abs_deg(d.theta_r_deg); }},
    GeometryColumn{"log_cos_alpha", "ln cos of the angle to the mirror direction; -1e30 beyond 90 degrees",
                   log_cos_alpha},
    GeometryColumn{"w", "|u_xy + v_xy|^2", tangential_sum_squared},
    GeometryColumn{"tan2", "tan^2 of the half vector's angle to the normal", tan2},
    GeometryColumn{"cd2", "cos^2 theta_d, theta_d = angle of either direction to the half vector", cd2},
    GeometryColumn{"sd2", "sin^2 theta_d", sd2},
    GeometryColumn{"hxy", "u_x v_x + u_y v_y", hxy},
    GeometryColumn{"hz", "u_z v_z", [](const Direction& d) { return cos_i(d) * cos_r(d); }},
};

}  // namespace

Direction canonical(const Direction& direction) {
    Direction d = direction;
    d.phi_deg = std::abs(std::remainder(d.phi_deg, 360));
    if (d.phi_deg > 90) {
        d.phi_deg = 180 - d.phi_deg;
        d.theta_r_deg = -d.theta_r_deg;
    }
    return d;
}

std::span<const GeometryColumn> geometry_columns() { return kColumns; }

std::string geometry_prelude() {
    std::string text = "#define COLUMNS " + std::to_string(kColumns.size()) + "\ntypedef struct {\n";
    for (const GeometryColumn& column : kColumns)
        text += "    real " + std::string(column.name) + "; /* " + std::string(column.doc) + " */\n";
    return text + "} Geometry;\n";
}

}  // namespace brdfit::kernels
