"""What is generated for a model: its one-step problem, what of it is a number, and which way the step is computed.

The scene of all values of a model's parameters: nothing of its code is read off some of them.

What is a number in the code and may depend on parameters, sizes and which ends of a law are finite, is read at values that the
law accepts, whatever the model declares: those of a declaration may be the ones at which a law has no width or a term vanishes.

Where a problem rests on the sign of a parameter (`OneStepProblem.assumed`) other values are left to code of their own. The
reaction of a start is found in C, by a step of length 0, whose law is that at t+; after a jump of an input likewise. `simulate`
takes the library of all values for runs over a grid of a model that declares parameters, unless code of the numbers pays
(`plan.is_fixed_code_faster`: 2 to 3 times faster a step, one build a value): that follows from the model and the number of
steps, never from what the cache holds; under "auto" the cache decides only whether a run is interpreted. The choice is a
setting of the run, and a resumed one keeps it. Libraries go with their models, or when 32 others have been used since.

Who sets which entries of a model's inputs in a library: the caller, blocks, or the duty in force of a PWM. Due ticks are a
function of the time of the state (no counter, so that `set_time` may go anywhere), computed into the inputs of the step that
begins there; `x` holds all that blocks keep, and a step that fails gives it back.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.codegen import constant_steps
from nsmodel.errors import CodegenError, NsmodelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.parameters import Values
from nsmodel.modeling.signals.pwm import HeldSignal, Pwm
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.modeling.variants import parametric_inputs
from nsmodel.solvers.catching_up import tolerance_function
from nsmodel.solvers.initial_checks import admitted, check_start
from nsmodel.solvers.newton import uses_working_set
from nsmodel.solvers.one_step_problem import OneStepProblem, one_step_problem
from nsmodel.solvers.plan import is_sparse_step_faster
from nsmodel.solvers.residuals import NumericLaw, numeric_law
from nsmodel.solvers.sparse import MAX_BANDWIDTH, FactoredJacobian, step_jacobian_function
from nsmodel.solvers.structure import MAX_DENSE_UNKNOWNS, MAX_STEP_SIZES, StepStructure, read_step_structure


class Pulse(NamedTuple):
    """A PWM whose duty is held: its entry, that of the duty in force, the signal."""

    at: int
    duty: int
    signal: Pwm


@dataclass(frozen=True)
class InputRoles:
    """Entries of the inputs.

    Attributes:
        given: by the caller.
        memory, held: of blocks; held: outputs, then duties in force. They stand behind all others.
        pulses: that the library makes.
    """

    given: tuple[int, ...]
    memory: tuple[int, ...] = ()
    held: tuple[int, ...] = ()
    pulses: tuple[Pulse, ...] = ()

    def names(self, model: Any) -> dict[str, list[str]]:
        """What stands where, by the names of the arrays in C."""
        arrays = {"u": self.given, "z": self.memory, "w": self.held}
        return {name: [model.input_names[i] for i in at] for name, at in arrays.items()}


def input_roles_of(model: Any) -> InputRoles:
    """Those of a model with blocks."""
    first, at = 0, dict[str, int]()
    for name, names in model.input_groups.items():
        at[name], first = first, first + len(names)
    pulses = tuple(
        Pulse(at[name], at[signal.duty.name], signal)
        for name, signal in model.inputs.items()
        if isinstance(signal, Pwm) and isinstance(signal.duty, HeldSignal)
    )
    memory = _concatenate(block.at[: block.memory] for block in model.blocks)
    held = _concatenate(block.at[block.memory :] for block in model.blocks)
    others = {*memory, *held, *(pulse.at for pulse in pulses)}
    return InputRoles(tuple(i for i in range(first) if i not in others), memory, held, pulses)


def _concatenate(parts: Any) -> tuple[int, ...]:
    return tuple(i for part in parts for i in part)


FIXED, BANDED, NEWTON, INCLUSION = "FIXED", "BANDED", "NEWTON", "INCLUSION"


@dataclass(frozen=True, eq=False)
class StepSpec:
    """A model of which code is written.

    Attributes:
        model: parameters that stay parameters of the code are symbols, all others numbers.
        numbers: the same model with numbers for all parameters.
        h: the time step; any_step: whether others may be used; lengths: those that are known to be.
        tolerance: largest accepted residual.
        allowed: eps_k of an inclusion's approximate projections: of each step, or one for all.
        worst_case: whether steps may solve no linear system: what they need of them is formed beforehand.
        ticking: whether the code has the model's blocks; else what they hold is given to it.
        of_all: whether it is of all values of the parameters: ``numbers`` are some that the law accepts, and nothing is theirs.
    """

    model: Model
    numbers: Model
    h: float
    any_step: bool
    tolerance: float
    lengths: tuple[float, ...] = ()
    allowed: tuple[float, ...] = ()
    worst_case: bool = False
    ticking: bool = False
    for_all_values: bool = False

    @cached_property
    def problem(self) -> OneStepProblem:
        """The one-step problem, symbolic in the parameters left."""
        return one_step_problem(self.model)

    @cached_property
    def structure(self) -> StepStructure:
        """What the expressions say, whatever the parameters."""
        return read_step_structure(self.problem)

    @cached_property
    def jacobians(self) -> tuple[ca.SX, ...]:
        """E_z, E_l, Y_z, Y_l, without entries that are 0."""
        return tuple(ca.sparsify(J) for J in self.problem.jacobians)

    @cached_property
    def law(self) -> NumericLaw:
        """The law at the default parameters."""
        return numeric_law(self.numeric_problem.law)

    @cached_property
    def numeric_problem(self) -> OneStepProblem:
        """The one-step problem at the default parameters."""
        return self.problem if self.model is self.numbers else one_step_problem(self.numbers)

    @cached_property
    def places(self) -> InputRoles:
        """Who sets which inputs."""
        return input_roles_of(self.model) if self.ticking else InputRoles(tuple(range(self.problem.inputs)))

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters left, with their default values."""
        return {name: self.numbers.bound_parameters[name] for name in self.model.parameters} if self.model.p.numel() else {}

    @cached_property
    def matrices(self) -> constant_steps.StepMatrices | None:
        """The matrices at h where they depend on the step alone, and are few enough to be written down or kept."""
        if not self._is_numeric or is_sparse_step_faster(self.structure, self.law):
            return None
        found = [self._regular_matrices(h) for h in (self.h, *self.lengths)]
        M = found[0]
        few = (
            M.kept <= constant_steps.MAX_STORED_NUMBERS
            if self.has_several_lengths
            else M.numbers <= constant_steps.MAX_WRITTEN_NUMBERS
        )
        return M if few else None

    def _regular_matrices(self, h: float) -> constant_steps.StepMatrices:
        found = constant_steps.step_matrices(self.problem, h)
        if found is None:
            raise _singular_error(h)
        return found

    @property
    def known_lengths(self) -> tuple[float, ...]:
        """The lengths of steps that are known beforehand, h first."""
        return (self.h, *self.lengths, *([0.0] if self.finds_restart_reaction else []))

    @property
    def has_several_lengths(self) -> bool:
        """Whether steps have several lengths: any, or 0, by which the reaction after a jump of an input is found."""
        return self.any_step or self.finds_restart_reaction

    @property
    def finds_restart_reaction(self) -> bool:
        """Whether the reaction that a step starts from is found anew after a jump of an input."""
        return self.problem.inputs > 0 and self.problem.start is not None

    @property
    def finds_start_reaction(self) -> bool:
        """Whether the code finds the reaction that a run starts from."""
        return self.for_all_values and self.problem.start is not None

    @cached_property
    def band(self) -> FactoredJacobian | None:
        """[E_z E_l; Y_z Y_l] of a large, sparse step in the order and scales of its band, where it is of numbers."""
        if self.has_several_lengths or not self._is_numeric or not is_sparse_step_faster(self.structure, self.law):
            return None
        try:
            found = FactoredJacobian(step_jacobian_function(self.problem)(self.h), self.structure.n)
        except np.linalg.LinAlgError:
            raise _singular_error(self.h) from None
        if not found.order.is_band:
            width = max(found.order.below, found.order.above)
            raise CodegenError(f"sparse LU has no counterpart in C: the step's band is {width} wide, more than {MAX_BANDWIDTH}")
        return found

    @property
    def _is_numeric(self) -> bool:
        return self.structure.constant and not self.model.p.numel()

    @cached_property
    def path(self) -> str:
        """How the step is computed.

        Raises:
            CodegenError: it is too large for what C has.
        """
        if self.problem.prediction is not None:
            if self.problem.inputs:
                raise CodegenError("catching-up has no inputs in C: take scheme='implicit', or interpreted steps")
            return INCLUSION
        if self.band is not None:
            return BANDED
        size = self.structure.n + self.structure.m
        if size > MAX_DENSE_UNKNOWNS:
            raise CodegenError(
                f"{size} unknowns and multipliers are more than {MAX_DENSE_UNKNOWNS}: C keeps them sparse only with constant "
                "matrices, one time step and no parameters left to set"
            )
        return NEWTON if self.matrices is None else FIXED

    @cached_property
    def law_of_parameters(self) -> bool:
        """Whether numbers of the law depend on parameters of the code."""
        numbers = self.problem.law.numbers
        return bool(numbers.numel() and self.model.p.numel() and ca.depends_on(numbers, self.model.p))

    @cached_property
    def uses_working_set(self) -> bool:
        """Whether only the rows that act enter a step's affine problem; not where y depends on l directly."""
        if self.path != NEWTON or self.law_of_parameters or self.jacobians[3].nnz():
            return False
        return uses_working_set(self.structure, self.law)


