/// What is told of a variant's optimum.
#pragma once

#include "optim/variant.h"

namespace brdfit::optim {

/// What the choice of a variant rests on: losses, errors, evidence. robust_scale: the channel's, of a robust loss.
void describe(const Work& work, const Variant* smaller, double robust_scale, Variant& variant);

/// Makes the variant keep to what the request requires: as it is, or searched anew under the constraint. Throws
/// SearchError where it cannot.
void keep_to_requirements(const Work& work, const Variant* smaller, double robust_scale, const Weighted& loss,
                          Variant& variant);

/// Everything else the report says of the variant that was chosen.
void explain(const Work& work, double robust_scale, Variant& variant);

}  // namespace brdfit::optim
