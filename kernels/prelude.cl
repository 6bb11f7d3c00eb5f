/* Vocabulary of every kernel text: `real` is one value per lane, `scalar` one value.
 *
 * The host defines REAL_IS_DOUBLE, SEARCH_ACCURACY and LANES (1 on a GPU, a SIMD width on a CPU) before this text. The same text
 * compiles as C++ behind tests/host_kernel.h, so it keeps to functions, structs of `real` and the names below. */
#ifdef __OPENCL_VERSION__

#define PASTE_(a, b) a##b
#define PASTE(a, b) PASTE_(a, b)

#if REAL_IS_DOUBLE
typedef double scalar;
typedef long mask_scalar;
#else
typedef float scalar;
typedef int mask_scalar;
#endif

#if LANES == 1
typedef scalar real;
typedef int mask;
#define sel(condition, yes, no) ((condition) ? (real)(yes) : (real)(no))
#define any_lane(condition) (condition)
#define load_lanes(pointer) (*(pointer))
#define store_lanes(value, pointer) (*(pointer) = (value))
#if REAL_IS_DOUBLE
typedef long bits;
#define as_bits(x) as_long(x)
#define as_real(x) as_double(x)
#else
typedef int bits;
#define as_bits(x) as_int(x)
#define as_real(x) as_float(x)
#endif
#define to_real(x) ((real)(x))
inline scalar sum_lanes(real x) { return x; }
#else
#if REAL_IS_DOUBLE
#define VECTOR(width) PASTE(double, width)
typedef VECTOR(LANES) real;
typedef PASTE(long, LANES) mask;
#define as_bits(x) PASTE(as_long, LANES)(x)
#define as_real(x) PASTE(as_double, LANES)(x)
#define to_real(x) PASTE(convert_double, LANES)(x)
#else
#define VECTOR(width) PASTE(float, width)
typedef VECTOR(LANES) real;
typedef PASTE(int, LANES) mask;
#define as_bits(x) PASTE(as_int, LANES)(x)
#define as_real(x) PASTE(as_float, LANES)(x)
#define to_real(x) PASTE(convert_float, LANES)(x)
#endif
typedef mask bits; /* a number's representation, for arithmetic on its exponent */
#define sel(condition, yes, no) select((real)(no), (real)(yes), (condition))
#define any_lane(condition) any(condition)
/* vload and vstore come in halves from some drivers. */
typedef real unaligned_real __attribute__((aligned(sizeof(scalar))));
#define load_lanes(pointer) (*(global const unaligned_real *)(pointer))
#define store_lanes(value, pointer) (*(global unaligned_real *)(pointer) = (value))
/* Pairwise: the order is fixed, the error small. */
inline scalar sum_2(VECTOR(2) x) { return x.lo + x.hi; }
inline scalar sum_4(VECTOR(4) x) { return sum_2(x.lo + x.hi); }
inline scalar sum_8(VECTOR(8) x) { return sum_4(x.lo + x.hi); }
inline scalar sum_16(VECTOR(16) x) { return sum_8(x.lo + x.hi); }
#define sum_lanes(x) PASTE(sum_, LANES)(x)
#endif

#endif

#define UNROLLED _Pragma("unroll") /* what follows is a loop whose count is known */
#define INLINED static inline __attribute__((always_inline)) /* compilers leave such large functions, and registers, alone */
#define PI 3.14159265358979323846
#define PI_SQUARED 9.86960440108935861883 /* + PI_SQUARED_LOW once rounded */

#if REAL_IS_DOUBLE
#define LOG_HUGE 709.0                     /* a lobe saturates at exp of this instead of overflowing */
#define HUGE_SLOPE 1e308                   /* ... and its slopes here */
#define HUGE_SUMMED 1e130                  /* what is summed in squares saturates here */
#define LOG_LEAST -708.0                   /* exp of it is a normal number */
#define LN2_HIGH 0.6931471805599453        /* + LN2_LOW = ln 2 */
#define LN2_LOW 2.3190468138462996155e-17
#define ROUNDER 6755399441055744.0         /* 1.5 * 2^52: adding it rounds to an integer */
#define MANTISSA_BITS 52
#define LOG_SHIFT 300.0
#define EXP_MINUS_SHIFT 5.148200222412014e-131 /* exp(-LOG_SHIFT) */
#define LOG_UNSEEN 800.0                   /* a series below exp(-this) is 0 whatever its prefactor */
#define HUGE 1e300                         /* short of overflow */
#define TINY 1e-300                        /* keeps a quotient finite where its numerator is 0 */
#define PI_SQUARED_LOW 6.265295508739711e-16
#define COLLINEAR 1e-13                    /* unit columns closer than this, squared, count as one */
#else
#define LOG_HUGE 88.0
#define HUGE_SLOPE 3e38
#define HUGE_SUMMED 1e15
#define LOG_LEAST -87.0
#define LN2_HIGH 0.693145751953125
#define LN2_LOW 1.42860682031e-6
#define ROUNDER 12582912.0
#define MANTISSA_BITS 23
#define LOG_SHIFT 60.0
#define EXP_MINUS_SHIFT 8.75651076269652e-27
#define LOG_UNSEEN 150.0
#define HUGE 1e37
#define TINY 1e-37
#define COLLINEAR 1e-6
#define PI_SQUARED_LOW 2.903715851813345e-07
#endif

/* eps to which series are summed, and what follows from it. */
#if SEARCH_ACCURACY
#define LOG_EPSILON 11.0 /* ln(1/eps) */
#define NEGLIGIBLE 5e-7  /* 0.03 eps */
#define LEFT_MARGIN 2.4  /* ln LOG_EPSILON, and what the slopes need beyond */
#define LAMBERT_STEPS 1
#define MODE_STEPS 0     /* of lambert_w where it only tells the place of a bell */
#elif REAL_IS_DOUBLE
#define LOG_EPSILON 37.5
#define NEGLIGIBLE 1.5e-18
#define LEFT_MARGIN 7.6
#define LAMBERT_STEPS 2
#define MODE_STEPS 1
#else
#define LOG_EPSILON 17.0
#define NEGLIGIBLE 1.2e-9
#define LEFT_MARGIN 6.8
#define LAMBERT_STEPS 1
#define MODE_STEPS 1
#endif
#ifdef SERIES_LOG_EPSILON /* another eps, by the compiler's options: kernels/series.h */
#undef LOG_EPSILON
#undef NEGLIGIBLE
#undef LEFT_MARGIN
#define LOG_EPSILON SERIES_LOG_EPSILON
#define NEGLIGIBLE SERIES_NEGLIGIBLE
#define LEFT_MARGIN SERIES_LEFT_MARGIN
#endif
