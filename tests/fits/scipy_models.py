"""The models of the paper in numpy, for scipy_multistart.py: data, values, gradients, starts. Shares no code with the
fitter. The paper's loss, the default parameter boxes; He-Torrance lengths are in wavelengths."""
import csv
import itertools

import numpy as np
from scipy.optimize import least_squares, lsq_linear, minimize, minimize_scalar, nnls
from scipy.special import erfc, gammaln, lambertw

PI = np.pi
CAP = 200.0                                     # cap on exponents: e^200 is "far too big" and squares safely


# ------------------------------------------------------------------ data

class Data:
    """One channel: angles, values, weights and what depends on angles only."""

    def __init__(self, theta_i, theta_r, phi, y):
        self.ti, self.tr, self.phi = (np.asarray(v, float) for v in (theta_i, theta_r, phi))
        self.y = np.asarray(y, float)
        ti, tr, phi = np.radians(self.ti), np.radians(self.tr), np.radians(self.phi)
        z = np.zeros_like(ti)
        u = np.stack([-np.sin(ti), z, np.cos(ti)])
        v = np.stack([np.sin(tr) * np.cos(phi), np.sin(tr) * np.sin(phi), np.cos(tr)])
        mirror = np.stack([np.sin(ti), z, np.cos(ti)])
        s = u + v
        self.ci, self.cr = u[2], v[2]
        self.cos_alpha = (v * mirror).sum(0)
        self.cos_alpha[np.abs(self.cos_alpha) < 1e-15] = 0   # a right angle, but for rounding
        self.hxy = u[0] * v[0] + u[1] * v[1]
        self.hz = u[2] * v[2]
        self.w_xy = s[0] ** 2 + s[1] ** 2
        self.cs = s[2]
        self.tan2 = self.w_xy / self.cs ** 2
        self.cd2 = np.minimum((s * s).sum(0) / 4, 1.0)      # cos^2 of half the angle between u and v
        self.tan_i, self.tan_r = np.abs(np.tan(ti)), np.abs(np.tan(tr))
        self.w = self.cr / self.cr.sum()
        self.scale = np.sqrt((self.w * self.y ** 2).sum())   # residuals are divided by it while fitting
        self.sw = np.sqrt(self.w) / self.scale
        self.rhs = self.sw * self.y
        self.count = len(self.y)

    def loss(self, f):
        return float(np.sqrt((self.w * (f - self.y) ** 2).sum()))


def read_csv(path):
    """{channel name: Data} in the file's order (a luminance channel Y first)."""
    with open(path, newline="") as handle:
        rows = csv.DictReader(line for line in handle if line.strip() and not line.startswith("#"))
        groups = {}
        for row in rows:
            row = {k.strip(): (v or "").strip() for k, v in row.items() if k}
            if row.get("channel"):
                name = row["channel"]
            elif row.get("wavelength_nm"):
                name = "%gnm" % float(row["wavelength_nm"])
            else:
                name = "1"
            tr = float(row["theta_r_deg"])
            phi = 0.0                                        # azimuth from the forward half plane
            if row.get("phi_r_deg") and tr >= 0:
                delta = (float(row["phi_r_deg"]) - float(row.get("phi_i_deg") or 0)) % 360
                if tr > 0 and delta != 180:
                    phi = delta - 180
            groups.setdefault(name, []).append((float(row["theta_i_deg"]), tr, phi, float(row["brdf_per_sr"])))
    names = sorted(groups, key=lambda n: n != "Y")
    return {n: Data(*np.array(groups[n]).T) for n in names}


# ------------------------------------------------------------------ small linear problems

def solve2(g11, g12, g22, b1, b2, hi1, hi2):
    """min over 0<=x<=hi1, 0<=z<=hi2 of x^2 g11 + 2 x z g12 + z^2 g22 - 2 x b1 - 2 z b2 (arrays)."""
    with np.errstate(all="ignore"):
        det = g11 * g22 - g12 ** 2
        x = (b1 * g22 - b2 * g12) / det
        z = (b2 * g11 - b1 * g12) / det
        inside = (x >= 0) & (x <= hi1) & (z >= 0) & (z <= hi2) & (det > 1e-14 * g11 * g22)
        cost = lambda x, z: x * x * g11 + 2 * x * z * g12 + z * z * g22 - 2 * x * b1 - 2 * z * b2
        best = np.where(inside, cost(x, z), np.inf)
        bx, bz = x, z
        for fixed in (0.0, hi2):
            xe = np.nan_to_num(np.clip((b1 - fixed * g12) / g11, 0, hi1))
            c = cost(xe, fixed)
            bx, bz, best = np.where(c < best, xe, bx), np.where(c < best, fixed, bz), np.minimum(best, c)
        for fixed in (0.0, hi1):
            ze = np.nan_to_num(np.clip((b2 - fixed * g12) / g22, 0, hi2))
            c = cost(fixed, ze)
            bx, bz, best = np.where(c < best, fixed, bx), np.where(c < best, ze, bz), np.minimum(best, c)
    return bx, bz, best


