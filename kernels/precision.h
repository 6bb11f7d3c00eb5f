/// The arithmetic of a kernel.
#pragma once

namespace brdfit::kernels {

/// Arithmetic of the kernels; the host computes in double.
enum class Precision { single_precision, double_precision };

}  // namespace brdfit::kernels
