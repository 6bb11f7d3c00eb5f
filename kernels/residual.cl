/* The skeleton around a model: it owns the loops over samples, the reduction and the linear coefficients; the model's
 * brdf() sees one sample (one per lane).
 *
 * f = sum_t c_t phi_t(sample; theta). The host generates, before this text, from the model's header and the geometry
 * table: structs Params, Geometry and Terms (all members `real`), their sizes PARAMETERS, COLUMNS and TERM_VALUES, the
 * number of terms TERMS, and the tables term_value (index of phi_t in Terms), slope_term, slope_value and slope_column
 * (for each of SLOPES derivatives: its term, its index in Terms, its place among the NONLINEAR parameters),
 * nonlinear_parameter (their places in Params), and ADD_ALL_ROWS: ADD_ROWS(i) for every second row i of the products of
 * Terms.
 *
 * Shapes: columns COLUMNS x samples, y and w samples (samples is a multiple of LANES, padding has w = 0);
 * in candidates x (PARAMETERS + 2 TERMS) = parameters, lower and upper bounds of c (for `loss` c twice);
 * out candidates x OUT_STRIDE = loss, c, d loss/d c, d loss/d parameters, and the upper triangle, row by row, of
 * sum w J'J where J = d residual/d (c, nonlinear parameters): the matrix of Gauss and Newton's method. */

#define UNKNOWNS (TERMS + NONLINEAR)
#define NORMALS (UNKNOWNS * (UNKNOWNS + 1) / 2)
#define PRODUCTS (TERM_VALUES * (TERM_VALUES + 1) / 2)
#define IN_STRIDE (PARAMETERS + 2 * TERMS)
#define OUT_STRIDE (1 + 2 * TERMS + PARAMETERS + NORMALS)

/* Vectors of samples after which products are summed, while the values are still in the nearest cache. */
#if LANES == 1
#define CHUNK 1
#else
#define CHUNK 16
#endif

INLINED Geometry load_geometry(global const scalar *columns, int samples, int first) {
    Geometry s;
    real *value = (real *)&s;
    UNROLLED
    for (int i = 0; i < COLUMNS; ++i) value[i] = load_lanes(columns + i * samples + first);
    return s;
}

/* Place of an element of a symmetric matrix that is stored as its upper triangle, row by row. */
INLINED int triangle_index(int row, int column, int size) {
    const int i = row < column ? row : column;
    const int j = row < column ? column : row;
    return i * size - i * (i - 1) / 2 + (j - i);
}

INLINED int gram_index(int row, int column) { return triangle_index(row, column, TERMS); }

/* Solves the free unknowns with the others held; a direction the data do not see is held as well. */
inline void solve_free(const scalar *gram, const scalar *b, const scalar *c, int *is_free, scalar *z) {
    scalar m[TERMS][TERMS];
    scalar v[TERMS];
    for (int i = 0; i < TERMS; ++i) {
        v[i] = b[i];
        for (int j = 0; j < TERMS; ++j) {
            const int both = is_free[i] && is_free[j];
            m[i][j] = both ? gram[gram_index(i, j)] : (scalar)(i == j ? 1.0 : 0.0);
            if (is_free[i] && !is_free[j]) v[i] -= gram[gram_index(i, j)] * c[j];
        }
        if (!is_free[i]) v[i] = c[i];
    }
    for (int i = 0; i < TERMS; ++i) { /* Cholesky: m becomes L */
        for (int j = 0; j <= i; ++j) {
            scalar sum = m[i][j];
            for (int k = 0; k < j; ++k) sum -= m[i][k] * m[j][k];
            if (i != j)
                m[i][j] = sum / m[j][j];
            else if (sum > COLLINEAR)
                m[i][i] = sqrt(sum);
            else { /* collinear with the unknowns before it: hold it where it is */
                is_free[i] = 0;
                m[i][i] = 1.0;
                for (int k = 0; k < i; ++k) {
                    v[k] -= gram[gram_index(i, k)] * c[i] * (scalar)is_free[k];
                    m[i][k] = 0.0;
                }
                for (int k = i + 1; k < TERMS; ++k) {
                    if (is_free[k]) v[k] -= gram[gram_index(i, k)] * c[i];
                    m[k][i] = 0.0;
                }
                v[i] = c[i];
            }
        }
    }
    for (int i = 0; i < TERMS; ++i) {
        scalar sum = v[i];
        for (int k = 0; k < i; ++k) sum -= m[i][k] * z[k];
        z[i] = sum / m[i][i];
    }
    for (int i = TERMS - 1; i >= 0; --i) {
        scalar sum = z[i];
        for (int k = i + 1; k < TERMS; ++k) sum -= m[k][i] * z[k];
        z[i] = sum / m[i][i];
    }
}

