/// Requests that work, for the published document.
#pragma once

#include "api/schema.h"

namespace brdfit::api::examples {

schema::Json dataset();
schema::Json fit_request();
schema::Json evaluate_request();
/// A file of measurements.
inline constexpr const char* kCsv =
    "theta_i_deg,theta_r_deg,brdf_per_sr\n30,-60,0.171\n30,0,0.18\n30,28,0.385\n30,32,0.38\n30,60,0.2\n60,0,0.19\n";

}  // namespace brdfit::api::examples
