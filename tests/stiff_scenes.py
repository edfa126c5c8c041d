"""Stiff scenes, and their solutions by other means: eigenvalues to 30 digits for linear modes, SciPy's Radau between switches."""

import itertools

import casadi as ca
import mpmath as mp
import numpy as np
from scipy.integrate import solve_ivp

from nsmodel import FirstOrderSystem, LureSystem, complementarity, relay

t = ca.SX.sym("t")


class Arcs:
    """x' = A x + B l, y = C x + D l with l in boxes: arcs between switches, by the eigenvalues of each mode.

    Modes are found by trying all of them; roots by samples that grow from the fastest time, then by halving.
    """

    def __init__(self, A, B, C, D, ends, x0, t_end):
        self.A, self.B, self.C, self.D, self.ends, self.T = A, B, C, D, ends, t_end
        self.known, self.arcs, self.events = {}, [], []
        self.fast = np.abs(np.linalg.eigvals(A)).max()
        start, x = np.longdouble(0), np.array([*x0, 1], np.longdouble)
        while start < t_end:
            mode = self.mode(x)
            self.arcs.append((start, mode, self.weights(mode, x)))
            length = self.length(mode, self.arcs[-1][2], t_end - start)
            if length is None:
                return
            x = np.append(self.states(mode, self.arcs[-1][2], np.array([length]))[0], np.longdouble(1))
            start += length
            self.events.append(float(start))

    @mp.workdps(15)  # Whatever other tests have set.
    def closed(self, mode):
        """(rates, vectors, inverse of these, conditions) of X = (x, 1): X' = closed X, conditions X >= 0."""
        if mode in self.known:
            return self.known[mode]
        m, n = len(mode), len(self.A)
        held = [i for i in range(m) if mode[i] == 0]
        free = [i for i in range(m) if mode[i]]
        l = mp.zeros(m, n + 1)
        for i in free:
            l[i, n] = self.ends[i][mode[i] > 0]
        A, B, C, D = (mp.matrix(np.asarray(a).tolist()) for a in (self.A, self.B, self.C, self.D))
        A1, C1 = mp.zeros(n, n + 1), mp.zeros(m, n + 1)
        A1[:, :n], C1[:, :n] = A, C
        if held:
            a, D_aa = len(held), np.asarray(self.D)[np.ix_(held, held)]
            C_a = mp.matrix([[C[i, j] for j in range(n)] for i in held])
            B_a = mp.matrix([[B[i, j] for j in held] for i in range(n)])
            y = C1 + D * l if D_aa.any() else None
            right = mp.matrix([[y[i, j] for j in range(n + 1)] for i in held]) if y is not None else C_a * (A1 + B * l)
            found = -mp.inverse(mp.matrix(D_aa.tolist()) if y is not None else C_a * B_a) * right
            for k in range(a):
                l[held[k], :] = found[k, :]
        closed = mp.zeros(n + 1, n + 1)
        closed[:n, :] = A1 + B * l
        rates, vectors = mp.eig(closed)
        y = C1 + D * l
        rows = []
        for i in range(m):
            if mode[i]:
                rows.append([-mode[i] * y[i, j] for j in range(n + 1)])
                continue
            for sign, end in zip((1, -1), self.ends[i], strict=True):
                if np.isfinite(end):
                    rows.append([sign * (l[i, j] - (end if j == n else 0)) for j in range(n + 1)])
        self.known[mode] = (long(rates), long(vectors), long(vectors**-1), long(rows).real)
        return self.known[mode]

    def weights(self, mode, x):
        return self.closed(mode)[2] @ x

    def states(self, mode, w, s):
        rates, vectors, _, _ = self.closed(mode)
        return ((np.exp(np.multiply.outer(s, rates)) * w) @ vectors.T).real[:, :-1]

    def conditions(self, mode, w, s):
        rates, vectors, _, rows = self.closed(mode)
        return ((np.exp(np.multiply.outer(s, rates)) * w) @ (rows @ vectors).T).real

    def mode(self, x):
        codes = [[0, *(code for code, end in zip((-1, 1), ends, strict=True) if np.isfinite(end))] for ends in self.ends]
        scale = np.abs(x).max()
        for mode in itertools.product(*codes):
            try:
                w = self.weights(mode, x)
            except ZeroDivisionError:
                continue
            s = np.array([1e-5, 1e-4], np.longdouble) / self.fast
            held = [i for i, code in enumerate(mode) if code == 0]
            z = x[:-1]
            if held and not np.asarray(self.D)[np.ix_(held, held)].any() and np.abs((self.C @ z)[held]).max() > 1e-12 * scale:
                continue
            rows = self.closed(mode)[3]
            if (self.conditions(mode, w, s) >= -1e-12 * (np.abs(rows) @ np.abs(x))).all():
                return mode
        raise AssertionError("no mode")

    def length(self, mode, w, rest):
        """Up to the first condition that becomes negative; None where none does."""
        grid = np.concatenate([np.geomspace(1e-3 / self.fast, rest, 600), np.linspace(0, rest, 4000)[1:]]).astype(np.longdouble)
        grid = np.unique(np.minimum(grid, rest))
        values = self.conditions(mode, w, grid)
        rows = self.closed(mode)[3]
        bad = values < -1e-15 * np.abs(rows).max()
        if not bad.any():
            return None
        k = int(np.argmax(bad.any(axis=1)))
        found = []
        for i in np.flatnonzero(bad[k]):
            low, high = grid[k - 1] if k else grid[0] * 0, grid[k]
            for _ in range(100):
                middle = (low + high) / 2
                low, high = (middle, high) if self.conditions(mode, w, np.array([middle]))[0, i] >= 0 else (low, middle)
            found.append(high)
        return min(found)

    def at(self, times):
        """X (k, n) at times."""
        starts = np.array([start for start, *_ in self.arcs])
        out = []
        for s in np.asarray(times, np.longdouble):
            start, mode, w = self.arcs[max(int(np.searchsorted(starts, s, side="right")) - 1, 0)]
            out.append(self.states(mode, w, np.array([s - start]))[0])
        return np.array(out, float)


