"""What is generated for a model: its one-step problem, what of it is a number, and which way the step is computed."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from nsmodel.codegen import banded, fixed
from nsmodel.codegen.places import InputRoles, input_roles_of
from nsmodel.errors import CodegenError
from nsmodel.grid import TimeGrid
from nsmodel.model.base import Model
from nsmodel.model.parameters import Values
from nsmodel.scheme import one_step_problem
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.band import MAX_BANDWIDTH
from nsmodel.solve.certificate import NumericLaw, numeric_law
from nsmodel.solve.choose import is_sparse_step_faster
from nsmodel.solve.newton import uses_working_set
from nsmodel.solve.projection import tolerance_function
from nsmodel.solve.structure import MAX_DENSE_UNKNOWNS, StepStructure, read_step_structure

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
    def matrices(self) -> fixed.StepMatrices | None:
        """The matrices at h where they depend on the step alone, and are few enough to be written down or kept."""
        if not self._is_numeric or is_sparse_step_faster(self.structure, self.law):
            return None
        found = [self._regular_matrices(h) for h in (self.h, *self.lengths)]
        M = found[0]
        few = M.kept <= fixed.MAX_STORED_NUMBERS if self.has_several_lengths else M.numbers <= fixed.MAX_WRITTEN_NUMBERS
        return M if few else None

    def _regular_matrices(self, h: float) -> fixed.StepMatrices:
        found = fixed.step_matrices(self.problem, h)
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
    def band(self) -> banded.BandedMatrices | None:
        """The matrices of a large, sparse step where they are numbers."""
        if self.has_several_lengths or not self._is_numeric or not is_sparse_step_faster(self.structure, self.law):
            return None
        found = banded.banded_matrices(self.problem, self.h, self.structure.n)
        if found is None:
            raise _singular_error(self.h)
        order = found.at.order
        if not order.is_band:
            width = max(order.below, order.above)
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
        """Whether only the rows that act enter a step's affine problem."""
        return self.path == NEWTON and uses_working_set(self.structure, self.law) and not self.law_of_parameters


def make_step_spec(
    model: Model, parameters: Values | None, grid: TimeGrid, tolerance: float, lengths: Collection[float] = (),
    numbers: Model | None = None,
) -> StepSpec:  # fmt: skip
    """Return the scene of a model; ``parameters`` become numbers, the others stay parameters of the code.

    ``lengths``: of steps that are known beforehand; left out: those of the grid, where they are few. ``numbers``: the model at
    some values, of a scene of all of them; left out: at those declared.
    """
    given, of_all = model.values_of(parameters), numbers is not None
    numbers = model.bind(given) if numbers is None else numbers
    left = dict.fromkeys(name for name in model.parameters if name not in given)
    kept = model.bind({**given, **left}, partly=True) if left else numbers
    own = grid.lengths.tolist() if grid.lengths.size <= fixed.MAX_LENGTHS else ()
    h = next(iter(lengths), 0.0) if len(lengths) > 1 else grid.step(0)
    known = tuple(length for length in lengths or own if length != h)
    return StepSpec(
        kept, numbers, h, grid.has_varying_steps, tolerance, known, projection_tolerances(numbers, grid), for_all_values=of_all
    )


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
