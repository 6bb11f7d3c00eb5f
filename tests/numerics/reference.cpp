#include "reference.h"

#include <array>
#include <boost/math/constants/constants.hpp>
#include <boost/math/special_functions/erf.hpp>
#include <cmath>
#include <cstddef>
#include <optional>
#include <stdexcept>
#include <string>

namespace brdfit::reference {
namespace {

using Vector = std::array<Real, 3>;

enum class Model { kLambert, kPhong, kWard, kLafortune, kHeTorrance };

const Real& pi() {
    static const Real value = boost::math::constants::pi<Real>();
    return value;
}

Real square(const Real& x) { return x * x; }

// The zeros at multiples of 90 degrees are made exact: pi itself is rounded.
Real sinDegrees(double degrees) {
    return std::fmod(degrees, 180.0) == 0.0 ? Real(0) : Real(sin(Real(degrees) * pi() / 180));
}

Real cosDegrees(double degrees) {
    return std::fabs(std::fmod(degrees, 180.0)) == 90.0 ? Real(0) : Real(cos(Real(degrees) * pi() / 180));
}

Real dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

struct Directions {
    explicit Directions(const Geometry& g)
        : cos_i(cosDegrees(g.theta_i_deg)),
          cos_r(cosDegrees(g.theta_r_deg)),
          sin_i(sinDegrees(g.theta_i_deg)),
          sin_r(sinDegrees(g.theta_r_deg)),
          u{-sin_i, 0, cos_i},
          v{sin_r * cosDegrees(g.phi_deg), sin_r * sinDegrees(g.phi_deg), cos_r},
          r{sin_i, 0, cos_i},
          sum{u[0] + v[0], u[1] + v[1], u[2] + v[2]} {
        const Real length = sqrt(dot(sum, sum));
        half = {sum[0] / length, sum[1] / length, sum[2] / length};
        grazing = cos_i <= 0 || cos_r <= 0;
    }

    Real cos_i, cos_r, sin_i, sin_r;
    Vector u;     // towards the light
    Vector v;     // towards the viewer
    Vector r;     // mirror direction of u
    Vector sum;   // u + v
    Vector half;  // unit vector along u + v
    bool grazing;
};

Real phong(std::span<const Real> p, const Directions& d) {
    const Real cos_alpha = dot(d.v, d.r);
    Real f = p[0] / pi();
    if (cos_alpha > 0) {
        f += p[1] * (p[2] + 1) / (2 * pi()) * pow(cos_alpha, p[2]) / d.cos_i;
    }
    return f;
}

Real ward(std::span<const Real> p, const Directions& d) {
    // Rounding may lift the z component of a unit vector above 1.
    const Real cos_delta = d.half[2] < 1 ? d.half[2] : Real(1);
    const Real tan_delta = tan(acos(cos_delta));
    const Real peak = p[1] / (4 * pi() * square(p[2]) * sqrt(d.cos_i * d.cos_r));
    return p[0] / pi() + peak * exp(-square(tan_delta / p[2]));
}

Real lafortune(std::span<const Real> p, const Directions& d) {
    Real f = p[0] / pi();
    for (std::size_t lobe = 1; lobe < p.size(); lobe += 3) {
        const Real base = p[lobe] * (d.u[0] * d.v[0] + d.u[1] * d.v[1]) + p[lobe + 1] * d.u[2] * d.v[2];
        if (base > 0) {
            f += pow(base, p[lobe + 2]);
        }
    }
    return f;
}

// erfc(x), x >= 0: 1 - erf(x) by the Taylor series of exp(x^2) erf(x), whose terms are all positive,
// up to x = 4 (loses 7 of 77 digits); the continued fraction above, where it converges fast.
Real complementaryError(const Real& x) {
    if (x > 10000) {
        return 0;  // below 10^-43000000
    }
    if (x > 4) {
        return boost::math::erfc(x);
    }
    const Real twice_square = 2 * x * x;
    Real term = x;
    Real sum = x;
    for (unsigned odd = 3; term > 1e-80 * sum; odd += 2) {
        term = term * twice_square / odd;
        sum += term;
    }
    return 1 - 2 / sqrt(pi()) * exp(-x * x) * sum;
}

struct Complex {
    Real re, im;
};

Complex operator+(const Complex& a, const Complex& b) { return {a.re + b.re, a.im + b.im}; }

Complex operator-(const Complex& a, const Complex& b) { return {a.re - b.re, a.im - b.im}; }

Complex operator*(const Complex& a, const Complex& b) { return {a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re}; }

Real norm(const Complex& a) { return square(a.re) + square(a.im); }

// Principal root in polar form.
Complex squareRoot(const Complex& a) {
    if (a.re == 0 && a.im == 0) {
        return {0, 0};
    }
    const Real modulus = sqrt(sqrt(norm(a)));
    const Real half_angle = atan2(a.im, a.re) / 2;
    return {modulus * cos(half_angle), modulus * sin(half_angle)};
}

// Unpolarised reflectance of an interface from vacuum to n + i k, from the amplitudes r_s and r_p.
Real fresnel(const Real& n, const Real& k, const Real& cos_d) {
    const Complex c{cos_d, 0};
    const Complex index_squared = Complex{n, k} * Complex{n, k};
    const Complex q = squareRoot(index_squared - Complex{1 - square(cos_d), 0});
    const Complex parallel = index_squared * c;
    return (norm(c - q) / norm(c + q) + norm(parallel - q) / norm(parallel + q)) / 2;
}

// K = tan(theta) erfc(tau cot(theta) / (2 sigma_0)) and the shadowing S = (1 - erfc / 2) / (1 + Lambda) of
// one direction.
struct Masking {
    Masking(const Real& sigma_0, const Real& tau, const Real& sin_theta, const Real& cos_theta) : k(0), s(1) {
        if (sin_theta == 0) {
            return;
        }
        const Real tan_theta = abs(sin_theta) / cos_theta;
        const Real h = tau / (2 * sigma_0 * tan_theta);
        const Real tail = complementaryError(h);
        const Real lambda = (h > 10000 ? Real(0) : Real(exp(-h * h) / (sqrt(pi()) * h) - tail)) / 2;
        k = tan_theta * tail;
        s = (1 - tail / 2) / (1 + lambda);
    }

