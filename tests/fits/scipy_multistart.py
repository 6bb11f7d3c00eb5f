#!/usr/bin/python3
"""Independent judge of the fits: multi-start bounded least squares with scipy.

    scipy_multistart.py FILE.csv [--starts 200] [--seed 1] [--models phong,ward,...]
                        [--channels Y,R] [--three-lobes] [--out FILE.json] [--merge]
    scipy_multistart.py --self-check

Shares no code with the fitter. Every model is minimised in the paper's loss

    loss = sqrt( sum cos(theta_r) (f - y)^2 / sum cos(theta_r) )        per channel

inside the default parameter boxes. He-Torrance lengths (sigma, tau) are in
wavelengths, whether or not the channel has one.

Where starts come from:
  phong, ward   the two albedos are linear: a dense scan of the shape parameter with the
                bounded 2-variable linear problem solved exactly, then random starts
  lafortune     b^n = A beta(omega)^n is linear in A: scans over (omega, n), for two lobes over
                pairs of columns; random starts with and without variable projection; starts
                from the best fit with one lobe fewer plus a random lobe
  he_torrance   a 4-D scan (sigma, tau, n, k) with rho_ud solved; random starts

Every start is run through scipy.optimize.least_squares (trf, box bounds); the best ones are
run again with tight tolerances, tried with near-bound parameters set to the bound, and
polished by Nelder-Mead (the clamps and the Fresnel term have kinks).
"starts_agreeing_1e-3" counts the starts whose loss after that is within 0.1 % of the best.
"""
import argparse
import json
import os
import sys
import time

import numpy as np

from scipy_models import MODELS, PI, Data, read_csv, series, stirling_error