def bounded_lstsq(a, b, hi):
    """min |a x - b|, 0 <= x <= hi; small and dense."""
    x, _ = nnls(a, b)
    if np.any(x > hi):
        x = lsq_linear(a, b, (np.zeros(len(hi)), hi), method="bvls").x
        x = np.clip(x, 0, hi)
    return x


# ------------------------------------------------------------------ models

class Model:
    """x: the fitted coordinates; lo, hi: their box."""

    def residual(self, x):
        return self.d.sw * self.value(x) - self.d.rhs

    def jacobian(self, x):
        return self.d.sw[:, None] * self.gradient(x)

    def loss(self, x):
        return self.d.loss(self.value(x))

    def run(self, x0, tol, nfev):
        width = self.hi - self.lo
        x0 = np.clip(x0, self.lo + 1e-9 * width, self.hi - 1e-9 * width)
        try:
            r = least_squares(self.residual, x0, self.jacobian, (self.lo, self.hi), method="trf",
                              x_scale="jac", ftol=tol, xtol=tol, gtol=tol, max_nfev=nfev)
        except (ValueError, np.linalg.LinAlgError):
            return np.inf, x0
        loss = self.loss(r.x)
        return (loss, r.x) if np.isfinite(loss) else (np.inf, x0)

    def snap(self, loss, x):
        """Set near-bound parameters to their bound, fit the others; keep what is better."""
        for i in range(len(x)):
            for bound in (self.lo[i], self.hi[i]):
                if abs(x[i] - bound) > 2e-3 * (self.hi[i] - self.lo[i]):
                    continue
                free = [j for j in range(len(x)) if j != i and self.lo[j] < x[j] < self.hi[j]]
                full = x.copy()
                full[i] = bound

                def put(z):
                    full[free] = z
                    return full
                try:
                    r = least_squares(lambda z: self.residual(put(z)), x[free], lambda z: self.jacobian(put(z))[:, free],
                                      (self.lo[free], self.hi[free]), method="trf", x_scale="jac",
                                      ftol=1e-14, xtol=1e-14, gtol=1e-14, max_nfev=300) if free else None
                except (ValueError, np.linalg.LinAlgError):
                    continue
                put(r.x if free else [])
                value = self.loss(full)
                if value <= loss * (1 + 1e-13):
                    loss, x = min(value, loss), full.copy()
        return loss, x


