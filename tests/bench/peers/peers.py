"""Times brdfit and other tools on the same fits and writes the table of docs/performance.md; called by ./run, which starts
the service and builds the peers."""
import argparse
import concurrent.futures
import json
import math
import os
import pathlib
import random
import re
import statistics
import subprocess
import sys
import threading
import time
import urllib.request

ROOT = pathlib.Path(__file__).resolve().parents[3]
HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(ROOT / "tests" / "fits"))
import scipy_models  # noqa: E402 (a folder that is no package)

MODELS = {"phong": {}, "ward": {}, "lafortune": {"lobes": 2}, "he_torrance": {}}
FOUND = 1 + 1e-3                # times the best known loss
SURE = 0.99                     # the success that a method's budget is chosen for
AGREE = 1e-6                    # largest relative difference of the implementations' values
AGREE_SLOPES = 1e-4             # ... of their slopes: the NumPy models form some by differences
CPP = ROOT / "build" / "tests" / "bench" / "peers"

# title: program and method
PEERS = {
    "SciPy DE + TRF": ([sys.executable, str(HERE / "scipy_peer.py")], "de"),
    "SciPy DIRECT + TRF": ([sys.executable, str(HERE / "scipy_peer.py")], "direct"),
    "Ceres multi-start": ([str(CPP / "ceres_peer")], "ceres"),
    "NLopt MLSL + SLSQP": ([str(CPP / "nlopt_peer")], "mlsl"),
    "NLopt CRS2 + SLSQP": ([str(CPP / "nlopt_peer")], "crs2"),
}
SERIES = ("textbook", "window")
EFFORTS = ("standard", "draft")  # brdfit's budgets


# ------------------------------------------------------------------ brdfit

