#!/usr/bin/env python3
"""Write the five surfaces of the paper as CSV samples: synthesised, not measured.

The paper is Westin, Li, Torrance, "A Comparison of Four BRDF Models", PCG-04-2, 2004.
Four surfaces come from the He-Torrance model, the metallic paint from two Lafortune lobes.

Where the parameters come from: the paper's fitted rows (Table 2 Lafortune, Table 3 He-Torrance)
were not at hand. Only rho_ud of the white plastic is a printed value. All other parameters were
RECONSTRUCTED by a search so that they reproduce, to the digits given, numbers computed earlier
from the printed rows: the lobe (BRDF less the diffuse term) in the specular direction, its full
width at half maximum (FWHM), the roughness parameter g, and the specular reflectance
rho_s = F exp(-g) S. Each entry of SURFACES says which. Values marked "assumed" follow from nothing
in the paper and are merely plausible. So compare with the paper's curves, never with its parameters.

The specular (mirror, delta) term of He-Torrance is left out. Noise is multiplicative Gaussian, 2 %.

    synthesise.py            write the CSV files beside this script
    synthesise.py --check    write nothing; exit 1 unless the files are byte for byte the same
"""

import random
import sys
from math import cos, erfc, exp, fsum, inf, lgamma, log, pi, radians, sin, sqrt, tan
from pathlib import Path

WAVELENGTH_NM = 550
THETA_I = (15, 30, 45, 60, 75)
NOISE = 0.02

SURFACES = {
    "rough_metal": dict(
        seed=20041, model="He-Torrance",
        params=dict(sigma_um=0.2, tau_um=8.17, n=0.958, k=6.69, rho_ud=0.03),
        provenance=[
            "sigma, tau: reconstructed from lobe 34.7 / 68.4 / 314 per sr at 15 / 45 / 75 deg, FWHM 9.0 deg,",
            "g = 19.5 at 15 deg, rho_s = 2.7e-5 / 0.0049 / 0.217 at 45 / 60 / 75 deg;",
            "n, k: tabulated aluminium at 550 nm, consistent with those numbers; rho_ud: assumed",
        ]),
    "white_plastic": dict(
        seed=20042, model="He-Torrance",
        params=dict(sigma_um=0.5125, tau_um=6.98, n=1.5, k=0.0, rho_ud=0.534),
        provenance=[
            "sigma, tau, n: reconstructed from lobe 0.160 / 0.376 / 15.8 per sr at 15 / 45 / 75 deg,",
            "FWHM 29-31 deg, g = 128 at 15 deg, rho_s = 2.6e-5 at 75 deg; k: taken as 0;",
            "rho_ud: printed in the paper",
        ]),
    "paper": dict(
        seed=20043, model="He-Torrance",
        params=dict(sigma_um=0.7975, tau_um=4.865, n=1.5, k=0.0, rho_ud=0.6),
        provenance=[
            "sigma, tau, n: reconstructed from lobe 0.032 / 0.075 / 2.29 per sr at 15 / 45 / 75 deg,",
            "g = 310 at 15 deg; k: taken as 0; rho_ud: assumed",
        ]),
    "smooth_metal": dict(
        seed=20044, model="He-Torrance",
        params=dict(sigma_um=0.0695, tau_um=1.28, n=1.06, k=6.69, rho_ud=0.02),
        provenance=[
            "sigma, tau, n: reconstructed from rho_s = 0.074 / 0.38 / 0.73 / 0.59 at 4 / 54 / 75 / 85 deg",
            "(several n, k fit equally well); k: tabulated aluminium; rho_ud: assumed;",
            "the real surface also has a strong mirror term, absent here",
        ]),
    "metallic_paint": dict(
        seed=20045, model="Lafortune, two lobes",
        params=dict(k_d=0.1, c_xy_1=-1.0224, c_z_1=0.9763, n_1=30.8, c_xy_2=-0.992, c_z_2=1.0321, n_2=11.7),
        provenance=[
            "lobes: reconstructed from lobe 1.93 / 2.13 / 2.74 per sr at 15 / 45 / 75 deg, FWHM 28-34 deg;",
            "those few numbers do not determine six parameters: one plausible choice of many; k_d: assumed",
        ]),
}


def lafortune(theta_i, theta_r, p):
    """BRDF in the plane of incidence; angles in degrees, theta_r signed, + on the specular side."""
    ti, tr = radians(theta_i), radians(theta_r)
    f = p["k_d"] / pi
    for j in ("1", "2"):
        base = -p["c_xy_" + j] * sin(ti) * sin(tr) + p["c_z_" + j] * cos(ti) * cos(tr)
        f += max(0.0, base) ** p["n_" + j]
    return f


def fresnel(cos_d, n, k):
    """Unpolarised reflectance of a surface of index n + ik."""
    index2 = complex(n, k) ** 2
    q = (index2 - (1 - cos_d**2)) ** 0.5
    return (abs((cos_d - q) / (cos_d + q)) ** 2 + abs((index2 * cos_d - q) / (index2 * cos_d + q)) ** 2) / 2


