"""S-start of many bodies: the least gap of those that are there at t = 0, by a search, and the sign of each gap near 0."""

from __future__ import annotations

import numpy as np

from nsmodel.classes.bodies.hypotheses.families import is_folded_exactly, member_constraint
from nsmodel.classes.bodies.hypotheses.near import row_constraint_name, term_sizes, undecided_constraints
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.bodies.schemes.prediction_correction import BodiesProblem, ContactRows
from nsmodel.classes.sweeping.hypotheses.constraint import EVERYWHERE, HypothesisAnswer
from nsmodel.classes.sweeping.hypotheses.start import ROUNDING_DEFICIT, start_sign
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, VIOLATED

MAX_EXACT_SIGNS = 400  # Signs that interval arithmetic leaves open and that are decided in rational numbers, at most.


def start_states(model: ManyBodies) -> np.ndarray:
    """The states (N, d) at t = 0, NaN for who enters later."""
    return np.where((model.enter <= 0)[:, None], model.bodies.q0, np.nan)


def start_answer(problem: BodiesProblem) -> HypothesisAnswer:
    """Return whether the start is admissible: signs by intervals, where they touch in rational arithmetic."""
    q = start_states(problem.model)
    rows, low, high = undecided_constraints(problem, 0.0, q)
    if not len(rows.g):
        return HypothesisAnswer(HOLDS, {"min g": np.inf}, EVERYWHERE, "no constraint")
    k = int(np.argmin(np.nan_to_num(rows.g, nan=-np.inf)))
    value = {"min g": float(rows.g[k])}
    bad = (high < -ROUNDING_DEFICIT * term_sizes(problem, 0.0, q, rows)) | np.isnan(rows.g)
    if bad.any():
        k = int(np.argmin(np.where(bad, np.nan_to_num(rows.g, nan=-np.inf), np.inf)))
        bodies = [int(rows.first[k]), *([int(rows.second[k])] if rows.pair[k] else [])]
        witness = {"constraint": row_constraint_name(problem, rows, k), "g": float(rows.g[k])} | {
            f"body {i}": q[i] for i in bodies
        }
        return HypothesisAnswer(
            VIOLATED, value, EVERYWHERE, f"g_i(0, q_0) < 0, rounding included, of {bad.sum()} constraints", witness
        )
    left = np.flatnonzero(low < 0)
    undecided = left if len(left) > MAX_EXACT_SIGNS else [i for i in left if _exact_start_sign(problem, rows, int(i), q) < 0]
    if len(undecided):
        witness = {"constraint": row_constraint_name(problem, rows, int(undecided[0])), "such constraints": len(undecided)}
        return HypothesisAnswer(SAMPLED, value, EVERYWHERE, "to rounding: the sign of g_i(0, q_0) is lost in it", witness)
    how = f"by a search for neighbours; the sign of each of the {len(rows.g)} nearest was decided with rounding included"
    return HypothesisAnswer(HOLDS, value, EVERYWHERE, how, {"constraint": row_constraint_name(problem, rows, k)})


def _exact_start_sign(problem: BodiesProblem, rows: ContactRows, k: int, q: np.ndarray) -> int:
    """The exact sign of one constraint at the start; -1 where it is not known."""
    i, j, number = int(rows.first[k]), int(rows.second[k]), int(rows.family[k])
    family, state = problem.families[number], np.concatenate([q[i], q[j]]) if rows.pair[k] else q[i]
    constraint, numbers = member_constraint(problem.model, problem.names[number], family, (i, j), folded=False)
    sign = start_sign(constraint, np.concatenate([state, numbers]))
    if sign is None and is_folded_exactly(family, numbers):
        sign = start_sign(member_constraint(problem.model, problem.names[number], family, (i, j), folded=True)[0], state)
    return -1 if sign is None else sign
