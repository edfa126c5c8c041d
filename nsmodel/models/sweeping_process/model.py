"""Sweeping processes by moving sets that are intersections of complements of convex sets (Bernicot-Venel 2010)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.parameters import describe_argument


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class SweepingProcess(Model):
    """q'(t) + N(Q(t), q(t)) ∋ f(t, q(t)), Q(t) = {q : g_i(t, q) >= 0 for all i}, q(0) = q0 in Q(0).

    Attributes:
        q: the state symbols (n).
        f: the velocity without constraints, n expressions of t and q; left out: 0.
        constraints: {name: g(t, q)}, each a scalar or a column of expressions kept >= 0, convex in q.
        q0: the start (n numbers).
        mean_forcing: use the mean of f(., q_k) over the step instead of f(t_k, q_k) (Remark 3.2).
        scene: for discs in the plane, q = (x_1, y_1, x_2, y_2, ...): {"radii": (N,), "walls": (W, 2, 2)}, for pictures only.

    Raises:
        ModelError: wrong shapes, undeclared symbols, NaN.
    """

    q: Any
    f: Any = None
    constraints: Any = None
    q0: Any
    mean_forcing: bool = False
    scene: Mapping[str, Any] | None = None

    multiplier_names: tuple[str, ...] = field(init=False, repr=False)

    paper: ClassVar[str] = "Bernicot and Venel, Convergence order of a numerical scheme for sweeping process (2010)"
    letter: ClassVar[str] = "q"
    schemes: ClassVar[tuple[str, ...]] = ("prediction-correction",)
    gaps: ClassVar[bool] = True

    def _declare(self) -> None:
        c = self._declare_symbols("q", q=self.q)
        n = len(self.names)
        if not isinstance(self.mean_forcing, bool):
            raise ModelError(f"mean_forcing = {self.mean_forcing!r}; expected True or False")
        constraints, names = self._named_constraints(c, self.constraints, [self.t, self.q])
        self._set(
            f=self._read_vector(c, 0 if self.f is None else self.f, "f", n, [self.t, self.q]),
            constraints=constraints,
            multiplier_names=tuple(names),
            q0=self._read_start(c, self.q0, "q0", n),
            scene=None if self.scene is None else _checked_scene(self.scene, n),
        )

    @property
    def row_names(self) -> tuple[str, ...]:
        """Those of the multipliers and of the constraints."""
        return (*self.multiplier_names, *self.constraints)

    @property
    def g(self) -> ca.SX:
        """All constraints as one column (p, 1)."""
        return ca.vertcat(ca.SX(0, 1), *self.constraints.values())


def _checked_scene(scene: Any, n: int) -> dict[str, np.ndarray]:
    if not isinstance(scene, Mapping) or not set(scene) <= {"radii", "walls"}:
        raise ModelError(f"scene: {describe_argument(scene)}; expected a dictionary {{'radii': [...], 'walls': [...]}}")
    try:
        radii = np.asarray(scene.get("radii", []), float).ravel()
        walls = np.asarray(scene.get("walls", np.zeros((0, 2, 2))), float)
    except (TypeError, ValueError):
        raise ModelError("scene: radii and walls must be numbers, walls of shape (W, 2, 2)") from None
    if not ((radii > 0).all() and np.isfinite(radii).all() and np.isfinite(walls).all()):
        raise ModelError("scene: radii must be finite numbers > 0, walls finite numbers")
    if 2 * radii.size != n:
        raise ModelError(f"scene: {radii.size} radii for {n} states; expected one radius for each pair (x_i, y_i)")
    if walls.ndim != 3 or walls.shape[1:] != (2, 2):
        raise ModelError(f"scene: walls has shape {walls.shape}; expected (W, 2, 2), two end points for each wall")
    return {"radii": radii, "walls": walls}
