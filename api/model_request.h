/// Models to fit, as they are read from the wire.
#pragma once

#include <vector>

#include "api/field.h"
#include "kernels/model.h"
#include "optim/request.h"

namespace brdfit::api {

inline constexpr std::size_t kMostModels = 50;

/// Appends those of an array of names and objects that are good; of the others the errors say what is wrong.
void read_models(const nlohmann::json& value, const Place& place, const kernels::Catalogue& catalogue,
                 std::vector<optim::ModelRequest>& out);
schema::Json models_schema();

}  // namespace brdfit::api
