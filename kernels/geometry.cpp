#include "kernels/geometry.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace brdfit::kernels {
namespace {

constexpr long double kRadian = std::numbers::pi_v<long double> / 180;

long double sqr(long double x) { return x * x; }
long double sin_deg(long double degrees) { return std::sin(degrees * kRadian); }
/// Accurate near 90 degrees, where cos of the rounded radians is not.
long double cos_deg(long double degrees) {
    const long double a = std::abs(degrees);
    return a < 45 ? std::cos(a * kRadian) : std::sin((90 - a) * kRadian);
}

/// 90 - (a + b) for a, b >= 0, exact where it is small.
long double complement_of_sum(long double a, long double b) { return (90 - std::max(a, b)) - std::min(a, b); }

}  // namespace

/// In long double, whose further bits (on x86) are for what sums of products lose when they nearly vanish. Sums and
/// differences of angles are formed in degrees, where they are exact for nearby angles, and complements to 90 likewise.
Angles::Angles(const Direction& d)
    : sin_i(sin_deg(d.theta_i_deg)),
      sin_r(sin_deg(d.theta_r_deg)),
      cos_i(cos_deg(d.theta_i_deg)),
      cos_r(cos_deg(d.theta_r_deg)),
      cos_phi(cos_deg(d.phi_deg)),
      lift(sin_i * sin_r * sqr(sin_deg(d.phi_deg / 2.0L))),
      cos_sum_of_angles(sin_deg(complement_of_sum(d.theta_i_deg, std::abs(d.theta_r_deg)))),
      sin_half_difference(sin_deg((static_cast<long double>(d.theta_r_deg) - d.theta_i_deg) / 2)),
      sin_half_sum(sin_deg((static_cast<long double>(d.theta_r_deg) + d.theta_i_deg) / 2)),
      cos_half_sum(sin_deg(((90 - static_cast<long double>(d.theta_i_deg)) + (90 - d.theta_r_deg)) / 2)) {}

namespace {

long double tangential_sum_squared(const Angles& d) {
    return sqr(2 * d.cos_half_sum * d.sin_half_difference) + 4 * d.lift;
}

long double log_cos_alpha(const Angles& d) {
    const long double q = 2 * (sqr(d.sin_half_difference) + d.lift);  // 1 - cos alpha
    if (q < 0.5L) return std::log1p(-q);
    // Two forms of cos alpha, beyond the normal each a difference: the one of the smaller terms.
    const long double height = d.cos_i * d.cos_r;
    const long double c = d.sin_r > 0 || height < std::abs(d.cos_sum_of_angles) ? height + d.sin_i * d.sin_r * d.cos_phi
                                                                                : d.cos_sum_of_angles - 2 * d.lift;
    return c > 0 ? std::log(c) : -1e30L;
}

long double hxy(const Angles& d) { return -d.sin_i * d.sin_r * d.cos_phi; }
long double hz(const Angles& d) { return d.cos_i * d.cos_r; }

#define COLUMN(expression) [](const Angles& d) { return expression; }

constexpr std::array kColumns{
    GeometryColumn{"ci", "cos theta_i", COLUMN(d.cos_i)},
    GeometryColumn{"cr", "cos theta_r", COLUMN(d.cos_r)},
    GeometryColumn{"cs", "cos theta_i + cos theta_r", COLUMN(d.cos_i + d.cos_r)},
    GeometryColumn{"ti", "tan theta_i", COLUMN(d.sin_i / d.cos_i)},
    GeometryColumn{"tr", "tan |theta_r|", COLUMN(std::abs(d.sin_r) / d.cos_r)},
    GeometryColumn{"log_cos_alpha", "ln cos of the angle to the mirror direction; -1e30 beyond 90 degrees",
                   log_cos_alpha},
    GeometryColumn{"w", "|u_xy + v_xy|^2", COLUMN(tangential_sum_squared(d))},
    GeometryColumn{"tan2", "tan^2 of the half vector's angle to the normal",
                   COLUMN(tangential_sum_squared(d) / sqr(d.cos_i + d.cos_r))},
    GeometryColumn{"cd2", "cos^2 theta_d, theta_d = angle of either direction to the half vector",
                   COLUMN(sqr(d.cos_half_sum) + d.lift)},
    GeometryColumn{"sd2", "sin^2 theta_d", COLUMN(sqr(d.sin_half_sum) - d.lift)},
    GeometryColumn{"G", "(4 cos^2 theta_d/(cos theta_i + cos theta_r))^2, He and Torrance's geometric factor",
                   COLUMN(sqr(4 * (sqr(d.cos_half_sum) + d.lift) / (d.cos_i + d.cos_r)))},
    GeometryColumn{"hxy", "u_x v_x + u_y v_y", hxy},
    GeometryColumn{"hxy_low", "hxy less its rounded value", hxy, GeometryColumn::Part::remainder},
    GeometryColumn{"hz", "u_z v_z", hz},
    GeometryColumn{"hz_low", "hz less its rounded value", hz, GeometryColumn::Part::remainder},
};
#undef COLUMN

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

double GeometryColumn::rounded(long double exact, Precision precision) const {
    const bool single = precision == Precision::single_precision;
    const double nearest = single ? static_cast<double>(static_cast<float>(exact)) : static_cast<double>(exact);
    return part == Part::rounded ? nearest : static_cast<double>(exact - nearest);
}

std::span<const GeometryColumn> geometry_columns() { return kColumns; }

std::string geometry_prelude() {
    std::string text = "#define COLUMNS " + std::to_string(kColumns.size()) + "\ntypedef struct {\n";
    for (const GeometryColumn& column : kColumns)
        text += "    real " + std::string(column.name) + "; /* " + std::string(column.doc) + " */\n";
    return text + "} Geometry;\n";
}

}  // namespace brdfit::kernels