    Real k;
    Real s;
};

// Root of sqrt(pi/2) z = (sigma_0/4) (K_i + K_r) exp(-z^2 / (2 sigma_0^2)): Newton's method inside a bracket.
Real heightOffset(const Real& sigma_0, const Real& k_sum) {
    if (k_sum == 0) {
        return 0;
    }
    const Real slope = sqrt(pi() / 2);
    const Real amplitude = sigma_0 / 4 * k_sum;
    Real low = 0;
    Real high = amplitude / slope;
    Real z = high;
    for (int iteration = 0; iteration < 1000; ++iteration) {
        const Real right = amplitude * exp(-square(z / sigma_0) / 2);
        const Real residual = slope * z - right;
        (residual > 0 ? high : low) = z;
        Real next = z - residual / (slope + right * z / square(sigma_0));
        if (!(next > low && next < high)) {
            next = (low + high) / 2;
        }
        const Real change = abs(next - z);
        z = next;
        if (change <= 1e-75 * z) {
            return z;
        }
    }
    throw std::runtime_error("he_torrance: the effective roughness did not converge");
}

// sum over m >= 1 of e^-g g^m / (m! m) exp(-a/m), from m = 1 upwards. The exponent range of Real keeps e^-g
// from underflow. The exponential costs far more than the rest of a term and grows with m, so below the mode
// of the weights it is skipped for weights that are below 1e-80 of the weight at g: those terms are below
// 1e-80 of one later term.
Real series(const Real& g, const Real& a) {
    const auto turn = static_cast<unsigned>(ceil(g));
    std::vector<Real> poisson;  // e^-g g^m / m!
    poisson.reserve(turn + 1);
    poisson.push_back(exp(-g));
    for (unsigned m = 1; m <= turn; ++m) {
        poisson.push_back(poisson.back() * g / m);
    }
    const Real negligible = 1e-80 * poisson[turn] / turn;

    Real sum = 0;
    Real previous = 0;
    Real weight = poisson[0];
    for (unsigned m = 1;; ++m) {
        weight = m <= turn ? poisson[m] : Real(weight * g / m);
        Real term = weight / m;
        if (m < turn && term < negligible) {
            continue;
        }
        if (a != 0) {
            term *= exp(-a / m);
        }
        sum += term;
        if (m > turn && term <= previous && term < 1e-75 * sum) {
            return sum;
        }
        previous = term;
    }
}

// G S D / (pi cos_i cos_r): f = rho_ud / pi + F times this. Lengths in wavelengths.
Real roughness(const Real& sigma_0, const Real& tau, const Directions& d) {
    if (d.grazing || sigma_0 == 0 || tau == 0) {
        return 0;
    }
    const Real geometric = square(dot(d.sum, d.sum) / d.sum[2]);
    const Masking i(sigma_0, tau, d.sin_i, d.cos_i);
    const Masking r(sigma_0, tau, d.sin_r, d.cos_r);
    const Real z_0 = heightOffset(sigma_0, i.k + r.k);
    const Real sigma = sigma_0 / sqrt(1 + square(z_0 / sigma_0));
    const Real wave_number = 2 * pi();
    const Real g = square(wave_number * sigma * (d.cos_i + d.cos_r));
    const Real a = square(wave_number * tau) * (square(d.sum[0]) + square(d.sum[1])) / 4;
    const Real distribution = square(pi() * tau) / 4 * series(g, a);
    return geometric * i.s * r.s * distribution / (pi() * d.cos_i * d.cos_r);
}

// One model at one geometry as a function of its parameters.
class Function {
public:
    Function(std::string_view name, std::size_t parameter_count, const Geometry& geometry) : directions_(geometry) {
        bool count_ok = false;
        if (name == "lambert") {
            model_ = Model::kLambert;
            count_ok = parameter_count == 1;
        } else if (name == "phong") {
            model_ = Model::kPhong;
            count_ok = parameter_count == 3;
        } else if (name == "ward") {
            model_ = Model::kWard;
            count_ok = parameter_count == 3;
        } else if (name == "lafortune") {
            model_ = Model::kLafortune;
            count_ok = parameter_count >= 4 && parameter_count % 3 == 1;
        } else if (name == "he_torrance") {
            model_ = Model::kHeTorrance;
            count_ok = parameter_count == 5;
        } else {
            throw std::invalid_argument("unknown model: " + std::string(name));
        }
        if (!count_ok) {
            throw std::invalid_argument("wrong number of parameters for " + std::string(name));
        }
        if ((model_ == Model::kPhong && directions_.cos_i <= 0) || (model_ == Model::kWard && directions_.grazing)) {
            throw std::invalid_argument(std::string(name) + " diverges at grazing directions");
        }
    }

