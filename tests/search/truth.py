"""The true step: E = 0 and the law's equations on an index set in 64 digits, and the signs that make it the solution.

Codes of a row are those of a trajectory: 0: y_i = 0; -1, +1: l_i at its lower, upper end. A ball's rows share a code: 0: y = 0
(stick); 1: l = -r y/|y| (slip). Where the signs of a set are wrong the rows at fault are exchanged, and the next set is solved.
"""

from __future__ import annotations

import decimal
import itertools
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import casadi as ca
import numpy as np
from scipy import linalg
from scipy.optimize import linprog

from nsmodel.solvers import active_set
from nsmodel.solvers.fallbacks import NonlinearProgramme
from nsmodel.solvers.residuals import NumericLaw

from .digits import CONTEXT, Exact, Rounding, column, exact, floats, solve

EPS = np.finfo(float).eps
FINE = Decimal("1e-40")  # To which a set is solved, beside what each unknown is made of.
NOTHING = Decimal("1e-38")  # Beside the largest it has been made of, an unknown below this is 0.
ANY = 1e200  # A multiplier that may be any number.
SIGN = Decimal("1e-32")  # Below which, beside its terms, an output or a multiplier counts as 0.
ENUMERATED = 7  # Rows up to which all index sets are tried.


@dataclass
class Truth:
    """The solution of a step, and how well it is determined.

    Attributes:
        z, l, y: in 64 digits. index: of each row of l.
        condition: least condition number of the system of the index set over all scalings of its rows and columns (Bauer: the
            spectral radius of |J^-1| |J|); inf where it is singular, though consistent.
        size_z, size_l: beside what an error counts: the unknown itself, or what makes it up over the condition.
        rounding_z, rounding_l: how far rounding of the data and of each term moves the unknowns (eps |J^-1| |terms|).
    """

    z: list[Decimal]
    l: list[Decimal]
    y: list[Decimal]
    index: np.ndarray
    condition: float
    size_z: np.ndarray
    size_l: np.ndarray
    rounding_z: np.ndarray
    rounding_l: np.ndarray


