/* Special functions that the models share; each works on lanes, has no branch on data and a stated error. */

inline real sqr(real x) { return x * x; }

/* x, short of overflow. */
inline real saturated(real x) { return fmin(fmax(x, (real)-HUGE_SLOPE), (real)HUGE_SLOPE); }

/* exp(x) as mantissa times factor, for x <= LOG_HUGE: the factor, 1 or tiny, holds off underflow until a large prefactor
 * has been multiplied in. */
typedef struct {
    real mantissa, factor;
} Exponential;

inline Exponential exponential(real x) {
    Exponential t;
    const mask deep = x < -LOG_SHIFT;
    t.mantissa = exp(sel(deep, x + LOG_SHIFT, x));
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

/* exp(x^2) erfc(x) for x >= 0: a Chebyshev polynomial of degree 24 for (1 + 2x) erfcx(x) - 1 in q = (x-3)/(x+3),
 * approximation error 1.4e-17. The value lies in [1, 1.27], so rounding stays at a few eps.
 * Coefficients: mpmath.chebyfit with 60 digits (docs/numerics.md). */
inline real erfcx(real x) {
    const real q = (x - 3.0) / (x + 3.0);
    real p = 8.8642190164270920236e-10;
    p = p * q + 9.8857988311393649365e-10;
    p = p * q - 8.5003979297726153534e-9;
    p = p * q - 1.3326364813003833048e-8;
    p = p * q + 4.1807846988455821994e-8;
    p = p * q + 1.0187000600072885081e-7;
    p = p * q - 1.4160064940265986074e-7;
    p = p * q - 6.1664960776043527766e-7;
    p = p * q + 3.5683839153992204616e-7;
    p = p * q + 3.4724146028756860322e-6;
    p = p * q - 7.3151051641590619093e-7;
    p = p * q - 0.000020100567931289228112;
    p = p * q + 4.9494849925705951714e-6;
    p = p * q + 0.00012509935235563107558;
    p = p * q - 0.00010515979981501177668;
    p = p * q - 0.00077983227210839912488;
    p = p * q + 0.0018886903591561552193;
    p = p * q + 0.002529391816066239156;
    p = p * q - 0.023770514918645886956;
    p = p * q + 0.068308027343978475049;
    p = p * q - 0.11927366341530699196;
    p = p * q + 0.12964515870276061969;
    p = p * q - 0.047562294353450872048;
    p = p * q - 0.13562110612458117271;
    p = p * q + 0.25300805826972965294;
    return (1.0 + p) / (1.0 + 2.0 * x);
}

/* Principal Lambert W of z = exp(log_z): Newton's method on W + ln W = ln z, which cannot overflow. Six steps from this
 * start reach full precision for z >= 1e-6; below, W = z - z^2 + 1.5 z^3 is exact to 3e-18. */
inline real lambert_w(real z, real log_z) {
    const mask small = z < 1e-6;
    const real series = z * (1.0 - z * (1.0 - 1.5 * z));
    if (!any_lane(z >= 1e-6)) return series;
    const real target = sel(small, 0.0, log_z);
    real w = sel(z > 1.0, 0.7 * target + 0.3, sel(small, 1.0, z) / (1.0 + z));
    for (int step = 0; step < 6; ++step) w = w * (1.0 + target - log(w)) / (1.0 + w);
    return sel(small, series, w);
}

/* m ln(m/g) - (m - g) >= 0, the exponent of a Poisson weight (Loader's deviance), for m, g > 0. Without cancellation
 * near m = g: a series of atanh in y = (m - g)/(m + g) for |y| < 0.2, else the logarithm, whose absolute error then
 * weighs less than e^-5. */
inline real poisson_deviance(real m, real g) {
    const real difference = m - g;
    const real y = difference / (m + g);
    const real z = sqr(y);
    real p = 1.0 / 25.0;
    p = p * z + 1.0 / 23.0;
    p = p * z + 1.0 / 21.0;
    p = p * z + 1.0 / 19.0;
    p = p * z + 1.0 / 17.0;
    p = p * z + 1.0 / 15.0;
    p = p * z + 1.0 / 13.0;
    p = p * z + 1.0 / 11.0;
    p = p * z + 1.0 / 9.0;
    p = p * z + 1.0 / 7.0;
    p = p * z + 1.0 / 5.0;
    p = p * z + 1.0 / 3.0;
    const real series = y * difference + 2.0 * m * y * z * p;
    const mask near = z < 0.04;
    if (!any_lane(z >= 0.04)) return series;
    return sel(near, series, m * log(m / g) - difference);
}