/* The solution of Gc = b, where it lies within the bounds and no column is collinear with those before it: the
 * ordinary case. An unknown whose bounds leave no room is held there. Whether it has been found. */
INLINED int solve_inside(const scalar *gram, const scalar *b, const scalar *low, const scalar *high, scalar *c) {
    scalar m[TERMS][TERMS], inverse[TERMS], z[TERMS];
    int inside = 1;
    UNROLLED
    for (int i = 0; i < TERMS; ++i) {
        const int held = !(low[i] < high[i]);
        z[i] = held ? low[i] : b[i];
        UNROLLED
        for (int j = 0; j < TERMS; ++j)
            if (j != i && !(low[j] < high[j]) && !held) z[i] -= gram[gram_index(i, j)] * low[j];
    }
    UNROLLED
    for (int i = 0; i < TERMS; ++i) {
        scalar pivot = low[i] < high[i] ? gram[gram_index(i, i)] : (scalar)1.0;
        UNROLLED
        for (int j = 0; j < i; ++j) {
            m[i][j] = low[i] < high[i] && low[j] < high[j] ? gram[gram_index(i, j)] : (scalar)0.0;
            UNROLLED
            for (int k = 0; k < j; ++k) m[i][j] -= m[i][k] * m[j][k];
            m[i][j] *= inverse[j];
            pivot -= m[i][j] * m[i][j];
        }
        if (!(pivot > COLLINEAR)) inside = 0;
        inverse[i] = (scalar)1.0 / sqrt(pivot);
    }
    UNROLLED
    for (int i = 0; i < TERMS; ++i) {
        UNROLLED
        for (int k = 0; k < i; ++k) z[i] -= m[i][k] * z[k];
        z[i] *= inverse[i];
    }
    UNROLLED
    for (int i = TERMS - 1; i >= 0; --i) {
        UNROLLED
        for (int k = i + 1; k < TERMS; ++k) z[i] -= m[k][i] * z[k];
        z[i] *= inverse[i];
        if (!(z[i] >= low[i] && z[i] <= high[i])) inside = 0;
    }
    if (inside)
        UNROLLED
        for (int i = 0; i < TERMS; ++i) c[i] = z[i];
    return inside;
}

/* Minimises c'Gc/2 - b'c within low <= c <= high, G of unit diagonal: active sets after Stark and Parker, exact for the
 * few unknowns of a model. */
inline void solve_active(const scalar *gram, const scalar *b, const scalar *low, const scalar *high, scalar *c) {
    int is_free[TERMS], blocked[TERMS];
    for (int i = 0; i < TERMS; ++i) {
        c[i] = fmin(fmax((scalar)0.0, low[i]), high[i]);
        is_free[i] = 0;
        blocked[i] = !(low[i] < high[i]); /* also where no sample sees the term */
    }
    scalar b_norm = 0.0;
    for (int i = 0; i < TERMS; ++i) b_norm = fmax(b_norm, fabs(b[i]));

    for (int round = 0; round < 6 * TERMS; ++round) {
        /* Free the unknown whose bound costs most. */
        int best = -1;
        scalar best_pull = b_norm * COLLINEAR;
        for (int i = 0; i < TERMS; ++i) {
            if (is_free[i] || blocked[i]) continue;
            scalar pull = b[i];
            for (int j = 0; j < TERMS; ++j) pull -= gram[gram_index(i, j)] * c[j];
            if (c[i] >= high[i]) pull = -pull;
            else if (c[i] > low[i]) pull = fabs(pull);
            if (pull > best_pull) {
                best_pull = pull;
                best = i;
            }
        }
        if (best < 0) break;
        is_free[best] = 1;
        for (int inner = 0; inner <= TERMS; ++inner) {
            scalar z[TERMS];
            const int was_free = is_free[best];
            solve_free(gram, b, c, is_free, z);
            if (was_free && !is_free[best]) blocked[best] = 1; /* collinear: do not free it again */
            scalar step = 1.0;
            int hit = -1;
            for (int i = 0; i < TERMS; ++i) {
                if (!is_free[i]) continue;
                const scalar bound = z[i] < low[i] ? low[i] : high[i];
                if (z[i] >= low[i] && z[i] <= high[i]) continue;
                const scalar fraction = (bound - c[i]) / (z[i] - c[i]);
                if (fraction < step) {
                    step = fraction;
                    hit = i;
                }
            }
            for (int i = 0; i < TERMS; ++i)
                if (is_free[i]) c[i] = fmin(fmax(c[i] + step * (z[i] - c[i]), low[i]), high[i]);
            if (hit < 0) break;
            c[hit] = z[hit] < low[hit] ? low[hit] : high[hit];
            is_free[hit] = 0;
        }
    }
}

