"""A run judged in NumPy, one step after the other, by the paper's formulas and the model's own expressions.

Nothing here comes from the solvers or their certificate: the expressions of the *model* are evaluated at the rows of the run,
and the scheme is written down once more. Each judge returns {what: largest misfit beside what is allowed}, <= 1 if right.
What is allowed is stated here, before any run: a tolerance times what moves or acts in the step, source terms and single
multipliers included, and ROUNDING times the running error bound of what is evaluated here (`majorant`), its inputs
known to the last digit:

- an equation: EQUATION times its terms, and the rounding of the positions;
- a law -y ∈ N_K(l): LAW times what moves y, what acts on it through the states, and l;
- a projection: the distance to the exact one, bounded by the duality gap <l, y>, at most PROJECTION times the step's motion;
- a minimum: no other velocity among the probes may be better by more than rounding.
"""

from __future__ import annotations

import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.model.base import Model
from nsmodel.stress.measures import StepResiduals
from nsmodel.trajectory import Trajectory


@np.errstate(all="ignore")  # a run that diverges is judged like any other
def formula_residuals(model: Model, run: Trajectory) -> StepResiduals:
    """The misfits of all steps of a run of the bound ``model``; nothing for a run without steps."""
    return class_of(model).part("judge").residuals(model, run) if len(run.t) > 2 else {}


@np.errstate(all="ignore")
def state_term_sizes(model: Model, run: Trajectory) -> np.ndarray:
    """What acts on each state in each step, whether it moves or not (N, n): the terms that make the state, in its own unit."""
    return class_of(model).part("judge").acting(model, run) if len(run.t) > 1 else run.x[1:]
