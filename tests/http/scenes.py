#!/usr/bin/python3
"""Holds what the service says of measured surfaces in scenes against models, errors, loss and albedo of its own.

    scenes.py URL FILE.csv [...]      (BRDFIT_LONG=1: every scene for every file)

Of an answer only parameters, costs and numbers of free parameters are taken; what is the cheapest model within the
tolerance, and the front of cost against error, follow from the textbook's formulas (tests/fits/scipy_models.py).
Prints a line for each scene and for each thing that is not so; exit 1 if there is one."""
import csv
import json
import os
import pathlib
import sys
import time
import urllib.parse
import urllib.request

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "fits"))
import scipy_models as textbook  # noqa: E402

PI = np.pi
LONG = os.environ.get("BRDFIT_LONG") == "1"
SMALLEST = np.finfo(float).tiny
NOWHERE_NEAR = 10  # decades: beyond, rounding decides where a model is 0

# (tolerance [decades], incidence, exitance, further options of the query)
SCENES = [
    (0.1, (0, 90), (0, 90), {}),
    (0.05, (0, 60), (0, 90), {}),
    (0.3, (0, 90), (0, 70), {"scene.max_ns_per_evaluation": 1.0}),
    (0.02, (0, 90), (0, 90), {"loss": "log"}),
    (0.3, (20, 65), (0, 60), {"scene.require": "energy_conserving"}),
    (0.1, (0, 50), (0, 60), {"scene.require": "reciprocal", "loss": "log"}),
]
if LONG:
    SCENES += [(t, i, r, {}) for t in (0.02, 0.05, 0.1, 0.3) for i, r in (((0, 90), (0, 90)), ((0, 45), (0, 60)))]


class RoughnessAsGiven(textbook.HeTorrance):
    """Without the effective roughness."""

    def rough(self, rho):
        return super().rough(rho)[0], 0.0


def lobes(fit):
    return [[fit["parameters"][f"{name}_{j}"]["value"] for name in ("c_xy", "c_z", "n")]
            for j in range(1, fit["lobes"] + 1)]


def lobe(data, c_xy, c_z, n):
    """One of Lafortune's, in long double: a narrow one's value where its sum nearly vanishes is all rounding."""
    theta_i, theta_r, phi = (np.radians(np.asarray(v, np.longdouble)) for v in (data.ti, data.tr, data.phi))
    b = np.maximum(c_z * np.cos(theta_i) * np.cos(theta_r) - c_xy * np.sin(theta_i) * np.sin(theta_r) * np.cos(phi), 0)
    return (b ** n).astype(float)


def values(fit, wavelength_um, data):
    p = {name: parameter["value"] for name, parameter in fit["parameters"].items()}
    if fit["model"] == "lambert":
        return np.full(data.count, p["k_d"] / PI)
    if fit["model"] == "phong":
        return textbook.Phong(data).value([p["k_d"], p["k_s"], np.log(p["n"])])
    if fit["model"] == "ward":
        return textbook.Ward(data).value([p["rho_d"], p["rho_s"], np.log(p["alpha"])])
    if fit["model"] == "lafortune":
        return sum((lobe(data, *one) for one in lobes(fit)), np.full(data.count, p["k_d"] / PI))
    kind = RoughnessAsGiven if fit.get("submodel") == "no effective roughness" else textbook.HeTorrance
    x = [np.log(p["sigma"] / wavelength_um), np.log(p["tau"] / wavelength_um), np.log(p["n"]), p["k"], p["rho_ud"]]
    return kind(data).value(x)


def decades(f, y):
    seen = y > 0
    return float(np.sqrt(np.mean(np.log10(np.maximum(f[seen], SMALLEST) / y[seen]) ** 2)))