/* Minimises c'Gc/2 - b'c within lower <= c <= upper. Scales gram and b in place to a unit diagonal. */
INLINED void solve_bounded(scalar *gram, scalar *b, const scalar *lower, const scalar *upper, scalar *c) {
    scalar size[TERMS], inverse[TERMS], low[TERMS], high[TERMS];
    UNROLLED
    for (int i = 0; i < TERMS; ++i) {
        size[i] = sqrt(gram[gram_index(i, i)]);
        inverse[i] = size[i] > 0.0 ? (scalar)1.0 / size[i] : (scalar)0.0;
        low[i] = lower[i] * size[i];
        high[i] = upper[i] * size[i];
    }
    UNROLLED
    for (int i = 0; i < TERMS; ++i) {
        b[i] *= inverse[i];
        UNROLLED
        for (int j = 0; j < TERMS; ++j)
            if (j >= i) gram[gram_index(i, j)] = gram[gram_index(i, j)] * inverse[i] * inverse[j]; /* no overflow */
    }
    if (!solve_inside(gram, b, low, high, c)) solve_active(gram, b, low, high, c);
    UNROLLED
    for (int i = 0; i < TERMS; ++i) {
        const scalar value = size[i] > 0.0 ? c[i] / size[i] : (scalar)0.0; /* exactly a bound where it was */
        c[i] = fmin(fmax(value, lower[i]), upper[i]);
    }
}

/* Sums of one candidate: weighted squares of the residual and their derivatives. */
typedef struct {
    real loss, by_unknown[UNKNOWNS], normal[NORMALS];
} Sums;

INLINED void clear_sums(Sums *sums) {
    sums->loss = 0.0;
    UNROLLED
    for (int i = 0; i < UNKNOWNS; ++i) sums->by_unknown[i] = 0.0;
    UNROLLED
    for (int i = 0; i < NORMALS; ++i) sums->normal[i] = 0.0;
}

/* residual = f - y, or ln f - y with y = ln of the measured value. A value that underflowed counts as the smallest. */
INLINED void add_sample(const real *term, const scalar *c, real y, real w, int logarithmic, Sums *sums) {
    real f = 0.0;
    UNROLLED
    for (int t = 0; t < TERMS; ++t) f += c[t] * term[term_value[t]];
    real residual = f - y;
    if (logarithmic) residual = log(fmax(f, (real)TINY)) - y;
    sums->loss += w * sqr(residual);
    real column[UNKNOWNS];
    UNROLLED
    for (int t = 0; t < TERMS; ++t) column[t] = term[term_value[t]];
    UNROLLED
    for (int i = TERMS; i < UNKNOWNS; ++i) column[i] = 0.0;
    UNROLLED
    for (int i = 0; i < SLOPES; ++i) column[TERMS + slope_column[i]] += c[slope_term[i]] * term[slope_value[i]];
    if (logarithmic) {
        const real by_f = sel(f > TINY, 1.0 / fmax(f, (real)TINY), 0.0);
        UNROLLED
        for (int i = 0; i < UNKNOWNS; ++i) column[i] *= by_f;
    }
    int place = 0;
    UNROLLED
    for (int i = 0; i < UNKNOWNS; ++i) {
        const real weighted = w * column[i];
        sums->by_unknown[i] += weighted * residual;
        UNROLLED
        for (int j = i; j < UNKNOWNS; ++j) sums->normal[place++] += weighted * column[j];
    }
}

INLINED void store_sums(const Sums *sums, const scalar *c, global scalar *out) {
    out[0] = sum_lanes(sums->loss);
    for (int t = 0; t < TERMS; ++t) out[1 + t] = c[t];
    out += 1 + TERMS;
    for (int i = 0; i < TERMS + PARAMETERS; ++i) out[i] = 0.0;
    for (int t = 0; t < TERMS; ++t) out[t] = (scalar)2.0 * sum_lanes(sums->by_unknown[t]);
    for (int i = 0; i < NONLINEAR; ++i)
        out[TERMS + nonlinear_parameter[i]] = (scalar)2.0 * sum_lanes(sums->by_unknown[TERMS + i]);
    out += TERMS + PARAMETERS;
    for (int i = 0; i < NORMALS; ++i) out[i] = sum_lanes(sums->normal[i]);
}

