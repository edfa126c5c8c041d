"""The theta-gamma scheme written down once more, for the judges of the classes that use it."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.stress.measures import EQUATION, ROUNDING, Sizes, apply, evaluated, known_to, majorant, worst_of
from nsmodel.trajectory import Trajectory


def theta_misfit(
    model: Any, run: Trajectory, symbol: ca.SX, rate: ca.SX, input: ca.SX, M: np.ndarray, l: np.ndarray
) -> tuple[float, Sizes]:
    """The misfit of M (x+ - x) = h (th f+ + (1-th) f) + h (ga r+ + (1-ga) r), and the sizes of what made the states.

    f is ``rate`` and r is ``input``, with the multipliers l in place of ``symbol``.
    """
    l, h, x, new = np.nan_to_num(l), run.step[1:, None], run.x[:-1], run.x[1:]
    asked = [rate, input, ca.jacobian(rate, model.x), ca.jacobian(input, symbol), majorant(rate), majorant(input)]
    f, r, slope, push, size_f, size_r = evaluated([model.t, model.x, symbol], asked, run.t, run.x, l)
    f, r, pushes = f[:, :, 0], r[:, :, 0], np.abs(r[:, :, 0]) + apply(np.abs(push), np.abs(l))

    def weighed(rates: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        th, ga = model.theta, model.gamma
        return h * (th * rates[1:] + (1 - th) * rates[:-1] + ga * inputs[1:] + (1 - ga) * inputs[:-1])

    first = 1 if model.gamma < 1 else 0  # r_0 is not a row of the run
    misfit = np.abs((new - x) @ M.T - weighed(f, r))
    size = np.abs(new - x) @ np.abs(M).T + weighed(np.abs(f), pushes)
    response = np.abs(np.linalg.pinv(np.nan_to_num(M - h[:, :, None] * model.theta * slope[1:])))
    place = np.abs(x) + np.abs(new) + size @ np.abs(np.linalg.pinv(M)).T
    seen = place @ np.abs(M).T + h * (apply(np.abs(slope[1:]), place) + apply(np.abs(slope[:-1]), place))
    allowed = EQUATION * size + ROUNDING * seen + weighed(known_to(size_f), known_to(size_r))
    return worst_of(misfit[first:], allowed[first:]), Sizes(apply(response, size), ROUNDING * place)
