/// Chooses the points of the self-test and computes their references.
#pragma once

#include <string>
#include <vector>

#include "kernels/hard_points.h"
#include "kernels/model.h"

namespace brdfit::tests {

/// Listed extremes of the model, then points drawn over the whole bounds that its header declares, at directions that
/// are hard for every model: all with a value that double can hold. Without value and slopes, which refer() computes.
std::vector<kernels::HardPoint> choose_hard_points(const kernels::Model& model);

/// Value and slopes from the 77-digit reference, rounded to long double.
void refer(const kernels::Model& model, kernels::HardPoint& point);

/// The point as it stands in kernels/hard_points.inc.
std::string text_of(const kernels::Model& model, const kernels::HardPoint& point);

}  // namespace brdfit::tests
