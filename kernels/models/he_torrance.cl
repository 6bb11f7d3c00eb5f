/*{
  "title": "He-Torrance: physical optics of a rough surface, unpolarised, with a uniform diffuse term",
  "source": "He, Torrance, Sillion, Greenberg 1991, corrected as in docs/numerics.md; without the ideal specular spike",
  "formula": "f = rho_ud/pi + F(theta_d) G S(theta_i) S(theta_r) D / (pi cos theta_i cos theta_r)",
  "parameters": [
    {"name": "sigma", "unit": "wavelength", "min": 1e-3, "max": 20, "domain": [0, 1e5], "typical": [0.02, 4],
     "scale": "log", "doc": "rms height of the surface"},
    {"name": "tau", "unit": "wavelength", "min": 0.1, "max": 200, "domain": [0, 1e6], "typical": [0.5, 60],
     "scale": "log", "doc": "autocorrelation length of the surface"},
    {"name": "n", "unit": "1", "min": 0.05, "max": 20, "domain": [1e-6, 1e6], "scale": "log",
     "doc": "real part of the refractive index"},
    {"name": "k", "unit": "1", "min": 0, "max": 20, "domain": [0, 1e6], "scale": "linear",
     "doc": "imaginary part of the refractive index"},
    {"name": "rho_ud", "unit": "1", "min": 0, "max": 1, "domain": [0, 1e30], "scale": "linear",
     "doc": "albedo of the uniform diffuse part"}
  ],
  "terms": [
    {"name": "diffuse", "factor": "rho_ud"},
    {"name": "lobe", "of": ["sigma", "tau", "n", "k"]}
  ],
  "charts": [{"kind": "complex_index", "parameters": ["n", "k"]}],
  "special_cases": [{"name": "real index", "fixed": {"k": 0}}, {"name": "no lobe", "fixed": {"n": 1, "k": 0}}],
  "submodels": [
    {"name": "no diffuse term", "fixed": {"rho_ud": 0}},
    {"name": "real index", "fixed": {"k": 0}},
    {"name": "no effective roughness", "define": "roughness_as_given"}
  ],
  "traits": {"reciprocal": true, "energy_conserving": false}
}*/

/* What rounding would do to g, a and h shows in the slopes by sigma and tau, which are differences of large terms. */
inline Wide quotient_of(real x, real y) {
    Wide t;
    const real inverse = 1.0 / y;
    t.high = x * inverse;
    t.low = fma(-t.high, y, x) * inverse;
    return t;
}

/* (pi x)^2 */
inline Wide pi_times_squared(Wide x) {
    const Wide square = product_of(x.high, x.high);
    Wide t = product_of(square.high, (real)PI_SQUARED);
    t.low += square.high * PI_SQUARED_LOW + (square.low + 2.0 * x.high * x.low) * PI_SQUARED;
    return t;
}

/* Shadowing S1 of one direction, K = tan theta erfc(h), and their slopes by ln h; h = tau cot theta / (2 sigma). */
typedef struct {
    real S, S_slope; /* S1 and d ln S1/d ln h */
    real K, K_slope; /* K and d K/d ln h */
} Shadow;