def make_step_spec(
    model: Model, parameters: Values | None, grid: TimeGrid, tolerance: float, lengths: Collection[float] = (),
    numbers: Model | None = None,
) -> StepSpec:  # fmt: skip
    """Return the scene of a model; ``parameters`` become numbers, the others stay parameters of the code.

    ``lengths``: of steps that are known beforehand; left out: those of the grid, where they are few. ``numbers``: the model at
    some values, of a scene of all of them; left out: at those declared.
    """
    given, of_all = model.values_of(parameters), numbers is not None
    if reason := moving_signals_reason(model, given):
        raise CodegenError(reason)
    numbers = model.bind(given) if numbers is None else numbers
    left = dict.fromkeys(name for name in model.parameters if name not in given)
    kept = model.bind({**given, **left}, partly=True) if left else numbers
    own = grid.lengths.tolist() if grid.lengths.size <= MAX_STEP_SIZES else ()
    h = next(iter(lengths), 0.0) if len(lengths) > 1 else grid.step(0)
    known = tuple(length for length in lengths or own if length != h)
    return StepSpec(
        kept, numbers, h, grid.has_varying_steps, tolerance, known, projection_tolerances(numbers, grid), for_all_values=of_all
    )


def moving_signals_reason(model: Model, given: Collection[str] = ()) -> str:
    """Why there is no code of a model whose signals move with parameters that are not ``given``; "" where none does."""
    for name, parameters in parametric_inputs(model).items():
        if free := [one for one in parameters if one not in given]:
            values = ", ".join(f"'{one}': ..." for one in free)
            return (
                f"the signal of input '{name}' moves with {', '.join(free)}, and code has no signals: "
                f"give {'its value' if len(free) == 1 else 'their values'}, parameters={{{values}}} (--set {free[0]}=VALUE)"
            )
    return ""


