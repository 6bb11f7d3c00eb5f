/* Special functions that the models share; each works on lanes, has no branch on data and a stated error. */

inline real sqr(real x) { return x * x; }

/* x, short of overflow. */
inline real saturated(real x) {
    const real low = sel(x > -HUGE_SLOPE, x, -HUGE_SLOPE); /* not fmin, fmax: they look after NaN */
    return sel(low < HUGE_SLOPE, low, HUGE_SLOPE);
}

/* Coefficients of the polynomials below, highest power first: mpmath.chebyfit with 60 digits (docs/numerics.md). */
#if SEARCH_ACCURACY
constant scalar exp_series[] = {8.35720015e-3, 0.0418338041, 0.166666308, 0.49999749};
constant scalar log_series[] = {0.204291347, 0.333317497};
constant scalar deviance_series[] = {0.165320467, 0.19895628, 0.33334033};
constant scalar erfcx_series[] = {
    1.6693729e-3, 1.12684393e-3, -0.0236118649, 0.0692832057, -0.119316217, 0.129383193, -0.0475593272,
    -0.135601716, 0.253008068};
#elif REAL_IS_DOUBLE
constant scalar exp_series[] = {
    2.5100375832561233664e-8, 2.7620075879983366586e-7, 2.7557268480310025526e-6, 2.4801521322368693266e-5,
    1.9841269863040545271e-4, 1.3888888917196719077e-3, 8.3333333333300644495e-3, 0.041666666666624161903,
    0.16666666666666667452, 0.50000000000000010211};
constant scalar log_series[] = {
    0.073082248425217029302, 0.076658608002780206343, 0.090914445626308610401, 0.11111105567397539928,
    0.14285714312987742461, 0.19999999999949752245, 0.33333333333333348431};
constant scalar deviance_series[] = {
    0.076497330660360588559, 0.045941147198392155651, 0.05964454478571132385, 0.06660684092588077903,
    0.076925751029641947022, 0.09090901852699111719, 0.11111111223248141237, 0.14285714284834337684,
    0.2000000000000267275, 0.33333333333333331996};
constant scalar erfcx_series[] = {
    8.8642190164270920236e-10, 9.8857988311393649365e-10, -8.5003979297726153534e-9, -1.3326364813003833048e-8,
    4.1807846988455821994e-8, 1.0187000600072885081e-7, -1.4160064940265986074e-7, -6.1664960776043527766e-7,
    3.5683839153992204616e-7, 3.4724146028756860322e-6, -7.3151051641590619093e-7, -0.000020100567931289228112,
    4.9494849925705951714e-6, 0.00012509935235563107558, -0.00010515979981501177668, -0.00077983227210839912488,
    0.0018886903591561552193, 0.002529391816066239156, -0.023770514918645886956, 0.068308027343978475049,
    -0.11927366341530699196, 0.12964515870276061969, -0.047562294353450872048, -0.13562110612458117271,
    0.25300805826972965294};
#else
constant scalar exp_series[] = {1.392617612e-3, 8.363173075e-3, 0.04166655466, 0.1666657703, 0.5};
constant scalar log_series[] = {0.147899747, 0.1999439028, 0.3333334252};
constant scalar deviance_series[] = {0.1185245578, 0.1080487177, 0.1429916307, 0.1999979603, 0.3333333382};
constant scalar erfcx_series[] = {
    8.00843423e-5, -9.251609368e-5, -7.340984008e-4, 1.875011403e-3, 2.506784385e-3, -0.02376352146, 0.06831319891,
    -0.1192752934, 0.1296447197, -0.04756215484, -0.1356211, 0.2530080563};
#endif

/* real sum = the polynomial with the coefficients `series` at x. */
#define HORNER(sum, x, series) \
    real sum = series[0];      \
    UNROLLED                   \
    for (int i = 1; i < (int)(sizeof(series) / sizeof(series[0])); ++i) sum = fma(sum, x, (real)series[i])

/* exp(x) for x <= LOG_HUGE, 0 below LOG_LEAST: half the time of the built-in function, which has special cases to
 * look after. x = k ln 2 + r; 1 + r + r^2 q(r) with an approximation error of 1.3e-17 (single precision 7.8e-9, search
 * 3.2e-7); k goes into the exponent's bits. */
inline real exp_plain(real x) {
    const mask deep = x < LOG_LEAST; /* false for NaN, which passes through */
    const real bounded = sel(deep, LOG_LEAST, x);
    const real shifted = fma(bounded, (real)1.44269504088896340736, (real)ROUNDER); /* k in the lowest bits */
    const real k = shifted - ROUNDER;
    const real r = fma(k, (real)-LN2_LOW, fma(k, (real)-LN2_HIGH, bounded));
    HORNER(q, r, exp_series);
    const real p = 1.0 + fma(q, sqr(r), r);
    return sel(deep, 0.0, as_real(as_bits(p) + (as_bits(shifted) << MANTISSA_BITS)));
}