inline Shadow shadow(real tan_theta, Wide slope) {
    Shadow t;
    t.S = 1.0;
    t.S_slope = 0.0;
    t.K = 0.0;
    t.K_slope = 0.0;
    /* Beyond h = 30 the surface is flat to this direction in every digit. What rounding takes off h and h^2 goes back
     * into E = exp(-h^2) and erfc(h), which would magnify it. */
    const real twice = 2.0 * fmax(tan_theta, (real)TINY);
    const real inverse = 1.0 / twice;
    const real quotient = slope.high * inverse;
    const mask steep = quotient < sqrt((real)LOG_EPSILON) + 0.5;
    if (!any_lane(steep)) return t;
    const real h = fmin(quotient, (real)30.0);
    const real h_low = sel(steep, (fma(-h, twice, slope.high) + slope.low) * inverse, 0.0);
    const Wide h2 = product_of(h, h);
    const real E_high = exp_plain(-h2.high);
    const real E = E_high - E_high * (h2.low + 2.0 * h * h_low);
    const real erfc_h = E_high * (erfcx(h) * (1.0 - h2.low) - 2.0 / sqrt((real)PI) * h_low);
    const real erfc_minus_h = 2.0 - erfc_h;
    const real x = sqrt((real)PI) * fma(h, erfc_minus_h, h_low * erfc_minus_h);
    const real inverse_sum = 1.0 / (x + E);
    t.S = x * inverse_sum;
    t.S_slope = E * (inverse_sum + 2.0 / sqrt((real)PI) * h / erfc_minus_h);
    t.K = tan_theta * erfc_h;
    t.K_slope = -2.0 / sqrt((real)PI) * tan_theta * h * E;
    return t;
}

/* Unpolarised Fresnel reflectance at theta_d for the index n + ik, and its slopes. */
typedef struct {
    real F, F_n, F_k;
} Fresnel;

inline Fresnel fresnel(real n, real k, real cd2, real sd2) {
    Fresnel t;
    const real c = sqrt(cd2);
    const complex_real N = complex_of(n, k);
    const complex_real N2 = complex_of((n - k) * (n + k), 2.0 * n * k);
    const complex_real N2_1 = complex_of((n - 1.0) * (n + 1.0) - sqr(k), N2.im); /* N^2 - 1, exact near 1 */

    /* q = sqrt(N^2 - sin^2 theta_d) = a + ib: the larger of a, b by its formula, the other by a b = n k. */
    const real A = sel(sd2 < 0.5, fma(n, n, -sd2) - sqr(k), N2_1.re + cd2); /* the form that cancels less */
    const mask refracts = A >= 0.0;
    const real longer = fmax(fabs(A), N2.im);
    const real ratio = fmin(fabs(A), N2.im) / fmax(longer, (real)TINY);
    const real large = 0.5 * (longer * sqrt(1.0 + sqr(ratio)) + fabs(A)); /* 0 at the onset of total reflection */
    const real root = sqrt(large);
    const real other = n * k / fmax(root, (real)TINY);
    const complex_real q = complex_of(sel(refracts, root, other), sel(refracts, other, root));
    const real b2 = sel(refracts, sqr(other), large);

    const real difference = sel(refracts, (N2_1.re + b2) / (q.re + c), q.re - c); /* a - c, exact near N = 1 */
    const real s_norm = sqr(q.re + c) + b2;                                       /* |q + c|^2 */
    const real qc_norm = sqr(q.re * c + sd2) + b2 * cd2;                          /* |q c + s^2|^2 = |N^2 c + q|^2/s_norm */
    const real inverse_s = 1.0 / s_norm;
    const real inverse_qc = 1.0 / qc_norm;
    const real inverse_both = inverse_s * inverse_qc;
    const real Rs = (sqr(difference) + b2) * inverse_s;
    const real p_over_s = (sqr(q.re * c - sd2) + b2 * cd2) * inverse_qc;
    t.F = 0.5 * Rs * (1.0 + p_over_s);

    /* dF/dN = conj(r_s) r_s' + conj(r_p) r_p'; as c^2 - q^2 = 1 - N^2 and N^4 c^2 - q^2 = (N^2 - 1)(N^2 c^2 - s^2) it is
     * 2c N conj(q)/|q|^2 [conj(N^2 - 1)/|q + c|^4 + (N^2 - 2 s^2) conj((N^2 - 1)(N^2 c^2 - s^2))/|N^2 c + q|^4],
     * without a difference of nearly equal terms. dF/dn is its real part, dF/dk minus its imaginary part. */
    const real q_norm = fmax(sqr(other) + large, (real)TINY);
    const complex_real s_part = complex_scaled(complex_scaled(complex_conjugate(N2_1), inverse_s), inverse_s);
    const real brewster = sel(sd2 < 0.5, A - N2.re * sd2, N2.re * cd2 - sd2); /* Re(N^2 c^2 - s^2) */
    const complex_real p_part = complex_times(
        complex_times(complex_scaled(complex_conjugate(N2_1), inverse_both), complex_of(brewster, -N2.im * cd2)),
        complex_scaled(complex_of(N2.re - 2.0 * sd2, N2.im), inverse_both));
    const complex_real N_q = complex_scaled(complex_times(N, complex_conjugate(q)), 2.0 * c / q_norm);
    const complex_real slope = complex_times(N_q, complex_of(s_part.re + p_part.re, s_part.im + p_part.im));
    t.F_n = slope.re;
    t.F_k = -slope.im;
    return t;
}

