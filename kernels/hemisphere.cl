/* Integrals of a model over the exitant hemisphere at one incidence, and its values there. Geometry is formed here.
 *
 * Directions are points (x, y) of the unit disk, v = (x, y, z): dx dy = cos theta_r dw, so what is summed is f itself.
 * The disk is seen in polar coordinates about a pole (m, 0), the foot of a lobe's axis: x = m + q r cos(chi),
 * y = r sin(chi), with chi in [0, pi], as models are isotropic. Both are spread, for a lobe of width `scale` in r and
 * an edge that is near at some chi only: r = scale sinh(S (1 - (1 - s)^2)), where s = 1 is the edge and S what takes it
 * there, and chi = chi_0 + chi_width sinh(low + (high - low) t). A cell is a rectangle of (s, t) in [0, 1]^2.
 *
 * Shapes: a row of `in` is the members of Cell, as many scalars, then TERMS coefficients of what is summed, TERMS
 * coefficients of the whole model, PARAMETERS; rule NODES nodes in [0, 1], NODES weights of Kronrod's rule, NODES of
 * Gauss's; the last node counts for nothing. */

#define NODES 16
#define BLOCKS (NODES / LANES)

typedef struct {
    scalar si, ci;          /* sin and cos of theta_i */
    scalar m, m2_left;      /* pole, 1 - m^2 */
    scalar beside_mirror;   /* m - sin theta_i */
    scalar m2_below_mirror; /* sin^2 theta_i - m^2 */
    scalar q;               /* how much flatter than a circle the coordinates are */
    scalar scale;           /* of r */
    scalar chi_0, chi_width, low, high;
    scalar s, s_size, t, t_size; /* the cell */
    scalar ends;                 /* 1: f is 0 where v is more than 90 degrees from (m, 0, sqrt(1 - m^2)) */
} Cell;
#define CELL ((int)(sizeof(Cell) / sizeof(scalar)))
#define CELL_STRIDE (CELL + 2 * TERMS + PARAMETERS)
#define SUMS 5

/* Of one chi: where its ray ends, and what its points have in common. */
typedef struct {
    real cosine, sine; /* of chi */
    real A, B;         /* |(x, y)|^2 = m^2 + 2 B r + A r^2 */
    real rim, behind;  /* r of the unit circle, and of that in the opposite direction */
    real end;          /* r of s = 1 */
} Ray;

INLINED Ray ray_of(Cell cell, real cosine, real sine) {
    Ray ray;
    ray.cosine = cosine;
    ray.sine = sine;
    ray.A = sqr(cell.q * cosine) + sqr(sine);
    ray.B = cell.m * cell.q * cosine;
    const real root = sqrt(sqr(ray.B) + ray.A * cell.m2_left);
    ray.rim = sel(ray.B > 0.0, cell.m2_left / (ray.B + root), (root - ray.B) / ray.A);
    ray.behind = cell.m2_left / (ray.A * ray.rim);
    ray.end = ray.rim;
    if (cell.ends >
        0.0) { /* the great circle 90 degrees from the pole is half an ellipse, at the other side of x = 0 */
        const real a = sqr(cell.q * cosine) / cell.m2_left + sqr(sine);
        const real b = ray.B / cell.m2_left;
        const real c = sqr((real)cell.m) / cell.m2_left - 1.0;
        const real discriminant = sqr(b) - a * c;
        const real r = (sqrt(fmax(discriminant, (real)0.0)) - b) / a;
        const mask crossed = (discriminant > 0.0) & (r > 0.0) & ((cell.m + cell.q * r * cosine) * cell.m < 0.0);
        ray.end = sel(crossed, fmin(r, ray.rim), ray.end);
    }
    return ray;
}

/* The geometry of u = (-si, 0, ci) and v = (x, y, z), with from_mirror = x - si and above_mirror = z - ci. */
INLINED Geometry geometry_of(real si, real ci, real x, real y, real z, real from_mirror, real above_mirror) {
    Geometry g;
    g.ci = ci;
    g.cr = z;
    g.cs = ci + z;
    g.ti = si / ci;
    g.tr = sqrt(sqr(x) + sqr(y)) / z;
    g.w = sqr(from_mirror) + sqr(y);
    const real near = 0.5 * (g.w + sqr(above_mirror)); /* 1 - cos alpha */
    const real cosine = 1.0 - near;
    const mask visible = cosine > TINY;
    const real bounded = sel(visible, cosine, 1.0);
    g.log_cos_alpha = sel(visible, log_plain(bounded) - ((bounded - 1.0) + near) / bounded, -1e30);
    g.tan2 = g.w / sqr(g.cs);
    g.cd2 = 0.25 * (g.w + sqr(g.cs));
    g.sd2 = 0.25 * (sqr(x + si) + sqr(y) + sqr(above_mirror));
    g.G = sqr(4.0 * g.cd2 / g.cs);
    const Wide hxy = product_of(-si, x);
    const Wide hz = product_of(ci, z);
    g.hxy = hxy.high;
    g.hxy_low = hxy.low;
    g.hz = hz.high;
    g.hz_low = hz.low;
    return g;
}

