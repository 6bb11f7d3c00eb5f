#include "kernels/geometry.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace brdfit::kernels {
namespace {

constexpr long double kRadian = std::numbers::pi_v<long double> / 180;

long double sqr(long double x) { return x * x; }

/// sin of k degrees, k = 0 ... 90, by the smaller of k and 90 - k.
std::array<long double, 91> sines() {
    std::array<long double, 91> table{};
    for (int k = 0; k <= 90; ++k)
        table[static_cast<std::size_t>(k)] = k <= 45 ? std::sin(k * kRadian) : std::cos((90 - k) * kRadian);
    return table;
}

struct SineCosine {
    long double sine, cosine;
};

/// Of an angle in degrees, |x| <= 90, to the last digits also where one of them nearly vanishes: x less its nearest
/// whole degree is exact, and of that remainder's powers those beyond the eighth are below 1e-22.
SineCosine sine_cosine(long double x) {
    static const std::array<long double, 91> kSine = sines();
    const long double a = std::abs(x);
    const long whole = std::lround(static_cast<double>(a));
    const long double s = kSine[static_cast<std::size_t>(whole)];
    const long double c = kSine[static_cast<std::size_t>(90 - whole)];
    const long double r = (a - static_cast<long double>(whole)) * kRadian;
    const long double z = r * r;
    const long double sin_r = r - r * z * (1 / 6.0L - z * (1 / 120.0L - z * (1 / 5040.0L)));
    const long double cos_r_1 = -z * (0.5L - z * (1 / 24.0L - z * (1 / 720.0L)));
    const long double sine = s + (c * sin_r + s * cos_r_1);
    return {x < 0 ? -sine : sine, c + (c * cos_r_1 - s * sin_r)};
}

}  // namespace

/// In long double, whose further bits (on x86) are for what sums of products lose when they nearly vanish. Sums and
/// differences of angles are formed in degrees, where they are exact for nearby angles and where they are nearly 90.
Angles::Angles(const Direction& direction) {
    theta_i_deg_ = phi_deg_ = std::nan("");  // nothing is known yet
    turn(direction);
}

void Angles::turn(const Direction& d) {
    if (d.theta_i_deg != theta_i_deg_) {
        theta_i_deg_ = d.theta_i_deg;
        const SineCosine incident = sine_cosine(d.theta_i_deg);
        sin_i = incident.sine;
        cos_i = incident.cosine;
    }
    if (d.phi_deg != phi_deg_) {
        phi_deg_ = d.phi_deg;
        cos_phi = sine_cosine(d.phi_deg).cosine;
        sin2_half_phi_ = sqr(sine_cosine(d.phi_deg / 2.0L).sine);
    }
    theta_r_deg_ = d.theta_r_deg;
    const SineCosine exitant = sine_cosine(theta_r_deg_);
    sin_r = exitant.sine;
    cos_r = exitant.cosine;
    const SineCosine half_sum = sine_cosine((theta_r_deg_ + theta_i_deg_) / 2);
    sin_half_sum = half_sum.sine;
    cos_half_sum = half_sum.cosine;
    sin_half_difference = sine_cosine((theta_r_deg_ - theta_i_deg_) / 2).sine;
    lift = sin_i * sin_r * sin2_half_phi_;
}

long double Angles::cos_sum_of_angles() const {
    const long double a = theta_i_deg_;
    const long double b = std::abs(theta_r_deg_);
    return sine_cosine((90 - std::max(a, b)) - std::min(a, b)).sine;  // exact where it is small
}

namespace {

long double tangential_sum_squared(const Angles& d) {
    return sqr(2 * d.cos_half_sum * d.sin_half_difference) + 4 * d.lift;
}

long double log_cos_alpha(const Angles& d) {
    const long double q = 2 * (sqr(d.sin_half_difference) + d.lift);  // 1 - cos alpha
    if (q < 0.5L) return std::log1p(-q);
    const auto cosine = [&] {
        const long double height = d.cos_i * d.cos_r;
        const long double plain = height + d.sin_i * d.sin_r * d.cos_phi;
        if (d.sin_r > 0) return plain;
        // Beyond the normal two forms, each a difference: the one of the smaller terms.
        const long double sum = d.cos_sum_of_angles();
        return height < std::abs(sum) ? plain : sum - 2 * d.lift;
    };
    const long double c = cosine();
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
    d.phi_deg = std::abs(d.phi_deg);
    if (d.phi_deg > 180) d.phi_deg = std::abs(std::remainder(d.phi_deg, 360));
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
