/// The options of a fit, and the scene that it is for, as they are read from the wire.
#pragma once

#include <string_view>
#include <vector>

#include "api/field.h"
#include "optim/request.h"

namespace brdfit::api {

/// Keys that checks over several fields name as well.
inline constexpr std::string_view kLossKey = "loss";
inline constexpr std::string_view kExponentIKey = "cos_theta_i_exponent";
inline constexpr std::string_view kExponentRKey = "cos_theta_r_exponent";
inline constexpr std::string_view kThresholdKey = "robust_threshold";

const std::vector<Field<optim::FitOptions>>& option_fields();
/// These are read into FitOptions::scene, which must be there.
const std::vector<Field<optim::FitOptions>>& scene_fields();

}  // namespace brdfit::api