/* The same as a renderer forms it, from products of the vectors: digits that cancel are in no picture. */
INLINED Geometry plain_geometry_of(real si, real ci, real x, real y, real z) {
    Geometry g;
    g.ci = ci;
    g.cr = z;
    g.cs = ci + z;
    g.ti = si / ci;
    g.tr = sqrt(sqr(x) + sqr(y)) / z;
    g.w = sqr(x - si) + sqr(y);
    g.hxy = -si * x;
    g.hxy_low = 0.0;
    g.hz = ci * z;
    g.hz_low = 0.0;
    const real cosine = g.hz - g.hxy;
    const mask visible = cosine > TINY;
    g.log_cos_alpha = sel(visible, log_plain(sel(visible, cosine, 1.0)), -1e30);
    g.tan2 = g.w / sqr(g.cs);
    g.cd2 = 0.5 + 0.5 * (g.hz + g.hxy);
    g.sd2 = 0.5 - 0.5 * (g.hz + g.hxy);
    g.G = sqr(4.0 * g.cd2 / g.cs);
    return g;
}

/* That of geometry_of at r of a ray; left = end - r. */
INLINED Geometry geometry_at(Cell cell, Ray ray, real r, real left) {
    const real along = cell.q * r * ray.cosine;
    const real z = sqrt(fmax(ray.A * (ray.rim - ray.end + left) * (r + ray.behind), (real)(TINY)));
    /* z - cos theta_i, from the difference of the squares */
    const real above_mirror = (cell.m2_below_mirror - r * (2.0 * ray.B + ray.A * r)) / (cell.ci + z);
    return geometry_of((real)(cell.si), (real)(cell.ci), cell.m + along, r * ray.sine, z, cell.beside_mirror + along,
                       above_mirror);
}

INLINED real combined(const real *term, global const scalar *c) {
    real f = 0.0;
    UNROLLED
    for (int t = 0; t < TERMS; ++t) f += c[t] * term[term_value[t]];
    return f;
}

INLINED Cell load_cell(global const scalar *row) {
    Cell cell;
    scalar *value = (scalar *)&cell;
    UNROLLED
    for (int i = 0; i < CELL; ++i) value[i] = row[i];
    return cell;
}

/* A cell's integral of f cos theta_r dw by Kronrod's rule; by Gauss's in s; by Gauss's in t; of |f|, by Kronrod's; and
 * the sum of how far the whole model falls below 0. out cells x SUMS. */
