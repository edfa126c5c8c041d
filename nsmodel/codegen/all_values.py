"""The scene of all values of a model's parameters: nothing of its code is read off some of them.

What is a number in the code and may depend on parameters, sizes and which ends of a law are finite, is read at values that the
law accepts, whatever the model declares: those of a declaration may be the ones at which a law has no width or a term vanishes.
"""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from nsmodel.codegen.scene import INCLUSION, StepSpec, make_step_spec
from nsmodel.errors import CodegenError, NsmodelError
from nsmodel.grid import TimeGrid
from nsmodel.hypotheses.quick import admitted, check_start
from nsmodel.model.base import Model
from nsmodel.scheme import one_step_problem
from nsmodel.solve.choose import is_sparse_step_faster

DRAWS = 2000  # Values that are tried at a time, of any sign and size.
MAX_CANDIDATES = 3  # Of those that seem right at a time, models that are made.


def spec_for_all_values(model: Model, grid: TimeGrid, tolerance: float) -> StepSpec:
    """The scene of a model whose parameters are all symbols.

    Raises:
        CodegenError: there are none; blocks; numbers of the code that would depend on them; no values that the law accepts.
    """
    if not model.p.numel():
        raise CodegenError("the model has no parameters: declare the numbers that change, parameters={a: 1.0}")
    if getattr(model, "blocks", ()):
        raise CodegenError("a model with blocks has no C for all values of its parameters")
    problem = one_step_problem(model)
    given = problem.prediction
    if given is not None and given.tolerances is not None and ca.depends_on(ca.vertcat(given.c, model.start), model.p):
        raise CodegenError("the tolerances of projections rest on a point inside of the set, which parameters move")
    spec = make_step_spec(model, None, grid, tolerance, numbers=bind_accepted_values(model))
    if is_sparse_step_faster(spec.structure, spec.law):
        raise CodegenError(
            f"{spec.structure.n + spec.structure.m} unknowns and multipliers of a sparse, constant matrix: C keeps it sparse "
            "where it is of numbers, for one value of the parameters"
        )
    if spec.path == INCLUSION and callable(getattr(given, "tolerances", None)) and grid.step(grid.N - 1) != grid.h:
        raise CodegenError("the tolerance of projections is a function of the step, and the last step is shorter")
    return spec


def bind_accepted_values(model: Model) -> Model:
    """The model at some values that its law and its start accept, and at which no end of the law meets another.

    Raises:
        CodegenError: none was found.
    """
    error: Exception | None = None
    for values in _candidate_values(model):
        try:
            bound = model.bind(dict(zip(model.parameters, values.tolist(), strict=True)))
            check_start(bound)
            one_step_problem(bound)
        except NsmodelError as refused:
            error = refused
            continue
        return bound
    why = f": {error}" if error is not None else ""
    raise CodegenError(f"no values of the parameters {', '.join(model.parameters)} were found that the model accepts{why}")


def _candidate_values(model: Model) -> Iterator[np.ndarray]:
    """Values (np,) that what can be told of all at once lets pass, at last those declared."""
    law = one_step_problem(model).law
    lower, upper = ca.densify(law.lower), ca.densify(law.upper)
    own = [i for i in range(law.size) if ca.depends_on(ca.vertcat(lower[i], upper[i]), model.p)]
    conditions = ca.vertcat(admitted(model), (upper - lower)[own])
    f = ca.Function("asked", [model.p], [conditions, (upper - lower)[own]])

    def violation_count(draws: np.ndarray) -> np.ndarray:
        """How many rows each of these values violates (K,)."""
        rows, widths = (np.array(part).T.reshape(len(draws), -1) for part in f(draws.T))
        return (~(rows >= 0)).sum(axis=1) + (~(widths > 0)).sum(axis=1)

    rng = np.random.default_rng(0)
    draws = _draws(rng, DRAWS, model.p.numel())
    for _ in range(1 + model.p.numel()):
        violated = violation_count(draws)
        yield from draws[np.flatnonzero(violated == 0)[:MAX_CANDIDATES]]
        best = np.tile(draws[np.argmin(violated)], (DRAWS, 1))  # go on from there, with another value of one parameter
        at = np.arange(DRAWS), rng.integers(0, model.p.numel(), DRAWS)
        best[at] = _draws(rng, DRAWS, 1)[:, 0]
        draws = best
    declared = list(model.parameters.values())
    if None not in declared:
        yield np.array(declared, float)


def _draws(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """Positive numbers about 1, then numbers of any sign and size (rows, columns)."""
    near = rng.uniform(0.5, 1.5, (rows // 4, columns))
    shape = rows - len(near), columns
    return np.vstack([near, rng.normal(size=shape) * 10.0 ** rng.integers(-3, 4, shape)])