/* Step of the trapezoidal rule in widths of the bell; the least that is added to u, as a share of it; Stirling's error,
 * ln m! less its main terms, is STIRLING/m with z = 1/m^2, and -m times its derivative STIRLING_SLOPE/m. */
#if SEARCH_ACCURACY
#define STRIDE 1.2
#define STIRLING (1.0 / 12.0)
#define STIRLING_SLOPE (1.0 / 12.0)
#elif REAL_IS_DOUBLE
#define STRIDE 0.66
#define STIRLING \
    (1.0 / 12.0 - \
     z * (1.0 / 360.0 - z * (1.0 / 1260.0 - z * (1.0 / 1680.0 - z * (1.0 / 1188.0 - z * (691.0 / 360360.0))))))
#define STIRLING_SLOPE (1.0 / 12.0 - z * (1.0 / 120.0 - z * (1.0 / 252.0 - z * (1.0 / 240.0 - z * (1.0 / 132.0)))))
#else
#define STRIDE 0.97
#define STIRLING (1.0 / 12.0 - z * (1.0 / 360.0 - z * (1.0 / 1260.0)))
#define STIRLING_SLOPE (1.0 / 12.0 - z * (1.0 / 120.0))
#endif
#ifdef SERIES_LOG_EPSILON
#undef STRIDE
#define STRIDE SERIES_STRIDE
#endif
#if REAL_IS_DOUBLE
#define LEAST_STRIDE 1e-15
#else
#define LEAST_STRIDE 1e-6
#endif

/* Sums over m >= 1 of the Poisson weights t_m = e^-g g^m/m! e^(-a/m), each to be multiplied by height twice, so that
 * neither leaves the range of numbers before the product does; the height is 1 unless the sums are tiny:
 * M1 = sum t_m/m, M2 = sum t_m/m^2 = -dM1/da, Q = sum t_m (m - g)/m = g dM1/dg. */
typedef struct {
    real M1, M2, Q, height;
} Series;