class Service:
    def __init__(self, url, pid):
        self.url, self.pid = url, pid
        self.models = {m["name"]: m for m in self.get("/v1/models")["models"]}

    def get(self, path, body=None):
        request = urllib.request.Request(self.url + path, None if body is None else json.dumps(body).encode(),
                                         {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=600) as answer:
            return json.load(answer)

    def parameters(self, model):
        """In the order of the peers."""
        lobes = MODELS[model].get("lobes", 0)
        return [p for p in self.models[model]["parameters"] if not p["name"][-1].isdigit() or int(p["name"][-1]) <= lobes]

    def bounds(self, model):
        return [(p["min"], p["max"]) for p in self.parameters(model)]

    def names(self, model):
        return [p["name"] for p in self.parameters(model)]

    def fit(self, samples, model, seed, effort):
        answer = self.get("/v1/fits", {
            "dataset": {"channels": [{"samples": samples}]}, "models": [{"name": model, **MODELS[model]}],
            "options": {"loss": "cosine_l2", "seed": seed, "effort": effort, "time_limit_s": 300}})
        fit = answer["channels"][0]["fits"][0]
        return fit["loss"], fit["search"]["time_s"]

    def processor_time(self):
        """Of all its threads until now, [s]."""
        return time.clock_gettime((~self.pid << 3) | 2)                 # clock_getcpuclockid(3), as Linux numbers clocks


def service_samples(data):
    """A scipy_models.Data as the columns of a request: unsigned theta_r, phi_r = phi_i + 180 in the mirror's half plane."""
    behind = data.tr < 0
    return {"theta_i_deg": data.ti.tolist(), "phi_i_deg": [0.0] * data.count, "theta_r_deg": abs(data.tr).tolist(),
            "phi_r_deg": ((data.phi + 180 * behind + 180) % 360).tolist(), "brdf": data.y.tolist()}


def time_brdfit(service, data_sets, seeds):
    """{(effort, data set, model): attempts}, as the peers' are; of "thorough" just one. An attempt's time is that of the
    whole request; "told" is what its answer says of the search."""
    results = {}
    for name, data in data_sets.items():
        samples = service_samples(data)
        for model in MODELS:
            for effort in EFFORTS + ("thorough",):
                service.fit(samples, model, 0, effort)                  # warm
                attempts = []
                for seed in range(1, 1 + (seeds if effort in EFFORTS else 1)):
                    begun = service.processor_time()
                    loss, told = service.fit(samples, model, seed, effort)
                    cpu = service.processor_time() - begun
                    attempts.append({"trace": [[cpu, loss]], "cpu": cpu, "told": told, "cut": False})
                results[effort, name, model] = attempts
                print(f"brdfit {effort} {name} {model}: {statistics.fmean(a['cpu'] for a in attempts):.4f} s", flush=True)
    return results


# ------------------------------------------------------------------ agreement

def draw_parameters(rng, bounds, count):
    """Uniform, in the logarithm where the bounds span decades."""
    return [[math.exp(rng.uniform(math.log(a), math.log(b))) if a > 0 and b / a > 100 else rng.uniform(a, b)
             for a, b in bounds] for _ in range(count)]


def check_agreement(service, folder):
    """Every implementation's values and slopes against the service's; exits where they differ."""
    rng = random.Random(1)
    directions = [(rng.uniform(0, 85), rng.uniform(-85, 85), rng.choice([0.0, rng.uniform(-180, 180)])) for _ in range(40)]
    directions += [(t, t, 0.0) for t in (0.0, 30.0, 60.0)]
    path = folder / "directions.txt"
    path.write_text("".join("%r %r %r 1\n" % d for d in directions))
    worst_of_all, lines = 0.0, []
    for model in MODELS:
        names, bounds = service.names(model), service.bounds(model)
        diffuse = next(i for i, n in enumerate(names) if n in ("k_d", "rho_d", "rho_ud"))
        rows = draw_parameters(rng, bounds, 60 if model == "lafortune" else 20)
        for row in rows[::2]:
            row[diffuse] = 0.0
        ours, slopes = [], []
        for row in rows:
            answer = service.get("/v1/evaluate", {
                "model": model, "parameters": dict(zip(names, row)), "precision": "double", "gradient": True,
                "geometry": {"theta_i_deg": [d[0] for d in directions], "theta_r_deg": [d[1] for d in directions],
                             "phi_deg": [d[2] for d in directions]}})
            ours += answer["values"]
            slopes += zip(*(answer["gradient"][n] for n in names))
        for series in SERIES if model == "he_torrance" else SERIES[:1]:
            for title in ("SciPy DE + TRF", "Ceres multi-start", "NLopt MLSL + SLSQP"):
                program, _ = PEERS[title]
                command = program + ["values", model, series, bounds_text(bounds), str(path), "0", "0", "0", "0"]
                output = subprocess.run(command, input="\n".join(" ".join(map(repr, r)) for r in rows), text=True,
                                        check=True, capture_output=True, env=one_thread()).stdout
                theirs = [[float(v) for v in line.split()] for line in output.splitlines()]
                worst, worst_slope, points = compare_values(ours, slopes, theirs, [r for r in rows for _ in directions])
                lines.append(f"{title.split()[0]} {model} {series}: {points} points, values differ by {worst:.1e}, "
                             f"slopes by {worst_slope:.1e}")
                print(lines[-1], flush=True)
                worst_of_all = max(worst_of_all, worst)
                if points < 200 or not worst <= AGREE or not worst_slope <= AGREE_SLOPES:
                    sys.exit("the implementations do not agree")
    return worst_of_all


def compare_values(ours, slopes, theirs, rows):
    """Largest relative difference of values, of slopes (against |f/p| at least), and at how many points. Left out: what no
    surface shows (beyond 1e60), differences below 1e-30."""
    if len(ours) != len(theirs):
        sys.exit(f"{len(theirs)} values in place of {len(ours)}")
    worst, worst_slope, points = 0.0, 0.0, 0
    for f, g, other, row in zip(ours, slopes, theirs, rows):
        if f > 1e60:
            continue
        if not all(map(math.isfinite, other)) or len(other) != 1 + len(row):
            return math.inf, math.inf, points
        points += 1
        worst = max(worst, abs(other[0] - f) / max(abs(f), 1e-30))
        for p, a, b in zip(row, g, other[1:]):
            worst_slope = max(worst_slope, abs(a - b) / max(abs(a), abs(f / p) if p else 0.0, 1e-30))
    return worst, worst_slope, points


# ------------------------------------------------------------------ the peers

def bounds_text(bounds):
    return ",".join("%r:%r" % pair for pair in bounds)


def one_thread():
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def run_peer(title, model, series, bounds, samples, seconds, target, enough):
    program, method = PEERS[title]
    command = program + [method, model, series, bounds_text(bounds), str(samples), "1", repr(seconds), repr(target),
                         str(enough)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=one_thread()) as process:
        guard = threading.Timer(2 * seconds + 60, process.kill)        # of this child alone
        guard.start()
        lines = process.stdout.read().splitlines()
        guard.cancel()
    return [json.loads(line) for line in lines if line.endswith("}")]


def need_of(cell):
    title, series, _, model = cell
    if model != "he_torrance":
        return 1
    return 2 if series == "window" else 32 if "DE" in title else 8


def time_peers(service, data_sets, targets, folder, seconds, jobs, enough):
    """{(title, series, data set, model): attempts}. Cells share the time by what they need; what a cell leaves goes to those
    after it, and those that take longest come last."""
    files = {}
    for name, data in data_sets.items():
        files[name] = folder / (name + ".txt")
        files[name].write_text("".join("%r %r %r %r\n" % t for t in zip(data.ti.tolist(), data.tr.tolist(),
                                                                          data.phi.tolist(), data.y.tolist())))
    cells = [(title, series, name, model) for model in MODELS
             for series in (SERIES[::-1] if model == "he_torrance" else SERIES[:1])
             for title in reversed(PEERS) for name in data_sets]
    results, lock = {}, threading.Lock()
    deadline, waiting = time.monotonic() + seconds, sum(map(need_of, cells))

    def work(cell):
        nonlocal waiting
        title, series, name, model = cell
        with lock:
            share = max((deadline - time.monotonic()) * jobs * need_of(cell) / waiting, 0.5)
            waiting -= need_of(cell)
        attempts = run_peer(title, model, series, service.bounds(model), files[name], share,
                            targets[name, model] * FOUND, enough if "SciPy" in title else 5 * enough)
        with lock:
            results[cell] = attempts
        spent = sum(a["cpu"] for a in attempts)
        found = sum(any(loss <= targets[name, model] * FOUND for _, loss in a["trace"]) for a in attempts)
        print(f"{title}, {series}, {name} {model}: {found} of {len(attempts)} attempts, {spent:.1f} of {share:.1f} s",
              flush=True)

    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        for done in [pool.submit(work, cell) for cell in cells]:
            done.result()
    return results


# ------------------------------------------------------------------ statistics

def repeats(p):
    """Of an attempt that succeeds with probability p, to be SURE."""
    return 1 if p == 1 else math.inf if p == 0 else max(1, math.ceil(math.log(1 - SURE) / math.log1p(-p)))


def time_to_success(attempts, target):
    """How long it takes to find `target`: {"expected", "sure": seconds, "found", "attempts", "censored"}.

    An attempt that is given a budget of T seconds succeeds if it met the target by then. With a share p of such attempts
    they are repeated: T ceil(ln(1 - SURE)/ln(1 - p)) seconds to be sure; "expected" stops at once where the target is met
    (an attempt's mean time until then, over p). Of all T the best is taken.
    Attempts that the target or the clock cut short say nothing of budgets beyond."""
    times = []                                               # (time of success or inf, own length, cut)
    for attempt in attempts:
        hit = next((t for t, loss in attempt["trace"] if loss <= target), math.inf)
        times.append((hit, attempt["cpu"], attempt["cut"]))
    spent = sum(length for _, length, _ in times)
    result = {"found": sum(math.isfinite(h) for h, _, _ in times), "attempts": len(times), "spent": spent}
    best_mean = best_sure = math.inf
    for budget in sorted({h for h, _, _ in times if math.isfinite(h)} | {length for _, length, cut in times if not cut}):
        known = [(h, length, cut) for h, length, cut in times if h <= budget or not cut or length >= budget]
        p = sum(h <= budget for h, _, _ in known) / len(known)
        if p == 0:
            continue
        cost = statistics.fmean(budget if cut else min(length, budget) for _, length, cut in known)
        seen = statistics.fmean(h if h <= budget else budget if cut else min(length, budget) for h, length, cut in known)
        best_mean, best_sure = min(best_mean, seen / p), min(best_sure, cost * repeats(p))
    result["censored"] = not math.isfinite(best_sure)
    result["expected"], result["sure"] = (spent, spent) if result["censored"] else (best_mean, best_sure)
    return result


def best_losses(*results):
    """{(data set, model): the best loss any attempt of any tool ended with}."""
    best = {}
    for attempts_of in results:
        for (*_, name, model), attempts in attempts_of.items():
            losses = [loss for a in attempts for _, loss in a["trace"]]
            best[name, model] = min(losses + [best.get((name, model), math.inf)])
    return best


def summed(cells):
    """Several data sets' times for one model. "hindsight" and "expected" let each data set have the budget that is best for
    it; "sure" is one budget for all of them, as for data that nobody has seen yet."""
    return {"expected": sum(c["expected"] for c in cells), "hindsight": sum(c["sure"] for c in cells),
            "sure": len(cells) * max(c["sure"] for c in cells), "censored": sum(c["censored"] for c in cells),
            "found": sum(c["found"] for c in cells), "attempts": sum(c["attempts"] for c in cells), "cells": len(cells)}


def summed_brdfit(cells, names, model):
    """The same; a budget is an effort, the same for all the data sets."""
    totals = []
    for effort in EFFORTS:
        mine = [cells[effort, n, model] for n in names]
        totals.append(summed(mine))
        totals[-1]["sure"] = (repeats(min(c["found"] / c["attempts"] for c in mine)) *
                              sum(c["spent"] / c["attempts"] for c in mine))
    best = min(totals, key=lambda t: (t["censored"], t["sure"]))
    for kind, key in (("expected", "expected"), ("hindsight", "sure")):
        best[kind] = sum(min((c["censored"], c[key]) for c in (cells[e, n, model] for e in EFFORTS))[1] for n in names)
    return best


def added(totals):
    return {key: sum(t[key] for t in totals) for key in totals[0]}


# ------------------------------------------------------------------ the document

def seconds_text(value):
    return f"{value:.3g} s" if value >= 0.1 else f"{1000 * value:.3g} ms"


def peer_text(peer, ours, kind):
    sign = "> " if peer["censored"] else ""
    ratio = peer[kind] / ours[kind]
    return f"{sign}{seconds_text(peer[kind])}, {sign}{ratio:.3g}"


def table(head, rows):
    lines = [head, ["---"] + ["---:"] * (len(head) - 1)] + rows
    return "\n".join("| " + " | ".join(row) + " |" for row in lines) + "\n"


def document(brdfit, peers, data_sets, facts):
    def ours(names, models):
        return added([summed_brdfit(brdfit, names, m) for m in models])

    def theirs(title, series, names, models):
        return added([summed([peers[title, series if m == "he_torrance" else "textbook", n, m] for n in names])
                      for m in models])

    def line(label, names, models, series, kind):
        mine = ours(names, models)
        return [label, seconds_text(mine[kind])] + [peer_text(theirs(t, series, names, models), mine, kind) for t in PEERS]

    def rate(names, model, series):
        totals = [ours(names, [model])] + [theirs(t, series, names, [model]) for t in PEERS]
        return [model] + [f"{t['found']}/{t['attempts']}; {t['cells'] - t['censored']}/{t['cells']}" for t in totals]

    def tables(models, series):
        lines = [line(m, names, [m], series, "sure") for m in models]
        for label, kind in (("**all four**", "sure"), ("all four, hindsight", "hindsight"), ("all four, expected", "expected")):
            lines.append(line(label, names, MODELS, series, kind))
        return (table(head, lines) + "\nAttempts that found it of all; data sets in which any did:\n\n" +
                table(head, [rate(names, m, series) for m in models]))

    head = ["", "brdfit"] + list(PEERS)
    names = list(data_sets)
    return "\n".join([
        "## Against other tools\n", facts,
        "### As written from the papers\n", tables(MODELS, "textbook"),
        "By data set, all four models, 99 %, hindsight:\n",
        table(head, [line(n, [n], MODELS, "textbook", "hindsight") for n in names]),
        "### With brdfit's window for He-Torrance's series\n",
        "The same tools, given the bounded sum of `kernels/models/he_torrance.cl`, for one point at a time:\n",
        tables(["he_torrance"], "window")]).rstrip()


def write_between_markers(path, text):
    begin, end = "<!-- peers:begin -->", "<!-- peers:end -->"
    block = f"{begin}\n{text}\n{end}"
    old = path.read_text() if path.exists() else f"# Performance\n\n{begin}\n{end}\n"
    if begin not in old:
        old = f"{old.rstrip()}\n\n{begin}\n{end}\n"
    path.write_text(re.sub(f"{begin}.*?{end}", lambda _: block, old, flags=re.S))


def version_of(package):
    answer = subprocess.run(["dpkg-query", "-W", "-f", "${Version}", package], capture_output=True, text=True, check=False)
    return re.split(r"[-+]", answer.stdout.split(":")[-1])[0] or "?"


def facts_text(args, service, brdfit, difference, data_sets, spent):
    attempts = [a for (effort, *_), cell in brdfit.items() if effort == "standard" for a in cell]
    processor, told = sum(a["cpu"] for a in attempts), sum(a["told"] for a in attempts)
    cpu = re.search(r"model name\s*:\s*(.*)", pathlib.Path("/proc/cpuinfo").read_text())
    command = " ".join(["tests/bench/peers/run"] + (["--quick"] if args.quick else []) +
                       ([f"--seconds {args.seconds:g}"] if args.seconds_given else []) +
                       ([f"--jobs {args.jobs}"] if args.jobs > 1 else []) +
                       [pathlib.Path(f).name for f in args.files])
    return f"""Written by `{command}` in {spent / 60:.0f} minutes, for {len(data_sets)} data sets.
What the peers were given: [tests/bench/peers](../tests/bench/peers/README.md).

The same data, loss (`cosine_l2`) and bounds; a fit counts as found within {FOUND - 1:.0e} of the best loss that any tool has
found. Cells: processor time of one thread, for all data sets one after the other, and its ratio to brdfit's.
Rows: to find the fit of every data set with 99 % success, by one budget a model for all of them, as for data that
nobody has seen yet; "hindsight": the same with the best budget for each data set; "expected": the mean time until it is found
by somebody who knows it when he sees it. "> T": not found in some data sets, T from the time tried there.

brdfit: the whole request in a warm service, {args.seeds} seeds; its budgets are `effort` `standard` and `draft`. (`standard`: {processor:.3g} s of
processor time for searches that took {told:.3g} s by `search.time_s`; more means a loaded machine.) Before, all implementations'
values were compared with `/v1/evaluate` at random points: they differ by {difference:.0e} at most, relative to the value.

{cpu.group(1) if cpu else "?"}; brdfit {service.get("/v1")["version"]}; SciPy {version_of("python3-scipy")}, NumPy \
{version_of("python3-numpy")}, Ceres {version_of("libceres-dev")}, NLopt {version_of("libnlopt-dev")}, g++ {version_of("g++-12")}.
"""


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--url", required=True)
    parser.add_argument("--pid", type=int, required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--document", type=pathlib.Path, required=True)
    parser.add_argument("--folder", type=pathlib.Path, required=True)
    parser.add_argument("files", nargs="*")
    args = parser.parse_args()
    begun = time.monotonic()
    args.seconds_given = args.seconds is not None
    args.seconds = args.seconds or (45 if args.quick else 800)
    args.seeds = 3 if args.quick else 20
    args.folder.mkdir(parents=True, exist_ok=True)

    paths = sorted((ROOT / "samples").glob("*.csv"))[:2 if args.quick else None] + [pathlib.Path(f) for f in args.files]
    data_sets = {p.stem: next(iter(scipy_models.read_csv(p).values())) for p in paths}
    service = Service(args.url, args.pid)
    difference = check_agreement(service, args.folder)
    brdfit = time_brdfit(service, data_sets, args.seeds)
    left = args.seconds - (time.monotonic() - begun)
    peers = time_peers(service, data_sets, best_losses(brdfit), args.folder, left, args.jobs, 2 if args.quick else 20)

    best = best_losses(brdfit, peers)
    cells, results = [], []
    for attempts_of in (brdfit, peers):
        cells.append({})
        for (*way, name, model), attempts in attempts_of.items():
            cell = time_to_success(attempts, best[name, model] * FOUND)
            cells[-1][(*way, name, model)] = cell
            results.append({"tool": way[0], "series": way[-1], "data": name, "model": model, "best_loss": best[name, model],
                            **cell, "runs": attempts})
    (args.folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    spent = time.monotonic() - begun
    write_between_markers(args.document, document(*cells, data_sets, facts_text(
        args, service, brdfit, difference, data_sets, spent)))
    print(f"{args.document}; {args.folder}/results.json; {spent:.0f} s")


if __name__ == "__main__":
    main()