/* The model at a sample. What is summed in squares must not overflow there. */
INLINED void evaluate(Params p, Geometry s, Terms *f) {
    brdf(p, s, f);
    real *value = (real *)f;
    UNROLLED
    for (int i = 0; i < TERM_VALUES; ++i) {
        value[i] = sel(value[i] > HUGE_SUMMED, HUGE_SUMMED, value[i]);
        value[i] = sel(value[i] < -HUGE_SUMMED, -HUGE_SUMMED, value[i]);
    }
}

/* Adds samples begin, begin + step, ... (LANES each) up at given coefficients. */
INLINED void sum_evaluated(global const scalar *columns, global const scalar *y, global const scalar *w, int samples,
                          int begin, int step, global const scalar *in, const scalar *c, int logarithmic, Sums *sums) {
    const Params p = broadcast_parameters(in);
    for (int first = begin; first < samples; first += step) {
        Terms f;
        evaluate(p, load_geometry(columns, samples, first), &f);
        add_sample((const real *)&f, c, load_lanes(y + first), load_lanes(w + first), logarithmic, sums);
    }
}

#if !SLICED

/* Rows `row` and the next of product_sum += sum w v v' over `vectors` times LANES samples, whose values v (Terms) stand in
 * `kept`. The sums of two rows stay in registers; those of all rows would not. A macro, as compilers unroll no loop whose
 * bounds they see only once the function around it is inlined; ADD_ALL_ROWS, from the host, names every second row. */
#define ADD_ROWS(row)                                                                                             \
    {                                                                                                             \
        real upper[TERM_VALUES], lower[TERM_VALUES];                                                              \
        UNROLLED                                                                                                  \
        for (int j = row; j < TERM_VALUES; ++j) upper[j] = product_sum[triangle_index(row, j, TERM_VALUES)];      \
        UNROLLED                                                                                                  \
        for (int j = row + 1; j < TERM_VALUES; ++j)                                                               \
            lower[j] = product_sum[triangle_index(row + 1, j, TERM_VALUES)];                                      \
        for (int k = 0; k < vectors; ++k) {                                                                       \
            global const scalar *value = kept + k * TERM_VALUES * LANES;                                          \
            const real from_upper = load_lanes(w + k * LANES) * load_lanes(value + row * LANES);                  \
            UNROLLED                                                                                              \
            for (int j = row; j < TERM_VALUES; ++j) upper[j] += from_upper * load_lanes(value + j * LANES);       \
            if (row + 1 >= TERM_VALUES) continue;                                                                 \
            const real from_lower = load_lanes(w + k * LANES) * load_lanes(value + (row + 1) * LANES);            \
            UNROLLED                                                                                              \
            for (int j = row + 1; j < TERM_VALUES; ++j) lower[j] += from_lower * load_lanes(value + j * LANES);   \
        }                                                                                                         \
        UNROLLED                                                                                                  \
        for (int j = row; j < TERM_VALUES; ++j) product_sum[triangle_index(row, j, TERM_VALUES)] = upper[j];      \
        UNROLLED                                                                                                  \
        for (int j = row + 1; j < TERM_VALUES; ++j)                                                               \
            product_sum[triangle_index(row + 1, j, TERM_VALUES)] = lower[j];                                      \
    }

INLINED void add_products(global const scalar *kept, global const scalar *w, int vectors, real *product_sum) {
    ADD_ALL_ROWS
}

/* The Gauss-Newton matrix from sums of products of Terms' values at c. */
INLINED void store_normal(const scalar *products, const scalar *c, global scalar *out) {
    int unknown[TERM_VALUES], value[TERM_VALUES];
    scalar factor[TERM_VALUES];
    UNROLLED
    for (int t = 0; t < TERMS; ++t) {
        unknown[t] = t;
        value[t] = term_value[t];
        factor[t] = 1.0;
    }
    UNROLLED
    for (int i = 0; i < SLOPES; ++i) {
        unknown[TERMS + i] = TERMS + slope_column[i];
        value[TERMS + i] = slope_value[i];
        factor[TERMS + i] = c[slope_term[i]];
    }
    for (int i = 0; i < NORMALS; ++i) out[i] = 0.0;
    UNROLLED
    for (int i = 0; i < TERM_VALUES; ++i)
        UNROLLED
        for (int j = 0; j < TERM_VALUES; ++j)
            if (unknown[i] <= unknown[j])
                out[triangle_index(unknown[i], unknown[j], UNKNOWNS)] +=
                    factor[i] * factor[j] * products[triangle_index(value[i], value[j], TERM_VALUES)];
}

