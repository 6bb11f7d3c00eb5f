/*{
  "title": "Phong lobe, normalised and divided by cos theta_i, on a Lambertian base",
  "source": "Phong 1975, in the form of Westin, Li, Torrance 2004; normalisation (n+1)/(2 pi)",
  "formula": "f = k_d/pi + k_s (n+1)/(2 pi) max(0, cos alpha)^n / cos theta_i, alpha = angle to the mirror direction",
  "parameters": [
    {"name": "k_d", "unit": "1", "min": 0, "max": 1, "domain": [0, 1e30], "scale": "linear", "doc": "diffuse albedo"},
    {"name": "k_s", "unit": "1", "min": 0, "max": 100, "domain": [0, 1e30], "scale": "linear", "doc": "weight of the lobe"},
    {"name": "n", "unit": "1", "min": 0.01, "max": 1e5, "domain": [0, 1e12], "typical": [1, 1e4], "scale": "log",
     "doc": "exponent; the lobe's half width is about 67 deg/sqrt(n)"}
  ],
  "terms": [
    {"name": "diffuse", "factor": "k_d"},
    {"name": "lobe", "factor": "k_s", "of": ["n"]}
  ],
  "submodels": [{"name": "no diffuse term", "fixed": {"k_d": 0}}],
  "traits": {"reciprocal": false, "energy_conserving": false}
}*/

void brdf(Params p, Geometry s, Terms *f) {
    f->diffuse.value = 1.0 / PI;

    /* cos^n alpha as exp(n ln cos alpha): the logarithm comes from the host, free of cancellation. */
    const mask visible = s.log_cos_alpha > -1e29;
    const real l = sel(visible, s.log_cos_alpha, 0.0);
    const real N = (p.n + 1.0) / (2.0 * PI);
    const Exponential e = exponential(p.n * l);
    const real lobe = sel(visible, N / s.ci * e.mantissa, 0.0);
    f->lobe.value = lobe * e.factor;
    f->lobe.n = lobe * (1.0 / (p.n + 1.0) + l) * e.factor;
}