kernel void hemisphere(global const scalar *rule, int cells, global const scalar *in, global scalar *out) {
    for (int i = (int)get_global_id(0); i < cells; i += (int)get_global_size(0)) {
        global const scalar *row = in + (size_t)i * CELL_STRIDE;
        const Cell cell = load_cell(row);
        const Params p = broadcast_parameters(row + CELL + 2 * TERMS);
        real cosines[BLOCKS], sines[BLOCKS], spreads[BLOCKS], sizes[BLOCKS];
        for (int b = 0; b < BLOCKS; ++b) {
            const real t = cell.t + cell.t_size * load_lanes(rule + b * LANES);
            const real growth = exp_plain(cell.low + (cell.high - cell.low) * t);
            const real shrunk = 1.0 / growth;
            const real chi = cell.chi_0 + 0.5 * cell.chi_width * (growth - shrunk);
            cosines[b] = cos(chi);
            sines[b] = sin(chi);
            const real reach = ray_of(cell, cosines[b], sines[b]).end / cell.scale;
            spreads[b] = log_plain(reach + sqrt(sqr(reach) + 1.0));
            /* dx dy = q r dr dchi, both sides of the plane of incidence */
            sizes[b] = cell.q * cell.chi_width * (growth + shrunk) * (cell.high - cell.low) * cell.t_size;
        }
        real kronrod = 0.0, gauss_s = 0.0, gauss_t = 0.0, size = 0.0, below = 0.0;
        for (int j = 0; j < NODES - 1; ++j) {
            const scalar cosine = ((const scalar *)cosines)[j];
            const scalar sine = ((const scalar *)sines)[j];
            const Ray ray = ray_of(cell, (real)(cosine), (real)(sine));
            const real spread = ((const scalar *)spreads)[j];
            real by_kronrod = 0.0, by_gauss = 0.0;
            for (int b = 0; b < BLOCKS; ++b) {
                const real s = cell.s + cell.s_size * load_lanes(rule + b * LANES);
                const real short_of = sqr(1.0 - s);
                const real growth = exp_plain(spread * (1.0 - short_of));
                const real shrunk = 1.0 / growth;
                const real half_growth = exp_plain(0.5 * spread * short_of);
                const real half_shrunk = 1.0 / half_growth;
                const real half_way = 0.5 * spread * short_of;
                const real half_sinh = sel(half_way < 0.03, half_way * (1.0 + sqr(half_way) * (1.0 / 6.0)),
                                           0.5 * (half_growth - half_shrunk));
                const real r = 0.5 * cell.scale * (growth - shrunk);
                const real left = cell.scale * half_sinh * (growth * half_growth + shrunk * half_shrunk);
                const real dr = cell.scale * (growth + shrunk) * spread * (1.0 - s) * cell.s_size;
                Terms terms;
                brdf(p, geometry_at(cell, ray, r, left), &terms);
                const real f = combined((const real *)&terms, row + CELL);
                const real whole = combined((const real *)&terms, row + CELL + TERMS);
                const real area = r * dr;
                const real weight = load_lanes(rule + NODES + b * LANES) * area;
                by_kronrod += weight * f;
                by_gauss += load_lanes(rule + 2 * NODES + b * LANES) * area * f;
                size += weight * fabs(f) * (rule[NODES + j] * ((const scalar *)sizes)[j]);
                below += fmax(-whole, (real)0.0);
            }
            const scalar width = ((const scalar *)sizes)[j];
            kronrod += by_kronrod * (rule[NODES + j] * width);
            gauss_s += by_gauss * (rule[NODES + j] * width);
            gauss_t += by_kronrod * (rule[2 * NODES + j] * width);
        }
        global scalar *sums = out + (size_t)i * SUMS;
        sums[0] = sum_lanes(kronrod);
        sums[1] = sum_lanes(gauss_s);
        sums[2] = sum_lanes(gauss_t);
        sums[3] = sum_lanes(size);
        sums[4] = sum_lanes(below);
    }
}

/* What is summed, along the rays chi = 0, pi/2 and pi of coordinates with q = 1, at r = (1 - 1e-3) 4^-k of the edge:
 * out cells x 3 x NODES. */
kernel void probe(int cells, global const scalar *in, global scalar *out) {
    for (int i = (int)get_global_id(0); i < cells; i += (int)get_global_size(0)) {
        global const scalar *row = in + (size_t)i * CELL_STRIDE;
        const Cell cell = load_cell(row);
        const Params p = broadcast_parameters(row + CELL + 2 * TERMS);
        for (int j = 0; j < 3; ++j) {
            const Ray ray = ray_of(cell, (real)((scalar)(1 - j)), (real)((scalar)(j == 1)));
            scalar share[NODES];
            share[0] = (scalar)(1.0 - 1e-3);
            for (int k = 1; k < NODES; ++k) share[k] = (scalar)0.25 * share[k - 1];
            for (int b = 0; b < BLOCKS; ++b) {
                real r;
                for (int lane = 0; lane < LANES; ++lane) ((scalar *)&r)[lane] = share[b * LANES + lane];
                r *= ray.rim;
                Terms terms;
                brdf(p, geometry_at(cell, ray, r, ray.end - r), &terms);
                store_lanes(combined((const real *)&terms, row + CELL), out + ((size_t)i * 3 + j) * NODES + b * LANES);
            }
        }
    }
}

/* What a renderer does, to be timed: values at pairs of directions given as unit vectors, geometry included. Columns
 * sin theta_i, cos theta_i, x, y, z, each `samples` long, a multiple of LANES; in candidates x (TERMS + PARAMETERS);
 * out: a sum for each work-item, so that nothing is left out. */
kernel void value(global const scalar *columns, int samples, int candidates, global const scalar *in,
                  global scalar *out) {
    real sum = 0.0;
    for (int i = 0; i < candidates; ++i) {
        global const scalar *row = in + (size_t)i * (TERMS + PARAMETERS);
        const Params p = broadcast_parameters(row + TERMS);
        for (int first = (int)get_global_id(0) * LANES; first < samples; first += (int)get_global_size(0) * LANES) {
            const real si = load_lanes(columns + first);
            const real ci = load_lanes(columns + samples + first);
            const real x = load_lanes(columns + 2 * samples + first);
            const real y = load_lanes(columns + 3 * samples + first);
            const real z = load_lanes(columns + 4 * samples + first);
            Terms terms;
            brdf(p, plain_geometry_of(si, ci, x, y, z), &terms);
            sum += combined((const real *)&terms, row);
        }
    }
    out[get_global_id(0)] = sum_lanes(sum);
}
