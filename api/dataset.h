/// Measurements, as they are read from the wire and kept.
#pragma once

#include <string>
#include <vector>

#include "api/field.h"
#include "optim/dataset.h"

namespace brdfit::api {

const std::vector<Field<optim::Dataset>>& dataset_fields();

/// The dataset as JSON that read_dataset() reads, the same for the same measurements: reading and writing it again
/// changes nothing. Azimuths are rounded once, to 1e-13 degrees.
std::string canonical_text(const optim::Dataset& dataset);

}  // namespace brdfit::api
