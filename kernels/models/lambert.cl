/*{
  "title": "Lambert: a perfectly diffuse surface",
  "source": "Lambert, Photometria, 1760",
  "formula": "f = k_d/pi",
  "parameters": [
    {"name": "k_d", "unit": "1", "min": 0, "max": 1, "domain": [0, 1e30], "scale": "linear", "doc": "diffuse albedo"}
  ],
  "terms": [
    {"name": "diffuse", "factor": "k_d"}
  ],
  "traits": {"reciprocal": true, "energy_conserving": true}
}*/

void brdf(Params p, Geometry s, Terms *f) { f->diffuse.value = 1.0 / PI; }
