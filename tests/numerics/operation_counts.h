/// What an evaluation of each model takes, counted in its kernel text.
#pragma once

#include <string>

namespace brdfit::tests {

/// kernels/operation_counts.inc as it should be.
std::string operation_counts_table();

}  // namespace brdfit::tests