/* ln(x) for normal x > 0, to its last digits also near 1: x = 2^k f, 1/2 <= f^2 < 2, ln f = 2 atanh y, y = (f-1)/(f+1), by
 * a polynomial in y^2 with a relative approximation error of 5e-18 (2.8e-9, 4.8e-7). */
inline real log_plain(real x) {
    const bits k = (as_bits(x) - as_bits((real)0.70710678118654752440)) >> MANTISSA_BITS;
    const real f = as_real(as_bits(x) - (k << MANTISSA_BITS));
    const real y = (f - 1.0) / (f + 1.0);
    const real z = sqr(y);
    HORNER(p, z, log_series);
    const real log_f = fma(2.0 * y * z, p, 2.0 * y);
    return fma(to_real(k), (real)LN2_HIGH, fma(to_real(k), (real)LN2_LOW, log_f));
}

/* exp(x) as mantissa times factor, for x <= LOG_HUGE: the factor, 1 or tiny, holds off underflow until a large prefactor
 * has been multiplied in. */
typedef struct {
    real mantissa, factor;
} Exponential;

inline Exponential exponential(real x) {
    Exponential t;
    const mask deep = x < -LOG_SHIFT;
    t.mantissa = exp_plain(sel(deep, x + LOG_SHIFT, x));
    t.factor = sel(deep, EXP_MINUS_SHIFT, 1.0);
    return t;
}

/* A number to twice the precision, high + low. */
typedef struct {
    real high, low;
} Wide;

inline Wide product_of(real x, real y) {
    Wide t;
    t.high = x * y;
    t.low = fma(x, y, -t.high);
    return t;
}

inline Wide sum_of(Wide x, Wide y) {
    Wide t;
    const real sum = x.high + y.high;
    const real from_y = sum - x.high;
    const real low = (x.high - (sum - from_y)) + (y.high - from_y) + (x.low + y.low);
    t.high = sum + low;
    t.low = low - (t.high - sum);
    return t;
}

/* Complex numbers, for Fresnel's equations. */
typedef struct {
    real re, im;
} complex_real;

inline complex_real complex_of(real re, real im) {
    complex_real z;
    z.re = re;
    z.im = im;
    return z;
}

inline complex_real complex_times(complex_real a, complex_real b) {
    return complex_of(a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re);
}

inline complex_real complex_conjugate(complex_real a) { return complex_of(a.re, -a.im); }

inline complex_real complex_scaled(complex_real a, real factor) { return complex_of(a.re * factor, a.im * factor); }

/* exp(x^2) erfc(x) for x >= 0: a Chebyshev polynomial of degree 24 (11, 8) for (1 + 2x) erfcx(x) - 1 in q = (x-3)/(x+3),
 * approximation error 1.4e-17 (6.9e-9, 2.3e-6). The value lies in [1, 1.27], so rounding stays at a few eps. */
inline real erfcx(real x) {
    const real inverse = 1.0 / ((x + 3.0) * (1.0 + 2.0 * x));
    const real q = (x - 3.0) * (1.0 + 2.0 * x) * inverse;
    HORNER(p, q, erfcx_series);
    return (1.0 + p) * (x + 3.0) * inverse;
}

/* Principal Lambert W of 0 <= z <= HUGE: from a start that is good to 0.5 % by Fritsch's step, whose error is of fourth
 * order: one leaves 1.2e-11, two the precision's own. */
inline real lambert_w(real z, int steps) {
    const mask small = z < 1e-6;
    const real series = z * (1.0 - z * (1.0 - 1.5 * z));
    if (!any_lane(z >= 1e-6)) return series;
    const real bounded = sel(small, 1.0, z);
    const real t = log_plain(1.0 + bounded);
    real w = t * (1.0 + t * (0.66952 + 0.11113 * t)) / (1.0 + t * (1.16952 + 0.11117 * t));
    for (int step = 0; step < steps; ++step) {
        const real miss = log_plain(bounded / w) - w;
        const real q = 2.0 * (1.0 + w) * (1.0 + w + (2.0 / 3.0) * miss);
        w = w + w * (miss * (q - miss) / ((1.0 + w) * (q - 2.0 * miss)));
    }
    return sel(small, series, w);
}

/* m ln(m/g) - (m - g) >= 0, the exponent of a Poisson weight (Loader's deviance), for m = u^2, g = u_g^2 and
 * difference = m - g. Without cancellation: w = (u - u_g)/(u + u_g), ln(m/g) = 4 atanh w by a polynomial for
 * w^2 < 0.1 (its error beyond grows more slowly than the weight falls, unless the bell lies there: far), else the
 * logarithm. inverse_sum = 1/(u + u_g)^2, inverse_g = 1/g. */
inline real poisson_deviance(real u, real u_g, real difference, real inverse_sum, real inverse_g, int far) {
    const real m = sqr(u);
    const real w = difference * inverse_sum;
    const real z = sqr(w);
    HORNER(p, z, deviance_series);
    const real near = z * fma(4.0 * m * w, p, (u + u_g) * (3.0 * u + u_g));
    if (!far) return near;
    return sel(z < 0.1, near, m * log_plain(m * inverse_g) - difference);
}
