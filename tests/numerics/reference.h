#pragma once

#include <boost/multiprecision/cpp_bin_float.hpp>
#ifdef __x86_64__
#include <boost/multiprecision/float128.hpp>
#endif
#include <span>
#include <string_view>
#include <vector>

/// High-precision reference of the five BRDF models, for the numerical tests.
///
/// Written from the literal definitions (unit vectors, half vector, pow, tan(acos), complex Fresnel
/// amplitudes, root finding, the series term by term), not from the cancellation-free forms of the kernels, so
/// that a slip in one of the two derivations shows up as a difference.
namespace brdfit::reference {

/// The judge: a 256-bit significand, about 77 decimal digits; faster for exp and log than a decimal type of 60 digits.
using Real =
    boost::multiprecision::number<boost::multiprecision::cpp_bin_float<256, boost::multiprecision::digit_base_2>,
                                  boost::multiprecision::et_off>;
/// For many points: a 113-bit significand, 34 decimal digits and exponents to 4932, ten times as fast.
#ifdef __x86_64__
using Fast = boost::multiprecision::number<boost::multiprecision::float128_backend, boost::multiprecision::et_off>;
#else
using Fast = boost::multiprecision::number<boost::multiprecision::cpp_bin_float_quad::backend_type,
                                           boost::multiprecision::et_off>;
#endif

/// Angles in degrees, taken as exact values.
struct Geometry {
    double theta_i_deg = 0;  ///< incidence, in [0, 90)
    double theta_r_deg = 0;  ///< exitance, in (-90, 90), positive on the specular side
    double phi_deg = 0;      ///< azimuth of the exitant direction from the specular half plane
};

/// BRDF in 1/sr. Parameters in the order of the interface:
///   lambert      {k_d}
///   phong        {k_d, k_s, n}
///   ward         {rho_d, rho_s, alpha}
///   lafortune    {k_d, then (c_xy, c_z, n) per lobe}
///   he_torrance  {sigma, tau, n, k, rho_ud}, sigma and tau in wavelengths; without the ideal specular term
///   he_torrance_roughness_as_given  the same with sigma in place of the effective roughness
/// Throws std::invalid_argument for an unknown model, a wrong number of parameters, or a grazing direction at
/// which the model diverges (he_torrance has the finite limit rho_ud / pi there).
Real value(std::string_view model, std::span<const double> parameters, const Geometry& geometry);
Real value(std::string_view model, std::span<const Real> parameters, const Geometry& geometry);

/// Derivatives with respect to the parameters, in their order, by central differences of value() with the
/// step relative_step * max(|p|, 1e-3); at p >= 0 within one step of 0 by the one-sided three-point formula,
/// so that a parameter that must not be negative never is. At the default step 40 digits or more are good,
/// also of a lobe far weaker than the diffuse term (a derivative that is exactly 0 comes out below 1e-48 of
/// the lobe), except where f is not smooth: Lafortune base 0, onset of total reflection at k = 0.
std::vector<Real> gradient(std::string_view model, std::span<const double> parameters, const Geometry& geometry);
std::vector<Real> gradient(std::string_view model, std::span<const double> parameters, const Geometry& geometry,
                           const Real& relative_step);

/// The BRDF without its diffuse term, and the derivatives of the whole by every parameter, by forward-mode
/// differentiation of the definitions.
template <typename T>
struct Jet {
    T specular = 0;
    std::vector<T> gradient;
    T steepness = 0;  ///< he_torrance: -d ln D/d ln tau^2 at a given roughness, >= 0
};

/// For T = Fast and Real. Throws as value().
template <typename T>
Jet<T> jet(std::string_view model, std::span<const double> parameters, const Geometry& geometry);
extern template Jet<Fast> jet(std::string_view, std::span<const double>, const Geometry&);
extern template Jet<Real> jet(std::string_view, std::span<const double>, const Geometry&);

}  // namespace brdfit::reference