INLINED void project_candidate(int gradient, global const scalar *columns, global const scalar *y,
                               global const scalar *w, int samples, global const scalar *in, global scalar *scratch,
                               global scalar *out) {
    const int stored = gradient ? TERM_VALUES : TERMS;
    const int by_rows = gradient ? TERM_VALUES > 5 : 0; /* else the sums of all products fit into registers */
    const Params p = broadcast_parameters(in);

    real product_sum[PRODUCTS], gram_sum[TERMS * (TERMS + 1) / 2], b_sum[TERMS];
    UNROLLED
    for (int i = 0; i < PRODUCTS; ++i) product_sum[i] = 0.0;
    UNROLLED
    for (int i = 0; i < TERMS * (TERMS + 1) / 2; ++i) gram_sum[i] = 0.0;
    UNROLLED
    for (int i = 0; i < TERMS; ++i) b_sum[i] = 0.0;
    for (int begin = 0; begin < samples; begin += CHUNK * LANES) {
        const int end = min(begin + CHUNK * LANES, samples);
        for (int first = begin; first < end; first += LANES) {
            Terms f;
            evaluate(p, load_geometry(columns, samples, first), &f);
            const real *term = (const real *)&f;
            const real weight = load_lanes(w + first);
            const real measured = load_lanes(y + first);
            global scalar *kept = scratch + first * stored;
            UNROLLED
            for (int i = 0; i < TERMS; ++i) {
                const real weighted = weight * term[term_value[i]];
                b_sum[i] += weighted * measured;
                UNROLLED
                for (int j = i; j < TERMS; ++j) gram_sum[gram_index(i, j)] += weighted * term[term_value[j]];
            }
            if (gradient)
                UNROLLED
                for (int i = 0; i < TERM_VALUES; ++i) store_lanes(term[i], kept + i * LANES);
            else
                UNROLLED
                for (int i = 0; i < TERMS; ++i) store_lanes(term[term_value[i]], kept + i * LANES);
        }
        if (by_rows)
            add_products(scratch + begin * TERM_VALUES, w + begin, (end - begin) / LANES, product_sum);
    }

    scalar gram[TERMS * (TERMS + 1) / 2], b[TERMS], low[TERMS], high[TERMS], c[TERMS];
    for (int i = 0; i < TERMS * (TERMS + 1) / 2; ++i) gram[i] = sum_lanes(gram_sum[i]);
    for (int i = 0; i < TERMS; ++i) {
        b[i] = sum_lanes(b_sum[i]);
        low[i] = in[PARAMETERS + i];
        high[i] = in[PARAMETERS + TERMS + i];
    }
    solve_bounded(gram, b, low, high, c);

    real loss_sum = 0.0, by_value[TERM_VALUES];
    UNROLLED
    for (int i = 0; i < TERM_VALUES; ++i) by_value[i] = 0.0;
    for (int first = 0; first < samples; first += LANES) {
        global const scalar *kept = scratch + first * stored;
        real residual = -load_lanes(y + first);
        UNROLLED
        for (int t = 0; t < TERMS; ++t) residual += c[t] * load_lanes(kept + (gradient ? term_value[t] : t) * LANES);
        const real weight = load_lanes(w + first);
        loss_sum += weight * sqr(residual);
        if (gradient)
            UNROLLED
            for (int i = 0; i < TERM_VALUES; ++i) {
                const real weighted = weight * load_lanes(kept + i * LANES);
                by_value[i] += weighted * residual;
                if (!by_rows)
                    UNROLLED
                    for (int j = i; j < TERM_VALUES; ++j)
                        product_sum[triangle_index(i, j, TERM_VALUES)] += weighted * load_lanes(kept + j * LANES);
            }
    }

    out[0] = sum_lanes(loss_sum);
    UNROLLED
    for (int t = 0; t < TERMS; ++t) out[1 + t] = c[t];
    if (!gradient) return;
    out += 1 + TERMS;
    for (int i = 0; i < TERMS + PARAMETERS; ++i) out[i] = 0.0;
    UNROLLED
    for (int t = 0; t < TERMS; ++t) out[t] = (scalar)2.0 * sum_lanes(by_value[term_value[t]]);
    UNROLLED
    for (int i = 0; i < SLOPES; ++i)
        out[TERMS + nonlinear_parameter[slope_column[i]]] +=
            (scalar)2.0 * c[slope_term[i]] * sum_lanes(by_value[slope_value[i]]);
    scalar products[PRODUCTS];
    for (int i = 0; i < PRODUCTS; ++i) products[i] = sum_lanes(product_sum[i]);
    store_normal(products, c, out + TERMS + PARAMETERS);
}