def hemisphere(theta_i_deg, pole_deg, kink_deg=None):
    """Directions in polar coordinates about a pole in the plane of incidence, down to the horizon, and weights of
    cos theta_r. What is integrated may go as a root at a cone of directions kink_deg from the source."""
    pole = np.radians(abs(pole_deg))
    x, w = np.polynomial.legendre.leggauss(8)
    # Broad lobes end steeply at a right angle; the others are where circles meet the horizon.
    steep = [PI / 2, abs(PI / 2 - pole), PI / 2 + pole, 3 * PI / 2 - pole]
    between = pole + np.radians(abs(theta_i_deg))       # the pole and the source
    if kink_deg is not None:
        kink = np.radians(kink_deg)
        steep += [abs(between - kink), between + kink, 2 * PI - between - kink, PI - kink]
    near = np.concatenate([[0.0], np.geomspace(1e-6, 0.2, 10)])
    edges = np.concatenate([[0.0, PI], np.geomspace(1e-4, 0.3, 16), np.linspace(0.3, PI, 13)] +
                           [at + side * near for at in steep for side in (-1, 1)])
    edges = np.unique(np.clip(edges, 0, PI))
    psi = np.concatenate([(a + b) / 2 + (b - a) / 2 * x for a, b in zip(edges, edges[1:])])
    weight = np.concatenate([(b - a) / 2 * w for a, b in zip(edges, edges[1:])])
    with np.errstate(all="ignore"):
        edge = np.where(np.sin(pole) > 1e-12, 1 / (np.tan(psi) * np.tan(pole)),
                        np.where((psi < PI / 2) == (pole < PI / 2), 2, -2))
    low = np.arccos(np.clip(edge, -1, 1))               # the horizon
    x, w = np.polynomial.legendre.leggauss(40)
    t, w = (x + 1) / 2, w / 2
    if kink_deg is None:
        chi = low[:, None] + (PI - low)[:, None] * t
        size = (PI - low)[:, None] * w
    else:  # the circle's part within the cone and that outside; squares of t take up the root
        with np.errstate(all="ignore"):
            turn = (np.cos(psi) * np.cos(between) - np.cos(kink)) / (np.sin(psi) * np.sin(between))
        turn = np.maximum(np.arccos(np.clip(np.nan_to_num(turn, nan=1), -1, 1)), low)
        parts = np.stack([low - turn, PI - turn])[:, :, None]
        chi = np.concatenate(turn[:, None] + parts * t ** 2, axis=1)
        size = np.concatenate(np.abs(parts) * 2 * t * w, axis=1)
    size *= (2 * weight * np.sin(psi))[:, None]
    psi = psi[:, None]
    vx = np.sign(pole_deg or 1) * (np.cos(psi) * np.sin(pole) + np.sin(psi) * np.cos(chi) * np.cos(pole))
    vy = np.sin(psi) * np.sin(chi)
    vz = np.cos(psi) * np.cos(pole) - np.sin(psi) * np.cos(chi) * np.sin(pole)
    up = (vz > 1e-9) & (size > 0)
    theta_r = np.degrees(np.arctan2(np.hypot(vx, vy)[up], vz[up]))
    data = textbook.Data(np.full(up.sum(), theta_i_deg), theta_r, np.degrees(np.arctan2(vy, vx)[up]),
                         np.ones(up.sum()))
    return data, size[up] * vz[up]


def albedo(fit, wavelength_um, theta_i_deg):
    """Each of Lafortune's lobes about its own peak, all else about the mirror direction."""
    if fit["model"] == "lafortune":
        sum_of_lobes = fit["parameters"]["k_d"]["value"]
        for c_xy, c_z, n in lobes(fit):
            theta_i = np.radians(theta_i_deg)
            peak = np.degrees(np.arctan2(-c_xy * np.sin(theta_i), c_z * np.cos(theta_i)))
            data, weight = hemisphere(theta_i_deg, peak)
            sum_of_lobes += float(lobe(data, c_xy, c_z, n) @ weight)
        return sum_of_lobes
    # Total reflection begins at the critical angle, which is half of that between source and view.
    n = fit["parameters"]["n"]["value"] if fit["model"] == "he_torrance" else 1
    kink_deg = 2 * np.degrees(np.arcsin(n)) if n < 1 else None
    data, weight = hemisphere(theta_i_deg, theta_i_deg, kink_deg)
    return float(values(fit, wavelength_um, data) @ weight)


def read(path):
    """The first channel's rows (luminance where there is one), its wavelength [um] or 1, and a CSV of them alone."""
    with open(path, newline="", encoding="utf-8") as handle:
        rows = list(csv.DictReader(line for line in handle if not line.startswith("#")))
    channels = [row.get("channel", "") for row in rows]
    rows = [row for row, name in zip(rows, channels) if name == ("Y" if "Y" in channels else channels[0])]
    wavelength = rows[0].get("wavelength_nm")
    rows = [row for row in rows if row.get("wavelength_nm") == wavelength]
    text = ",".join(rows[0]) + "\n" + "".join(",".join(row.values()) + "\n" for row in rows)
    return rows, float(wavelength) / 1000 if wavelength else 1.0, text


def post(url, query, text):
    request = urllib.request.Request(f"{url}/v1/fits?{urllib.parse.urlencode(query)}", text.encode(),
                                     {"Content-Type": "text/csv", "Prefer": "wait=60"})
    with urllib.request.urlopen(request, timeout=90) as answer:
        body = json.load(answer)
    end = time.time() + 120
    while "channels" not in body and time.time() < end:
        time.sleep(0.2)
        try:
            with urllib.request.urlopen(f"{url}/v1/fits/{body['id']}/result", timeout=90) as answer:
                body = json.load(answer)
        except urllib.error.HTTPError as error:
            if error.code != 409:
                raise
    return body


wrong = []


def must(condition, text):
    if not condition:
        wrong.append(text)
        print("  NOT SO:", text)


def name_of(fit):
    return fit["model"] + (f" ({fit['lobes']})" if "lobes" in fit else "") + \
        (f", {fit['submodel']}" if "submodel" in fit else "")


