/// Measurements as comma-separated values.
#pragma once

#include <string_view>

#include "optim/dataset.h"

namespace brdfit::api {

/// `#` comment lines, one header line, then rows; fields may be quoted (RFC 4180), but not hold a line break. Columns
/// by name in any order: theta_i_deg, theta_r_deg and brdf_per_sr are needed; phi_i_deg, phi_r_deg, sigma,
/// wavelength_nm and channel are optional. Rows of one channel name (or wavelength) form a channel. If any theta_r_deg
/// is negative the signs are meaningful (positive = specular) and phi, if given, must agree; otherwise phi alone, if
/// given, tells the side. Throws Refusal (422) with line and field of each error.
optim::Dataset read_csv(std::string_view text);

}  // namespace brdfit::api
