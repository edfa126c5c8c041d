"""One row of a trajectory as one vector: [state | l | y | residual | newton | multipliers | outputs | records].

The state ends with the inputs that the step was given: "inputs_begin", u at its begin, and "inputs", at its end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import casadi as ca

from nsmodel.scheme.problem import OneStepProblem


@dataclass(frozen=True)
class RowLayout:
    """Where each quantity of a step stands in its packed row."""

    slices: dict[str, slice]
    width: int
    state: slice
    l: slice
    y: slice
    residual: int
    newton: int
    inputs: slice  # Of the state: those of the step at its begin, then at its end.

    @classmethod
    def of(cls, problem: OneStepProblem, **records: int) -> Self:
        """Lay out a problem's row; ``records`` (name: size) come after the problem's own."""
        m = problem.l.numel()
        sizes = {"state": problem.state.numel(), "l": m, "y": m, "residual": 1, "newton": 1}
        sizes |= {name: e.numel() for name, e in extra_columns(problem).items()} | records
        slices, at = {}, 0
        for name, size in sizes.items():
            slices[name] = slice(at, at + size)
            at += size
        end, nu = slices["state"].stop, problem.inputs
        if nu:
            slices |= {"inputs_begin": slice(end - 2 * nu, end - nu), "inputs": slice(end - nu, end)}
        return cls(
            slices, at, slices["state"], slices["l"], slices["y"], slices["residual"].start, slices["newton"].start,
            slice(end - 2 * nu, end),
        )  # fmt: skip


def extra_columns(problem: OneStepProblem) -> dict[str, ca.SX]:
    """The user's multipliers and outputs where they differ from l and y, and the records."""
    out = {} if problem.multipliers is None else {"multipliers": problem.multipliers}
    out |= {} if problem.outputs is None else {"outputs": problem.outputs}
    return out | problem.records