class Shape1(Model):
    """k_d/pi + k_s * column(ln s): Phong and Ward."""

    def __init__(self, d):
        self.d = d
        self.lo = np.array([0.0, 0.0, np.log(self.box[0])])
        self.hi = np.array([1.0, 100.0, np.log(self.box[1])])

    def value(self, x):
        return x[0] / PI + x[1] * self.column(x[2])[0]

    def gradient(self, x):
        col, slope = self.column(x[2])
        return np.stack([np.full(self.d.count, 1 / PI), col, x[1] * slope], 1)

    def project(self, s):
        """The exact best (k_d, k_s) for each shape in s, and the loss^2 (relative)."""
        d = self.d
        cols = np.stack([self.column(v)[0] for v in np.atleast_1d(s)]) * d.sw
        c0 = d.sw / PI
        kd, ks, q = solve2((c0 ** 2).sum(), cols @ c0, (cols ** 2).sum(1), c0 @ d.rhs, cols @ d.rhs, 1.0, 100.0)
        return kd, ks, q + (d.rhs ** 2).sum()

    def projected_loss(self, s):
        kd, ks, _ = self.project(s)
        return self.loss([kd[0], ks[0], s])

    def starts(self, rng, count, _):
        """Scanned local minima, each refined; then random starts."""
        grid = np.linspace(self.lo[2], self.hi[2], 6001)
        q = np.concatenate([self.project(part)[2] for part in np.array_split(grid, 20)])
        out = []
        minima = []
        for i in np.argsort(q):
            a, b = max(i - 1, 0), min(i + 1, len(grid) - 1)
            if len(minima) < 12 and q[i] <= q[a] and q[i] <= q[b]:
                minima.append(i)
                r = minimize_scalar(self.projected_loss, bounds=(grid[a], grid[b]), method="bounded",
                                    options={"xatol": 1e-13, "maxiter": 300})
                s = min((r.x, grid[a], grid[b]), key=self.projected_loss)
                kd, ks, _ = self.project(s)
                out.append((np.array([kd[0], ks[0], s]), True))
        for i in range(count):
            s = rng.uniform(self.lo[2], self.hi[2])
            if i % 2:                                        # albedos solved, or random
                kd, ks, _ = self.project(s)
                out.append((np.array([kd[0], ks[0], s]), False))
            else:
                out.append((np.array([rng.uniform(0, 1), np.exp(rng.uniform(np.log(1e-3), np.log(100))), s]), False))
        return out

    def polish(self, loss, x):
        r = minimize_scalar(self.projected_loss, bounds=(max(x[2] - 1e-3, self.lo[2]), min(x[2] + 1e-3, self.hi[2])),
                            method="bounded", options={"xatol": 1e-14, "maxiter": 300})
        kd, ks, _ = self.project(r.x)
        new = np.array([kd[0], ks[0], r.x])
        return (self.loss(new), new) if self.loss(new) < loss else (loss, x)


class Phong(Shape1):
    box = (0.01, 1e5)

    def column(self, s):
        n = np.exp(s)
        with np.errstate(all="ignore"):
            ln = np.log(self.d.cos_alpha)
        ok = self.d.cos_alpha > 0
        e = np.where(ok, np.exp(n * np.where(ok, ln, 0)), 0) / (2 * PI * self.d.ci)
        return (n + 1) * e, n * e * (1 + (n + 1) * np.where(ok, ln, 0))

    def named(self, x):
        return {"k_d": x[0], "k_s": x[1], "n": np.exp(x[2])}


class Ward(Shape1):
    box = (1e-3, 5.0)

    def column(self, s):
        al2 = np.exp(2 * s)
        t = self.d.tan2 / al2
        e = np.exp(-t) / (4 * PI * al2 * np.sqrt(self.d.ci * self.d.cr))
        return e, 2 * e * (t - 1)

    def named(self, x):
        return {"rho_d": x[0], "rho_s": x[1], "alpha": np.exp(x[2])}