class Teller:
    """Tells the truth about the steps of one one-step problem, with its law's numbers."""

    def __init__(self, problem: Any) -> None:
        p = self.problem = problem
        known = [p.t, p.h, p.state]
        self.n, self.m = p.z.numel(), p.l.numel()
        jacobians = p.jacobians
        self._values = Exact([*known, p.z, p.l], [p.E, p.Y])
        self._slopes = ca.Function("J", [*known, p.z, p.l], [ca.densify(J) for J in jacobians])
        self._exact_slopes: Exact | None = None
        self._felt = Rounding([*known, p.z, p.l], [p.E, p.Y])
        self._guess = ca.Function("guess", [*known, p.l], [ca.densify(p.guess)])
        next_l = p.l if p.multipliers is None else p.multipliers
        self._answer = Exact([*known, p.z, p.l], [p.next_state, next_l])
        self._answer_slopes = ca.Function(
            "A", [*known, p.z, p.l], [ca.densify(ca.jacobian(e, v)) for e in (p.next_state, next_l) for v in (p.z, p.l)]
        )
        law = p.law
        self.lower = np.array(ca.DM(law.lower)).ravel()
        self.upper = np.array(ca.DM(law.upper)).ravel()
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self.balls, at = [], 0
        for block in law.blocks:
            rows = slice(at, at + block.size)
            at += block.size
            if block.kind == "ball":
                self.balls.append((rows, float(block.radius)))
                self.lower[rows], self.upper[rows] = -np.inf, np.inf
            elif block.kind != "box":
                raise NotImplementedError(block.kind)
        self.curved = np.zeros(self.m, bool)
        for rows, _ in self.balls:
            self.curved[rows] = True

    # ------------------------------------------------------------------------------------------ equations

    def guess(self, t, h, state, l):
        return np.array(self._guess(t, h, state, l)).ravel()

    def slopes(self, t, h, state, z, l):
        return [np.array(part) for part in self._slopes(t, h, state, z, l)]

    def _system(self, known, z, l, index, fine=False):
        """(E, Y, residual, J) of the square system on an index set; J in doubles, or in digits."""
        E, Y = self._values(*known, z, l)
        n, m = self.n, self.m
        at = [floats(part) for part in known], floats(z), floats(l)
        if fine:
            if self._exact_slopes is None:
                p = self.problem
                self._exact_slopes = Exact([p.t, p.h, p.state, p.z, p.l], [ca.densify(J) for J in p.jacobians])
            flat = self._exact_slopes(*known, z, l)
            E_z, E_l = (np.array(part, object).reshape((n, -1), order="F") for part in flat[:2])
            Y_z, Y_l = (np.array(part, object).reshape((m, -1), order="F") for part in flat[2:])
            zero, one = Decimal(0), Decimal(1)
            J = np.full((n + m, n + m), zero, object)
        else:
            E_z, E_l, Y_z, Y_l = self.slopes(at[0][0], at[0][1], at[0][2], at[1], at[2])
            zero, one = 0.0, 1.0
            J = np.zeros((n + m, n + m))
        J[:n, :n], J[:n, n:] = E_z, E_l
        residual = list(E)
        for i in range(m):
            row = n + i
            if index[i] == 0 or self.curved[i]:
                J[row, :n], J[row, n:] = Y_z[i], Y_l[i]
                residual.append(Y[i])
            else:
                J[row, n + i] = one
                residual.append(l[i] - exact(self.lower[i] if index[i] < 0 else self.upper[i]))
        for rows, radius in self.balls:
            if index[rows.start] == 0:
                continue
            with decimal.localcontext(CONTEXT):
                y, r = Y[rows], exact(radius)
                length = sum(v * v for v in y).sqrt()
                if not length:
                    continue
                for a, i in enumerate(range(rows.start, rows.stop)):
                    residual[n + i] = l[i] + r * y[a] / length
                D = [
                    [r * ((1 if a == b else 0) / length - y[a] * y[b] / length**3) for b in range(len(y))] for a in range(len(y))
                ]
            D = np.array(D, object) if fine else np.array([[float(v) for v in row] for row in D])
            block = slice(n + rows.start, n + rows.stop)
            Yz, Yl = Y_z[rows], Y_l[rows]
            J[block, :n], J[block, n:] = D @ Yz, D @ Yl
            for i in range(rows.start, rows.stop):
                J[n + i, n + i] += one
        return E, Y, residual, J

    def _on_set(self, known, z, l, index):
        """(z, l, Y, J) that solve the system on the set to FINE; None where no way leads there."""
        z, l = list(z), list(l)
        for i in range(self.m):
            if index[i] and not self.curved[i]:
                l[i] = exact(self.lower[i] if index[i] < 0 else self.upper[i])
        fine, last, peak = False, None, [Decimal(0)] * (self.n + self.m)
        for iteration in range(60):
            try:
                _, Y, r, J = self._system(known, z, l, index, fine)
            except (decimal.DecimalException, OverflowError, RuntimeError):
                return None
            if not fine and not np.isfinite(J).all():
                return None
            if not any(r):
                return z, l, Y, (J if not fine else self._system(known, z, l, index)[3])
            step, size = self._newton_step(J, r, z, l, fine)
            if step is None:
                if fine:
                    return None
                fine = True
                continue
            with decimal.localcontext(CONTEXT):
                peak = [max(a, b) for a, b in zip(peak, size, strict=True)]
                z = [a + b for a, b in zip(z, step[: self.n], strict=True)]
                l = [a + b for a, b in zip(l, step[self.n :], strict=True)]
                worst = max((abs(s) / w for s, w in zip(step, size, strict=True) if s), default=Decimal(0))
            if worst <= FINE:
                with decimal.localcontext(CONTEXT):  # what is left of larger terms is 0
                    u = [a if abs(a) > NOTHING * b else Decimal(0) for a, b in zip([*z, *l], peak, strict=True)]
                z, l = u[: self.n], u[self.n :]
                _, Y, r, J = self._system(known, z, l, index)
                return z, l, Y, J
            if iteration > 25 and last is not None and worst > last / 2 and not fine:
                fine = True
            last = worst
        return None

    def _newton_step(self, J, r, z, l, fine):
        """(step, what each unknown is made of)."""
        if fine:
            step = solve_scaled(J, r)
            if step is None:
                return None, None
            u = [*z, *l]
            with decimal.localcontext(CONTEXT):
                size = [abs(a) + abs(b) + Decimal("1e-300") for a, b in zip(u, step, strict=True)]
            return [-s for s in step], size
        with decimal.localcontext(CONTEXT):
            top = max(abs(v) for v in r)
            small = np.array([float(v / top) for v in r])
        rows, cols = equilibrate(J)
        A = J / rows[:, None] / cols
        if not np.isfinite(A).all():
            return None, None
        inverse = self._inverse(J, A, rows, cols)
        if inverse is None:
            return None, None
        u = np.abs(np.concatenate([floats(z), floats(l)]))
        with np.errstate(all="ignore"):
            du = -inverse @ small
            size = np.abs(inverse) @ (np.abs(J) @ (u + np.abs(du) * float(top)))
        if not (np.isfinite(du).all() and np.isfinite(size).all()):
            return None, None
        with decimal.localcontext(CONTEXT):
            return [exact(v) * top for v in du], [exact(max(v, 1e-300)) for v in size]

    def _inverse(self, J, A, rows, cols):
        """J^{-1} from the scaled A, the last one where J is the same; of least norm where J is singular for sure, else None."""
        if self._last is not None and np.array_equal(self._last[0], J):
            return self._last[1]
        try:
            inverse = np.linalg.inv(A)
        except np.linalg.LinAlgError:
            inverse = np.full_like(A, np.inf)
        if not np.abs(inverse).sum(axis=1).max() * np.abs(A).sum(axis=1).max() < 1e13:
            try:
                U, s, Vt = np.linalg.svd(A)
            except np.linalg.LinAlgError:
                return None
            keep = s > 1e-11 * s[0]
            if s[~keep].max(initial=0.0) > 1e-3 * s[keep].min():
                return None
            inverse = (Vt[keep].T / s[keep]) @ U[:, keep].T
        with np.errstate(all="ignore"):
            inverse = inverse / cols[:, None] / rows
        self._last = J.copy(), inverse
        return inverse

    # ------------------------------------------------------------------------------------------ signs

    def _wrong(self, known, z, l, Y, index):
        """Rows whose sign forbids the set, and the code that they should have."""
        at = [floats(part) for part in known]
        zf, lf = floats(z), floats(l)
        _, _, Y_z, Y_l = self.slopes(at[0], at[1], at[2], zf, lf)
        size = np.abs(Y_z) @ np.abs(zf) + np.abs(Y_l) @ np.abs(lf) + np.abs(floats(Y) - Y_z @ zf - Y_l @ lf)
        wrong = {}
        with decimal.localcontext(CONTEXT):
            for i in range(self.m):
                if self.curved[i]:
                    continue
                lo, up, tiny = self.lower[i], self.upper[i], SIGN * exact(size[i])
                if index[i] == 0:
                    slack = SIGN * (abs(l[i]) + 1 if lo == up == 0 else abs(l[i]))
                    if np.isfinite(lo) and l[i] < exact(lo) - max(slack, SIGN * exact(abs(lo)), self._tiny_l(l)):
                        wrong[i] = -1
                    elif np.isfinite(up) and l[i] > exact(up) + max(slack, SIGN * exact(abs(up)), self._tiny_l(l)):
                        wrong[i] = 1
                elif lo == up:
                    continue
                elif (index[i] < 0 and Y[i] < -tiny) or (index[i] > 0 and Y[i] > tiny):
                    wrong[i] = 0
            for rows, radius in self.balls:
                i, r = rows.start, exact(radius)
                if index[i] == 0:
                    if sum(v * v for v in l[rows]).sqrt() > r * (1 + SIGN):
                        wrong[i] = 1
                elif sum(a * b for a, b in zip(l[rows], Y[rows], strict=True)) > 0:
                    wrong[i] = 0
        return wrong

    def _tiny_l(self, l):
        return max((abs(v) for v in l), default=Decimal(0)) * Decimal("1e-48")

    def tell(self, t, h, state, z, l, index, more=()) -> Truth | None:
        """The truth, looked for from (z, l, index set) and further index sets; None where none is found."""
        known = ([exact(t)], [exact(h)], column(state))
        z, l = column(z), column([v if np.isfinite(v) else 0.0 for v in l])
        for start in (index, *more):
            found = self._from(known, z, l, np.array(start, int))
            if found is not None:
                return self._with_sizes(known, *found)
        if self.m <= ENUMERATED and not self.balls:
            choices = [
                [c for c, ok in ((0, True), (-1, np.isfinite(lo)), (1, np.isfinite(up))) if ok]
                for lo, up in zip(self.lower, self.upper, strict=True)
            ]
            for code in itertools.islice(itertools.product(*choices), 800):
                found = self._checked(known, z, l, np.array(code))
                if found is not None and not found[-1]:
                    return self._with_sizes(known, *found[:-1])
        return None

    def _checked(self, known, z, l, index):
        solved = self._on_set(known, z, l, index)
        if solved is None:
            return None
        z, l, Y, J = solved
        return z, l, Y, J, index, self._wrong(known, z, l, Y, index)

    def _from(self, known, z, l, index):
        index = np.where((index < 0) & ~np.isfinite(self.lower) & ~self.curved, 0, index)
        index = np.where((index > 0) & ~np.isfinite(self.upper) & ~self.curved, 0, index)
        index[(index < -1) | (index > 1)] = 0
        seen: set[bytes] = set()
        single = False
        for _ in range(self.m + 20):
            found = self._checked(known, z, l, index)
            if found is None:
                return None
            *found, wrong = found
            if not wrong:
                return found
            if index.tobytes() in seen:
                single = True
            seen.add(index.tobytes())
            index = index.copy()
            items = list(wrong.items())
            for i, code in items[-1:] if single else items:
                index[i] = code
                for rows, _ in self.balls:
                    if rows.start == i:
                        index[rows] = code
            z, l = found[0], found[1]
        return None

    # ------------------------------------------------------------------------------------------ how well determined

    def _with_sizes(self, known, z, l, Y, J, index) -> Truth:
        n, m = self.n, self.m
        (t,), (h,), state = (floats(part) for part in known)
        zf, lf = floats(z), floats(l)
        E_z, E_l, Y_z, Y_l = self.slopes(t, h, state, zf, lf)
        guess = self.guess(t, h, state, np.zeros(m))
        E_0, Y_0 = (floats(part) for part in self._values(*known, column(guess), column(np.zeros(m))))
        Y_1 = floats(Y)
        a_E, a_Y = self._felt([t], [h], state, zf, lf)
        free = np.flatnonzero((index == 0) | self.curved)
        keep = np.concatenate([np.arange(n), n + free])
        A = J[np.ix_(keep, keep)]
        rows, cols = equilibrate(A)
        with np.errstate(all="ignore"):
            S = A / rows[:, None] / cols
            try:
                inverse = np.linalg.inv(S)
            except np.linalg.LinAlgError:
                inverse = np.full_like(S, np.inf)
            singular = not np.abs(inverse).sum(axis=1).max(initial=0.0) * np.abs(S).sum(axis=1).max(initial=0.0) < 1e14
            inverse = np.linalg.pinv(S, rcond=1e-13) if singular else inverse
        with np.errstate(all="ignore"):
            inverse = np.abs(inverse / cols[:, None] / rows)
            B = inverse @ np.abs(A)
            condition = max(1.0, float(np.abs(linalg.eigvals(B)).max(initial=1.0))) if np.isfinite(B).all() else np.inf
        condition = np.inf if singular else condition
        u, du = np.concatenate([zf, lf]), np.concatenate([zf - guess, lf])
        rhs = np.concatenate([np.abs(E_0), np.abs(Y_0)])
        made = np.concatenate(
            [np.abs(E_z) @ np.abs(du[:n]) + np.abs(E_l) @ np.abs(lf), np.abs(Y_z) @ np.abs(du[:n]) + np.abs(Y_l) @ np.abs(lf)]
        )
        for ball, radius in self.balls:
            if index[ball.start]:  # the rows are l + r y/|y|
                at = slice(n + ball.start, n + ball.stop)
                rhs[at], made[at] = radius, radius
                length = np.linalg.norm(Y_1[ball])
                a_Y[ball] = radius * (1 + a_Y[ball].max() / max(length, 1e-300))
        moved = inverse @ (made[keep] + rhs[keep]) if keep.size else np.zeros(0)
        size, rounding = np.abs(du), np.zeros(n + m)
        known_condition = condition if np.isfinite(condition) else 1e8
        size[keep] = np.maximum(size[keep], moved / known_condition)
        rounding[keep] = EPS * (inverse @ np.concatenate([a_E, a_Y])[keep]) if keep.size else 0.0
        rounding = np.maximum(rounding, EPS * np.abs(u))
        with np.errstate(all="ignore"):
            try:
                parts = np.linalg.solve(
                    E_z, np.column_stack([E_0, E_l * lf])
                )  # what moves z: without multipliers, and each of them
                rounding[:n] += EPS * np.nan_to_num(np.abs(parts).sum(axis=1))
            except np.linalg.LinAlgError:
                pass
        if m:
            bounds, linked = self._least_sizes(E_z, E_l, Y_z, Y_l, lf)
            size[n:] = np.maximum(size[n:], np.maximum(bounds, linked))
            size[:n] = np.maximum(size[:n], np.abs(np.linalg.pinv(E_z) @ E_l) @ linked)
            whole = J.copy()
            fixed = np.flatnonzero((index != 0) & ~self.curved)
            whole[n + fixed] = np.hstack([Y_z, Y_l])[fixed]
            self._add_near_bounds(index, np.concatenate([a_E, a_Y]), whole, lf, rounding)
            self._add_ties(index, Y_1, np.concatenate([a_E, a_Y]), whole, lf, rounding)
        return Truth(z, l, Y, index, condition, size[:n], size[n:], rounding[:n], rounding[n:])

    def _add_ties(self, index, Y, a, J, l, rounding):
        """A row at its bound whose y is 0 to rounding may as well be free: what that moves, and what may then be any.

        What is moved so may bring the y of more rows within rounding of 0.
        """
        n, tied = self.n, None
        while True:
            felt = 4 * np.abs(J[n:, :n]) @ rounding[:n]  # of y, where its row is whole
            last, tied = tied, (index != 0) & ~self.curved & (np.abs(Y) <= 256 * EPS * a[n:] + felt)
            if not tied.any() or np.array_equal(last, tied):
                return
            keep = np.concatenate([np.arange(n), n + np.flatnonzero((index == 0) | self.curved | tied)])
            A = J[np.ix_(keep, keep)]
            rows, cols = equilibrate(A)
            with np.errstate(all="ignore"):
                U, s, Vt = np.linalg.svd(A / rows[:, None] / cols)
                seen = s > 1e-13 * s.max(initial=0.0)
                inverse = (Vt[seen].T / s[seen]) @ U[:, seen].T / cols[:, None] / rows
            rounding[keep] = np.maximum(rounding[keep], 4 * EPS * (np.abs(inverse) @ a[keep]))
            rounding[keep[n:]] = np.maximum(rounding[keep[n:]], self._spread(Vt[~seen], cols, l, keep[n:] - n))

    def _add_near_bounds(self, index, a, J, l, rounding):
        """A row whose l is not told from its bound may as well be there: what moves without it."""
        n = self.n
        near = (index == 0) & ~self.curved & (np.minimum(l - self.lower, self.upper - l) <= 4 * rounding[n:])
        if not near.any():
            return
        keep = np.concatenate([np.arange(n), n + np.flatnonzero(((index == 0) & ~near) | self.curved)])
        A = J[np.ix_(keep, keep)]
        rows, cols = equilibrate(A)
        with np.errstate(all="ignore"):
            inverse = np.linalg.pinv(A / rows[:, None] / cols, rcond=1e-13) / cols[:, None] / rows
        rounding[keep] = np.maximum(rounding[keep], 4 * EPS * (np.abs(inverse) @ a[keep]))

    def _spread(self, null, cols, l, rows):
        """How far the multipliers (of ``rows``) may go along the null space, within their bounds: they are not unique there."""
        spread = np.zeros(rows.size)
        if not len(null):
            return spread
        D = (np.where(np.abs(null) <= 1e-9, 0.0, null) / cols).T[-rows.size :]
        low, high = np.minimum(self.lower[rows] - l[rows], 0.0), np.maximum(self.upper[rows] - l[rows], 0.0)
        held = np.isfinite(low) & np.isfinite(high)
        scaled = cols[-rows.size :]
        unit = np.where(held, np.maximum(high, -low), ((np.abs(l[rows]) * scaled).max() or 1.0) / scaled)
        unit[unit == 0] = 1.0
        bounded_up, bounded_low = np.isfinite(high), np.isfinite(low)
        A = np.vstack([(D / unit[:, None])[bounded_up], -(D / unit[:, None])[bounded_low]])
        b = np.concatenate([(high / unit)[bounded_up], (-low / unit)[bounded_low]])
        scale = np.abs(D / unit[:, None]).max(axis=0)
        scale[scale == 0] = 1.0
        for i in np.flatnonzero(np.abs(D).max(axis=1)):
            for sign in (1, -1):
                found = linprog(-sign * D[i] / unit[i] / scale, A_ub=A / scale, b_ub=b, bounds=(None, None))
                spread[i] = max(spread[i], ANY if found.status == 3 else -found.fun * unit[i] if found.success else 0.0)
        return spread

    def _least_sizes(self, E_z, E_l, Y_z, Y_l, l):
        """Bounds of each multiplier; and 1e-6 of the largest of others that are linked to it, in the unit in which W_ii = 1."""
        bound = np.maximum(*(np.where(np.isfinite(b), np.abs(b), 0.0) for b in (self.lower, self.upper)))
        for rows, radius in self.balls:
            bound[rows] = radius
        try:
            W = Y_l - Y_z @ np.linalg.solve(E_z, E_l)
        except np.linalg.LinAlgError:
            return bound, np.zeros(len(l))
        w = np.sqrt(np.abs(W).max(axis=1))
        linked = W != 0
        largest = np.array([(np.abs(l) * w)[linked[i] | linked[:, i]].max(initial=0.0) for i in range(len(l))])
        return bound, np.divide(1e-6 * largest, w, out=np.zeros_like(w), where=w > 0)

    def misfit(self, t, h, state, z, l, index):
        """How far (z, l) misses the law, in units of 1e-9 of what moves plus rounding, and the row that is worst."""
        known = ([exact(t)], [exact(h)], column(state))
        E, Y = (floats(part) for part in self._values(*known, column(z), column(l)))
        E_0, Y_0 = (floats(p) for p in self._values(*known, column(self.guess(t, h, state, 0 * l)), column(0 * l)))
        a_E, a_Y = self._felt([t], [h], state, z, l)
        E_z, E_l, Y_z, Y_l = self.slopes(t, h, state, z, l)
        dz = z - self.guess(t, h, state, 0 * l)
        moved_E = np.abs(E_0) + np.abs(E_z) @ np.abs(dz) + np.abs(E_l) @ np.abs(l)
        moved_Y = np.abs(Y_0) + np.abs(Y_z) @ np.abs(dz) + np.abs(Y_l) @ np.abs(l)
        a_Y = a_Y + np.abs(Y_z) @ (np.abs(np.linalg.pinv(E_z)) @ a_E)  # z is as exact as E tells it
        wrong = np.where(index < 0, np.maximum(-Y, 0), np.where(index > 0, np.maximum(Y, 0), np.abs(Y)))
        wrong[self.curved] = 0
        ratio = np.concatenate([np.abs(E), wrong]) / (
            np.concatenate([1e-9 * moved_E + 64 * EPS * a_E, 1e-9 * moved_Y + 64 * EPS * a_Y]) + 1e-290
        )
        return float(ratio.max(initial=0.0)), int(np.argmax(ratio))

    def answer(self, t, h, state, truth: Truth):
        """Next state and multipliers as (decimals, tolerance sizes, rounding) of each."""
        known = ([exact(t)], [exact(h)], column(state))
        values = self._answer(*known, truth.z, truth.l)
        zf, lf = floats(truth.z), floats(truth.l)
        slopes = [np.abs(np.array(part)) for part in self._answer_slopes(t, h, state, zf, lf)]
        out = []
        for value, (a, b) in zip(values, (slopes[:2], slopes[2:]), strict=True):
            size = a @ truth.size_z + b @ truth.size_l
            rounding = np.maximum(a @ truth.rounding_z + b @ truth.rounding_l, EPS * np.abs(floats(value)))
            out.append((value, size, rounding))
        return out

    def starts(self, t, h, state):
        """Index sets to start from that owe nothing to the run: Lemke's, all at rest, all free, IPOPT's."""
        zero = np.clip(np.zeros(self.m), self.lower, self.upper)
        z = self.guess(t, h, state, zero)
        by_lemke = None if self.balls else self._by_lemke(t, h, state, z, zero)
        if by_lemke is not None:
            yield by_lemke
        yield np.where(self.lower == 0, -1, 0)
        yield np.zeros(self.m, int)
        found = NonlinearProgramme(
            self.problem, NumericLaw(self.lower, self.upper, tuple(("ball", r, a) for r, a in self.balls))
        ).solve(t, h, state, z, zero)
        if found is not None:
            _, l, y = found
            with np.errstate(all="ignore"):
                y_s, l_s = np.abs(y) / (np.abs(y).max() or 1.0), np.abs(l) / (np.abs(l).max() or 1.0)
            at_lower = np.isfinite(self.lower) & (l - self.lower <= np.maximum(1e-6 * np.abs(l).max(), 0)) & (y_s >= l_s * 1e-3)
            at_upper = np.isfinite(self.upper) & (self.upper - l <= 1e-6 * np.abs(l).max()) & (y_s >= l_s * 1e-3)
            yield np.where(at_lower, -1, np.where(at_upper, 1, 0))

    def _by_lemke(self, t, h, state, z, l):
        """The index set of Lemke's solution of the step linearised at (z, l), in units in which W_ii = 1."""
        known = [exact(t)], [exact(h)], column(state)
        E, Y = (floats(part) for part in self._values(*known, column(z), column(l)))
        E_z, E_l, Y_z, Y_l = self.slopes(t, h, state, z, l)
        try:
            both = np.linalg.solve(E_z, np.column_stack([E, E_l]))
        except np.linalg.LinAlgError:
            return None
        W, b = Y_l - Y_z @ both[:, 1:], Y - Y_z @ both[:, 0] - Y_l @ l + Y_z @ (both[:, 1:] @ l)
        unit = np.sqrt(np.abs(W).max(axis=1, initial=0.0))
        unit[~(unit > 0)] = 1.0
        law = NumericLaw(self.lower * unit, self.upper * unit, ())
        with np.errstate(all="ignore"):
            found = active_set.lemke(W / unit[:, None] / unit, b / unit, law)
        if found is None or not np.isfinite(found).all():
            return None
        return active_set.estimate_index_set(found, W / unit[:, None] / unit @ found + b / unit, law, np.ones(self.m))


def equilibrate(J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors of rows and columns (powers of 2) that make the largest entry of each about 1."""
    rows, cols = np.ones(J.shape[0]), np.ones(J.shape[1])
    A = np.abs(J)
    for _ in range(12):
        r = np.sqrt(A.max(axis=1, initial=0.0))
        r[~(r > 0)] = 1.0
        c = np.sqrt(A.max(axis=0, initial=0.0))
        c[~(c > 0)] = 1.0
        A = A / r[:, None] / c
        rows, cols = rows * r, cols * c
    return 2.0 ** np.round(np.log2(rows)), 2.0 ** np.round(np.log2(cols))


def solve_scaled(J, r):
    """`digits.solve` with equilibrated columns."""
    with decimal.localcontext(CONTEXT):
        n = len(r)
        big = [max((abs(J[i][j]) for i in range(n)), default=Decimal(0)) for j in range(n)]
        if not all(big):
            return None
        rows = [[J[i][j] / big[j] for j in range(n)] for i in range(n)]
        u = solve(rows, r)
        return None if u is None else [a / b for a, b in zip(u, big, strict=True)]
