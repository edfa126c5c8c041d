"""The modes of a step, for any law: square systems in u = (x, l, s) with strict inequalities.

A mode says which rows are at which bound, which balls and cones are touched; s are the normal forces of what is touched.
"""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from nsmodel.classes.first_order.hypotheses.linearised import SystemLinearisation
from nsmodel.modeling.laws import CurvedSet, Law
from nsmodel.solvers.one_step_problem import rewrite_as_basic_law
from nsmodel.solvers.residuals import numeric_law

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
        self.x, self.user_l = x, basic.multipliers
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
