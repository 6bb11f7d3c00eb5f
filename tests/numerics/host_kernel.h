/// The kernel text as host C++: the vocabulary of kernels/prelude.cl, and where compiled kernels register. The
/// generated source (host_kernel_generator.cpp) includes this and holds each model's text in a namespace of its own.
#pragma once

#include <algorithm>
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
    /// candidates x OUT_STRIDE
    std::vector<double> (*project)(std::span<const double> columns, std::span<const double> y,
                                   std::span<const double> w, std::span<const double> parameters,
                                   std::span<const double> lower, std::span<const double> upper);
    /// "project", or without gradient "project_value", on buffers of the precision's numbers. Nothing is copied.
    void (*project_in_place)(bool gradient, const void* columns, const void* y, const void* w, int samples,
                             int candidates, const void* in, void* scratch, void* out);
};

/// Compiled with double literals, and with float ones.
std::span<const HostKernel> host_kernels_double();
std::span<const HostKernel> host_kernels_single();

}  // namespace brdfit::tests

#ifdef BRDFIT_HOST_KERNEL  // the generated sources only
using std::exp, std::floor, std::fma, std::fmax, std::fmin, std::log, std::min, std::sqrt;
#define kernel
#define global
#define constant static const
#if REAL_IS_DOUBLE
typedef double scalar;
typedef long mask_scalar;
#else
typedef float scalar;
typedef int mask_scalar;
#endif
inline std::size_t get_global_id(int) { return 0; }
inline std::size_t get_global_size(int) { return 1; }

#if LANES == 1
typedef scalar real;
typedef int mask;
#define sel(condition, yes, no) ((condition) ? (real)(yes) : (real)(no))
#define any_lane(condition) (condition)
#define load_lanes(pointer) (*(pointer))
#define store_lanes(value, pointer) (*(pointer) = (value))
#define sum_lanes(x) (x)
#define fabs(x) std::fabs(x)
typedef mask_scalar bits;
inline std::int64_t as_bits(double x) { return std::bit_cast<std::int64_t>(x); }
inline std::int32_t as_bits(float x) { return std::bit_cast<std::int32_t>(x); }
inline double as_real(std::int64_t x) { return std::bit_cast<double>(x); }
inline float as_real(std::int32_t x) { return std::bit_cast<float>(x); }
#define to_real(x) static_cast<real>(x)
#else  // clang's vectors, 512 bits wide; log from glibc's libmvec, for the loss of logarithms
using std::fabs;
typedef scalar real __attribute__((ext_vector_type(LANES)));
typedef mask_scalar mask __attribute__((ext_vector_type(LANES)));
typedef real unaligned_real __attribute__((aligned(sizeof(scalar))));
#define sel(condition, yes, no) ((condition) ? (real)(yes) : (real)(no))
typedef mask bits;
inline bits as_bits(real x) { return std::bit_cast<bits>(x); }
inline real as_real(bits x) { return std::bit_cast<real>(x); }
inline real to_real(bits x) { return __builtin_convertvector(x, real); }
inline bool any_lane(mask condition) { return __builtin_reduce_or(condition) != 0; }
inline real load_lanes(const scalar* pointer) { return *(const unaligned_real*)pointer; }
inline void store_lanes(real value, scalar* pointer) { *(unaligned_real*)pointer = value; }
inline scalar sum_lanes(real x) {
    for (int width = LANES / 2; width > 0; width /= 2)
        for (int i = 0; i < width; ++i) x[i] += x[i + width];
    return x[0];
}
#if REAL_IS_DOUBLE
#define VECTOR_FUNCTION(name) _ZGVeN8v_##name
#else
#define VECTOR_FUNCTION(name) _ZGVeN16v_##name##f
#endif
extern "C" real VECTOR_FUNCTION(log)(real);
inline real log(real x) { return VECTOR_FUNCTION(log)(x); }
inline real fabs(real x) { return __builtin_elementwise_abs(x); }
inline real floor(real x) { return __builtin_elementwise_floor(x); }
inline real fmin(real x, real y) { return __builtin_elementwise_min(x, y); }
inline real fmax(real x, real y) { return __builtin_elementwise_max(x, y); }
// The compiler makes one instruction of each loop.
inline real sqrt(real x) {
    for (int i = 0; i < LANES; ++i) x[i] = std::sqrt(x[i]);
    return x;
}
inline real fma(real x, real y, real z) {
    for (int i = 0; i < LANES; ++i) z[i] = std::fma(x[i], y[i], z[i]);
    return z;
}
#endif

/// A column of the kernel's type.
template <typename Scalar>
std::vector<Scalar> narrowed(std::span<const double> values) {
    std::vector<Scalar> result;
    for (const double value : values) result.push_back(static_cast<Scalar>(value));
    return result;
}
#endif
