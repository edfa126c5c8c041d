"""The theta-gamma scheme written down once more, for the judges of the classes that use it."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.run.driven import reinitialised_step_mask
from nsmodel.stress.measures import (
    EQUATION_TOLERANCE,
    EVALUATION_ROUNDING,
    StepMagnitudes,
    apply_matrices,
    evaluate_at_rows,
    majorant,
    moving_bound_sizes,
    rounding_allowance,
    run_inputs,
    step_begins,
    step_ends,
    worst_ratio,
)
from nsmodel.trajectory import Trajectory


def theta_gamma_residual(
    model: Any, run: Trajectory, symbol: ca.SX, rate: ca.SX, input: ca.SX, M: np.ndarray, l: np.ndarray
) -> tuple[float, StepMagnitudes]:
    """The misfit of M (x+ - x) = h (th f+ + (1-th) f) + h (ga r+ + (1-ga) r), and the sizes of what made the states.

    f is ``rate`` and r is ``input``, with the multipliers l in place of ``symbol``.
    """
    l, h, x, new = np.nan_to_num(l), run.step[1:, None], run.x[:-1], run.x[1:]
    symbols, rates = [model.t, model.x, model.u], [rate, ca.jacobian(rate, model.x), majorant(rate)]
    (f, slope, size_f), (f_end, slope_end, size_end) = (
        evaluate_at_rows(symbols, rates, *rows) for rows in (step_begins(run), step_ends(run))
    )
    input_expressions, rows = [input, ca.jacobian(input, symbol), majorant(input)], (run.t, run.x, run_inputs(run), l)
    r, push, size_r = evaluate_at_rows([*symbols, symbol], input_expressions, *rows)
    f, f_end, r = f[:, :, 0], f_end[:, :, 0], r[:, :, 0]

    def weighed(begin: np.ndarray, end: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        th, ga = model.theta, model.gamma
        return h * (th * end + (1 - th) * begin + ga * inputs[1:] + (1 - ga) * inputs[:-1])

    misfit = np.abs((new - x) @ M.T - weighed(f, f_end, r))
    size = np.abs(new - x) @ np.abs(M).T + weighed(np.abs(f), np.abs(f_end), np.abs(r) + apply_matrices(np.abs(push), np.abs(l)))
    response = np.abs(np.linalg.pinv(np.nan_to_num(M - h[:, :, None] * model.theta * slope_end)))
    size_r = (
        size_r + np.abs(push) @ moving_bound_sizes(model, run)[:, :, None]
    )  # An l between ends that move is known beside these.
    place = np.abs(x) + np.abs(new) + size @ np.abs(np.linalg.pinv(M)).T
    seen = place @ np.abs(M).T + h * (apply_matrices(np.abs(slope_end), place) + apply_matrices(np.abs(slope), place))
    allowed = (
        EQUATION_TOLERANCE * size
        + EVALUATION_ROUNDING * seen
        + weighed(rounding_allowance(size_f), rounding_allowance(size_end), rounding_allowance(size_r))
    )
    known = ~_reinitialised_steps(model, run) if model.gamma < 1 else np.ones(len(h), bool)
    return worst_ratio(misfit[known], allowed[known]), StepMagnitudes(apply_matrices(response, size), EVALUATION_ROUNDING * place)


def _reinitialised_steps(model: Any, run: Trajectory) -> np.ndarray:
    """The steps (N,) whose r_k is no row of the run: the first, and those that begin with a jump of an input."""
    found = reinitialised_step_mask(model, run) if model.u.numel() else np.zeros(len(run.t) - 1, bool)
    found[0] = True
    return found
