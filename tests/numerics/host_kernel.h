/// The kernel text as host C++: the vocabulary of kernels/prelude.cl for one lane, and where compiled kernels register.
/// The generated source (host_kernel_generator.cpp) includes this and holds each model's text in a namespace of its
/// own.
#pragma once

#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "kernels/engine.h"

namespace brdfit::tests {

/// One model's kernels; arguments as in kernels/residual.cl, in double outside.
struct HostKernel {
    std::string_view label;  ///< as tests::label() writes it
    kernels::Precision precision;
    /// candidates x term values x samples
    std::vector<double> (*terms)(std::span<const double> columns, int samples, std::span<const double> parameters);
    /// candidates x (1 + 2 terms + parameters)
    std::vector<double> (*project)(std::span<const double> columns, std::span<const double> y,
                                   std::span<const double> w, std::span<const double> parameters,
                                   std::span<const double> lower, std::span<const double> upper);
};

/// Compiled with double literals, and with float ones.
std::span<const HostKernel> host_kernels_double();
std::span<const HostKernel> host_kernels_single();

}  // namespace brdfit::tests

#ifdef BRDFIT_HOST_KERNEL  // the generated sources only
using std::exp, std::floor, std::fma, std::fmax, std::fmin, std::log, std::sqrt;
#define kernel
#define global
#define constant static const
#define sel(condition, yes, no) ((condition) ? (real)(yes) : (real)(no))
#define any_lane(condition) (condition)
#define load_lanes(pointer) (*(pointer))
#define store_lanes(value, pointer) (*(pointer) = (value))
#define sum_lanes(x) (x)
#define fabs(x) std::fabs(x)
inline std::int64_t as_bits(double x) { return std::bit_cast<std::int64_t>(x); }
inline std::int32_t as_bits(float x) { return std::bit_cast<std::int32_t>(x); }
inline double as_real(std::int64_t x) { return std::bit_cast<double>(x); }
inline float as_real(std::int32_t x) { return std::bit_cast<float>(x); }
#define to_real(x) static_cast<real>(x)
typedef int mask;
inline std::size_t get_global_id(int) { return 0; }
inline std::size_t get_global_size(int) { return 1; }

/// A column of the kernel's type.
template <typename Scalar>
std::vector<Scalar> narrowed(std::span<const double> values) {
    std::vector<Scalar> result;
    for (const double value : values) result.push_back(static_cast<Scalar>(value));
    return result;
}
#endif
