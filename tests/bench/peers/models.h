/// The models as a user writes them from the papers, with the standard library, on a scalar that may be a dual number.
#pragma once

#include <ceres/jet.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

namespace brdfit::peers {

/// How He-Torrance's series is summed.
enum class Series {
    textbook,  ///< term by term from the first, until the next ones no longer count
    window     ///< only terms about the largest, on a stride where they form a smooth bell
};

/// One measured direction and what depends on its angles only.
struct Sample {
    double ci = 0, cr = 0;        ///< cosines of theta_i, theta_r
    double tan_i = 0, tan_r = 0;  ///< their tangents' sizes
    double cos_alpha = 0;         ///< alpha: angle to the mirror direction
    double hxy = 0, hz = 0;       ///< u_x v_x + u_y v_y, u_z v_z
    double w = 0, cs = 0;         ///< |u_xy + v_xy|^2, u_z + v_z
    double cd2 = 0;               ///< squared cosine of the angle to the half vector
    double y = 0;                 ///< measured, [1/sr]
    double weight = 0;            ///< of (f - y)^2; sum weight y^2 = 1
};

/// How a search sees a parameter: as it is, or as ln(p + shift). A shift opens a logarithm to 0.
struct Scale {
    bool logarithmic = false;
    double shift = 0;

    template <typename T>
    T natural(const T& u) const {
        using std::exp;
        return logarithmic ? T(exp(u) - shift) : u;
    }
    double coordinate(double p) const { return logarithmic ? std::log(p + shift) : p; }
};

constexpr Scale kLinear{};
constexpr Scale kLog{true, 0};

struct Phong {
    static constexpr std::array kScales{kLinear, Scale{true, 1e-3}, kLog};  // k_d, k_s, n

    template <typename T>
    static T value(const T* p, const Sample& s, Series /*series*/) {
        using std::pow;
        T diffuse = p[0] * std::numbers::inv_pi;
        if (s.cos_alpha <= 0) return diffuse;
        return diffuse + p[1] * (p[2] + 1.0) * pow(s.cos_alpha, p[2]) * (0.5 * std::numbers::inv_pi / s.ci);
    }
};

struct Ward {
    static constexpr std::array kScales{kLinear, Scale{true, 1e-3}, kLog};  // rho_d, rho_s, alpha

    template <typename T>
    static T value(const T* p, const Sample& s, Series /*series*/) {
        using std::exp;
        const T alpha2 = p[2] * p[2];
        return p[0] * std::numbers::inv_pi +
               p[1] * exp(-s.w / (s.cs * s.cs) / alpha2) / (4 * std::numbers::pi * std::sqrt(s.ci * s.cr) * alpha2);
    }
};

/// Two lobes.
struct Lafortune {
    static constexpr std::array kScales{kLinear, kLinear, kLinear, kLog,
                                        kLinear, kLinear, kLog};  // k_d, (c_xy, c_z, n) x 2

    template <typename T>
    static T value(const T* p, const Sample& s, Series /*series*/) {
        using std::exp, std::log, std::min;
        T f = p[0] * std::numbers::inv_pi;
        for (const T* lobe : {p + 1, p + 4}) {
            const T b = lobe[0] * s.hxy + lobe[1] * s.hz;
            if (b > 0.0) f += exp(min(T(lobe[2] * log(b)), T(kLargest)));
        }
        return f;
    }

private:
    static constexpr double kLargest = 200;  // far too bright, and its square is still a number
};

namespace he_torrance {

/// f and its slopes as a T: a plain number, or a dual one by the chain rule.
inline double chained(double f, double /*dx*/, double /*x*/, double /*dy*/, double /*y*/) { return f; }
template <int N>
ceres::Jet<double, N> chained(double f, double dx, const ceres::Jet<double, N>& x, double dy,
                              const ceres::Jet<double, N>& y) {
    return {f, dx * x.v + dy * y.v};
}
inline double number(double x) { return x; }
template <int N>
double number(const ceres::Jet<double, N>& x) {
    return x.a;
}

/// sum over m >= 1 of e^-g g^m/m! e^(-a/m) m^-j.
struct Sums {
    double m0 = 0, m1 = 0, m2 = 0;

