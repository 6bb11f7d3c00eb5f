#include "api/samples.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>

#include <nlohmann/json.hpp>

namespace brdfit::api {
bool is_utf8(const std::string& text) {
    if (std::all_of(text.begin(), text.end(), [](char c) { return static_cast<unsigned char>(c) < 0x80; })) return true;
    try {
        (void)nlohmann::json(text).dump();
        return true;
    } catch (const nlohmann::json::type_error&) {
        return false;
    }
}

std::string wavelength_name(double nm) {
    std::array<char, 32> buffer{};
    const auto end = std::to_chars(buffer.data(), buffer.data() + buffer.size(), nm).ptr;
    return std::string(buffer.data(), end) + "nm";
}

std::optional<kernels::Direction> direction_of(double theta_i_deg, double theta_r_deg, double phi_i_deg,
                                               double phi_r_deg, Signs signs) {
    const double phi_deg = std::remainder(phi_r_deg - phi_i_deg - 180, 360);  // from the specular half-plane
    if (signs == Signs::meaningful && theta_r_deg != 0) {
        const bool specular_half = std::abs(phi_deg) < 90;
        const bool edge = std::abs(phi_deg) == 90;
        if (!edge && specular_half != (theta_r_deg > 0)) return std::nullopt;
    }
    const double theta_deg = signs == Signs::meaningful ? std::abs(theta_r_deg) : theta_r_deg;
    return kernels::canonical({theta_i_deg, theta_deg, phi_deg});
}

}  // namespace brdfit::api