    Real operator()(std::span<const Real> p) {
        switch (model_) {
            case Model::kLambert: return p[0] / pi();
            case Model::kPhong: return phong(p, directions_);
            case Model::kWard: return ward(p, directions_);
            case Model::kLafortune: return lafortune(p, directions_);
            case Model::kHeTorrance: break;
        }
        const Real cos_d = dot(directions_.u, directions_.half);
        return p[4] / pi() + fresnel(p[2], p[3], cos_d) * rememberedRoughness(p[0], p[1]);
    }

private:
    // The series is the expensive part, and differences in n, k and rho_ud leave it unchanged.
    const Real& rememberedRoughness(const Real& sigma_0, const Real& tau) {
        if (!remembered_ || remembered_->sigma_0 != sigma_0 || remembered_->tau != tau) {
            remembered_ = Remembered{sigma_0, tau, roughness(sigma_0, tau, directions_)};
        }
        return remembered_->value;
    }

    struct Remembered {
        Real sigma_0, tau, value;
    };

    Model model_ = Model::kLambert;
    Directions directions_;
    std::optional<Remembered> remembered_;
};

}  // namespace

Real value(std::string_view model, std::span<const Real> parameters, const Geometry& geometry) {
    return Function(model, parameters.size(), geometry)(parameters);
}

Real value(std::string_view model, std::span<const double> parameters, const Geometry& geometry) {
    const std::vector<Real> exact(parameters.begin(), parameters.end());
    return value(model, std::span<const Real>(exact), geometry);
}

std::vector<Real> gradient(std::string_view model, std::span<const double> parameters, const Geometry& geometry,
                           const Real& relative_step) {
    Function function(model, parameters.size(), geometry);
    const std::vector<Real> all(parameters.begin(), parameters.end());
    const std::size_t diffuse = model == "he_torrance" ? 4 : 0;
    std::vector<Real> result;
    for (std::size_t i = 0; i < all.size(); ++i) {
        // Summands without the parameter are left out of the difference: they cancel, and next to them a weak
        // lobe would keep few digits.
        std::vector<Real> p = all;
        std::size_t index = i;
        if (i != diffuse) {
            if (model == "lafortune") {
                const auto lobe = all.begin() + static_cast<std::ptrdiff_t>(i - (i - 1) % 3);
                p.assign({0, lobe[0], lobe[1], lobe[2]});
                index = 1 + (i - 1) % 3;
            }
            p[diffuse] = 0;
        }
        const auto shifted = [&](const Real& offset) {
            p[index] = all[i] + offset;
            return function(p);
        };
        const Real size = abs(all[i]) > 1e-3 ? Real(abs(all[i])) : Real(1e-3);
        const Real step = relative_step * size;
        if (all[i] >= 0 && all[i] < step) {
            result.push_back((4 * shifted(step) - 3 * shifted(0) - shifted(2 * step)) / (2 * step));
        } else {
            result.push_back((shifted(step) - shifted(-step)) / (2 * step));
        }
    }
    return result;
}

std::vector<Real> gradient(std::string_view model, std::span<const double> parameters, const Geometry& geometry) {
    // Truncation (1e-48 times the scaled third derivative) and rounding (about 1e-74 / 1e-24) balance.
    return gradient(model, parameters, geometry, Real("1e-24"));
}

}  // namespace brdfit::reference
