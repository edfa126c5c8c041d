"""Multipliers that are at a bound in every step from a state of the region, as their y has one sign there and where it leads.

The modes of a step, for any law: square systems in u = (x, l, s) with strict inequalities.

A mode says which rows are at which bound, which balls and cones are touched; s are the normal forces of what is touched.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.modeling.laws import CurvedSet, Law, box, product
from nsmodel.modeling.laws.base import Intervals, SecondOrder
from nsmodel.models.first_order_system.linearisation import SystemLinearisation, system_jacobians
from nsmodel.proof import exact, interval_bounds
from nsmodel.solvers.one_step_problem import rewrite_as_basic_law
from nsmodel.solvers.residuals import numeric_law

HELD_ROUNDS = 3  # Rounds of putting in multipliers that their signs hold: with fewer multipliers more signs show.


def substitute_held_rows(at: SystemLinearisation) -> SystemLinearisation:
    """The system with the held multipliers put in; all of them held: x' = theta f + gamma g with theta = 1."""
    for _ in range(HELD_ROUNDS):
        held = _held_values(at)
        if np.isnan(held).all():
            break
        at = _substitute_held(at, held)
    return at


def _held_values(at: SystemLinearisation) -> np.ndarray:
    """The values (m,) of the held multipliers, NaN of the others."""
    out, place, around = np.full(at.model.law.size, np.nan), 0, _reachable_box(at)
    if around is None:
        return out
    low, high = (end.ravel() for end in interval_bounds.enclose(at.model.h, at.z, *around))
    for block in at.model.law.blocks:
        own = slice(place, place + block.size)
        place += block.size
        shape = block.shape()
        if isinstance(shape, Intervals):
            bottom, top = shape
            value = np.where(low[own] > 0, bottom, np.where(high[own] < 0, top, np.nan))
            out[own] = np.where(np.isfinite(value), value, np.nan)
        elif isinstance(shape, SecondOrder):
            across = np.maximum(np.abs(low[own]), np.abs(high[own]))[1:]
            if low[own][0] > 1.001 * np.linalg.norm(across):
                out[own] = 0.0
    return out


def _reachable_box(at: SystemLinearisation) -> tuple[np.ndarray, np.ndarray] | None:
    """A box of (t, x, l) into which each step from a state of the region leads, f and g being continued beyond it."""
    n, h, inverse = len(at.model.names), float(at.steps.max()), exact.inverse_matrix(at.M)
    if inverse is None:
        return None
    lower, upper = at.lower.copy(), at.upper.copy()
    lower[0] = min(lower[0] + at.steps.min(), at.upper[0])
    for widening in (2.0, 1.0):
        force = [np.abs(end).ravel() for e in (at.model.f, at.model.g) for end in interval_bounds.enclose(e, at.z, lower, upper)]
        if not np.isfinite(force).all():
            return None
        reach = 1.001 * widening * h * np.abs(exact.doubles(inverse)) @ (np.maximum(*force[:2]) + np.maximum(*force[2:]))
        low, high = at.lower[1 : n + 1] - reach, at.upper[1 : n + 1] + reach
        if widening == 1 and ((low < lower[1 : n + 1]) | (high > upper[1 : n + 1])).any():
            return None
        if widening > 1:
            lower[1 : n + 1], upper[1 : n + 1] = low, high
    return lower, upper


def _substitute_held(at: SystemLinearisation, held: np.ndarray) -> SystemLinearisation:
    model, n, left = at.model, len(at.model.names), np.isnan(held)
    lam = ca.vertsplit(model.lam)
    known = [lam[i] for i in np.flatnonzero(~left)], [ca.SX(float(held[i])) for i in np.flatnonzero(~left)]
    h, g = ca.substitute([model.h, model.g], *known)
    kept, place = [], 0
    for block in model.law.blocks:
        own = np.flatnonzero(left[place : place + block.size])
        place += block.size
        shape = block.shape()
        if isinstance(shape, Intervals) and own.size:
            bottom, top = shape
            kept.append(box(bottom[own], top[own]))
        elif own.size:
            kept.append(Law((block,)))
    rows = [int(i) for i in np.flatnonzero(left)]
    given: dict[str, Any] = {
        "lam": ca.vertcat(*(lam[i] for i in rows)),
        "h": h[rows],
        "g": g,
        "law": product(*kept),
        "lam0": model.lam0[rows],
    }
    if not rows:
        given |= {**dict.fromkeys(given), "f": model.theta * model.f + model.gamma * g, "theta": 1.0}
    model = replace(model, **given)
    columns = [*range(1 + n), *(1 + n + i for i in rows)]
    names = tuple(at.names[i] for i in columns)
    return replace(
        at, model=model, jacobians=system_jacobians(model), z=ca.vertcat(model.t, model.x, model.lam), names=names,
        lower=at.lower[columns], upper=at.upper[columns], points=at.points[:, columns],
        boxed=tuple(name for name in at.boxed if name in names),
    )  # fmt: skip