class Lafortune(Model):
    """x = k_d, then (c_xy, c_z, ln n) per lobe. Scans and projections use polar lobes
    b = R beta, beta = -sin(omega) hxy + cos(omega) hz, so that c_xy = -R sin(omega), c_z = R cos(omega)."""

    c_max = 3.0
    ln_n = (np.log(0.01), np.log(1e4))

    def __init__(self, d, lobes):
        self.d, self.lobes = d, lobes
        self.lo = np.array([0.0] + [-self.c_max, -self.c_max, self.ln_n[0]] * lobes)
        self.hi = np.array([1.0] + [self.c_max, self.c_max, self.ln_n[1]] * lobes)

    def lobe(self, cxy, cz, s):
        b = cxy * self.d.hxy + cz * self.d.hz
        ok = b > 0
        lb = np.log(np.where(ok, b, 1.0))
        n = np.exp(s)
        v = np.where(ok, np.exp(np.minimum(n * lb, CAP)), 0.0)
        return v, n * v / np.where(ok, b, 1.0), n * v * lb

    def value(self, x):
        f = np.full(self.d.count, x[0] / PI)
        for j in range(self.lobes):
            f += self.lobe(*x[1 + 3 * j:4 + 3 * j])[0]
        return f

    def gradient(self, x):
        g = np.empty((self.d.count, len(x)))
        g[:, 0] = 1 / PI
        for j in range(self.lobes):
            _, db, ds = self.lobe(*x[1 + 3 * j:4 + 3 * j])
            g[:, 1 + 3 * j], g[:, 2 + 3 * j], g[:, 3 + 3 * j] = db * self.d.hxy, db * self.d.hz, ds
        return g

    # -- polar form: z = (omega, ln n) per lobe; amplitudes and k_d are linear

    def polar_column(self, omega, s):
        """Column with maximum 1, ln of the largest beta, and the largest amplitude the c box allows."""
        beta = -np.sin(omega) * self.d.hxy + np.cos(omega) * self.d.hz
        top = beta.max()
        n = np.exp(s)
        ln_cap = n * np.log(max(top, 1e-300) * self.c_max / max(abs(np.sin(omega)), abs(np.cos(omega))))
        if top <= 1e-12 or ln_cap < -200:                    # cannot be bright anywhere
            return np.zeros(self.d.count), 0.0, 0.0
        ok = beta > 0
        col = np.where(ok, np.exp(n * np.log(np.where(ok, beta / top, 1.0))), 0.0)
        return col, np.log(top), np.exp(min(ln_cap, 600.0))

    def project(self, z):
        z = np.array(z, float)
        z[1::2] = np.clip(z[1::2], *self.ln_n)
        cols = [self.polar_column(*z[2 * j:2 * j + 2]) for j in range(self.lobes)]
        a = np.stack([np.full(self.d.count, 1 / PI)] + [c[0] for c in cols], 1) * self.d.sw[:, None]
        amp = bounded_lstsq(a, self.d.rhs, np.array([1.0] + [c[2] or 1.0 for c in cols]))
        return a @ amp - self.d.rhs, amp, [c[1] for c in cols], z

    def from_polar(self, z):
        _, amp, ln_top, z = self.project(z)
        x = [amp[0]]
        for j in range(self.lobes):
            omega, s = z[2 * j], z[2 * j + 1]
            a = max(amp[1 + j], 1e-9 * self.d.scale)
            r = np.exp(np.log(a) / np.exp(s) - ln_top[j])
            x += [-r * np.sin(omega), r * np.cos(omega), s]
        return np.clip(np.nan_to_num(x), self.lo, self.hi)

    def to_polar(self, x):
        z = []
        for j in range(self.lobes):
            cxy, cz, s = x[1 + 3 * j:4 + 3 * j]
            z += [np.arctan2(-cxy, cz), s]
        return np.array(z)

    def run_polar(self, z0, nfev, jac="2-point", tol=1e-9):
        lo, hi = np.array([-10.0, self.ln_n[0]] * self.lobes), np.array([10.0, self.ln_n[1]] * self.lobes)
        try:
            r = least_squares(lambda z: self.project(z)[0], np.clip(z0, lo + 1e-9, hi - 1e-9), jac, (lo, hi), method="trf",
                              x_scale="jac", ftol=tol, xtol=tol, gtol=tol, max_nfev=nfev)
            return r.x
        except (ValueError, RuntimeError, np.linalg.LinAlgError):
            return np.asarray(z0)

    def random_lobe(self, rng):
        """(omega, ln n): anywhere, or peaking at a bright sample."""
        s = rng.uniform(*self.ln_n) if rng.random() < 0.4 else rng.uniform(0, self.ln_n[1])
        kind = rng.random()
        if kind < 0.35:
            omega = rng.uniform(-PI, PI)
        elif kind < 0.65:                                    # near the mirror direction, as close as n asks for
            omega = PI / 4 + rng.choice([-1, 1]) * min(np.exp(rng.uniform(np.log(0.1), np.log(30))) / np.exp(s), 0.8)
        else:                                                # a lobe whose maximum is at a data sample
            d = self.d
            p = d.w * d.y ** rng.choice([1, 2])
            i = rng.choice(d.count, p=p / p.sum())
            omega = np.arctan2(np.tan(np.radians(d.tr[i])), np.tan(np.radians(max(d.ti[i], 0.5))))
            omega += rng.normal() * 0.1 / np.sqrt(1 + np.exp(s))
        return [omega, s]

    def column_grid(self):
        dense = self.lobes == 1
        lobes = []
        for s in np.linspace(*self.ln_n, 121 if dense else 31):
            n = np.exp(s)
            omegas = list(np.linspace(-PI, PI, 361 if dense else 73)[:-1])
            for c in np.geomspace(0.2, max(0.5 * n, 0.4), 24 if dense else 9):
                if c / n < 0.6:
                    omegas += [PI / 4 - c / n, PI / 4 + c / n]
            omegas.append(PI / 4)
            lobes += [(o, s) for o in omegas]
        keep, cols, caps = [], [], []
        for o, s in lobes:
            col, _, cap = self.polar_column(o, s)
            if cap > 0:
                keep.append((o, s)), cols.append(col * self.d.sw), caps.append(cap)
        return np.array(keep), np.array(cols), np.array(caps)

    def scan(self, rng):
        """Polar starts from the linear scan over single columns or pairs of columns."""
        d = self.d
        keep, cols, caps = self.column_grid()
        c0 = d.sw / PI
        b = cols @ d.rhs
        p = cols @ c0
        g = (cols ** 2).sum(1)
        if self.lobes == 1:
            _, _, q = solve2((c0 ** 2).sum(), p, g, c0 @ d.rhs, b, 1.0, caps)
            return [list(keep[i]) for i in spread(q, keep, 80)]
        gram = cols @ cols.T
        k00, b0 = (c0 ** 2).sum(), c0 @ d.rhs
        # k_d unconstrained from below by the pair scan: eliminate it when positive, else set it to 0
        best, mate = np.full(len(g), np.inf), np.zeros(len(g), int)
        for i in range(len(g)):
            q = np.full(len(g), np.inf)
            for with_kd in (True, False):
                f = 1 / k00 if with_kd else 0.0
                g11, g12, g22 = g[i] - f * p[i] ** 2, gram[i] - f * p[i] * p, g - f * p ** 2
                b1, b2 = b[i] - f * p[i] * b0, b - f * p * b0
                x, z, c = solve2(g11, g12, g22, b1, b2, caps[i], caps)
                c = c - f * b0 ** 2
                if with_kd:
                    kd = (b0 - x * p[i] - z * p) / k00
                    c = np.where((kd >= 0) & (kd <= 1), c, np.inf)
                q = np.minimum(q, c)
            mate[i] = int(np.argmin(q))
            best[i] = q[mate[i]]
        pairs = np.concatenate([keep, keep[mate]], 1)
        return [list(pairs[i]) for i in spread(best, pairs, 80)]

    def starts(self, rng, count, fewer):
        out = []
        for z in self.scan(rng):
            if self.lobes > 2:
                z = z + self.random_lobe(rng)
            out.append((self.from_polar(self.run_polar(z, 60)), True))
        for i in range(count):
            z = sum((self.random_lobe(rng) for _ in range(self.lobes)), [])
            if fewer is not None and i % 5 < 2:              # the best fit with one lobe fewer, plus one
                smaller = Lafortune(self.d, self.lobes - 1)
                z = list(smaller.to_polar(fewer)) + self.random_lobe(rng)
                if i % 5 == 1:
                    z = list(np.array(z) + rng.normal(size=len(z)) * 0.05)
                z0 = z
                for _ in range(6):                           # the most useful of a few random lobes
                    t = z0[:-2] + self.random_lobe(rng)
                    if (self.project(t)[0] ** 2).sum() < (self.project(z)[0] ** 2).sum():
                        z = t
                out.append((self.from_polar(self.run_polar(z, 60)), False))
            elif i % 5 < 4:                                  # projected
                if i % 2:
                    for _ in range(10):
                        t = sum((self.random_lobe(rng) for _ in range(self.lobes)), [])
                        if (self.project(t)[0] ** 2).sum() < (self.project(z)[0] ** 2).sum():
                            z = t
                out.append((self.from_polar(self.run_polar(z, 60)), False))
            else:                                            # plain random parameters
                x = [rng.uniform(0, 1)]
                for j in range(self.lobes):
                    omega, s = z[2 * j:2 * j + 2]
                    _, ln_top, _ = self.polar_column(omega, s)
                    amp = self.d.y.max() * rng.uniform(0.05, 1.5)
                    r = np.exp(np.log(amp) / np.exp(s) - ln_top)
                    x += [-r * np.sin(omega), r * np.cos(omega), s]
                out.append((np.clip(np.nan_to_num(x), self.lo, self.hi), False))
        return out

    def polish(self, loss, x):
        z = self.run_polar(self.to_polar(x), 200, "3-point", 1e-13)
        for _ in range(2):
            r = minimize(lambda z: (self.project(z)[0] ** 2).sum(), z, method="Nelder-Mead",
                         options={"xatol": 1e-11, "fatol": 1e-16, "maxfev": 1500 * self.lobes, "adaptive": True})
            z = r.x
        for y in (self.from_polar(z),):
            for cand in (((self.loss(y)), y), self.run(y, 1e-14, 1000)):
                if cand[0] < loss:
                    loss, x = cand
        return loss, x

    def named(self, x):
        lobes = sorted((tuple(x[1 + 3 * j:4 + 3 * j]) for j in range(self.lobes)), key=lambda t: -t[2])
        out = {"k_d": x[0]}
        for j, (cxy, cz, s) in enumerate(lobes, 1):
            out.update({"c_xy_%d" % j: cxy, "c_z_%d" % j: cz, "n_%d" % j: np.exp(s)})
        return out


