"""SciPy on the models of tests/fits/scipy_models.py: a global method, then least_squares (trf, exact Jacobian).

    scipy_peer.py METHOD MODEL SERIES LOW:HIGH,... SAMPLES SEED SECONDS TARGET ENOUGH

  de      differential_evolution with its default population, strategy and tolerance, from Sobol points
  direct  scipy.optimize.direct (deterministic: one attempt)
  values  for each line of parameters on standard input: value and slopes at each sample

How long either global method should run is not known before: de is interrupted after 10, 20, 40 ... generations and the best
point so far descended from, direct is called with twice the evaluations each time. Every such end is an event of the attempt,
at the time that a run with just this budget takes.
"""
import functools
import json
import pathlib
import sys
import time

import numpy as np
from scipy.optimize import differential_evolution, direct

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "fits"))
import scipy_models  # noqa: E402 (a folder that is no package)

# The parameters that 0 is a bound of and that span decades: searched as ln(p + shift).
SHIFTS = {"phong": {1: 1e-3}, "ward": {1: 1e-3}, "lafortune": {}, "he_torrance": {3: 0.1}}
LOGARITHMIC = {"phong": [2], "ward": [2], "lafortune": [3, 6], "he_torrance": [0, 1, 2]}     # in the Model's own x
NAMES = {"lafortune": "lafortune_2"}


def textbook_series(g, a):
    """M_0, M_1, M_2 as scipy_models.series gives them, term by term from the first in pieces of 64, until the next ones
    no longer count."""
    past = (g + np.sqrt(g * g + 4 * a)) / 2                  # terms fall from here on
    sums = np.zeros((3, len(g)))
    going = np.arange(len(g))
    log_g = np.log(g)
    first = 1
    while len(going):
        m = np.arange(first, first + 64.0)
        t = np.exp(np.outer(log_g[going], m) - scipy_models.gammaln(m + 1) - g[going, None] - np.outer(a[going], 1 / m))
        sums[:, going] += (t @ np.stack([m ** 0, 1 / m, 1 / m ** 2], 1)).T
        going = going[(m[-1] < past[going]) | (t[:, -1] > 1e-12 * sums[0, going])]
        first += 64
    return sums


class Problem:
    """A Model in the coordinates u of a global search."""

    def __init__(self, model, name):
        self.model, self.shifts = model, SHIFTS[name]
        self.lo, self.hi = model.lo.copy(), model.hi.copy()
        for i, shift in self.shifts.items():
            self.lo[i], self.hi[i] = np.log(self.lo[i] + shift), np.log(self.hi[i] + shift)
        self.bounds = list(zip(self.lo, self.hi))

    def x(self, u):
        x = np.array(u, float)
        for i, shift in self.shifts.items():
            x[i] = np.exp(x[i]) - shift
        return x

    def objective(self, u):
        r = self.model.residual(self.x(u))
        return float(r @ r)


    def descend(self, u):
        return self.model.run(self.x(u), 1e-9, 200)[0]


def tell(trace, cpu, wall, cut):
    print(json.dumps({"trace": trace, "cpu": cpu, "wall": wall, "cut": cut}), flush=True)


def run_de(problem, seed, seconds, target):
    """True if it found the target."""
    trace, cut, generation = [], False, 0
    begun, wall = time.process_time(), time.monotonic()
    descents = 0.0                                           # seconds, which do not count

    def polish(u):
        nonlocal descents
        at = time.process_time()
        loss = problem.descend(u)
        spent = time.process_time() - at
        trace.append([at - begun - descents + spent, loss])
        descents += spent
        return loss

    def each(u, convergence):
        nonlocal generation, cut
        generation += 1
        due = generation % 10 == 0 and (generation // 10) & (generation // 10 - 1) == 0
        cut = (due and polish(u) <= target) or time.process_time() - begun > seconds
        return cut

    result = differential_evolution(problem.objective, problem.bounds, seed=seed, init="sobol", polish=False, callback=each)
    cpu = time.process_time() - begun - descents
    if not cut:
        polish(result.x)
        cpu = trace[-1][0]
    tell(trace, cpu, time.monotonic() - wall, cut)
    return any(loss <= target for _, loss in trace)


def run_direct(problem, seconds, target):
    trace, cut, evaluations = [], True, 20 * len(problem.lo)
    begun, wall = time.process_time(), time.monotonic()
    spent = 0.0
    while not trace or (trace[-1][1] > target and time.process_time() - begun + 2 * spent < seconds):
        at = time.process_time()
        result = direct(problem.objective, problem.bounds, maxfun=evaluations, maxiter=evaluations, vol_tol=0, len_tol=1e-6)
        loss = problem.descend(result.x)
        spent = time.process_time() - at
        trace.append([spent, loss])
        cut = result.nfev >= evaluations                     # else it ended by itself
        if not cut:
            break
        evaluations *= 2
    tell(trace, spent, time.monotonic() - wall, cut)


def print_values(model, name):
    for line in sys.stdin:
        x = np.array([float(word) for word in line.split()])
        logarithmic = LOGARITHMIC[name]
        x[logarithmic] = np.log(x[logarithmic])
        slopes = model.gradient(x)
        slopes[:, logarithmic] /= np.exp(x[logarithmic])
        for row in np.column_stack([model.value(x), slopes]):
            print(*(repr(float(v)) for v in row))


def main():
    method, name, series, bounds, samples, seed, seconds, target, enough = sys.argv[1:]
    np.seterr(all="ignore")                                  # wild points overflow; they lose
    scipy_models.series = textbook_series if series == "textbook" else functools.partial(
        scipy_models.series, digits=21.0, step=0.87)
    model = scipy_models.MODELS[NAMES.get(name, name)](scipy_models.Data(*np.loadtxt(samples).T))
    natural = [[np.exp(v) if i in LOGARITHMIC[name] else v for v in pair]
               for i, pair in enumerate(zip(model.lo, model.hi))]
    wanted = [[float(v) for v in pair.split(":")] for pair in bounds.split(",")]
    if not np.allclose(natural, wanted, rtol=1e-12):
        sys.exit(f"{name}: scipy_models.py has other bounds than the service: {natural}, {wanted}")
    if method == "values":
        print_values(model, name)
        return
    problem = Problem(model, name)
    problem.descend((problem.lo + problem.hi) / 2)           # warm, as the service is
    differential_evolution(np.sum, [(0, 1)] * 2, init="sobol", maxiter=1, polish=False)
    direct(np.sum, [(0, 1)] * 2, maxfun=10)
    seconds, target = float(seconds), float(target)
    if method == "direct":
        run_direct(problem, seconds, target)
        return
    begun, found = time.process_time(), 0
    for run in range(10_000):
        left = seconds - (time.process_time() - begun)
        if left <= 0 or found >= int(enough):
            break
        found += run_de(problem, int(seed) + run, left, target)


if __name__ == "__main__":
    main()