def judge(url, path, scene):
    tolerance, seen_i, seen_r, options = scene
    rows, wavelength_um, text = read(path)
    query = {"scene.tolerance_log10": tolerance, "scene.theta_i_deg": "%g,%g" % seen_i,
             "scene.theta_r_deg": "%g,%g" % seen_r, **options}
    if not LONG:
        query["effort"] = "draft"
    channel = post(url, query, text)["channels"][0]
    kept = [(float(row["theta_i_deg"]), float(row["theta_r_deg"]), 0.0, float(row["brdf_per_sr"])) for row in rows]
    kept = [s for s in kept if seen_i[0] <= s[0] <= seen_i[1] and seen_r[0] <= abs(s[1]) <= seen_r[1]]
    data = textbook.Data(*np.array(kept).T)
    what = f"{path.name} {query}"
    must(channel["samples"] == len(kept), f"{what}: samples")
    found = []
    for fit in channel["fits"]:
        f = values(fit, wavelength_um, data)
        error = decades(f, data.y)
        loss = error if options.get("loss") == "log" else data.loss(f)
        if min(error, fit["log10_rmse"]) < NOWHERE_NEAR:
            must(abs(error - fit["log10_rmse"]) <= 1e-6 * max(1, error),
                 f"{what}: {name_of(fit)} is off by {error} decades, not {fit['log10_rmse']}")
            must(abs(loss - fit["loss"]) <= 1e-5 * loss, f"{what}: {name_of(fit)} loses {loss}, not {fit['loss']}")
        else:
            error = fit["log10_rmse"]
        free = sum(not parameter.get("fixed", False) for parameter in fit["parameters"].values())
        ns = fit["cost"]["single_ns"] or fit["cost"]["double_ns"]
        found.append((ns, free, error, fit))
    found.sort(key=lambda point: point[:3])

    front = []
    for ns, _, error, fit in found:
        if not front or error < front[-1][0] * (1 - 1e-3):
            front.append((error, fit["rank"]))
    must([rank for _, rank in front] == [point["rank"] for point in channel["pareto"]], f"{what}: the front")
    good = [point for point in found if point[2] <= tolerance]
    most = options.get("scene.max_ns_per_evaluation", np.inf)
    recommended = channel["recommended"]
    if good and good[0][0] <= most:
        must(recommended.get("rank") == good[0][3]["rank"], f"{what}: {name_of(good[0][3])} is to be recommended")
        must(recommended["reason"].startswith(name_of(good[0][3])), f"{what}: the reason names it")
    else:
        must(recommended["model"] is None, f"{what}: nothing is to be recommended")
        must(("cheap enough" if good else "good enough") in recommended["reason"], f"{what}: the reason")

    # Energy: of all at the data's angles; of one at more.
    steepest = min(seen_i[1], max(89, max(s[0] for s in kept)))
    for k, fit in enumerate(channel["fits"]):
        physics = fit["physics"]
        must(physics["theta_i_deg"] == [seen_i[0], steepest], f"{what}: energy is judged where the scene sees")
        must([a["theta_i_deg"] for a in fit["albedo"]] == sorted({s[0] for s in kept}), f"{what}: angles of albedos")
        told = fit["albedo"] if LONG or fit["model"] != "he_torrance" else fit["albedo"][k % 2::2]
        for a in told:
            if a["value"] is None:
                continue
            own = albedo(fit, wavelength_um, a["theta_i_deg"])
            must(abs(own - a["value"]) <= 1e-4 * max(1, own),
                 f"{what}: {name_of(fit)} has the albedo {own} at {a['theta_i_deg']}, not {a['value']}")
        if physics["max_albedo"] is None:
            continue
        most_told = max((a["value"] for a in fit["albedo"] if a["value"] is not None), default=0)
        at = albedo(fit, wavelength_um, physics["at_theta_i_deg"])
        must(seen_i[0] <= physics["at_theta_i_deg"] <= steepest, f"{what}: the place of the largest albedo")
        must(abs(at - physics["max_albedo"]) <= 1e-4 * max(1, at) and physics["max_albedo"] >= most_told - 1e-4,
             f"{what}: {name_of(fit)} has the albedo {at} at {physics['at_theta_i_deg']}, not {physics['max_albedo']}")
        must(physics["energy_conserving"] == (physics["max_albedo"] <= 1 + 1e-4), f"{what}: the verdict on energy")
        if options.get("scene.require") == "energy_conserving":
            must(physics["energy_conserving"], f"{what}: {name_of(fit)} conserves energy")
        if options.get("scene.require") == "reciprocal":
            must(physics["reciprocal"], f"{what}: {name_of(fit)} is reciprocal")
    print(f"{path.name} {tolerance} {seen_i} {seen_r} {options}: {len(found)} fits; {recommended['reason']}", flush=True)


def main():
    url, files = sys.argv[1], [pathlib.Path(name) for name in sys.argv[2:]]
    count = 0
    for k, path in enumerate(files):
        for i, scene in enumerate(SCENES):
            if LONG or (i - k) % len(SCENES) == 0:
                judge(url, path, scene)
                count += 1
    print(f"{count} scenes, {len(wrong)} things that are not so")
    return 1 if wrong or not count else 0


if __name__ == "__main__":
    sys.exit(main())