def lambert_w(z):
    """W with W exp(W) = z, for z >= 0."""
    w = log(1 + z)  # not below the root, so Newton's steps fall to it monotonically
    for _ in range(50):
        w -= (w - z * exp(-w)) / (1 + w)
    return w


def series(g, a):
    """sum over m >= 1 of exp(-g) g^m / (m! m) exp(-a/m), to convergence."""
    mode = (g + sqrt(g * g + 4 * a)) / 2  # an upper bound of where the terms peak
    last = int(mode + 9 * sqrt(mode) + 30)
    return fsum(exp(m * log(g) - g - lgamma(m + 1) - a / m) / m for m in range(1, last + 1))


def he_torrance(theta_i, theta_r, p):
    """Diffuse and directional-diffuse terms in the plane of incidence (He et al. 1991).

    Two misprints of the original are put right: v_xy holds 2 pi / lambda, and Lambda has its exponential.
    """
    sigma_0, tau = p["sigma_um"], p["tau_um"]
    ti, tr = radians(theta_i), radians(theta_r)
    cos_i, cos_r = cos(ti), cos(tr)
    wave = 2 * pi / (WAVELENGTH_NM / 1000)  # per micrometre
    cos_d = cos((ti + tr) / 2)  # between either direction and the half vector

    def steepness(theta):
        return tau / (2 * sigma_0 * tan(abs(theta))) if theta else inf

    def visible(theta):
        return tan(abs(theta)) * erfc(steepness(theta))

    def unshadowed(theta):  # (1 - erfc(h)/2) / (1 + Lambda), without cancellation
        h = steepness(theta)
        x = sqrt(pi) * h * erfc(-h)
        return x / (x + exp(-h * h)) if h < inf else 1.0

    # Effective roughness: only the part of the surface that is lit and seen.
    sigma2 = sigma_0**2 / (1 + lambert_w((visible(ti) + visible(tr)) ** 2 / (8 * pi)))
    g = wave**2 * sigma2 * (cos_i + cos_r) ** 2
    v_xy = wave * (sin(tr) - sin(ti))
    distribution = (wave * tau / 4) ** 2 * series(g, (v_xy * tau / 2) ** 2)
    geometric = (4 * cos_d**2 / (cos_i + cos_r)) ** 2
    shadowing = unshadowed(ti) * unshadowed(tr)
    lobe = fresnel(cos_d, p["n"], p["k"]) * geometric * shadowing * distribution / (pi * cos_i * cos_r)
    return p["rho_ud"] / pi + lobe


def exitant_angles(theta_i):
    """Every 4 degrees from -80 to 80, every degree within 16 of the mirror, every half within 4."""
    coarse = [2.0 * j for j in range(-40, 41, 2)]
    fine = [theta_i + d for d in range(-16, 17)] + [theta_i + d / 2 for d in range(-8, 9)]
    return sorted({t for t in coarse + fine if abs(t) <= 80})


def csv(name):
    surface = SURFACES[name]
    p = surface["params"]
    evaluate = he_torrance if surface["model"] == "He-Torrance" else lafortune
    noise = random.Random(surface["seed"])
    lines = [
        f"# {name.replace('_', ' ')}: SYNTHESISED, NOT MEASURED",
        "# written by samples/synthesise.py, which says more",
        '# after a sample of Westin, Li, Torrance, "A Comparison of Four BRDF Models", PCG-04-2, 2004',
        "# the paper's table rows were not at hand; provenance of the parameters:",
        *(f"#   {line}" for line in surface["provenance"]),
        f"# model = {surface['model']}",
        *(f"# {key} = {value!r}" for key, value in p.items()),
        f"# noise = multiplicative Gaussian, {100 * NOISE:g} %",
        f"# seed = {surface['seed']}",
        "# in the plane of incidence; theta_r_deg > 0 on the specular side; no specular (delta) term",
        "theta_i_deg,theta_r_deg,wavelength_nm,brdf_per_sr",
    ]
    for theta_i in THETA_I:
        for theta_r in exitant_angles(theta_i):
            f = evaluate(theta_i, theta_r, p) * (1 + NOISE * noise.gauss(0, 1))
            lines.append(f"{theta_i},{theta_r:g},{WAVELENGTH_NM},{f:.6g}")
    return ("\n".join(lines) + "\n").encode()


def main(arguments):
    if arguments not in ([], ["--check"]):
        sys.exit(__doc__)
    different = []
    for name in SURFACES:
        path = Path(__file__).resolve().parent / f"{name}.csv"
        if not arguments:
            path.write_bytes(csv(name))
        elif not path.is_file() or path.read_bytes() != csv(name):
            different.append(path.name)
    if different:
        sys.exit("not what synthesise.py writes: " + ", ".join(different))


if __name__ == "__main__":
    main(sys.argv[1:])
