"""Two solutions of one step from one state, for any law: suggested by Newton's method, proved by the operator of Krawczyk.

    E = M (x - x_k) - h theta f(t + h, x) - h (1 - theta) f(t, x_k) - h gamma g(t + h, x, l) - h (1 - gamma) r_k = 0
    y = h(t + h, x, l),   -y ∈ N_K(l),   r_k = g(t, x_k, l_k)

On a mode (which rows are at which bound, which balls and cones are touched) this is a square system in x, l and the normal forces
s of what is touched, with strict inequalities. A point (x, l) of a mode, with the x_k that it comes from, has an orientation, the
sign of the determinant of its system. Where the sign is the same everywhere nothing is sought; where both signs occur all modes
are tried at the states of the rarer one.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.linearised import Linearised
from nsmodel.laws import Curved, Law
from nsmodel.proof import interval, krawczyk
from nsmodel.scheme.problem import basic_law
from nsmodel.solve.certificate import numeric_law

MOST_MODES = 2500  # that are tried at one state
SAMPLES, STATES, ROWS = 300, 12, 4  # points of modes; states of them, and of the runs, at which all modes are tried
STARTS = 6  # of Newton's method on a mode where a ball or a cone is touched
MOST_TRIES = 2500  # runs of Newton's method, in all
NEWTON, TOLERANCE = 14, 1e-11
SLACK, CLEAR = 1e-7, 1e-9  # An inequality counts where it holds by this part of its size, for all data this near to the model's.
SAME = 1e-6  # Two solutions are one if they differ by less than this part of what x moves in a step.
SINGULAR = 1e-10
LEAST = np.finfo(float).tiny / np.finfo(float).eps  # Below it products with h underflow.

Block = tuple[Curved | None, tuple[int, ...]]  # the set, None for a row of a box, and its rows of l
Mode = tuple[str, ...]  # of each block: "free", "lower", "upper"; "inside", "touched"; "vertex"


class Two(NamedTuple):
    """States x_k, r_k (None where gamma = 1) at time t and two solutions (x, l)."""

    t: float
    x_k: np.ndarray
    r_k: np.ndarray | None
    first: tuple[np.ndarray, np.ndarray]
    other: tuple[np.ndarray, np.ndarray]


class Searched(NamedTuple):
    """Two solutions, or None; how many points of modes were looked at, and whether their orientations differ."""

    two: Two | None
    points: int
    turned: bool


class _Point(NamedTuple):
    """Unknowns u = (x, l, s) of a mode, the state they come from, and the orientation."""

    mode: Mode
    u: np.ndarray
    t: float
    x_k: np.ndarray
    sign: float


def search(at: Linearised, h: float, seed: int = 0) -> Searched | None:
    """Look for two solutions of a step of length h; None where there are too many modes."""
    step = _Step(at, h)
    if step.count > MOST_MODES:
        return None
    rng = np.random.default_rng(seed)
    points = [point for _ in range(SAMPLES) if (point := step.draw(rng)) is not None]
    ahead, back = ([point for point in points if point.sign == sign] for sign in (1.0, -1.0))
    rarer = min(ahead, back, key=len)
    rows = at.points[np.unique(np.linspace(0, len(at.points) - 1, ROWS).astype(int))]
    seen = [
        _Point((), np.concatenate([row[1 : step.n + 1], np.zeros(0)]), float(row[0]), row[1 : step.n + 1], 0.0) for row in rows
    ]
    for point in [*rarer[:STATES], *seen]:
        two = step.two(point, rng)
        if two is not None or step.tries > MOST_TRIES:
            return Searched(two, len(points), bool(rarer))
    return Searched(None, len(points), bool(rarer))


class _Step:
    """The step as functions of u = (x, l, s), the time and the state."""

    def __init__(self, at: Linearised, h: float) -> None:
        model = at.model
        self.at, self.h, self.n = at, h, len(at.model.names)
        y_user = ca.SX.sym("y", model.law.size)
        basic = basic_law(model.law, model.multiplier_names, y_user)
        law = numeric_law(basic.law)
        self.law, self.m, self.lower, self.upper = law, law.size, law.lower, law.upper
        self.blocks = list(_blocks(basic.law))
        self.modes = [_modes(block, law.lower, law.upper) for block in self.blocks]
        self.count = int(np.prod([float(len(modes)) for modes in self.modes]))
        self.radius = np.ones(self.m)
        for rows, K in law.curved:
            self.radius[rows] = K.radius if K.is_bounded else 1.0
        x, self.l, self.s = ca.SX.sym("x", self.n), basic.l, ca.SX.sym("s", len(self.blocks))
        self.t, self.step, self.x_k = model.t, ca.SX.sym("h"), model.x
        old = [model.t, model.x, model.lam]
        f, g, y = ca.substitute([model.f, model.g, model.h], old, [model.t + self.step, x, basic.multipliers])
        l_k = np.clip(np.zeros(model.law.size), at.lower[1 + self.n :], at.upper[1 + self.n :])
        r_k = ca.substitute([model.g], [model.lam], [ca.DM(l_k)])[0]
        theta, gamma = model.theta, model.gamma
        self.E = model.M @ (x - model.x) - self.step * (
            theta * f + (1 - theta) * model.f + gamma * g + (1 - gamma) * (r_k if gamma < 1 else 0)
        )
        self.Y = ca.substitute([basic.y], [y_user], [y])[0]
        self.x, self.user_l = x, basic.multipliers
        inputs, both = [x, self.l, self.t, self.x_k, self.step], ca.vertcat(self.E, self.Y)
        self.values = ca.Function("values", inputs, [ca.densify(ca.horzcat(both, ca.jacobian(both, ca.vertcat(x, self.l))))])
        self.in_x_k = ca.Function("in_x_k", inputs, [ca.densify(ca.jacobian(self.E, self.x_k))])
        self.user = ca.Function("user", [self.l], [ca.densify(basic.multipliers)])
        self.r_k = ca.Function("r_k", [self.t, self.x_k], [ca.densify(r_k)]) if gamma < 1 else None
        self.everywhere = at.constant and at.affine
        self.tries = 0
        self._scales()

    def _scales(self) -> None:
        """How far x and l may go, for samples."""
        at, n = self.at, self.n
        low, up = at.lower[1 : n + 1], at.upper[1 : n + 1]
        self.low, self.up, self.span = low, up, np.where(up > low, up - low, 1.0)
        value, J = self.at_point((low + up) / 2, np.clip(np.zeros(self.m), self.lower, self.upper), at.lower[0], (low + up) / 2)
        with np.errstate(all="ignore"):
            rows = np.abs(value[n:]) + np.abs(J[n:, :n]) @ self.span
            moved = np.abs(J[:, n:]).T @ (1 / np.concatenate([np.abs(J[:n, :n]) @ self.span, np.where(rows > 0, rows, np.inf)]))
        unit = np.where(np.isfinite(moved) & (moved > 0), 1 / np.where(moved > 0, moved, 1.0), 1.0)
        width = self.upper - self.lower
        self.width = np.where(np.isfinite(width), width, unit)
        for own, K in self.law.curved:
            self.width[own] = K.radius if K.is_bounded else unit[own].max()
        self.size_y = np.where(np.isfinite(rows) & (rows > 0), rows, 1.0)
        W = J[n:, n:] - J[n:, :n] @ np.linalg.lstsq(J[:n, :n], J[:n, n:], rcond=None)[0]
        size = np.array([np.abs(W[np.ix_(rows, rows)]).max() for _, rows in self.blocks])
        self.size_s = np.where(np.isfinite(size) & (size > 0), size, 1.0)

    def at_point(self, x: np.ndarray, l: np.ndarray, t: float, x_k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(E, y), and its Jacobian in (x, l)."""
        both = self.values(x, l, t, x_k, self.h).full()
        return both[:, 0], both[:, 1:]

    # -- the system of a mode ---------------------------------------------------------------------------------------------

    def system(self, mode: Mode, u: np.ndarray, value: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Its residual and Jacobian (as long as u, E first), and what has to be > 0, divided by its size."""
        n, m = self.n, self.m
        l, s, y = u[n : n + m], u[n + m :], value[n:]
        F, D = np.zeros(len(u)), np.zeros((len(u), len(u)))
        F[:n], D[:n, : n + m] = value[:n], J[:n]
        F[n : n + m], D[n : n + m, : n + m] = y, J[n:]
        size = self.size_y
        slack: list[float] = []
        for k, ((K, rows), how) in enumerate(zip(self.blocks, mode, strict=True)):
            own, at_s = [n + i for i in rows], n + m + k
            F[at_s], D[at_s, at_s] = s[k], 1.0
            i = rows[0]
            if how in ("lower", "upper", "vertex"):
                held = {"lower": self.lower, "upper": self.upper}.get(how, np.zeros(m))[list(rows)]
                F[own], D[own] = l[list(rows)] - held, 0.0
                D[own, own] = 1.0
            if how in ("lower", "upper") and self.lower[i] < self.upper[i]:
                slack.append((y[i] if how == "lower" else -y[i]) / size[i])
            elif how == "free":
                slack += [gap / self.width[i] for gap in (l[i] - self.lower[i], self.upper[i] - l[i]) if np.isfinite(gap)]
            elif K is not None:
                of_l, of_y = (part[list(rows)] for part in (l, y))
                S, c = K.quadric(len(rows))
                square = c - of_l @ S @ of_l
                slack += [of_l[0] / self.width[i]] if K.is_cone and how != "vertex" else []
                if how == "vertex":
                    slack += [of_y[0] / size[i], -(of_y @ S @ of_y) / size[i] ** 2]
                elif how == "inside":
                    slack.append(square / (self.width[i] ** 2 * np.abs(S).max()))
                else:
                    F[own] += s[k] * S @ of_l
                    D[np.ix_(own, own)] += s[k] * S
                    D[own, at_s] = S @ of_l
                    F[at_s], D[at_s, at_s] = square / 2, 0.0
                    D[at_s, own] = -S @ of_l
                    slack.append(s[k] / self.size_s[k])
        return F, D, np.array(slack)

    def expressions(self, mode: Mode) -> tuple[ca.SX, ca.SX]:
        """The system and the inequalities > 0 as expressions of x, l, s, t, x_k and h."""
        F, conditions = [self.E], []
        for k, ((K, rows), how) in enumerate(zip(self.blocks, mode, strict=True)):
            l, y, s, i = self.l[list(rows)], self.Y[list(rows)], self.s[k], rows[0]
            S, c = K.quadric(len(rows)) if K is not None else (np.zeros((1, 1)), 0.0)
            square, above = c - ca.bilin(ca.SX(ca.DM(S)), l, l), [l[0]] if K is not None and K.is_cone else []
            if how in ("lower", "upper"):
                F += [l - float((self.lower if how == "lower" else self.upper)[i]), s]
                if self.lower[i] < self.upper[i]:
                    conditions.append(y if how == "lower" else -y)
            elif how == "vertex":
                F += [l, s]
                conditions += [y[0], -ca.bilin(ca.SX(ca.DM(S)), y, y)]
            elif how == "touched":
                F += [y + s * ca.DM(S) @ l, square]
                conditions += [s, *above]
            else:
                F += [y, s]
                if how == "free":
                    conditions += [l - float(self.lower[i])] if np.isfinite(self.lower[i]) else []
                    conditions += [float(self.upper[i]) - l] if np.isfinite(self.upper[i]) else []
                else:
                    conditions += [square, *above]
        return ca.vertcat(*F), ca.vertcat(ca.SX(0, 1), *conditions)

    # -- points of modes --------------------------------------------------------------------------------------------------

    def start(self, mode: Mode, rng: np.random.Generator) -> np.ndarray:
        """L and s as the mode has them."""
        l, s = np.zeros(self.m), np.zeros(len(self.blocks))
        spread = 10.0 ** (rng.uniform(-2, 2) if self.everywhere else rng.uniform(-3, 1))
        for k, ((K, rows), how) in enumerate(zip(self.blocks, mode, strict=True)):
            i, own = rows[0], list(rows)
            if how in ("lower", "upper"):
                l[i] = (self.lower if how == "lower" else self.upper)[i]
            elif how == "free":
                low, up = np.isfinite(self.lower[i]), np.isfinite(self.upper[i])
                draw = spread * rng.exponential() * self.width[i]
                l[i] = (
                    rng.uniform(self.lower[i], self.upper[i]) if low and up else self.lower[i] + draw if low
                    else self.upper[i] - draw if up else rng.normal() * spread * self.width[i]
                )  # fmt: skip
            elif how != "vertex":
                part = rng.normal(size=len(own))
                if K is not None and not K.is_cone:
                    S, c = K.quadric(len(own))
                    part *= np.sqrt(c / (part @ S @ part)) * (1.0 if how == "touched" else rng.random())
                else:
                    part *= spread * self.width[i]
                    part[0] = np.linalg.norm(part[1:]) * (1.0 if how == "touched" else 1 + rng.exponential())
                l[own] = part
                s[k] = 10.0 ** rng.uniform(-3, 0) * self.size_s[k] if how == "touched" else 0.0
        return np.concatenate([l, s])

    def draw(self, rng: np.random.Generator) -> _Point | None:
        """A point of a mode, with the state it comes from; None where the draw does not satisfy the law."""
        at, n = self.at, self.n
        t = float(at.lower[0] if not at.timed or rng.random() < 0.5 else rng.uniform(at.lower[0], at.upper[0] - self.h))
        wide = 10.0 ** rng.uniform(-1, 2) if self.everywhere else 1.0
        x = (
            rng.uniform(self.low, self.up)
            if wide <= 1
            else rng.uniform(-0.5, 0.5, n) * wide * self.span + (self.low + self.up) / 2
        )
        mode = tuple(modes[int(rng.integers(len(modes)))] for modes in self.modes)
        u = np.concatenate([x, self.start(mode, rng)])
        scale = np.concatenate([10 * max(wide, 1.0) * self.span if self.everywhere else self.span, self.width, self.size_s])
        for _ in range(6):
            value, J = self.at_point(u[:n], u[n : n + self.m], t, u[:n])
            F, D, slack = self.system(mode, u, value, J)
            if not (np.isfinite(F).all() and np.isfinite(D).all()):
                return None
            weight = 1 / np.maximum(np.abs(D[n:] * scale).max(axis=1), np.finfo(float).tiny)
            if np.abs(weight * F[n:]).max(initial=0.0) < 1e-12:
                break
            u = u - scale * np.linalg.lstsq(weight[:, None] * D[n:] * scale, weight * F[n:], rcond=1e-9)[0]
            mode = self._by_sign(mode, value[n:])
            for (_, rows), how in zip(self.blocks, mode, strict=True):
                if how in ("lower", "upper"):
                    u[n + rows[0]] = (self.lower if how == "lower" else self.upper)[rows[0]]
        else:
            return None
        if slack.min(initial=1.0) < 1e-4:
            return None
        x_k = self._origin(u, t)
        if x_k is None or not (self.everywhere or ((x_k >= self.low) & (x_k <= self.up)).all()):
            return None
        value, J = self.at_point(u[:n], u[n : n + self.m], t, x_k)
        D = self.system(mode, u, value, J)[1] * scale
        sign, size = np.linalg.slogdet(D / np.maximum(np.abs(D).max(axis=1, keepdims=True), np.finfo(float).tiny))
        return _Point(mode, u, t, x_k, sign) if size > np.log(SINGULAR) else None

    def _by_sign(self, mode: Mode, y: np.ndarray) -> Mode:
        """The mode with rows at the other bound where the sign of y asks for it."""
        other = list(mode)
        for k, ((_, rows), how) in enumerate(zip(self.blocks, mode, strict=True)):
            if how == "lower" and y[rows[0]] < 0 and np.isfinite(self.upper[rows[0]]):
                other[k] = "upper"
            elif how == "upper" and y[rows[0]] > 0 and np.isfinite(self.lower[rows[0]]):
                other[k] = "lower"
        return tuple(other)

    def _origin(self, u: np.ndarray, t: float) -> np.ndarray | None:
        """The x_k from which E = 0."""
        x_k = u[: self.n].copy()
        for _ in range(8):
            point = u[: self.n], u[self.n : self.n + self.m], t, x_k
            value, J_k = self.at_point(*point)[0], self.in_x_k(*point, self.h).full()
            if not (np.isfinite(value).all() and np.isfinite(J_k).all()):
                return None
            step = np.linalg.lstsq(J_k, -value[: self.n], rcond=None)[0]
            x_k = x_k + step
            if np.abs(step).max() <= 1e-13 * np.abs(x_k).max() + LEAST:
                return x_k
        return None

    # -- two solutions ----------------------------------------------------------------------------------------------------

    def two(self, point: _Point, rng: np.random.Generator) -> Two | None:
        """Two solutions from the state of a point, both proved."""
        kept = [(point.mode, point.u)] if point.mode else []
        for mode, u in self._solutions(point, rng):
            for case in kept:
                if not self._apart(u, case[1], point.x_k):
                    break
            else:
                kept.append((mode, u))
        proved: list[krawczyk.Zero] = []
        changes: list[np.ndarray] = []
        for case in kept if len(kept) > 1 else []:
            change = self._clear(case[0], point._replace(u=case[1]))
            zero = None if change is None else self._proved(*case, point)
            if zero is None or change is None:
                continue
            proved.append(zero)
            changes.append(change)
            if len(proved) > 1 and self._disjoint(proved[0], proved[1], changes[0] + changes[-1]):
                first, other = ((zero.middle[: self.n], self._user(zero.middle)) for zero in proved)
                r_k = None if self.r_k is None else np.array(self.r_k(point.t, point.x_k)).ravel()
                return Two(point.t, point.x_k, r_k, first, other)
            proved = proved[:1]
        return None

    def _user(self, u: np.ndarray) -> np.ndarray:
        return np.array(self.user(u[self.n : self.n + self.m])).ravel()

    def _solutions(self, point: _Point, rng: np.random.Generator) -> Iterator[tuple[Mode, np.ndarray]]:
        curved = any(K is not None for K, _ in self.blocks)
        for mode in product(*self.modes):
            for _ in range(STARTS if curved and "touched" in mode else 1):
                self.tries += 1
                u = self._newton(mode, np.concatenate([point.u[: self.n], self.start(mode, rng)]), point)
                if u is not None:
                    yield mode, u

    def _newton(self, mode: Mode, u: np.ndarray, point: _Point) -> np.ndarray | None:
        n, m = self.n, self.m
        for _ in range(NEWTON):
            value, J = self.at_point(u[:n], u[n : n + m], point.t, point.x_k)
            F, D, slack = self.system(mode, u, value, J)
            if not (np.isfinite(F).all() and np.isfinite(D).all()):
                return None
            try:
                step = np.linalg.solve(D, -F)
            except np.linalg.LinAlgError:
                return None
            u = u + step
            if (np.abs(step) <= TOLERANCE * (np.abs(u) + np.abs(step))).all() or np.abs(step).max() < LEAST:
                return u if slack.min(initial=1.0) > SLACK else None
        return None

    def _apart(self, u: np.ndarray, v: np.ndarray, x_k: np.ndarray) -> bool:
        """Whether two x_{k+1} differ by more than the step's tolerance leaves open."""
        a, b = u[: self.n], v[: self.n]
        moved = max(np.abs(a - x_k).max(), np.abs(b - x_k).max())
        return bool(np.abs(a - b).max() > max(SAME * moved, 1e-9 * np.abs(x_k).max(), LEAST))

    def _clear(self, mode: Mode, point: _Point) -> np.ndarray | None:
        """By how much x (n,) changes where the data do by CLEAR of themselves; None where an inequality may then fail."""
        n, m, u = self.n, self.m, point.u
        state = u[:n], u[n : n + m], point.t, point.x_k
        (value, J), J_k = self.at_point(*state), self.in_x_k(*state, self.h).full()
        D = self.system(mode, u, value, J)[1]
        terms = np.abs(D) @ np.abs(u)
        terms[:n] += np.abs(J_k) @ np.abs(point.x_k)
        try:
            change = CLEAR * np.abs(np.linalg.inv(D)) @ terms
        except np.linalg.LinAlgError:
            return None
        of_l, of_s = change[n : n + m], change[n + m :]
        of_y = CLEAR * np.abs(J[n:]) @ np.abs(u[: n + m]) + np.abs(J[n:]) @ change[: n + m]
        l, y = u[n : n + m], value[n:]
        for k, ((K, rows), how) in enumerate(zip(self.blocks, mode, strict=True)):
            own = list(rows)
            least, of_it = np.inf, 0.0
            if how == "free":
                least, of_it = min(l[own[0]] - self.lower[own[0]], self.upper[own[0]] - l[own[0]]), of_l[own[0]]
            elif how in ("lower", "upper") and self.lower[own[0]] < self.upper[own[0]]:
                least, of_it = np.abs(y[own[0]]), of_y[own[0]]
            elif how == "touched":
                least, of_it = u[n + m + k], of_s[k]
            elif K is not None and K.is_cone:
                part, of_it = (l[own], of_l[own].sum()) if how == "inside" else (y[own], of_y[own].sum())
                least = part[0] - np.linalg.norm(part[1:])
            elif K is not None:
                S, c = K.quadric(len(own))
                least, of_it = np.sqrt(c) - np.sqrt(l[own] @ S @ l[own]), np.sqrt(of_l[own] @ np.abs(S) @ of_l[own])
            if not least > of_it:
                return None
        return change[:n]

    def _proved(self, mode: Mode, u: np.ndarray, point: _Point) -> krawczyk.Zero | None:
        F, conditions = self.expressions(mode)
        z = ca.vertcat(self.x, self.l, self.s, self.t, self.x_k, self.step)
        start = np.concatenate([u, [point.t], point.x_k, [self.h]])
        size = np.concatenate([np.where(np.abs(u) > 0, np.abs(u), 1.0), np.full(len(start) - len(u), 1e-200)])
        zero = krawczyk.zero_near(F, z, start, size)
        if zero is None or (zero.lower[len(u) :] != start[len(u) :]).any() or (zero.upper[len(u) :] != start[len(u) :]).any():
            return None
        low, _ = interval.enclose(conditions, z, zero.lower, zero.upper) if conditions.numel() else (np.ones(1), None)
        return zero if (low > 0).all() else None

    def _disjoint(self, a: krawczyk.Zero, b: krawczyk.Zero, change: np.ndarray) -> bool:
        """Whether some x_i differ, by more than ``change`` (n,)."""
        n = self.n
        return bool((np.maximum(b.lower[:n] - a.upper[:n], a.lower[:n] - b.upper[:n]) > change).any())


def _blocks(law: Law) -> Iterator[Block]:
    """Each row of a box, each curved set."""
    for rows, block in law.parts():
        own = tuple(range(rows.start, rows.stop))
        K = block.curved()
        yield from ((None, (i,)) for i in own) if K is None else [(K, own)]


def _modes(block: Block, lower: np.ndarray, upper: np.ndarray) -> list[str]:
    K, (i, *_) = block
    if K is not None:
        return ["vertex", "inside", "touched"] if K.is_cone else ["inside", "touched"]
    if lower[i] == upper[i]:
        return ["lower"]
    return ["free", *(["lower"] if np.isfinite(lower[i]) else []), *(["upper"] if np.isfinite(upper[i]) else [])]