def _singular_error(h: float) -> CodegenError:
    return CodegenError(f"the step's matrix is singular at h = {h:g}: change the step, or check M, A and K")


def projection_tolerances(model: Model, grid: TimeGrid) -> tuple[float, ...]:
    """eps_k of each step, or one for all; nothing where projections are exact."""
    prediction = one_step_problem(model).prediction
    if prediction is None or prediction.tolerances is None:
        return ()
    eps = tolerance_function(prediction.tolerances)
    count = (1 if grid.steps is None else grid.N) if callable(prediction.tolerances) else np.size(prediction.tolerances)
    values = tuple(eps(k, grid.step(min(k, grid.N - 1))) for k in range(count))
    return values[:1] if len(set(values)) == 1 else values


DRAWS = 2000  # Values that are tried at a time, of any sign and size: one call of a vector function.
# Of the values that seem right at a time, models that are made: some conditions only show on a model, which is then refused.
MAX_CANDIDATES = 3


def spec_for_all_values(model: Model, grid: TimeGrid, tolerance: float) -> StepSpec:
    """The scene of a model whose parameters are all symbols.

    Raises:
        CodegenError: there are none; blocks; numbers of the code that would depend on them; no values that the law accepts.
    """
    if not model.p.numel():
        raise CodegenError("the model has no parameters: declare the numbers that change, parameters={a: 1.0}")
    if getattr(model, "blocks", ()):
        raise CodegenError("a model with blocks has no C for all values of its parameters")
    if reason := moving_signals_reason(model):
        raise CodegenError(reason)
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
