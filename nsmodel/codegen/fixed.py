"""The functions and tables of a step whose matrices are numbers (see ``c/fixed.c``)."""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.codegen.expression import c_function
from nsmodel.codegen.tables import exact_tables, table
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.active_set import choices
from nsmodel.solve.certificate import NumericLaw, bound_size
from nsmodel.solve.kernel import AtStep, at_step, matrices_at, regular_inverse
from nsmodel.solve.rounding import equilibrated, error_bound
from nsmodel.solve.structure import Structure

MOST_INDEX_SETS = 81  # Up to which every index set may be tried: no pivoting.
MOST_NUMBERS = 6000  # Coefficients written into the code; a larger step forms its matrices when it is prepared.


class Matrices(NamedTuple):
    """Of z = z_0 + Z l, y = W l + b at one h, dense: E_z (n, n), E_l (n, m), Y_z (m, n), Y_l (m, m), E_z^{-1}, Z, W."""

    E_z: np.ndarray
    E_l: np.ndarray
    Y_z: np.ndarray
    Y_l: np.ndarray
    inverse: np.ndarray
    Z: np.ndarray
    W: np.ndarray

    @property
    def numbers(self) -> int:
        """How many coefficients the code holds."""
        return sum(int(np.count_nonzero(M)) for M in self)


def matrices(problem: OneStepProblem, h: float) -> Matrices | None:
    """Return the matrices at h; None where E_z is singular."""
    E_z, E_l, Y_z, Y_l = matrices_at(problem, h)
    try:
        inverse = regular_inverse(E_z)
    except np.linalg.LinAlgError:
        return None
    Z = -inverse @ E_l
    return Matrices(E_z, E_l, Y_z, Y_l, inverse, Z, Y_l + Y_z @ Z)


class _Symbols(NamedTuple):
    """A step at one h, with E_z^{-1} and Z sparse, and arguments of its C functions; ``Y`` and ``l`` are empty without a law."""

    at: AtStep
    inverse: ca.DM
    Z: ca.DM
    z: ca.SX
    l: ca.SX
    known: dict[str, ca.SX]
    E: dict[str, ca.SX]
    Y: dict[str, ca.SX]

    @property
    def solution(self) -> dict[str, ca.SX]:
        """z, and l where there is one."""
        return {"z": self.z} | ({"l": self.l} if self.Y else {})


def text(problem: OneStepProblem, structure: Structure, law: NumericLaw, h: float, M: Matrices) -> str:
    """The C functions and tables."""
    at, n, m = at_step(problem, h, tuple(M[:4])), M.E_z.shape[0], problem.l.numel()
    inverse, Z = (ca.sparsify(ca.DM(A)) for A in (M.inverse, M.Z))
    known = {"s->t": problem.t, "s->x": problem.state}
    E, Y = {"E_0": ca.SX.sym("E_0", n)}, ({"Y_0": ca.SX.sym("Y_0", m)} if m else {})
    step = _Symbols(at, inverse, Z, problem.z, problem.l, known, E, Y)
    functions, units = _functions_of_unknowns(step), _unit_tables(M)
    if not m:
        return units + "\n" + "\n".join(functions)
    functions += _functions_of_law(step, structure.projection)
    tables = [_law_tables(M, law), units, exact_tables(structure), _follow_tables(structure, M.E_z), _choice_tables(law)]
    return "".join(tables) + "\n" + "\n".join(functions)


def _functions_of_unknowns(step: _Symbols) -> list[str]:
    """What each step has."""
    at, z, l, known, E, Y, m = step.at, step.z, step.l, step.known, step.E, step.Y, bool(step.Y)
    E_0, Y_0 = E["E_0"], Y.get("Y_0", ca.SX())
    predicted = -step.inverse @ E_0
    moved = ca.fabs(E_0 + at.E_z @ at.guess) + ca.fabs(at.E_z) @ ca.fabs(z - at.guess)
    passed = {"felt_E": at.E_z @ z + (at.E_l @ l if m else 0)} | ({"felt_Y": at.Y_z @ z + at.Y_l @ l} if m else {})
    return [
        c_function("constant_part", known, {"E_0": at.E_0} | ({"Y_0": at.Y_0} if m else {}), "E and Y at z = 0, l = 0"),
        c_function(
            "predict", E | Y, {"z_0": predicted} | ({"b": Y_0 + at.Y_z @ predicted} if m else {}),
            "the solution without multipliers" + (", and y there" if m else ""),
        ),
        c_function(
            "residuals", E | Y | step.solution,
            {"E": E_0 + at.E_z @ z + (at.E_l @ l if m else 0)} | ({"Y": Y_0 + at.Y_z @ z + at.Y_l @ l} if m else {}),
        ),
        c_function(
            "scale_E", known | E | {"z": z}, {"scale": moved}, "what moves in the step"
        ),
        c_function(
            "round_off_E", known | step.solution, {"error": error_bound(at.E, ca.vertcat(z, l))}, "running error bound in EPS/2"
        ),
        c_function("passed_on", step.solution, passed, "what E and Y feel of errors of z" + (" and l" if m else "")),
    ]  # fmt: skip


