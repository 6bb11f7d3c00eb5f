/// Rules that every form of measurement obeys: angles, values, limits. Declared once, used by JSON and CSV.
#pragma once

#include <cstddef>
#include <optional>
#include <string>
#include <string_view>

#include "kernels/geometry.h"

namespace brdfit::api {

inline constexpr std::size_t kMostSamples = 1'000'000;  ///< of a request
inline constexpr std::size_t kMostChannels = 1000;

/// A rule for a number: why it is refused, or nothing.
struct Rule {
    double low;
    bool low_open;
    double high;
    bool high_open;
    std::string_view rule;  ///< for people

    std::optional<std::string> operator()(double value) const {
        const bool good =
            (low_open ? value > low : value >= low) && (high_open ? value < high : value <= high);  // false for NaN
        return good ? std::nullopt : std::optional<std::string>(rule);
    }
};

/// Why a value cannot be one of a sample; nullopt if it can. In the wire's units.
inline constexpr Rule bad_theta_i{
    0, false, 90, true, "theta_i_deg must lie in [0, 90); the side of the specimen is the sign of theta_r_deg"};
inline constexpr Rule bad_theta_r{-90, true, 90, true, "theta_r_deg must lie in (-90, 90)"};
inline constexpr Rule bad_phi{-360, false, 360, false, "phi must lie in [-360, 360]"};
inline constexpr Rule bad_brdf{-1e30, false, 1e30, false, "a BRDF value must be finite and at most 1e30 in size"};
inline constexpr Rule bad_sigma{0, true, 1e30, false, "sigma must be positive and finite"};
inline constexpr Rule bad_wavelength{1, false, 1e7, false, "wavelength_nm must lie in [1, 1e7]"};

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