def fit(name, d, count, seed, fewer=None, first=None):
    model = MODELS[name](d)
    rng = np.random.default_rng([seed, sorted(MODELS).index(name)])
    starts = model.starts(rng, count, fewer)
    if first is not None:
        starts.insert(0, (first, True))
    ends = [model.run(x, 1e-10, 200) for x, _ in starts]
    order = sorted(range(len(ends)), key=lambda i: ends[i][0])
    for i in order[:max(25, len(order) // 5)]:               # tight tolerances for the better ones
        again = model.run(ends[i][1], 1e-12, 1500)
        if again[0] < ends[i][0]:
            ends[i] = again
    order.sort(key=lambda i: ends[i][0])
    best = ends[order[0]]
    tried = []
    for i in order:                                          # polish the best few that differ
        if any(abs(ends[i][0] / t - 1) < 1e-7 for t in tried):
            continue
        tried.append(ends[i][0])
        end = model.snap(*ends[i])
        end = model.polish(*end)
        end = model.snap(*end)
        ends[i] = min(ends[i], end, key=lambda e: e[0])
        best = min(best, end, key=lambda e: e[0])
        if len(tried) == 4:
            break
    agreeing = [i for i, e in enumerate(ends) if e[0] <= best[0] * (1 + 1e-3)]
    return {
        "loss": best[0],
        "relative_loss": best[0] / d.scale,
        "parameters": {k: float(v) for k, v in model.named(best[1]).items()},
        "starts": len(ends),
        "starts_agreeing_1e-3": len(agreeing),
        "random_starts_agreeing_1e-3": sum(not starts[i][1] for i in agreeing),
        "seed": seed,
    }, best[1]


def coordinates(name, p):
    """A stored result's parameters as fitted coordinates."""
    if name == "phong":
        return np.array([p["k_d"], p["k_s"], np.log(p["n"])])
    if name == "ward":
        return np.array([p["rho_d"], p["rho_s"], np.log(p["alpha"])])
    if name == "he_torrance":
        return np.array([np.log(p["sigma"]), np.log(p["tau"]), np.log(p["n"]), p["k"], p["rho_ud"]])
    x = [p["k_d"]]
    for j in range(1, int(name[-1]) + 1):
        x += [p["c_xy_%d" % j], p["c_z_%d" % j], np.log(p["n_%d" % j])]
    return np.array(x)


def self_check():
    """Series against plain summation, gradients against differences."""
    rng = np.random.default_rng(0)
    worst = 0.0
    for _ in range(300):
        g, a = np.exp(rng.uniform(np.log(1e-8), np.log(2e4))), np.exp(rng.uniform(np.log(1e-4), np.log(1e5)))
        got = series(np.array([g]), np.array([a]))[:, 0]
        m = np.arange(1.0, 60000.0)
        t = m * np.log1p((m - g) / g) - (m - g)
        t = np.exp(-t - stirling_error(m) - a / m) / np.sqrt(2 * PI * m)
        for j in range(3):
            ref = (t / m ** j).sum()
            if ref > 1e-290:
                worst = max(worst, abs(got[j] / ref - 1))
    print("series: worst relative difference %.2g" % worst)
    ti, tr = (v.ravel() for v in np.meshgrid([5.0, 30, 60, 75], np.arange(-80.0, 81, 8)))
    d = Data(ti, tr, 0 * ti, 1 + rng.random(len(ti)))
    bad = worst > 1e-11
    for name, make in MODELS.items():
        model, err = make(d), 0.0
        for _ in range(20):
            if name == "he_torrance":
                x = np.array([rng.uniform(-3, 2), 0, rng.uniform(-1, 1), rng.uniform(0.1, 3), 0.4])
                x[1] = x[0] + rng.uniform(0, 3)
            elif name.startswith("lafortune"):
                x = np.array([0.4] + [-1.0, 0.9, 2.0] * model.lobes) + rng.normal(size=len(model.lo)) * 0.1
            else:
                x = np.array([0.3, 0.5, rng.uniform(-1, 0)])
            jac = model.gradient(x)
            for i in range(len(x)):
                e = np.zeros(len(x))
                e[i] = 1e-5
                num = (model.value(x + e) - model.value(x - e)) / 2e-5
                err = max(err, np.abs(num - jac[:, i]).max() / max(np.abs(jac[:, i]).max(), 1e-6))
        print("%s: worst gradient difference %.2g" % (name, err))
        bad = bad or err > 1e-5
    return 1 if bad else 0


def main():
    p = argparse.ArgumentParser(description="Independent multi-start fits of BRDF models")
    p.add_argument("file", nargs="?")
    p.add_argument("--starts", type=int, default=200)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--models", default="phong,ward,lafortune_1,lafortune_2,he_torrance")
    p.add_argument("--three-lobes", action="store_true", help="also fit Lafortune with three lobes")
    p.add_argument("--channels", help="only these, comma separated")
    p.add_argument("--out", help="write here (after every fit) instead of stdout")
    p.add_argument("--merge", action="store_true", help="start from the results in --out and keep the better of both")
    p.add_argument("--self-check", action="store_true")
    args = p.parse_args()
    np.seterr(all="ignore")                                  # wild starts overflow; they lose
    if args.self_check:
        return self_check()
    if not args.file:
        p.error("FILE is missing")
    models = args.models.split(",") + (["lafortune_3"] if args.three_lobes else [])
    if set(models) - set(MODELS):
        p.error("models are " + ", ".join(MODELS))
    channels = read_csv(args.file)
    result = {"file": os.path.basename(args.file), "units": {"sigma": "lambda", "tau": "lambda"}, "channels": {}}
    if args.merge and args.out and os.path.exists(args.out):
        with open(args.out) as handle:
            result = json.load(handle)

    def write():
        text = json.dumps(result, indent=1) + "\n"
        if args.out:
            with open(args.out + ".part", "w") as handle:
                handle.write(text)
            os.replace(args.out + ".part", args.out)
        else:
            sys.stdout.write(text)

    for channel, d in channels.items():
        if args.channels and channel not in args.channels.split(","):
            continue
        found = result["channels"].setdefault(channel, {})
        for name in [m for m in MODELS if m in models]:
            began = time.time()
            lobes = int(name[-1]) if name.startswith("lafortune") else 0
            smaller = found.get("lafortune_%d" % (lobes - 1))
            fewer = coordinates("lafortune_%d" % (lobes - 1), smaller["parameters"]) if smaller else None
            old = found.get(name)
            first = coordinates(name, old["parameters"]) if old else None
            new, _ = fit(name, d, args.starts, args.seed, fewer, first)
            if old:
                same = abs(old["loss"] / new["loss"] - 1) < 1e-3
                if same:
                    new["starts_agreeing_1e-3"] += old["starts_agreeing_1e-3"] - 1
                    new["random_starts_agreeing_1e-3"] += old["random_starts_agreeing_1e-3"]
                new["starts"] += old["starts"] - 1
                if old["loss"] < new["loss"]:
                    new["loss"], new["relative_loss"], new["parameters"] = old["loss"], old["relative_loss"], old["parameters"]
            found[name] = new
            print("%s %s %s: loss %.12g, %d of %d starts agree, %.1f s" % (result["file"], channel, name, new["loss"],
                  new["starts_agreeing_1e-3"], new["starts"], time.time() - began), file=sys.stderr, flush=True)
            if args.out:
                write()
    if not args.out:
        write()
    return 0


if __name__ == "__main__":
    sys.exit(main())