def spread(cost, points, count, apart=0.25):
    """Indices of the best (omega, ln n, ...) points, no two of them neighbours (greedy)."""
    points = points.copy()
    points[:, ::2] *= np.exp(np.clip(points[:, 1::2], 0, None) / 2)      # omega in lobe widths
    chosen = []
    for i in np.argsort(cost)[:20000]:
        if not np.isfinite(cost[i]):
            break
        if all(np.abs(points[i] - points[j]).max() > apart for j in chosen):
            chosen.append(i)
            if len(chosen) == count:
                break
    return chosen


# -- He-Torrance

STIRLING = np.concatenate([[0.0], [gammaln(m + 1.0) - (m + 0.5) * np.log(m) + m - 0.5 * np.log(2 * PI) for m in range(1, 16)]])


def stirling_error(m):
    r = 1 / m
    r2 = r * r
    big = r * (1 / 12 - r2 * (1 / 360 - r2 * (1 / 1260 - r2 * (1 / 1680 - r2 / 1188))))
    return np.where(m < 16, STIRLING[np.minimum(m, 15).astype(int)], big)


def series(g, a, digits=37.0, step=0.65):
    """M_0, M_1, M_2 = sum_{m>=1} e^-g g^m/m! m^-j e^(-a/m) for arrays g > 0, a >= 0."""
    g, a = np.asarray(g, float), np.asarray(a, float)
    mu = (g + np.sqrt(g * g + 4 * a)) / 2
    with np.errstate(all="ignore"):
        far = np.sqrt(a / np.log(mu / g))
    m = np.where(mu > np.e * g, np.maximum(g, np.where(np.isfinite(far), far, g)), mu)
    for _ in range(8):
        m = np.maximum(m - (np.log(m / g) - a / m ** 2) / (1 / m + 2 * a / m ** 3), m / 3)
    s = np.sqrt(m / (1 + 2 * a / m ** 2))
    mb = np.maximum(m, 1.0)
    lo = np.maximum(1.0, np.floor(mb - np.sqrt(2 * mb * digits) - 1))
    hi = np.ceil(mb + digits / 3 + np.sqrt(digits ** 2 / 9 + 2 * mb * digits))
    stride = np.where(lo > 1, np.maximum(1.0, np.floor(step * s)), 1.0)
    peak = -g + m * np.log(g / m) + m - a / m
    alive = np.nonzero(peak > -740)[0]
    out = np.zeros((3, len(g)))
    if len(alive) == 0:
        return out
    n = ((hi - lo)[alive] // stride[alive]).astype(int) + 1
    first = np.concatenate([[0], np.cumsum(n)[:-1]])
    k = np.arange(n.sum()) - np.repeat(first, n)
    node = np.repeat(lo[alive], n) + k * np.repeat(stride[alive], n)
    gn = np.repeat(g[alive], n)
    deviance = node * np.log1p((node - gn) / gn) - (node - gn)
    t = np.exp(-deviance - stirling_error(node) - np.repeat(a[alive], n) / node) / np.sqrt(2 * PI * node)
    for j in range(3):
        out[j, alive] = np.add.reduceat(t, first) * stride[alive]
        t = t / node
    return out


class HeTorrance(Model):
    """x = ln sigma, ln tau (wavelengths), ln n, k, rho_ud."""

    def __init__(self, d):
        self.d = d
        self.lo = np.array([np.log(1e-3), np.log(0.1), np.log(0.05), 0.0, 0.0])
        self.hi = np.array([np.log(20.0), np.log(200.0), np.log(20.0), 20.0, 1.0])
        self.front = 4 * d.cd2 / d.cs
        self.front = self.front ** 2 / (PI * d.ci * d.cr)   # G / (pi ci cr)
        self.key = None

    def rough(self, rho):
        """ln(tau/sigma) -> ln S, ln(1 + W)."""
        d = self.d
        lnS, kk = 0.0, 0.0
        for tan in (d.tan_i, d.tan_r):
            with np.errstate(all="ignore"):
                h = np.exp(rho) / (2 * tan)
                lam = 0.5 * (np.where(h < 27, np.exp(-np.minimum(h, 27.0) ** 2) / (np.sqrt(PI) * h), 0.0) - erfc(h))
            e = erfc(h)
            lnS = lnS + np.log1p(-e / 2) - np.log1p(np.maximum(lam, 0.0))
            kk = kk + tan * e
        return lnS, np.log1p(lambertw(kk ** 2 / (8 * PI)).real)

    def geometry(self, ls, lt, slopes=False):
        """H with f = rho_ud/pi + F H; optionally dH/dln sigma, dH/dln tau."""
        key = (ls, lt)
        if self.key is not None and self.key[0] == key and (self.key[1] or not slopes):
            return self.kept
        d = self.d
        lnS, lw = self.rough(lt - ls)
        g = (2 * PI * d.cs) ** 2 * np.exp(2 * ls - lw)
        big_t = (PI * np.exp(lt)) ** 2
        a = big_t * d.w_xy
        m0, m1, m2 = series(g, a)
        base = self.front * np.exp(lnS) * big_t / 4
        h, hs, ht = base * m1, None, None
        if slopes:
            e = 1e-4                                         # 5-point differences in ln(tau/sigma)
            up, dn, up2, dn2 = (self.rough(lt - ls + k * e) for k in (1, -1, 2, -2))
            s1, w1 = ((8 * (p - q) - (p2 - q2)) / (12 * e) for p, q, p2, q2 in zip(up, dn, up2, dn2))
            dg = m0 - g * m1                                 # dM_1/dln g
            hs = base * (-s1 * m1 + dg * (2 + w1))
            ht = base * ((2 + s1) * m1 - dg * w1 - 2 * a * m2)
        self.key, self.kept = (key, slopes), (h, hs, ht)
        return self.kept

    def fresnel(self, ln_n, k):
        c2 = self.d.cd2
        c = np.sqrt(c2)
        n2 = (np.exp(ln_n) + 1j * k) ** 2
        q = np.sqrt(n2 - (1 - c2))
        rs = (c - q) / (c + q)
        rp = (n2 * c - q) / (n2 * c + q)
        return (rs.real ** 2 + rs.imag ** 2 + rp.real ** 2 + rp.imag ** 2) / 2

    def value(self, x):
        return x[4] / PI + self.fresnel(x[2], x[3]) * self.geometry(x[0], x[1])[0]

    def gradient(self, x):
        h, hs, ht = self.geometry(x[0], x[1], True)
        f = self.fresnel(x[2], x[3])
        e = 1e-6
        fn = (self.fresnel(x[2] + e, x[3]) - self.fresnel(x[2] - e, x[3])) / (2 * e)
        if x[3] > e:
            fk = (self.fresnel(x[2], x[3] + e) - self.fresnel(x[2], x[3] - e)) / (2 * e)
        else:                                                # one-sided at k = 0
            fk = (4 * self.fresnel(x[2], x[3] + e) - 3 * f - self.fresnel(x[2], x[3] + 2 * e)) / (2 * e)
        return np.stack([f * hs, f * ht, fn * h, fk * h, np.full(self.d.count, 1 / PI)], 1)

    def project(self, z):
        """Best rho_ud for (ln sigma, ln tau, ln n, k); returns loss and x."""
        z = np.clip(z, self.lo[:4], self.hi[:4])
        spec = self.fresnel(z[2], z[3]) * self.geometry(z[0], z[1])[0]
        rho = np.clip(PI * (self.d.w * (self.d.y - spec)).sum(), 0, 1)
        return self.d.loss(spec + rho / PI), np.append(z, rho)

    def random_shape(self, rng):
        if rng.random() < 0.35:
            ls, lt = rng.uniform(self.lo[0], self.hi[0]), rng.uniform(self.lo[1], self.hi[1])
        else:                                                # by slope 2 sigma/tau
            ls = rng.uniform(self.lo[0], self.hi[0])
            lt = ls + np.log(2) - rng.uniform(np.log(3e-3), np.log(3.0))
            if not self.lo[1] < lt < self.hi[1]:
                lt = rng.uniform(self.lo[1], self.hi[1])
        kind = rng.random()
        if kind < 0.35:                                      # dielectric, metal, anything
            ln_n, k = np.log(rng.uniform(1.02, 4.0)), np.exp(rng.uniform(np.log(1e-3), 0))
        elif kind < 0.65:
            ln_n, k = np.log(rng.uniform(0.1, 5.0)), rng.uniform(0.5, 12.0)
        else:
            ln_n, k = rng.uniform(self.lo[2], self.hi[2]), np.exp(rng.uniform(np.log(1e-3), np.log(20)))
        return np.array([ls, lt, ln_n, k])

    def scan(self):
        d = self.d
        side = 52
        gs, gt = np.linspace(self.lo[0], self.hi[0], side), np.linspace(self.lo[1], self.hi[1], side)
        nk = np.array([(ln, k) for ln in np.linspace(self.lo[2], self.hi[2], 41)
                       for k in np.concatenate([[0.0], np.geomspace(0.02, 20, 19)])])
        table = np.stack([self.fresnel(*p) for p in nk])
        square = table ** 2
        regimes = [(nk[:, 1] == 0) & (nk[:, 0] >= 0), (nk[:, 1] == 0) & (nk[:, 0] < 0),
                   (nk[:, 1] > 0) & (nk[:, 0] >= 0), (nk[:, 1] > 0) & (nk[:, 0] < 0)]
        best = np.full((4, side, side), np.inf)
        arg = np.zeros((4, side, side), int)
        wy, ybar = d.w * d.y, (d.w * d.y).sum()
        for i, j in itertools.product(range(side), range(side)):
            h = self.geometry(gs[i], gt[j])[0]
            sp, spp, spy = table @ (d.w * h), square @ (d.w * h * h), table @ (wy * h)
            c = np.clip(ybar - sp, 0, 1 / PI)                # rho_ud / pi
            q = spp + c * c + 2 * c * (sp - ybar) - 2 * spy
            for r, mask in enumerate(regimes):
                k = np.argmin(np.where(mask, q, np.inf))
                best[r, i, j], arg[r, i, j] = q[k], k
        out = []
        for r in range(4):
            pad = np.pad(best[r], 1, constant_values=np.inf)
            near = np.min([pad[1 + di:1 + di + side, 1 + dj:1 + dj + side]
                           for di in (-1, 0, 1) for dj in (-1, 0, 1) if di or dj], axis=0)
            local = np.argwhere(best[r] <= near)
            local = sorted(local.tolist(), key=lambda t: best[r][tuple(t)])[:12]
            out += [np.array([gs[i], gt[j], *nk[arg[r, i, j]]]) for i, j in local]
        flat = best.min(0)
        for i, j in np.dstack(np.unravel_index(np.argsort(flat, axis=None)[:8], flat.shape))[0]:
            out.append(np.array([gs[i], gt[j], *nk[arg[np.argmin(best[:, i, j]), i, j]]]))
        return out

    def starts(self, rng, count, _):
        out = [(self.project(z)[1], True) for z in self.scan()]
        for i in range(count):
            z = self.random_shape(rng)
            if i % 2:                                        # the best of a few
                z = min([z] + [self.random_shape(rng) for _ in range(7)], key=lambda t: self.project(t)[0])
            x = self.project(z)[1]
            if i % 4 == 0:
                x[4] = rng.uniform(0, 1)
            out.append((x, False))
        return out

    def polish(self, loss, x):
        z = x[:4].copy()
        for _ in range(2):
            simplex = np.vstack([z] + [z + np.eye(4)[i] * (0.02 if i < 3 else max(0.02 * z[3], 0.01)) for i in range(4)])
            z = minimize(lambda z: self.project(z)[0], z, method="Nelder-Mead",
                         options={"xatol": 1e-11, "fatol": 1e-15 * loss, "maxfev": 800, "initial_simplex": simplex}).x
        new = self.project(z)
        for cand in (new, self.run(new[1], 1e-14, 1000)):
            if cand[0] < loss:
                loss, x = cand
        return loss, x

    def named(self, x):
        return {"sigma": np.exp(x[0]), "tau": np.exp(x[1]), "n": np.exp(x[2]), "k": x[3], "rho_ud": x[4]}


MODELS = {
    "phong": Phong,
    "ward": Ward,
    "lafortune_1": lambda d: Lafortune(d, 1),
    "lafortune_2": lambda d: Lafortune(d, 2),
    "lafortune_3": lambda d: Lafortune(d, 3),
    "he_torrance": HeTorrance,
}


# ------------------------------------------------------------------ the search
