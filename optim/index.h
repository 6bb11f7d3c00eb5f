/// Eigen's signed indices beside the standard library's.
#pragma once

#include <cstddef>

#include <Eigen/Core>

namespace brdfit::optim {

/// As an index of a vector of the standard library.
inline std::size_t at(Eigen::Index i) { return static_cast<std::size_t>(i); }

}  // namespace brdfit::optim
