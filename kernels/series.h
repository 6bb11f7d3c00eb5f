/// How far a series is summed, as a dial: what kernels/prelude.cl reads.
#pragma once

#include <string>

namespace brdfit::kernels {

/// EngineOptions::build_options with which every kernel sums its series to an eps of exp(-log_epsilon), whatever its
/// precision and Accuracy say, from 6 to 37.5. The other constants follow from it as they do in prelude.cl.
std::string series_options(double log_epsilon);

}  // namespace brdfit::kernels
