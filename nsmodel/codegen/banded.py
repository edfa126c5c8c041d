"""The functions and tables of a large step whose matrices are numbers and sparse (see ``c/banded.c``)."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.codegen.loops import looped_c_function
from nsmodel.codegen.tables import c_table, exact_tables
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.band import FactoredJacobian, step_jacobian
from nsmodel.solve.rounding import rounding_error_bound
from nsmodel.solve.structure import StepStructure


class BandedMatrices(NamedTuple):
    """J = [E_z E_l; Y_z Y_l] at one h, in the order and scales of its band."""

    at: FactoredJacobian

    @property
    def sizes(self) -> dict[str, int]:
        """The constants of the header."""
        order = self.at.order
        upper = order.above + order.below  # of U, with what row interchanges fill in
        return {
            "SIZE": self.at.diagonal.size, "NONZEROS": self.at.J.nnz, "BELOW": order.below, "UPPER": upper,
            "BAND": order.below + upper + 1,
        }  # fmt: skip


def banded_matrices(problem: OneStepProblem, h: float, n: int) -> BandedMatrices | None:
    """Return the matrices at h; None where E_z is singular."""
    try:
        return BandedMatrices(FactoredJacobian(step_jacobian(problem, h), n))
    except np.linalg.LinAlgError:
        return None


def banded_code(problem: OneStepProblem, structure: StepStructure, h: float, M: BandedMatrices) -> str:
    """The C functions and tables."""
    at, n, m = M.at, structure.n, structure.m
    zero_z, zero_l = ca.SX.zeros(n), ca.SX.zeros(m)
    both = ca.vertcat(problem.E, problem.Y)
    constant, guess = ca.substitute([both, problem.guess], [problem.h, problem.z, problem.l], [ca.SX(h), zero_z, zero_l])
    function = looped_c_function(
        "constant_part", {"s->t": problem.t, "s->x": problem.state}, {"constant": constant, "guess": ca.vertcat(guess, zero_l)},
        "E and Y at z = 0, l = 0; the z for which nothing moves",
    )  # fmt: skip
    given = looped_c_function(
        "given_error", {"s->t": problem.t, "s->x": problem.state}, {"error": rounding_error_bound(constant, ca.SX(0, 1))},
        "running error bound of E and Y at z = 0, l = 0, in EPS/2",
    )  # fmt: skip
    tables = [
        c_table("J", at.J.data, "MODEL_NONZEROS", "[E_z E_l; Y_z Y_l] by rows"),
        c_table("J_column", at.J.indices, "MODEL_NONZEROS", kind="int"),
        c_table("J_start", at.J.indptr, "MODEL_SIZE + 1", kind="int"),
        c_table("place", at.order.place, "MODEL_SIZE", "of each unknown and equation in the band", "int"),
        c_table("row_scale", at.rows, "MODEL_SIZE", "powers of 2"),
        c_table("column_scale", at.columns, "MODEL_SIZE"),
        exact_tables(structure, by_rows=True),
    ]
    return "".join(tables) + "\n" + function + "\n" + given
