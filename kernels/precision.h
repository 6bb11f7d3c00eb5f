/// The arithmetic of a kernel and how far its series are summed.
#pragma once

namespace brdfit::kernels {

/// Arithmetic of the kernels; the host computes in double.
enum class Precision { single_precision, double_precision };

/// How far a kernel's series are summed: to the last digits of the precision, or (search) until values are good to 2e-5
/// and slopes to 2e-4 of their size, for global searches whose end is polished at full accuracy.
enum class Accuracy { full, search };

}  // namespace brdfit::kernels
