/// The arithmetic of a kernel and how far its series are summed.
#pragma once

namespace brdfit::kernels {

/// Arithmetic of the kernels; the host computes in double.
enum class Precision { single_precision, double_precision };

/// How far a kernel's series are summed: to the last digits of the precision, or (search) to a few 1e-5 of their value,
/// for global searches whose end is polished at full accuracy. Models without a series are the same in both.
enum class Accuracy { full, search };

}  // namespace brdfit::kernels
