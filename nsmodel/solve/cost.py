"""What interpreted steps and compilers take, and when compiling pays: seconds as functions of the structure, never of a clock.

A run is compiled where building, or loading what was built before, takes less than its interpreted steps; compiled ones take
1 % to 5 % of these. The numbers were fitted to the CPU time of generating, compiling and stepping the cases, chains of 8 to 300
masses with friction, and random Lur'e systems of up to 25 states and 20 rows, with GCC on a busy machine, and brought to an idle
one by known times (a relay's step 4 us, a step by Newton's method 0.35 ms, building a relay 0.4 s). How many iterations a step
takes is not known beforehand: index sets changed at one step in ten.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca

from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.structure import StepStructure

REPEATED_PATH = "repeated"  # The path "newton" where most steps are those of `repeated`.
LOADING_SECONDS = 0.05  # Seconds for finding a library that was built before, its hash, and loading it.


class CompilationCost(NamedTuple):
    """Seconds of one interpreted step, and of building the compiled one: 0 where it is there."""

    step: float
    building: Callable[[], float]

    def pays(self, steps: int) -> bool:
        """Whether compiling takes less time than so many steps."""
        saved = steps * self.step - LOADING_SECONDS
        return saved > 0 and saved > self.building()

    def text(self, steps: int, what: str = "steps") -> str:
        """Why it does not, as a line of what is left out."""
        return f"{what} in C: {steps:,} interpreted {what} take about {steps * self.step:.2g} s, building them would take longer"


def interpreted_step_seconds(path: str, structure: StepStructure | None) -> float:
    """Seconds of a step on a path of `choose.Plan`, or REPEATED; None: the structure of a projection on given sets."""
    if structure is None:
        return 2.5e-4
    if path == "kernel":
        return 4.5e-6 + 2.5e-7 * structure.m**2
    size = structure.n + structure.m
    if path == REPEATED_PATH:
        return 3e-5 + 1e-6 * size**2
    return 1.3e-4 + 2.8e-7 * size if path == "sparse" else 3.2e-4 + 4.4e-6 * size


def build_seconds(path: str, structure: StepStructure | None, problem: OneStepProblem) -> float:
    """Seconds for building the steps of a path: C for its graph, tables for its matrices."""
    if structure is None:
        return 1.6
    size = structure.n + structure.m
    if path == "sparse":
        return 1.0 + 1.0e-3 * size
    graph = ca.densify(ca.vertcat(problem.E, problem.Y))
    nodes = ca.Function("step", [ca.vertcat(*ca.symvar(graph))], [graph]).n_instructions()
    return 0.45 + 1.0e-3 * size**2 + 8.5e-4 * nodes if path == "kernel" else 1.2 + 8e-4 * nodes


def is_fixed_code_faster(path: str, structure: StepStructure | None, problem: OneStepProblem, steps: int) -> bool:
    """Whether so many steps pay for code of the values at hand alone, where there may be one library for all of them.

    That has the matrices of "kernel" as numbers: by what a step of it is faster was fitted to 1 + 1 to 25 + 20 unknowns and
    multipliers, C against C. Other paths have the same code either way, but for large sparse matrices, which must be numbers.
    """
    if path != "kernel" or structure is None:
        return path == "sparse"
    size = structure.n + structure.m
    return steps * (2e-8 + 5e-9 * size + 1.7e-9 * size**2) > build_seconds(path, structure, problem)


def bodies_cost(count: int, solver: Callable[[], bool], own: Callable[[], bool]) -> CompilationCost:
    """The cost of many bodies; whether the solver, which all models share, and the model's own functions are built."""
    return CompilationCost(1.4e-3 + 5e-6 * count, lambda: 4.5 * (not solver()) + 0.15 * (not own()))


def pieces_cost(size: int, rows: int, built: Callable[[], bool]) -> CompilationCost:
    """The cost of event-driven pieces: ``size`` states and rows, operations of f, g and h besides; whether they are built."""
    return CompilationCost(1e-3 + 1e-4 * size + 2e-5 * rows, lambda: 0.0 if built() else 1.0 + 2e-4 * rows + 2e-3 * size)
