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
  "special_cases": [{"name": "real index", "fixed": {"k": 0}}],
  "traits": {"reciprocal": true, "energy_conserving": false}
}*/

/* What rounding would do to g, a and h shows in the slopes by sigma and tau, which are differences of large terms. */
inline Wide quotient_of(real x, real y) {
    Wide t;
    t.high = x / y;
    t.low = fma(-t.high, y, x) / y;
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
    /* Beyond h = 30 the surface is flat to this direction in every digit. What rounding takes off h and h^2 goes back
     * into E = exp(-h^2) and erfc(h), which would magnify it. */
    const real twice = 2.0 * fmax(tan_theta, (real)TINY);
    const real quotient = slope.high / twice;
    const real h = fmin(quotient, (real)30.0);
    const real h_low = sel(quotient < 30.0, (fma(-h, twice, slope.high) + slope.low) / twice, 0.0);
    const Wide h2 = product_of(h, h);
    const real E_high = exp(-h2.high);
    const real E = E_high - E_high * (h2.low + 2.0 * h * h_low);
    const real erfc_h = E_high * (erfcx(h) * (1.0 - h2.low) - 2.0 / sqrt((real)PI) * h_low);
    const real erfc_minus_h = 2.0 - erfc_h;
    const real x = sqrt((real)PI) * fma(h, erfc_minus_h, h_low * erfc_minus_h);
    t.S = x / (x + E);
    t.S_slope = E / (x + E) + 2.0 * h2.high * E / x;
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

    /* q = sqrt(N^2 - sin^2 theta_d) = a + ib: the larger of a^2, b^2 by its formula, the other by a b = n k. */
    const real A = sel(sd2 < 0.5, fma(n, n, -sd2) - sqr(k), N2_1.re + cd2); /* the form that cancels less */
    const mask refracts = A >= 0.0;
    const real longer = fmax(fabs(A), N2.im);
    const real ratio = fmin(fabs(A), N2.im) / fmax(longer, (real)TINY);
    const real large = 0.5 * (longer * sqrt(1.0 + sqr(ratio)) + fabs(A)); /* 0 at the onset of total reflection */
    const real small = sqr(n * k) / fmax(large, (real)TINY);
    const real a = sqrt(sel(refracts, large, small));
    const real b2 = sel(refracts, small, large);
    const complex_real q = complex_of(a, sqrt(b2));

    const real difference = sel(refracts, (N2_1.re + b2) / (a + c), a - c); /* a - c, exact near N = 1 */
    const real s_norm = sqr(a + c) + b2;
    const real Rs = (sqr(difference) + b2) / s_norm;
    const real p_over_s = (sqr(a * c - sd2) + b2 * cd2) / (sqr(a * c + sd2) + b2 * cd2);
    t.F = 0.5 * Rs * (1.0 + p_over_s);

    /* dF/dN = conj(r_s) r_s' + conj(r_p) r_p'; as c^2 - q^2 = 1 - N^2 and N^4 c^2 - q^2 = (N^2 - 1)(N^2 c^2 - s^2) it is
     * 2c N conj(q)/|q|^2 [conj(N^2 - 1)/|q + c|^4 + (N^2 - 2 s^2) conj((N^2 - 1)(N^2 c^2 - s^2))/|N^2 c + q|^4],
     * without a difference of nearly equal terms. dF/dn is its real part, dF/dk minus its imaginary part. */
    const real q_norm = fmax(large + small, (real)TINY);
    const real p_norm = sqr(N2.re * c + q.re) + sqr(N2.im * c + q.im);
    const complex_real s_part = complex_scaled(complex_scaled(complex_conjugate(N2_1), 1.0 / s_norm), 1.0 / s_norm);
    const real brewster = sel(sd2 < 0.5, A - N2.re * sd2, N2.re * cd2 - sd2); /* Re(N^2 c^2 - s^2) */
    const complex_real p_part = complex_times(
        complex_times(complex_scaled(complex_conjugate(N2_1), 1.0 / p_norm), complex_of(brewster, -N2.im * cd2)),
        complex_scaled(complex_of(N2.re - 2.0 * sd2, N2.im), 1.0 / p_norm));
    const complex_real N_q = complex_scaled(complex_times(N, complex_conjugate(q)), 2.0 * c / q_norm);
    const complex_real slope = complex_times(N_q, complex_of(s_part.re + p_part.re, s_part.im + p_part.im));
    t.F_n = slope.re;
    t.F_k = -slope.im;
    return t;
}

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

    /* Mode: ln(m/g) = a/m^2. The function is concave and rising: Newton's steps converge from the left. */
    const real m_upper = 0.5 * (g + sqrt(sqr(g) + 4.0 * a));
    const real ratio = m_upper / g;
    real mode = sel(ratio > 2.718281828, fmax(g, sqrt(a / log(fmax(ratio, (real)2.7)))), m_upper);
    for (int step = 0; step < 3; ++step) {
        const real a_m2 = a / mode / mode;
        mode = fmax(mode - mode * (log(mode / g) - a_m2) / (1.0 + 2.0 * a_m2), mode / 3.0);
    }
    const real width = sqrt(mode / (1.0 + 2.0 * (a / mode / mode)));
    mode = fmax(mode, (real)1.0);
    const real peak = poisson_deviance(mode, g) + a / mode;
    const mask seen = peak < LOG_UNSEEN;
    if (!any_lane(seen)) return t;
    const real lift = sel(peak > LOG_SHIFT, peak, 0.0); /* what the sums are scaled by */

    /* The window that holds all but eps of the sum, log_epsilon = ln(1/eps); its upper end is a Bernstein bound. Beyond
     * the mode terms fall faster and faster, so a sum may end once a term is negligible. */
    const real L = LOG_EPSILON;
    const real negligible = 0.03 * exp(-L);
    const real low = mode - sqrt(2.0 * L * mode) - 1.0;
    const real high = mode + L / 3.0 + sqrt(sqr(L) / 9.0 + 2.0 * L * mode);
    const mask direct = seen & (low < 2.0);
    const mask bell = seen & (low >= 2.0);

    /* A window from m = 1: the weights e^-g g^m/m! by their recurrence, with a low part that keeps its rounding from
     * adding up; Q, where sqrt(g) digits cancel, would show it. The same m in every lane, four between looks at the end.
     * Weight and exponential each take a share of the height. */
    if (any_lane(direct)) {
        const real weight_shift = fmin(lift, (real)LOG_SHIFT);
        const real shift = fmin(lift - weight_shift, (real)LOG_SHIFT);
        real weight = sel(direct, g * exp(-g) * exp(weight_shift), 0.0);
        real weight_low = 0.0;
        scalar m = 1.0;
        mask active = direct;
        while (any_lane(active)) {
            real M1 = 0.0, M2 = 0.0, Q = 0.0, term = 0.0;
            for (int i = 0; i < 4; ++i) {
                const scalar inverse = (scalar)1.0 / m;
                term = (weight + weight_low) * exp(shift - a * inverse) * inverse;
                M1 += term;
                M2 += term * inverse;
                Q += term * (m - g);
                m += (scalar)1.0;
                const real step = g / m;
                const real step_low = fma(-step, (real)m, g) / m;
                const real next = weight * step;
                weight_low = fma(weight, step, -next) + (weight * step_low + weight_low * step);
                weight = next;
            }
            t.M1 += M1;
            t.M2 += M2;
            t.Q += Q;
            active = direct & (m <= high) & ((m <= mode) | (term > negligible * t.M1));
        }
        t.height = exp(-0.5 * (weight_shift + shift));
    }

    /* A smooth bell: every stride-th term times the stride (Poisson summation), each in its saddle-point form. For Q,
     * sum t_m (m - g)/m cancels; as the integral of dt/dm vanishes over the bell, the logarithmic derivative of t_m
     * may be taken off and leaves terms of the order of the sum. Where the bell is narrow (g << m) nothing cancels. */
    if (any_lane(bell)) {
        Series b;
        b.M1 = 0.0;
        b.M2 = 0.0;
        b.Q = 0.0;
        /* Steps on a grid where m is exact, should the numbers near high be wider apart than 1. */
        const real grid = 2.0 * high;
        const real stride = fmax((floor(width * (4.0 / sqrt(L))) + grid) - grid, (real)1.0);
        const mask smooth = width > 2.0;
        real m = sel(bell, fmax((floor(low) + grid) - grid, (real)1.0), 1.0);
        mask active = bell;
        while (any_lane(active)) {
            const real inverse = 1.0 / m;
            const real z = sqr(inverse);
            const real deviance = poisson_deviance(m, g);
            const real stirling =
                inverse * (1.0 / 12.0 -
                           z * (1.0 / 360.0 - z * (1.0 / 1260.0 - z * (1.0 / 1680.0 - z * (1.0 / 1188.0)))));
            const real stirling_slope = inverse * (1.0 / 12.0 - z * (1.0 / 120.0 - z * (1.0 / 252.0)));
            const real density = stride * exp(lift - deviance - a * inverse - stirling) * sqrt(inverse / (2.0 * PI));
            const real term = sel(active, density * inverse, 0.0);
            b.M1 += term;
            b.M2 += term * inverse;
            b.Q += term * sel(smooth, a * inverse - deviance - 0.5 + stirling_slope, m - g);
            active = active & (m <= high) & ((m <= mode) | (term > negligible * b.M1));
            m += stride;
        }
        t.M1 = sel(bell, b.M1, t.M1);
        t.M2 = sel(bell, b.M2, t.M2);
        t.Q = sel(bell, b.Q, t.Q);
        t.height = sel(bell, exp(-0.5 * lift), t.height);
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
    const real K = in.K + out.K;
    const real c = fmax(K, (real)TINY) / sqrt((real)(8.0 * PI));
    const real W = lambert_w(sqr(c), 2.0 * log(c));
    const real l = -2.0 * W / sqr(1.0 + W) * ((in.K_slope + out.K_slope) / fmax(K, (real)TINY)); /* d ln sigma_e^2/d ln h */

    const Wide height2 = pi_times_squared(product_of(sigma, s.cs));
    const real g = fmax(4.0 * (height2.high + height2.low) / (1.0 + W), (real)TINY); /* keeps m/g finite */
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