inline Series poisson_series(real g, real a) {
    Series t;
    t.M1 = 0.0;
    t.M2 = 0.0;
    t.Q = 0.0;
    t.height = 0.0;

    /* Mode: m = g e^(W/2), W e^W = 2 a/g^2, as ln(m/g) = a/m^2. */
    const real inverse_g = 1.0 / g;
    const real z_W = 2.0 * a * inverse_g * inverse_g;
    real W = lambert_w(fmin(z_W, (real)HUGE), MODE_STEPS);
    const mask beyond = z_W > HUGE; /* both directions graze: W from W + ln W = ln z */
    if (any_lane(beyond)) {
        const real log_z = log_plain(sel(beyond, 2.0 * a, 1.0)) + 2.0 * log_plain(inverse_g);
        const real bounded = sel(beyond, log_z, 100.0);
        W = sel(beyond, bounded - log_plain(bounded - log_plain(bounded)), W);
    }
    const real growth = exp_plain(fmin(0.5 * W, (real)LOG_HUGE));
    const real mode = fmax(g * growth, (real)1.0);
    const real peak = g * sel(W < 0.1, W * (0.5 + W * (0.375 + W * (5.0 / 48.0))), growth * (W - 1.0) + 1.0);
    const mask seen = peak < LOG_UNSEEN;
    if (!any_lane(seen)) return t;
    const real lift = sel(peak > LOG_SHIFT, peak, 0.0); /* what the sums are scaled by */
    const int lifted = any_lane(lift > 0.0);
    t.height = 1.0;

    /* A bell's sum is its integral where it is wide and nothing is left of it at m = 1, nor of the singularity at m = 0:
     * their exponents are g - ln g - 1 + a and g + 2 sqrt(pi a), and ln g <= g/L + ln L - 1. Stirling's series needs a
     * mode that is not small. Beyond the mode terms fall faster and faster, so a sum may end once a term is negligible. */
    const real L = LOG_EPSILON;
    const real negligible = NEGLIGIBLE;
    const real start = g - g / L - LEFT_MARGIN + fmin(a, 2.0 * sqrt((real)PI * a));
    const mask smooth = (mode > 0.8 * L) & (mode > (0.075 * L) * (1.0 + W)) & (start > peak + L);
    mask direct = seen & !smooth;
    /* Lanes of both kinds cost both loops: a few more terms of the sum are cheaper than the other loop. */
    if (any_lane(direct) && !any_lane(seen & smooth & (mode > 1.6 * L))) direct = seen;
    const mask bell = seen & !direct;

    /* A sum from m = 1: the weights e^-g g^m/m! by their recurrence. The same m in every lane, four between looks at the
     * end. Weight and exponential each take a share of the height. */
    if (any_lane(direct)) {
        const real weight_shift = fmin(lift, (real)LOG_SHIFT);
        const real shift = fmin(lift - weight_shift, (real)LOG_SHIFT);
        real weight = sel(direct, g * exp_plain(-g), 0.0);
        if (lifted) {
            weight *= exp_plain(weight_shift);
            t.height = exp_plain(-0.5 * (weight_shift + shift));
        }
        scalar m = 1.0;
        mask active = direct;
        while (any_lane(active)) {
            real term = 0.0;
            UNROLLED for (int i = 0; i < 4; ++i) {
                const scalar inverse = (scalar)1.0 / m;
                term = weight * exp_plain(fma(a, (real)-inverse, shift)) * inverse;
                t.M1 += term;
                t.M2 += term * inverse;
                t.Q = fma(term, m - g, t.Q); /* the sum cancels */
                m += (scalar)1.0;
                weight *= g * ((scalar)1.0 / m);
            }
            active = direct & ((m <= mode) | (term > negligible * t.M1));
        }
    }

    /* A smooth bell by the trapezoidal rule in u = sqrt(m), where it is as wide for any g: 30 terms (14, 10), each in its
     * saddle-point form. For Q, sum t_m (m - g)/m cancels; as the integral of dt/dm vanishes over the bell, the
     * logarithmic derivative of t_m may be taken off and leaves terms of the order of the sum. */
    if (any_lane(bell)) {
        Series b;
        b.M1 = 0.0;
        b.M2 = 0.0;
        b.Q = 0.0;
        /* Steps on a grid where u is exact: a sum of what rounding shifts would show the slope of the bell. */
        const real root = sqrt(mode);
        const real u_g = sqrt(g);
        const int far = any_lane(bell & (W > 1.0));
        const real width = 0.5 / sqrt(1.0 + W);
        const real grid = 4.0 * root;
        const real stride = fmax((STRIDE * width + grid) - grid, LEAST_STRIDE * root);
        const real reach = sqrt(8.0 * L) * width;
        const real left = mode - mode * (reach / (root + reach / 6.0)); /* a bound on where the bell begins */
        real u = (sqrt(fmax(left, (real)1.0)) + grid) - grid;
        mask active = bell;
        while (any_lane(active)) {
            real term = 0.0;
            UNROLLED for (int i = 0; i < 2; ++i) {
                const real m = sqr(u);
                const real sum = sqr(u + u_g);
                const real both = 1.0 / (m * sum); /* one division for two quotients */
                const real inverse = sum * both;
                const real z = sqr(inverse);
                const real deviance = poisson_deviance(u, u_g, fma(u, u, -g), m * both, inverse_g, far);
                const real stirling = STIRLING;
                const real stirling_slope = STIRLING_SLOPE;
                term = exp_plain(lift - deviance - a * inverse - inverse * stirling) * inverse;
                b.M1 += term;
                b.M2 += term * inverse;
                b.Q += term * (a * inverse - deviance - 0.5 + inverse * stirling_slope);
                u += stride;
            }
            active = bell & ((u <= root) | (term > negligible * b.M1));
        }
        const real factor = stride * (2.0 / sqrt((real)(2.0 * PI)));
        t.M1 = sel(bell, factor * b.M1, t.M1);
        t.M2 = sel(bell, factor * b.M2, t.M2);
        t.Q = sel(bell, factor * b.Q, t.Q);
        if (lifted) t.height = sel(bell, exp_plain(-0.5 * lift), t.height);
    }
    return t;
}