    void add(double term, double m) {
        m0 += term;
        m1 += term / m;
        m2 += term / (m * m);
    }
};

/// The weights by their recurrence, as logarithms where e^-g is no number any more.
inline Sums textbook_sums(double g, double a) {
    constexpr double kEps = 1e-12, kLargestExponent = 700;
    Sums sums;
    const double past = 0.5 * (g + std::sqrt(g * g + 4 * a));  // terms fall from here on
    const bool plain = g < kLargestExponent;
    double weight = plain ? std::exp(-g) : -g;
    const double log_g = std::log(g);
    double m = 0, term = 0;
    do {
        m += 1;
        term = 0;
        if (plain) {
            weight *= g / m;
            term = weight * std::exp(-a / m);
        } else {
            weight += log_g - std::log(m);
            const double exponent = weight - a / m;
            if (exponent > -kLargestExponent) term = std::exp(exponent);
        }
        sums.add(term, m);
    } while (m <= past || term > kEps * sums.m0);
    return sums;
}

/// As kernels/models/he_torrance.cl sums it, to about ten digits.
inline Sums window_sums(double g, double a) {
    constexpr double kLogEps = 21, kUnseen = 700;
    const double upper = 0.5 * (g + std::sqrt(g * g + 4 * a));
    const double ratio = upper / g;
    double mode = ratio > std::numbers::e ? std::max(g, std::sqrt(a / std::log(ratio))) : upper;
    for (int step = 0; step < 3; ++step) {
        const double r = a / (mode * mode);
        mode = std::max(mode - mode * (std::log(mode / g) - r) / (1 + 2 * r), mode / 3);
    }
    const auto deviance = [&](double m) {  // m ln(m/g) - (m - g)
        const double d = (m - g) / g;
        return m * std::log1p(d) - (m - g);
    };
    Sums sums;
    if (deviance(std::max(mode, 1.0)) + a / std::max(mode, 1.0) > kUnseen) return sums;
    const double width = std::sqrt(mode / (1 + 2 * a / (mode * mode)));
    mode = std::max(mode, 1.0);
    const double low = std::floor(mode - std::sqrt(2 * kLogEps * mode) - 1);
    const double high = mode + kLogEps / 3 + std::sqrt(kLogEps * kLogEps / 9 + 2 * kLogEps * mode);
    const double enough = std::exp(-kLogEps);
    const bool direct = low <= 1;
    const double stride = direct ? 1 : std::max(1.0, std::floor(0.87 * width));
    double weight = direct ? std::exp(-g) : 0;
    double m = std::max(low, 1.0), term = 0;
    do {
        if (direct) {
            weight *= g / m;
            term = weight * std::exp(-a / m);
        } else {
            const double z = 1 / (m * m);
            const double stirling = (1.0 / 12 - z * (1.0 / 360 - z * (1.0 / 1260 - z * (1.0 / 1680 - z / 1188)))) / m;
            term = stride * std::exp(-deviance(m) - stirling - a / m) / std::sqrt(2 * std::numbers::pi * m);
        }
        sums.add(term, m);
        m += stride;
    } while (m <= high && (m <= mode || term >= enough * sums.m0));
    return sums;
}

/// sum over m >= 1 of e^-g g^m/(m! m) e^(-a/m).
template <typename T>
T series(const T& g, const T& a, Series method) {
    const double g_number = std::max(number(g), 1e-300);
    const Sums sums =
        method == Series::textbook ? textbook_sums(g_number, number(a)) : window_sums(g_number, number(a));
    return chained(sums.m1, sums.m0 / g_number - sums.m1, g, -sums.m2, a);
}

/// z_0/sigma_0 from K_i + K_r: x exp(x^2/2) = c by Newton's method on its logarithm.
template <typename T>
T roughness_ratio(const T& sum_of_k) {
    const double c = number(sum_of_k) / std::sqrt(8 * std::numbers::pi);
    if (c < 1e-150) return T(0.0);
    double x = c < 1 ? c : std::sqrt(2 * std::log(1 + c));
    for (int step = 0; step < 50; ++step) {
        const double next = std::max(x - (std::log(x / c) + 0.5 * x * x) / (1 / x + x), 0.1 * x);
        const bool still = std::abs(next - x) <= 1e-14 * x;
        x = next;
        if (still) break;
    }
    return chained(x, x / (number(sum_of_k) * (1 + x * x)), sum_of_k, 0, sum_of_k);
}

/// Shadowing S1 of a direction and K = |tan theta| erfc(h).
template <typename T>
void shadow(double tan_theta, const T& slope, T& s1, T& k) {
    using std::erfc, std::exp;
    s1 = T(1.0);
    k = T(0.0);
    if (number(slope) > 27 * 2 * tan_theta) return;  // erfc is 0
    const T h = slope / (2 * tan_theta);
    const T e = erfc(h);
    const T lambda = 0.5 * (exp(-h * h) / (std::sqrt(std::numbers::pi) * h) - e);
    s1 = (1.0 - 0.5 * e) / (1.0 + lambda);
    k = tan_theta * e;
}

/// Unpolarised Fresnel reflectance of n + ik.
template <typename T>
T fresnel(const T& n, const T& k, double cd2) {
    using std::abs, std::sqrt;
    const double c = std::sqrt(cd2);
    const double sd2 = 1 - cd2;
    const T difference = n * n - k * k - sd2;
    const T nk = n * k;
    const T large2 = 0.5 * (sqrt(difference * difference + 4.0 * nk * nk) + abs(difference));
    const T large = sqrt(large2);
    const bool refracts = difference > 0.0;
    const T a = refracts ? large : T(nk / large);
    const T b2 = refracts ? T(nk * nk / large2) : large2;
    const T rs = ((a - c) * (a - c) + b2) / ((a + c) * (a + c) + b2);
    const T rp_over_rs = ((a * c - sd2) * (a * c - sd2) + b2 * cd2) / ((a * c + sd2) * (a * c + sd2) + b2 * cd2);
    return 0.5 * rs * (1.0 + rp_over_rs);
}

}  // namespace he_torrance

/// Lengths in wavelengths, without the specular spike.
struct HeTorrance {
    static constexpr std::array kScales{kLog, kLog, kLog, Scale{true, 0.1}, kLinear};  // sigma, tau, n, k, rho_ud

    template <typename T>
    static T value(const T* p, const Sample& s, Series method) {
        const T slope = p[1] / p[0];
        T s1_i, s1_r, k_i, k_r;
        he_torrance::shadow(s.tan_i, slope, s1_i, k_i);
        he_torrance::shadow(s.tan_r, slope, s1_r, k_r);
        const T x = he_torrance::roughness_ratio(T(k_i + k_r));
        const T height = 2 * std::numbers::pi * s.cs * p[0];
        const T g = height * height / (1.0 + x * x);
        const T t = std::numbers::pi * std::numbers::pi * p[1] * p[1];
        const double geometry = 16 * s.cd2 * s.cd2 / (s.cs * s.cs);
        return p[4] * std::numbers::inv_pi + he_torrance::fresnel(p[2], p[3], s.cd2) * s1_i * s1_r *
                                                 he_torrance::series(g, T(t * s.w), method) * t *
                                                 (0.25 * geometry * std::numbers::inv_pi / (s.ci * s.cr));
    }
};

}  // namespace brdfit::peers