/* Best coefficients within their bounds, the loss there and its gradient (by c it is 0 away from the bounds). Every
 * kernel strides over its candidates, so that the host chooses the number of work-items; each work-item has scratch for
 * one candidate. */
kernel void project(global const scalar *columns, global const scalar *y, global const scalar *w, int samples,
                    int candidates, global const scalar *in, global scalar *scratch, global scalar *out) {
    const int item = (int)get_global_id(0);
    for (int i = item; i < candidates; i += (int)get_global_size(0))
        project_candidate(1, columns, y, w, samples, in + i * IN_STRIDE,
                          scratch + (size_t)item * samples * TERM_VALUES, out + i * OUT_STRIDE);
}

/* The same without derivatives: for screening. */
kernel void project_value(global const scalar *columns, global const scalar *y, global const scalar *w, int samples,
                          int candidates, global const scalar *in, global scalar *scratch, global scalar *out) {
    const int item = (int)get_global_id(0);
    for (int i = item; i < candidates; i += (int)get_global_size(0))
        project_candidate(0, columns, y, w, samples, in + i * IN_STRIDE, scratch + (size_t)item * samples * TERM_VALUES,
                          out + i * OUT_STRIDE);
}

/* Loss and derivatives at given coefficients; logarithmic: residuals ln f - y. */
kernel void loss(global const scalar *columns, global const scalar *y, global const scalar *w, int samples,
                 int candidates, global const scalar *in, int logarithmic, global scalar *out) {
    for (int i = (int)get_global_id(0); i < candidates; i += (int)get_global_size(0)) {
        scalar c[TERMS];
        for (int t = 0; t < TERMS; ++t) c[t] = in[i * IN_STRIDE + PARAMETERS + t];
        Sums sums;
        clear_sums(&sums);
        sum_evaluated(columns, y, w, samples, 0, LANES, in + i * IN_STRIDE, c, logarithmic, &sums);
        store_sums(&sums, c, out + i * OUT_STRIDE);
    }
}

#else

#define GRAM (TERMS * (TERMS + 1) / 2)

/* The normal equations of one candidate's coefficients, over samples begin, begin + step, ... (LANES each): gram and b.
 * Its terms at sample `first` are kept at scratch + first * apart, each `stride` from the next. */
INLINED void sum_products(int gradient, global const scalar *columns, global const scalar *y, global const scalar *w,
                         int samples, int begin, int step, global const scalar *in, global scalar *scratch, int apart,
                         int stride, scalar *gram, scalar *b) {
    const Params p = broadcast_parameters(in);
    real gram_sum[GRAM], b_sum[TERMS];
    UNROLLED
    for (int i = 0; i < GRAM; ++i) gram_sum[i] = 0.0;
    UNROLLED
    for (int i = 0; i < TERMS; ++i) b_sum[i] = 0.0;
    for (int first = begin; first < samples; first += step) {
        global scalar *kept = scratch + (size_t)first * apart;
        Terms f;
        evaluate(p, load_geometry(columns, samples, first), &f);
        const real *term = (const real *)&f;
        const real weight = load_lanes(w + first);
        const real measured = load_lanes(y + first);
        UNROLLED
        for (int i = 0; i < TERMS; ++i) {
            const real weighted = weight * term[term_value[i]];
            b_sum[i] += weighted * measured;
            UNROLLED
            for (int j = i; j < TERMS; ++j) gram_sum[gram_index(i, j)] += weighted * term[term_value[j]];
        }
        if (gradient)
            UNROLLED
            for (int i = 0; i < TERM_VALUES; ++i) store_lanes(term[i], kept + i * stride);
        else
            UNROLLED
            for (int i = 0; i < TERMS; ++i) store_lanes(term[term_value[i]], kept + i * stride);
    }
    for (int i = 0; i < GRAM; ++i) gram[i] = sum_lanes(gram_sum[i]);
    for (int i = 0; i < TERMS; ++i) b[i] = sum_lanes(b_sum[i]);
}

