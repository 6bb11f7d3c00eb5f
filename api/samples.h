/// Rules that every form of measurement obeys: angles, values, limits. Declared once, used by JSON and CSV.
#pragma once

#include <cstddef>
#include <optional>
#include <string>

#include "kernels/geometry.h"

namespace brdfit::api {

inline constexpr std::size_t kMostSamples = 1'000'000;  ///< of a request
inline constexpr std::size_t kMostChannels = 1000;

/// Why a value cannot be one of a sample; nullopt if it can. In the wire's units.
std::optional<std::string> bad_theta_i(double degrees);
std::optional<std::string> bad_theta_r(double degrees);
std::optional<std::string> bad_phi(double degrees);
std::optional<std::string> bad_brdf(double value);
std::optional<std::string> bad_sigma(double value);
std::optional<std::string> bad_wavelength(double nm);

/// Whether a text may be answered as it is. JSON is UTF-8 or refused; CSV and queries may hold anything.
bool is_utf8(const std::string& text);
inline constexpr std::size_t kLongestName = 200;  ///< bytes

/// A channel's name where none is given: "550nm" for 550, "550.5nm" for 550.5.
std::string wavelength_name(double nm);

/// Whether the sign of theta_r says the side of the normal (positive = specular), beside phi.
enum class Signs { meaningful, absent };

/// A direction pair from angles with azimuths: phi_r - phi_i = 180 is the specular side. With meaningful signs, theta_r
/// > 0 must lie on the specular half and theta_r < 0 on the other; nullopt where they contradict phi.
std::optional<kernels::Direction> direction_of(double theta_i_deg, double theta_r_deg, double phi_i_deg,
                                               double phi_r_deg, Signs signs);

}  // namespace brdfit::api