/* x height^2, in this order (see Series); saturates. */
inline real raised(real x, Series M) { return saturated(x) * M.height * M.height; }

void brdf(Params p, Geometry s, Terms *f) {
    f->diffuse.value = 1.0 / PI;

    const real sigma = fmax(p.sigma, (real)1e-18); /* no division by 0 */
    const real tau = fmax(p.tau, (real)1e-18);
    const Wide slope = quotient_of(tau, sigma);
    const Shadow in = shadow(s.ti, slope);
    const Shadow out = shadow(s.tr, slope);

    /* Effective roughness: sigma_e^2 = sigma^2/(1 + W), W e^W = (K_i + K_r)^2/(8 pi). */
#if ROUGHNESS_AS_GIVEN
    const real inverse_W = 1.0;
    const real l = 0.0;
#else
    const real K = in.K + out.K;
    const real c = fmax(K, (real)TINY) / sqrt((real)(8.0 * PI));
    const real W = lambert_w(sqr(c), LAMBERT_STEPS);
    const real inverse_W = 1.0 / (1.0 + W);
    const real l = -2.0 * W * sqr(inverse_W) * ((in.K_slope + out.K_slope) / fmax(K, (real)TINY)); /* d ln sigma_e^2/d ln h */
#endif

    const Wide height2 = pi_times_squared(product_of(sigma, s.cs));
    const real g = fmax(4.0 * (height2.high + height2.low) * inverse_W, (real)TINY); /* keeps m/g finite */
    const Wide T = pi_times_squared(product_of(tau, (real)1.0));
    const real a = fma(T.high, s.w, T.low * s.w);
    const Series M = poisson_series(g, a);
    const Fresnel F = fresnel(p.n, p.k, s.cd2, s.sd2);

    const mask rough = (p.sigma > 0.0) & (p.tau > 0.0); /* else there is no lobe */
    const real prefactor = s.G * (in.S / s.ci) * (out.S / s.cr) * (sqr(tau) * (PI / 4.0));
    const real base = sel(rough, fmin(prefactor, (real)HUGE_SLOPE), 0.0);
    const real shadows = M.M1 * (in.S_slope + out.S_slope);
    f->lobe.value = raised(base * F.F * M.M1, M);
    f->lobe.sigma = raised(base * F.F * ((M.Q * (2.0 - l) - shadows) / sigma), M);
    f->lobe.tau = raised(base * F.F * ((2.0 * M.M1 - 2.0 * a * M.M2 + M.Q * l + shadows) / tau), M);
    f->lobe.n = raised(base * M.M1 * F.F_n, M);
    f->lobe.k = raised(base * M.M1 * F.F_k, M);
}