/* The best coefficients within the candidate's bounds. */
INLINED void solve_coefficients(scalar *gram, scalar *b, global const scalar *in, scalar *c) {
    scalar low[TERMS], high[TERMS];
    for (int i = 0; i < TERMS; ++i) {
        low[i] = in[PARAMETERS + i];
        high[i] = in[PARAMETERS + TERMS + i];
    }
    solve_bounded(gram, b, low, high, c);
}

/* Adds what sum_products has kept of the same samples up. */
INLINED void sum_kept(int gradient, global const scalar *y, global const scalar *w, int samples, int begin, int step,
                     global const scalar *scratch, int apart, int stride, const scalar *c, Sums *sums) {
    for (int first = begin; first < samples; first += step) {
        global const scalar *kept = scratch + (size_t)first * apart;
        real term[TERM_VALUES];
        if (gradient)
            UNROLLED
            for (int i = 0; i < TERM_VALUES; ++i) term[i] = load_lanes(kept + i * stride);
        else
            UNROLLED
            for (int i = 0; i < TERMS; ++i) term[term_value[i]] = load_lanes(kept + i * stride);
        if (gradient)
            add_sample(term, c, load_lanes(y + first), load_lanes(w + first), 0, sums);
        else {
            real f = 0.0;
            UNROLLED
            for (int t = 0; t < TERMS; ++t) f += c[t] * term[term_value[t]];
            sums->loss += load_lanes(w + first) * sqr(f - load_lanes(y + first));
        }
    }
}

/* The same in steps, for devices with more work-items than a batch has candidates. Slice s of a candidate is its samples
 * s, s + slices, ... (LANES each), so that neighbouring work-items read neighbouring samples. Sums of slices are added
 * up in the slices' order: results do not depend on what ran when.
 *
 * Shapes: scratch candidates x TERM_VALUES x samples; products candidates x slices x (GRAM + TERMS) = gram, b;
 * sums candidates x slices x SUMS = loss, by_unknown, normal. */
#define SUMS (1 + UNKNOWNS + NORMALS)

INLINED void keep_slices(int gradient, global const scalar *columns, global const scalar *y, global const scalar *w,
                        int samples, int candidates, global const scalar *in, int slices, global scalar *scratch,
                        global scalar *products) {
    for (int i = (int)get_global_id(0); i < candidates * slices; i += (int)get_global_size(0)) {
        const int candidate = i / slices;
        scalar gram[GRAM], b[TERMS];
        sum_products(gradient, columns, y, w, samples, (i - candidate * slices) * LANES, slices * LANES,
                     in + candidate * IN_STRIDE, scratch + (size_t)candidate * TERM_VALUES * samples, 1, samples, gram, b);
        global scalar *row = products + (size_t)i * (GRAM + TERMS);
        for (int k = 0; k < GRAM; ++k) row[k] = gram[k];
        for (int k = 0; k < TERMS; ++k) row[GRAM + k] = b[k];
    }
}

/* Keeps terms and slopes, and sums the normal equations of the coefficients. */
kernel void keep_terms(global const scalar *columns, global const scalar *y, global const scalar *w, int samples,
                       int candidates, global const scalar *in, int slices, global scalar *scratch,
                       global scalar *products) {
    keep_slices(1, columns, y, w, samples, candidates, in, slices, scratch, products);
}

/* The same without slopes. */
kernel void keep_values(global const scalar *columns, global const scalar *y, global const scalar *w, int samples,
                        int candidates, global const scalar *in, int slices, global scalar *scratch,
                        global scalar *products) {
    keep_slices(0, columns, y, w, samples, candidates, in, slices, scratch, products);
}

/* A row of out with what no sum fills. */
INLINED void begin_row(const scalar *c, global scalar *row) {
    for (int t = 0; t < TERMS; ++t) row[1 + t] = c[t];
    for (int k = 0; k < PARAMETERS; ++k) row[1 + 2 * TERMS + k] = 0.0;
}

/* Best coefficients of each candidate, into out. */
kernel void solve_slices(int candidates, global const scalar *in, int slices, global const scalar *products,
                         global scalar *out) {
    for (int i = (int)get_global_id(0); i < candidates; i += (int)get_global_size(0)) {
        scalar product[GRAM + TERMS], c[TERMS];
        for (int k = 0; k < GRAM + TERMS; ++k) product[k] = 0.0;
        for (int s = 0; s < slices; ++s)
            for (int k = 0; k < GRAM + TERMS; ++k) product[k] += products[((size_t)i * slices + s) * (GRAM + TERMS) + k];
        solve_coefficients(product, product + GRAM, in + i * IN_STRIDE, c);
        begin_row(c, out + i * OUT_STRIDE);
    }
}