def long(matrix):
    """As complex numbers with 18 digits."""
    rows = matrix.tolist() if isinstance(matrix, mp.matrix) else matrix
    digits = np.vectorize(
        lambda v: np.longdouble(mp.nstr(mp.re(v), 25)) + 1j * np.longdouble(mp.nstr(mp.im(v), 25)), otypes=[np.clongdouble]
    )
    return digits(np.array(rows, dtype=object))


def rotor(A, B, C, x0, drive, w):
    """The matrices with two more states (cos wt, sin wt), and ``drive`` (n, 2) of them in x'."""
    n = len(A)
    big = np.zeros((n + 2, n + 2))
    big[:n, :n], big[:n, n:], big[n:, n:] = A, drive, [[0, -w], [w, 0]]
    return big, np.vstack([B, np.zeros((2, B.shape[1]))]), np.hstack([C, np.zeros((len(C), 2))]), [*x0, 1, 0]


def stiff_lure(seed, fastest=6.0):
    """A passive Lur'e system with rates from 1 to 10^fastest, driven; its exact solution."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(3, 6)), int(rng.integers(1, 3))
    rates = 10 ** np.concatenate([[0, fastest], rng.uniform(0, fastest, n - 2)])
    Q, K = np.linalg.qr(rng.normal(size=(n, n)))[0], rng.normal(size=(n, n))
    A = Q @ (np.diag(-rates) + np.sqrt(np.outer(rates, rates)) * (K - K.T) * 0.3) @ Q.T
    C = rng.normal(size=(m, n)) @ np.diag(np.ones(n)) @ Q.T
    E = rng.normal(size=(m, m))
    D = np.zeros((m, m)) if seed % 2 else E @ E.T + 0.1 * np.eye(m) + (E - E.T)
    law = relay(m) if seed % 4 < 2 or not D.any() else complementarity(m)
    ends = [(-1, 1)] * m if seed % 4 < 2 or not D.any() else [(0, np.inf)] * m
    drive, w, x0 = 3 * rng.normal(size=(n, 2)), 2.5, rng.normal(size=n)
    B = C.T
    model = LureSystem(t=t, A=A, B=B, C=C, D=D, f=drive @ ca.vertcat(ca.cos(w * t), ca.sin(w * t)), law=law, x0=x0, t_end=4)
    big = rotor(A, B, C, x0, drive, w)
    return model, lambda: Arcs(big[0], big[1], big[2], D, ends, big[3], 4.0)


def rectifier(stray):
    """10 sin 50 t behind 1 ohm and 0.1 H, a diode, a capacitor with its load; a stray capacitance makes it stiff.

    x = (current, voltage at the diode, voltage of the load).
    """
    L, R, C, load = 0.1, 1.0, 0.02, 20.0
    A = np.array([[-R / L, -1 / L, 0], [1 / stray, -1 / (50 * stray), 0], [0, 0, -1 / (load * C)]])
    B, row, D = np.array([[0], [-1 / stray], [1 / C]]), np.array([[0, -1.0, 1.0]]), np.array([[0.05]])
    drive, w = np.array([[0, 10 / L], [0, 0], [0, 0]]), 50.0
    model = LureSystem(
        t=t, A=A, B=B, C=row, D=D, f=drive @ ca.vertcat(ca.cos(w * t), ca.sin(w * t)), law=complementarity(1), x0=[0, 0, 1],
        t_end=1,
    )  # fmt: skip
    big = rotor(A, B, row, [0, 0, 1], drive, w)
    return model, lambda: Arcs(big[0], big[1], big[2], D, [(0, np.inf)], big[3], 1.0)


def damped_chain(rate, n=4):
    """Masses in a row with dashpots of c = rate/4, driven at one end, dry friction at the other: sticks and slips."""
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    K[0, 0] = K[-1, -1] = 1
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K - 0.2 * np.eye(n), -rate / 4 * K]])
    B = np.zeros((2 * n, 1))
    B[-1] = 1
    drive, w, x0 = np.zeros((2 * n, 2)), 1.3, [*np.linspace(0.5, 0.1, n), *np.linspace(0.4, 0.1, n)]
    drive[n] = [3, 0]
    model = LureSystem(
        t=t, A=A, B=B, C=B.T, f=drive @ ca.vertcat(ca.cos(w * t), ca.sin(w * t)), law=relay(1, -1, 1), x0=x0, t_end=12
    )
    big = rotor(A, B, B.T, x0, drive, w)
    return model, lambda: Arcs(big[0], big[1], big[2], np.zeros((1, 1)), [(-1, 1)], big[3], 12.0)


def by_radau(parts, x0, t_end, at):
    """Arcs by SciPy: ``parts`` are (rate(t, x), Jacobian, event(t, x)) that follow one another in turns; rows and events."""
    x, start, rows, events, k = np.array(x0, float), 0.0, np.empty((len(at), len(x0))), [], 0
    rows[0] = x
    done = 1
    while start < t_end:
        rate, jacobian, event = parts[k % len(parts)]
        event.terminal, event.direction = True, -1
        r = solve_ivp(rate, (start, t_end), x, "Radau", jac=jacobian, events=[event], rtol=1e-12, atol=1e-14, dense_output=True)
        end = r.t[-1]
        while done < len(at) and at[done] <= end:
            rows[done] = r.sol(at[done])
            done += 1
        if r.status == 0:
            break
        start, x, k = end, r.y[:, -1].copy(), k + 1
        events.append(start)
    return rows, events


MU, FORCE = 1e3, 0.3


def van_der_pol():
    """x'' = mu (1 - x^2) x' - x + l, l in -F Sgn x': a relaxation oscillator with dry friction, at rest at no time."""
    x, l = ca.SX.sym("x", 2), ca.SX.sym("l")
    f = [x[1], MU * (1 - x[0] ** 2) * x[1] - x[0]]
    return FirstOrderSystem(t=t, x=x, lam=l, f=f, g=[0, l], h=[x[1]], law=relay(1, -FORCE, FORCE), x0=[2, 0], t_end=3000)


# By `solve_ivp` with Radau, rtol = 1e-12, atol = 1e-14, between the turns of x', each an event of its own.
VAN_DER_POL_EVENTS = (992.8209771560537, 1985.7404427370327, 2978.6599083181172)
VAN_DER_POL = {
    500.0: (1.67622454, -7.60458675e-04),
    1500.0: (-1.67082365, 7.65116910e-04),
    2500.0: (1.66538943, -7.69874176e-04),
}


def kinetics():
    """Robertson's reactions with a feed l in [0, 1] that is on where the first species is below 0.7: it ends at 0.7 and stays."""
    x, l = ca.SX.sym("x", 3), ca.SX.sym("l")
    fast, slow = 3e7 * x[1] ** 2, 0.04 * x[0] - 1e4 * x[1] * x[2]
    return FirstOrderSystem(
        t=t, x=x, lam=l, f=[-slow, slow - fast, fast], g=[0.1 * l, 0, 0], h=[x[0] - 0.7], law=relay(1, 0, 1), x0=[1, 0, 0],
        t_end=100,
    )  # fmt: skip


def kinetics_reference(at):
    """Off until x_0 = 0.7; then l = x_0'-balance holds it there."""

    def rate(held):
        def of(_, x):
            fast, slow = 3e7 * x[1] ** 2, 0.04 * x[0] - 1e4 * x[1] * x[2]
            return [0.0 if held else -slow, slow - fast, fast]

        return of

    def jacobian(held):
        def of(_, x):
            slow, fast = np.array([0.04, -1e4 * x[2], -1e4 * x[1]]), np.array([0, 6e7 * x[1], 0])
            return [np.zeros(3) if held else -slow, slow - fast, fast]

        return of

    never = lambda _, x: 1.0  # noqa: E731
    return by_radau(
        [(rate(False), jacobian(False), lambda _, x: x[0] - 0.7), (rate(True), jacobian(True), never)], [1, 0, 0], 100, at
    )