def _functions_of_law(step: _Symbols, projection: bool) -> list[str]:
    """What a step with multipliers has besides."""
    at, z, l, Z, E_0 = step.at, step.z, step.l, step.Z, step.E["E_0"]
    z_0 = ca.SX.sym("z_0", E_0.numel())
    functions = [
        c_function("respond", {"z_0": z_0, "l": l}, {"z": z_0 + Z @ l}, "z = z_0 + Z l"),
        c_function(
            "scale_Y", {"l": l}, {"terms": ca.fabs(at.Y_z) @ ca.fabs(Z @ l) + ca.fabs(at.Y_l) @ ca.fabs(l)}, "the terms of W l"
        ),
        c_function("round_off_Y", step.known | step.solution, {"error": error_bound(at.Y, ca.vertcat(z, l))}),
    ]  # fmt: skip
    if projection:
        reach = ca.sumsqr(z - at.guess) + ca.sumsqr(E_0 + at.E_z @ at.guess)
        functions.append(c_function("moved", step.known | step.E | {"z": z}, {"reach": reach}, "the square of what moves"))
    return functions


def _law_tables(M: Matrices, law: NumericLaw) -> str:
    """W, and the sizes by which the law is judged."""
    W, w_max = table("W", M.W.ravel(), "MODEL_M*MODEL_M", "y = W l + b"), np.abs(M.W).max(axis=1)
    if law.curved:
        return W + table("w_max", w_max, "MODEL_M", "max_j |W_ij|")
    w_root = table("w_root", np.sqrt(w_max), "MODEL_M", "sqrt(max_j |W_ij|)")
    return W + w_root + table("bound_size", bound_size(law), "MODEL_M")


def _choice_tables(law: NumericLaw) -> str:
    """The codes of the index sets that are tried one by one."""
    if not index_sets(law):
        return ""
    codes = choices(law)
    rows = ", ".join("{" + ", ".join(map(str, [*code, 0, 0][:3])) + "}" for code in codes)
    return f"static const signed char choices[MODEL_M][3] = {{{rows}}}; /* codes that a row can have */\n" + table(
        "choice_count", [len(code) for code in codes], "MODEL_M", kind="int"
    )


def _unit_tables(M: Matrices) -> str:
    """Units of z and l in which the step is well scaled, and the size of each row in them."""
    n, J = len(M.E_z), np.block([[M.E_z, M.E_l], [M.Y_z, M.Y_l]])
    units = equilibrated(J)[2]
    size = np.abs(J) @ units
    about = "units in which the step is well scaled"
    tables = table("unit_z", units[:n], "MODEL_N", about) + table("unit_size_E", size[:n], "MODEL_N", "of the rows in these")
    if len(J) == n:
        return tables
    return tables + table("unit_l", units[n:], "MODEL_M") + table("unit_size_Y", size[n:], "MODEL_M")


def _follow_tables(structure: Structure, E_z: np.ndarray) -> str:
    """The coefficients of the rows of E that give an unknown exactly."""
    rows = structure.follow_rows
    if not rows:
        return ""
    entries = [E_z[i, j] for i, needed in rows for j, _ in needed]
    return table("follow_entry", entries, "") + table("follow_own", [E_z[i, i] for i, _ in rows], "MODEL_FOLLOW")


def index_sets(law: NumericLaw, most: int = MOST_INDEX_SETS) -> int:
    """How many index sets there are, where they are at most ``most``; else, and with curved blocks, 0."""
    count = math.prod(map(len, choices(law)))
    return int(count) if count <= most and not law.curved else 0