INLINED void store_slice(const Sums *sums, int gradient, global scalar *row) {
    row[0] = sum_lanes(sums->loss);
    if (!gradient) return;
    for (int k = 0; k < UNKNOWNS; ++k) row[1 + k] = sum_lanes(sums->by_unknown[k]);
    for (int k = 0; k < NORMALS; ++k) row[1 + UNKNOWNS + k] = sum_lanes(sums->normal[k]);
}

/* Sums of each slice from what is kept, at the coefficients in out. */
kernel void sum_slices(int gradient, global const scalar *y, global const scalar *w, int samples, int candidates,
                       int slices, global const scalar *scratch, global const scalar *out, global scalar *slice_sums) {
    for (int i = (int)get_global_id(0); i < candidates * slices; i += (int)get_global_size(0)) {
        const int candidate = i / slices;
        scalar c[TERMS];
        for (int t = 0; t < TERMS; ++t) c[t] = out[candidate * OUT_STRIDE + 1 + t];
        Sums sums;
        clear_sums(&sums);
        sum_kept(gradient, y, w, samples, (i - candidate * slices) * LANES, slices * LANES,
                 scratch + (size_t)candidate * TERM_VALUES * samples, 1, samples, c, &sums);
        store_slice(&sums, gradient, slice_sums + (size_t)i * SUMS);
    }
}

/* Sums of each slice at the coefficients in `in`; logarithmic: residuals ln f - y. */
kernel void loss_slices(global const scalar *columns, global const scalar *y, global const scalar *w, int samples,
                        int candidates, global const scalar *in, int slices, int logarithmic, global scalar *slice_sums,
                        global scalar *out) {
    for (int i = (int)get_global_id(0); i < candidates * slices; i += (int)get_global_size(0)) {
        const int candidate = i / slices;
        scalar c[TERMS];
        for (int t = 0; t < TERMS; ++t) c[t] = in[candidate * IN_STRIDE + PARAMETERS + t];
        if (i == candidate * slices) begin_row(c, out + candidate * OUT_STRIDE);
        Sums sums;
        clear_sums(&sums);
        sum_evaluated(columns, y, w, samples, (i - candidate * slices) * LANES, slices * LANES,
                      in + candidate * IN_STRIDE, c, logarithmic, &sums);
        store_slice(&sums, 1, slice_sums + (size_t)i * SUMS);
    }
}

/* Adds slices up, a work-item a sum. */
kernel void add_slices(int gradient, int candidates, int slices, global const scalar *slice_sums, global scalar *out) {
    const int count = gradient ? SUMS : 1;
    for (int i = (int)get_global_id(0); i < candidates * count; i += (int)get_global_size(0)) {
        const int candidate = i / count;
        const int k = i - candidate * count;
        scalar sum = 0.0;
        for (int s = 0; s < slices; ++s) sum += slice_sums[((size_t)candidate * slices + s) * SUMS + k];
        global scalar *row = out + candidate * OUT_STRIDE;
        if (k == 0)
            row[0] = sum;
        else if (k <= TERMS)
            row[TERMS + k] = (scalar)2.0 * sum;
        else if (k <= UNKNOWNS)
            row[1 + 2 * TERMS + nonlinear_parameter[k - 1 - TERMS]] = (scalar)2.0 * sum;
        else
            row[1 + 2 * TERMS + PARAMETERS + (k - 1 - UNKNOWNS)] = sum;
    }
}

#endif

/* Every term and its slopes for every sample: out candidates x TERM_VALUES x samples. A work-item takes LANES samples of
 * a candidate at a time. */
kernel void terms(global const scalar *columns, int samples, int candidates, global const scalar *parameters,
                  global scalar *out) {
    const int blocks = samples / LANES;
    for (int i = (int)get_global_id(0); i < candidates * blocks; i += (int)get_global_size(0)) {
        const int candidate = i / blocks;
        const int first = (i - candidate * blocks) * LANES;
        const Params p = broadcast_parameters(parameters + candidate * PARAMETERS);
        Terms f;
        brdf(p, load_geometry(columns, samples, first), &f);
        const real *term = (const real *)&f;
        global scalar *row = out + (size_t)candidate * TERM_VALUES * samples + first;
        for (int v = 0; v < TERM_VALUES; ++v) store_lanes(term[v], row + v * samples);
    }
}
