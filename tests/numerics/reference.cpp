#include "reference.h"

#include <array>
#include <boost/math/constants/constants.hpp>
#include <boost/math/special_functions/erf.hpp>
#include <boost/math/special_functions/gamma.hpp>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>

#include "dual.h"

namespace brdfit::reference {
namespace {

template <typename T>
using Vector = std::array<T, 3>;

enum class Model { kLambert, kPhong, kWard, kLafortune, kHeTorrance, kHeTorranceRoughnessAsGiven };

bool isHeTorrance(Model model) { return model == Model::kHeTorrance || model == Model::kHeTorranceRoughnessAsGiven; }

template <typename T>
const T& pi() {
    static const T value(boost::math::constants::pi<Real>());
    return value;
}

template <typename T>
const T& epsilon() {
    static const T value = std::numeric_limits<T>::epsilon();
    return value;
}

template <typename X>
X square(const X& x) {
    return x * x;
}

// The zeros at multiples of 90 degrees are made exact: pi itself is rounded.
template <typename T>
T sinDegrees(double degrees) {
    return std::fmod(degrees, 180.0) == 0.0 ? T(0) : T(sin(T(degrees) * pi<T>() / 180));
}

template <typename T>
T cosDegrees(double degrees) {
    return std::fabs(std::fmod(degrees, 180.0)) == 90.0 ? T(0) : T(cos(T(degrees) * pi<T>() / 180));
}

template <typename T>
T dot(const Vector<T>& a, const Vector<T>& b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <typename T>
struct Directions {
    explicit Directions(const Geometry& g)
        : cos_i(cosDegrees<T>(g.theta_i_deg)),
          cos_r(cosDegrees<T>(g.theta_r_deg)),
          sin_i(sinDegrees<T>(g.theta_i_deg)),
          sin_r(sinDegrees<T>(g.theta_r_deg)),
          u{-sin_i, 0, cos_i},
          v{sin_r * cosDegrees<T>(g.phi_deg), sin_r * sinDegrees<T>(g.phi_deg), cos_r},
          r{sin_i, 0, cos_i},
          sum{u[0] + v[0], u[1] + v[1], u[2] + v[2]} {
        const T length = sqrt(dot(sum, sum));
        half = {sum[0] / length, sum[1] / length, sum[2] / length};
        grazing = cos_i <= 0 || cos_r <= 0;
    }

    T cos_i, cos_r, sin_i, sin_r;
    Vector<T> u;     // towards the light
    Vector<T> v;     // towards the viewer
    Vector<T> r;     // mirror direction of u
    Vector<T> sum;   // u + v
    Vector<T> half;  // unit vector along u + v
    bool grazing;
};

// The lobes, without the diffuse term. X is T, or a Dual of it.

template <typename X, typename T>
X phongLobe(const X& k_s, const X& n, const Directions<T>& d) {
    const T cos_alpha = dot(d.v, d.r);
    if (!(cos_alpha > 10 * epsilon<T>())) {
        return 0;  // an exact right angle as well, whose cosine is rounded
    }
    return k_s * (n + 1) / X(2 * pi<T>()) * pow(X(cos_alpha), n) / X(d.cos_i);
}

template <typename X, typename T>
X wardLobe(const X& rho_s, const X& alpha, const Directions<T>& d) {
    // Rounding may lift the z component of a unit vector above 1.
    const T cos_delta = d.half[2] < 1 ? d.half[2] : T(1);
    const T tan_delta = tan(acos(cos_delta));
    const X peak = rho_s / (X(4 * pi<T>()) * square(alpha) * X(sqrt(d.cos_i * d.cos_r)));
    return peak * exp(-square(X(tan_delta) / alpha));
}

template <typename X, typename T>
X lafortuneLobe(const X& c_xy, const X& c_z, const X& n, const Directions<T>& d) {
    const X tangential = c_xy * X(d.u[0] * d.v[0] + d.u[1] * d.v[1]);
    const X normal = c_z * X(d.u[2] * d.v[2]);
    const X base = tangential + normal;
    const T rounding = 10 * epsilon<T>() * T(abs(plain(tangential)) + abs(plain(normal)));
    return base > X(rounding) ? pow(base, n) : X(0);  // 0 also where the two cancel exactly
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
    return 1 - 2 / sqrt(pi<Real>()) * exp(-x * x) * sum;
}

Real logFactorial(const Real& m) { return boost::math::lgamma(m + 1); }

#ifdef __x86_64__
Fast complementaryError(const Fast& x) { return Fast(erfcq(x.backend().value())); }
Fast logFactorial(const Fast& m) { return Fast(lgammaq((m + 1).backend().value())); }
#else
Fast complementaryError(const Fast& x) { return boost::math::erfc(x); }
Fast logFactorial(const Fast& m) { return boost::math::lgamma(m + 1); }
#endif

template <typename T, std::size_t N>
Dual<T, N> complementaryError(const Dual<T, N>& x) {
    return x.through(complementaryError(x.v), -2 / sqrt(pi<T>()) * exp(-x.v * x.v));
}

template <typename X>
struct Complex {
    X re, im;
};

template <typename X>
Complex<X> operator+(const Complex<X>& a, const Complex<X>& b) {
    return {a.re + b.re, a.im + b.im};
}

template <typename X>
Complex<X> operator-(const Complex<X>& a, const Complex<X>& b) {
    return {a.re - b.re, a.im - b.im};
}

template <typename X>
Complex<X> operator*(const Complex<X>& a, const Complex<X>& b) {
    return {a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re};
}

template <typename X>
X norm(const Complex<X>& a) {
    return square(a.re) + square(a.im);
}

// Principal root in polar form.
template <typename X>
Complex<X> squareRoot(const Complex<X>& a) {
    if (a.re == X(0) && a.im == X(0)) {
        return {X(0), X(0)};
    }
    const X modulus = sqrt(sqrt(norm(a)));
    const X half_angle = atan2(a.im, a.re) / X(2);
    return {modulus * cos(half_angle), modulus * sin(half_angle)};
}

// Unpolarised reflectance of an interface from vacuum to n + i k, from the amplitudes r_s and r_p.
template <typename X, typename T>
X fresnel(const X& n, const X& k, const T& cos_d) {
    if (n == X(1) && k == X(0)) {
        return 0;  // exactly; so are its derivatives
    }
    const Complex<X> c{X(cos_d), X(0)};
    const Complex<X> index_squared = Complex<X>{n, k} * Complex<X>{n, k};
    const Complex<X> q = squareRoot(index_squared - Complex<X>{X(1), X(0)} + c * c);
    const Complex<X> parallel = index_squared * c;
    return (norm(c - q) / norm(c + q) + norm(parallel - q) / norm(parallel + q)) / X(2);
}

// Near n + i k = 1 the amplitudes cancel: the narrower type would keep too few digits there.
template <typename T>
Dual<T, 2> fresnelJet(double n, double k, const T& cos_d) {
    using Wide = Dual<Real, 2>;
    if (std::hypot(n - 1, k) > 1e-2) {
        return fresnel(Dual<T, 2>(T(n), 0), Dual<T, 2>(T(k), 1), cos_d);
    }
    const Wide wide = fresnel(Wide(Real(n), 0), Wide(Real(k), 1), Real(cos_d));
    Dual<T, 2> result(static_cast<T>(wide.v));
    for (std::size_t i = 0; i < 2; ++i) {
        result.d[i] = static_cast<T>(wide.d[i]);
    }
    return result;
}

// K = tan(theta) erfc(tau cot(theta) / (2 sigma_0)) and the shadowing S = (1 - erfc / 2) / (1 + Lambda) of
// one direction.
template <typename X>
struct Masking {
    template <typename T>
    Masking(const X& sigma_0, const X& tau, const T& sin_theta, const T& cos_theta) : k(0), s(1) {
        if (sin_theta == 0) {
            return;
        }
        const X tan_theta = T(abs(sin_theta) / cos_theta);
        const X h = tau / (X(2) * sigma_0 * tan_theta);
        if (h > X(10000)) {
            return;  // the tails are below 10^-43000000
        }
        const X tail = complementaryError(h);
        const X lambda = (exp(-h * h) / (X(sqrt(pi<T>())) * h) - tail) / X(2);
        k = tan_theta * tail;
        s = (X(1) - tail / X(2)) / (X(1) + lambda);
    }

    X k;
    X s;
};

// Root of sqrt(pi/2) z = (sigma_0/4) (K_i + K_r) exp(-z^2 / (2 sigma_0^2)): Newton's method inside a bracket.
template <typename T>
T heightOffset(const T& sigma_0, const T& k_sum) {
    if (k_sum == 0) {
        return 0;
    }
    const T slope = sqrt(pi<T>() / 2);
    const T amplitude = sigma_0 / 4 * k_sum;
    T low = 0;
    T high = amplitude / slope;
    if (k_sum < epsilon<T>()) {
        return high;  // the exponential is 1 in every digit
    }
    T z = high;
    T change = 2 * high;  // of the last step; one that is not half of it is not yet Newton's convergence
    for (int iteration = 0; iteration < 1000; ++iteration) {
        const T right = amplitude * exp(-square(T(z / sigma_0)) / 2);
        const T residual = slope * z - right;
        (residual > 0 ? high : low) = z;
        T next = z - residual / (slope + right * z / square(sigma_0));
        if (!(next > low && next < high && abs(next - z) < change / 2)) {
            next = (low + high) / 2;
        }
        change = abs(next - z);
        z = next;
        if (change <= 50 * epsilon<T>() * z) {
            return z;
        }
    }
    throw std::runtime_error("he_torrance: the effective roughness did not converge");
}

// One more step of Newton's method, with its derivatives, from the root found: that of the implicit function.
template <typename T, std::size_t N>
Dual<T, N> heightOffset(const Dual<T, N>& sigma_0, const Dual<T, N>& k_sum) {
    using X = Dual<T, N>;
    const T z = heightOffset(sigma_0.v, k_sum.v);
    const T slope = sqrt(pi<T>() / 2);
    const X right = sigma_0 / X(4) * k_sum * exp(-square(X(z) / sigma_0) / X(2));
    return X(z) - (X(slope * z) - right) / X(T(slope + right.v * z / square(sigma_0.v)));
}

// M(g, a) = sum over m >= 1 of e^-g g^m / (m! m) exp(-a/m), and its derivatives.
template <typename T>
struct Series {
    T sum = 0, by_g = 0, by_a = 0;
};

// The largest term's place: the ratio of a term's weight e^-g g^m / m! exp(-a/m) to the one before falls with m.
unsigned largestTerm(double g, double a) {
    const auto rises = [&](unsigned m) { return std::log(g / (m + 1.0)) + a / m / (m + 1.0) > 0; };
    unsigned low = 0;
    unsigned high = 1;
    while (rises(high)) {
        low = high;
        high *= 2;
    }
    while (high - low > 1) {
        const unsigned middle = low + (high - low) / 2;
        (rises(middle) ? low : high) = middle;
    }
    return high;
}

// Term by term in both directions from about the largest, each way until what is left is negligible: the ratio of
// neighbours falls, so that it is less than a geometric series. A weight follows from its neighbour, with its
// derivative by g.
template <typename T>
Series<T> series(const T& g, const T& a) {
    const unsigned start = largestTerm(g.template convert_to<double>(), a.template convert_to<double>());
    const T logarithm = -g + start * log(g) - logFactorial(T(start));
    Series<T> result;
    // Beyond the range of the narrower type; far below that of any result.
    if (logarithm - a / start < -11000 && std::numeric_limits<T>::digits < 200) {
        return result;
    }
    const T negligible = 100 * epsilon<T>();
    const auto add = [&](unsigned m, const T& weight, const T& weight_by_g) {
        const T inverse = T(1) / m;
        const T factor = a == 0 ? inverse : T(exp(-a * inverse) * inverse);
        const T term = weight * factor;
        result.sum += term;
        result.by_g += weight_by_g * factor;
        result.by_a -= term * inverse;
        return term;
    };
    const auto ended = [&](const T& term, const T& previous) {
        return term <= 0 || (term < previous && term * term < negligible * result.sum * (previous - term));
    };
    const T first = exp(logarithm);
    const T first_by_g = first * (start / g - 1);

    T weight = first;
    T weight_by_g = first_by_g;
    T previous = 0;
    for (unsigned m = start;; ++m) {
        const T term = add(m, weight, weight_by_g);
        if (ended(term, previous)) {
            break;
        }
        previous = term;
        const T inverse = T(1) / (m + 1);
        weight_by_g = (weight_by_g * g + weight) * inverse;
        weight = weight * g * inverse;
    }
    weight = first;
    weight_by_g = first_by_g;
    previous = 0;
    const T per_g = 1 / g;
    for (unsigned m = start; m > 1; --m) {
        weight_by_g = (weight_by_g - weight * per_g) * m * per_g;
        weight = weight * m * per_g;
        const T term = add(m - 1, weight, weight_by_g);
        if (ended(term, previous)) {
            break;
        }
        previous = term;
    }
    return result;
}

// A sum, and how steep the exponential within it is.
template <typename X, typename T>
struct Sum {
    X value;
    T steepness;  // -d ln value/d ln a
};

template <typename T>
T steepness(const Series<T>& s, const T& a) {
    return s.sum > 0 ? T(-s.by_a * a / s.sum) : T(0);
}

template <typename T>
Sum<T, T> seriesSum(const T& g, const T& a) {
    const Series<T> s = series(g, a);
    return {s.sum, steepness(s, a)};
}

template <typename T, std::size_t N>
Sum<Dual<T, N>, T> seriesSum(const Dual<T, N>& g, const Dual<T, N>& a) {
    const Series<T> s = series(g.v, a.v);
    Dual<T, N> result(s.sum);
    for (std::size_t i = 0; i < N; ++i) {
        result.d[i] = s.by_g * g.d[i] + s.by_a * a.d[i];
    }
    return {result, steepness(s, a.v)};
}

// G S D / (pi cos_i cos_r): f = rho_ud / pi + F times this. Lengths in wavelengths. As given: sigma = sigma_0.
template <typename X, typename T>
Sum<X, T> roughness(const X& sigma_0, const X& tau, const Directions<T>& d, bool as_given) {
    if (d.grazing || sigma_0 == X(0) || tau == X(0)) {
        return {0, 0};
    }
    const T geometric = square(T(dot(d.sum, d.sum) / d.sum[2]));
    const Masking<X> i(sigma_0, tau, d.sin_i, d.cos_i);
    const Masking<X> r(sigma_0, tau, d.sin_r, d.cos_r);
    const X z_0 = as_given ? X(0) : heightOffset(sigma_0, X(i.k + r.k));
    const X sigma = sigma_0 / sqrt(X(1) + square(X(z_0 / sigma_0)));
    const T wave_number = 2 * pi<T>();
    const X g = square(X(X(wave_number) * sigma * X(d.cos_i + d.cos_r)));
    const X a = square(X(X(wave_number) * tau)) * X((square(d.sum[0]) + square(d.sum[1])) / 4);
    const Sum<X, T> sum = seriesSum(g, a);
    const X distribution = square(X(X(pi<T>()) * tau)) / X(4) * sum.value;
    return {X(X(geometric) * i.s * r.s * distribution / X(pi<T>() * d.cos_i * d.cos_r)), sum.steepness};
}

Model checkedModel(std::string_view name, std::size_t parameter_count, bool is_i_grazing, bool is_any_grazing) {
    Model model{};
    bool count_ok = false;
    if (name == "lambert") {
        model = Model::kLambert;
        count_ok = parameter_count == 1;
    } else if (name == "phong") {
        model = Model::kPhong;
        count_ok = parameter_count == 3;
    } else if (name == "ward") {
        model = Model::kWard;
        count_ok = parameter_count == 3;
    } else if (name == "lafortune") {
        model = Model::kLafortune;
        count_ok = parameter_count >= 4 && parameter_count % 3 == 1;
    } else if (name == "he_torrance") {
        model = Model::kHeTorrance;
        count_ok = parameter_count == 5;
    } else if (name == "he_torrance_roughness_as_given") {
        model = Model::kHeTorranceRoughnessAsGiven;
        count_ok = parameter_count == 5;
    } else {
        throw std::invalid_argument("unknown model: " + std::string(name));
    }
    if (!count_ok) {
        throw std::invalid_argument("wrong number of parameters for " + std::string(name));
    }
    if ((model == Model::kPhong && is_i_grazing) || (model == Model::kWard && is_any_grazing)) {
        throw std::invalid_argument(std::string(name) + " diverges at grazing directions");
    }
    return model;
}

// One model at one geometry as a function of its parameters.
class Function {
public:
    Function(std::string_view name, std::size_t parameter_count, const Geometry& geometry)
        : directions_(geometry),
          model_(checkedModel(name, parameter_count, directions_.cos_i <= 0, directions_.grazing)) {}

    Real operator()(std::span<const Real> p) {
        const std::size_t diffuse = isHeTorrance(model_) ? 4 : 0;
        Real f = p[diffuse] / pi<Real>();
        switch (model_) {
            case Model::kLambert: break;
            case Model::kPhong: f += phongLobe(p[1], p[2], directions_); break;
            case Model::kWard: f += wardLobe(p[1], p[2], directions_); break;
            case Model::kLafortune:
                for (std::size_t lobe = 1; lobe < p.size(); lobe += 3) {
                    f += lafortuneLobe(p[lobe], p[lobe + 1], p[lobe + 2], directions_);
                }
                break;
            case Model::kHeTorrance:
            case Model::kHeTorranceRoughnessAsGiven:
                f += fresnel(p[2], p[3], dot(directions_.u, directions_.half)) * rememberedRoughness(p[0], p[1]);
                break;
        }
        return f;
    }

private:
    // The series is the expensive part, and differences in n, k and rho_ud leave it unchanged.
    const Real& rememberedRoughness(const Real& sigma_0, const Real& tau) {
        if (!remembered_ || remembered_->sigma_0 != sigma_0 || remembered_->tau != tau) {
            remembered_ = Remembered{
                sigma_0, tau, roughness(sigma_0, tau, directions_, model_ == Model::kHeTorranceRoughnessAsGiven).value};
        }
        return remembered_->value;
    }

    struct Remembered {
        Real sigma_0, tau, value;
    };

    Directions<Real> directions_;
    Model model_;
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
    const std::size_t diffuse = model.starts_with("he_torrance") ? 4 : 0;
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

template <typename T>
Jet<T> jet(std::string_view model, std::span<const double> parameters, const Geometry& geometry) {
    const Directions<T> directions(geometry);
    const Model kind = checkedModel(model, parameters.size(), directions.cos_i <= 0, directions.grazing);
    using Pair = Dual<T, 2>;
    using Triple = Dual<T, 3>;
    const auto p = [&](std::size_t i) { return T(parameters[i]); };
    Jet<T> result;
    result.gradient.assign(parameters.size(), T(0));
    result.gradient[isHeTorrance(kind) ? 4 : 0] = 1 / pi<T>();
    switch (kind) {
        case Model::kLambert: break;
        case Model::kPhong:
        case Model::kWard: {
            const Pair weight(p(1), 0);
            const Pair width(p(2), 1);
            const Pair lobe =
                kind == Model::kPhong ? phongLobe(weight, width, directions) : wardLobe(weight, width, directions);
            result.specular = lobe.v;
            result.gradient[1] = lobe.d[0];
            result.gradient[2] = lobe.d[1];
            break;
        }
        case Model::kLafortune:
            for (std::size_t i = 1; i < parameters.size(); i += 3) {
                const Triple lobe =
                    lafortuneLobe(Triple(p(i), 0), Triple(p(i + 1), 1), Triple(p(i + 2), 2), directions);
                result.specular += lobe.v;
                for (std::size_t j = 0; j < 3; ++j) {
                    result.gradient[i + j] = lobe.d[j];
                }
            }
            break;
        case Model::kHeTorrance:
        case Model::kHeTorranceRoughnessAsGiven: {
            const Pair reflectance = fresnelJet(parameters[2], parameters[3], T(dot(directions.u, directions.half)));
            const Sum<Pair, T> rough =
                roughness(Pair(p(0), 0), Pair(p(1), 1), directions, kind == Model::kHeTorranceRoughnessAsGiven);
            const Pair& rest = rough.value;
            result.steepness = rough.steepness;
            result.specular = reflectance.v * rest.v;
            for (std::size_t j = 0; j < 2; ++j) {
                result.gradient[j] = reflectance.v * rest.d[j];
                result.gradient[2 + j] = reflectance.d[j] * rest.v;
            }
            break;
        }
    }
    return result;
}

template Jet<Fast> jet(std::string_view, std::span<const double>, const Geometry&);
template Jet<Real> jet(std::string_view, std::span<const double>, const Geometry&);

}  // namespace brdfit::reference