ModeBlock = tuple[CurvedSet | None, tuple[int, ...]]  # the set, None for a row of a box, and its rows of l
StepMode = tuple[str, ...]  # of each block: "free", "lower", "upper"; "inside", "touched"; "vertex"


class StepModes:
    """The step as functions of u = (x, l, s), the time and the state."""

    def __init__(self, at: SystemLinearisation, h: float) -> None:
        model = at.model
        self.at, self.h, self.n = at, h, len(at.model.names)
        y_user = ca.SX.sym("y", model.law.size)
        basic = rewrite_as_basic_law(model.law, model.multiplier_names, y_user, ca.vertcat(model.t, model.u))
        law = numeric_law(basic.law)
        self.law, self.m, self.lower, self.upper = law, law.size, law.lower, law.upper
        self.blocks = list(_mode_blocks(basic.law))
        self.modes = [_block_modes(block, law.lower, law.upper) for block in self.blocks]
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
        self.x = x
        inputs, both = [x, self.l, self.t, self.x_k, self.step], ca.vertcat(self.E, self.Y)
        self.values = ca.Function("values", inputs, [ca.densify(ca.horzcat(both, ca.jacobian(both, ca.vertcat(x, self.l))))])
        self.in_x_k = ca.Function("in_x_k", inputs, [ca.densify(ca.jacobian(self.E, self.x_k))])
        self.user = ca.Function("user", [self.l], [ca.densify(basic.multipliers)])
        self.r_k = ca.Function("r_k", [self.t, self.x_k], [ca.densify(r_k)]) if gamma < 1 else None
        self.everywhere = at.constant and at.affine
        self._set_scales()

    def _set_scales(self) -> None:
        """How far x and l may go, for samples."""
        at, n = self.at, self.n
        low, up = at.lower[1 : n + 1], at.upper[1 : n + 1]
        self.low, self.up, self.span = low, up, np.where(up > low, up - low, 1.0)
        value, J = self.residual_and_jacobian(
            (low + up) / 2, np.clip(np.zeros(self.m), self.lower, self.upper), at.lower[0], (low + up) / 2
        )
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

    def residual_and_jacobian(self, x: np.ndarray, l: np.ndarray, t: float, x_k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(E, y), and its Jacobian in (x, l)."""
        both = self.values(x, l, t, x_k, self.h).full()
        return both[:, 0], both[:, 1:]

    def system(
        self, mode: StepMode, u: np.ndarray, value: np.ndarray, J: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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

    def expressions(self, mode: StepMode) -> tuple[ca.SX, ca.SX]:
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

    def start(self, mode: StepMode, rng: np.random.Generator) -> np.ndarray:
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


def _mode_blocks(law: Law) -> Iterator[ModeBlock]:
    """Each row of a box, each curved set."""
    for rows, block in law.parts():
        own = tuple(range(rows.start, rows.stop))
        K = block.curved()
        yield from ((None, (i,)) for i in own) if K is None else [(K, own)]


def _block_modes(block: ModeBlock, lower: np.ndarray, upper: np.ndarray) -> list[str]:
    K, (i, *_) = block
    if K is not None:
        return ["vertex", "inside", "touched"] if K.is_cone else ["inside", "touched"]
    if lower[i] == upper[i]:
        return ["lower"]
    return ["free", *(["lower"] if np.isfinite(lower[i]) else []), *(["upper"] if np.isfinite(upper[i]) else [])]
