/*{
  "title": "Lafortune generalised cosine lobes, isotropic, on a Lambertian base",
  "source": "Lafortune, Foo, Torrance, Greenberg 1997, in the form of Westin, Li, Torrance 2004",
  "formula": "f = k_d/pi + sum_j max(0, c_xy_j (u_x v_x + u_y v_y) + c_z_j u_z v_z)^n_j",
  "parameters": [
    {"name": "k_d", "unit": "1", "min": 0, "max": 1, "domain": [0, 1e30], "scale": "linear", "doc": "diffuse albedo"}
  ],
  "repeated": {
    "name": "lobe", "option": "lobes", "min": 1, "max": 3, "auto_max": 2, "order_by": "n",
    "parameters": [
      {"name": "c_xy", "unit": "1", "min": -3, "max": 3, "domain": [-1e30, 1e30], "scale": "linear",
       "doc": "coefficient of the tangential product; negative for a forward lobe, positive for a retro-reflective one"},
      {"name": "c_z", "unit": "1", "min": -3, "max": 3, "domain": [-1e30, 1e30], "scale": "linear",
       "doc": "coefficient of the normal product"},
      {"name": "n", "unit": "1", "min": 0.01, "max": 1e4, "domain": [0, 1e12], "typical": [0.03, 3e3], "scale": "log",
       "doc": "exponent of the lobe"}
    ]
  },
  "terms": [
    {"name": "diffuse", "factor": "k_d"},
    {"name": "lobe", "of": ["c_xy", "c_z", "n"], "homogeneous": {"in": ["c_xy", "c_z"], "degree": "n", "pole": [-1, 1],
     "columns": ["hxy", "hz"]}}
  ],
  "submodels": [{"name": "no diffuse term", "fixed": {"k_d": 0}}],
  "traits": {"reciprocal": true, "energy_conserving": false}
}*/

void brdf(Params p, Geometry s, Terms *f) {
    f->diffuse.value = 1.0 / PI;
    UNROLLED for (int j = 0; j < LOBES; ++j) {
        /* The products may cancel, and the exponent magnifies what is left: b = high + low throughout. */
        Wide tangential = product_of(p.lobe[j].c_xy, s.hxy);
        Wide normal = product_of(p.lobe[j].c_z, s.hz);
        tangential.low += p.lobe[j].c_xy * s.hxy_low;
        normal.low += p.lobe[j].c_z * s.hz_low;
        const Wide b = sum_of(tangential, normal);
        const mask lit = b.high > TINY;
        const real base = sel(lit, b.high, 1.0);
        const real inverse = 1.0 / base;
        const real l = fma(sel(lit, b.low, 0.0), inverse, log_plain(base));
        const Exponential v = exponential(fmin(p.lobe[j].n * l, (real)LOG_HUGE)); /* saturates */
        const real value = sel(lit, v.mantissa, 0.0);
        const real slope = fmin(p.lobe[j].n * inverse, (real)HUGE_SLOPE);
        f->lobe[j].value = value * v.factor;
        f->lobe[j].c_xy = saturated(value * (slope * s.hxy)) * v.factor;
        f->lobe[j].c_z = saturated(value * (slope * s.hz)) * v.factor;
        f->lobe[j].n = saturated(value * l) * v.factor;
    }
}
