"""The functions and tables of a step whose matrices depend on its length alone (see ``c/fixed.c``): numbers for one length, for
several arrays, formed once for each.

The functions and tables of a large step whose matrices are numbers and sparse (see ``c/banded.c``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.codegen.expressions import c_function, c_table, exact_tables, looped_c_function
from nsmodel.solvers.active_set import row_code_choices
from nsmodel.solvers.constant_matrices import FixedStepProblem, fix_step_size, regular_inverse, step_matrices_at
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import NumericLaw, largest_bound
from nsmodel.solvers.rounding_errors import equilibrate_matrix, rounding_error_bound
from nsmodel.solvers.sparse import FactoredJacobian
from nsmodel.solvers.structure import StepStructure

# Up to which every index set may be tried, those of 4 rows with two ends: code without pivoting, and a bound of its work.
MAX_TRIED_INDEX_SETS = 81
# Coefficients written into the code, 150 KB of text; a larger step forms its matrices when it is prepared.
MAX_WRITTEN_NUMBERS = 6000
# Coefficients of the matrices of one step size for which a library has memory, 16 KB; of more it solves anew in each step.
MAX_STORED_NUMBERS = 2000
# Part of the largest entry below which one of a matrix of generic numbers is 0: rounding, as others are not so small by chance.
GENERIC_ZERO = 1e-9


class StepMatrices(NamedTuple):
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

    @property
    def kept(self) -> int:
        """How many coefficients are kept of a length."""
        return sum(M.size for M in self)


def step_matrices(problem: OneStepProblem, h: float) -> StepMatrices | None:
    """Return the matrices at h; None where E_z is singular."""
    E_z, E_l, Y_z, Y_l = step_matrices_at(problem, h)
    try:
        inverse = regular_inverse(E_z)
    except np.linalg.LinAlgError:
        return None
    Z = -inverse @ E_l
    return StepMatrices(E_z, E_l, Y_z, Y_l, inverse, Z, Y_l + Y_z @ Z)


class _SymbolicStep(NamedTuple):
    """A step, with E_z^{-1} and Z sparse, and arguments of its C functions; ``Y`` and ``l`` are empty without a law.

    Matrices are numbers, or symbols that are read from arrays: ``numbers``.
    """

    problem: OneStepProblem
    at: FixedStepProblem
    inverse: ca.DM | ca.SX
    Z: ca.DM | ca.SX
    known: dict[str, ca.SX]
    numbers: dict[str, ca.SX]
    E: dict[str, ca.SX]
    Y: dict[str, ca.SX]

    @property
    def solution(self) -> dict[str, ca.SX]:
        """z, and l where there is one."""
        return {"z": self.problem.z} | ({"l": self.problem.l} if self.Y else {})


def fixed_code(
    problem: OneStepProblem, structure: StepStructure, law: NumericLaw, M: StepMatrices, lengths: tuple[float, ...], several: bool
) -> str:
    """The C functions and tables of steps of the first of ``lengths``, which M belongs to; ``several``: of any length."""
    n, m = M.E_z.shape[0], problem.l.numel()
    given = {"E_0": ca.SX.sym("E_0", n)}, ({"Y_0": ca.SX.sym("Y_0", m)} if m else {})
    step = _SymbolicStep(problem, *(_symbolic_step(problem, M) if several else _numeric_step(problem, M, lengths[0])), *given)
    numbers = "" if several else (_law_tables(M, law) + _follow_tables(structure, M.E_z) if m else "") + _unit_tables(M)
    tables = _array_tables(law, lengths) if several else numbers
    shared = exact_tables(structure) + _choice_tables(law) if m else ""
    functions = _functions_of_unknowns(step) + (_functions_of_law(step, structure.projection) if m else [])
    return "\n".join([tables + shared, *([_matrices_function(problem)] if several else []), *functions])


def _numeric_step(problem: OneStepProblem, M: StepMatrices, h: float) -> tuple[FixedStepProblem, ca.DM, ca.DM, dict, dict]:
    """The step of one length, its matrices as numbers; what it knows."""
    inverse, Z = (ca.sparsify(ca.DM(A)) for A in (M.inverse, M.Z))
    known = {"s->t": problem.t, "s->x": problem.state}
    return fix_step_size(problem, h, tuple(M[:4])), inverse, Z, known, {}


def _symbolic_step(problem: OneStepProblem, M: StepMatrices) -> tuple[FixedStepProblem, ca.SX, ca.SX, dict, dict]:
    """The step of any length, its matrices as symbols row by row, but for entries that are the same at every length."""
    matrices, arrays = [], {}
    for name, entries in zip(_ARRAY_NAMES, (*map(ca.sparsify, problem.jacobians), *_generic_sparsity(problem)), strict=True):
        symbol = ca.SX.sym(name, entries.numel())
        matrices.append(_with_symbol_entries(symbol, entries))
        arrays |= {f"AT.{name}": symbol} if entries.numel() else {}
    at = fix_step_size(problem, problem.h, tuple(M[:4]))._replace(**dict(zip(_ARRAY_NAMES[:4], matrices[:4], strict=True)))
    known = {"s->t": problem.t, "s->x": problem.state, "AT.h": problem.h}
    return at, matrices[4], matrices[5], known | arrays, arrays


_ARRAY_NAMES = ("E_z", "E_l", "Y_z", "Y_l", "inverse", "Z")


def _generic_sparsity(problem: OneStepProblem) -> Iterator[ca.SX]:
    """E_z^{-1} and Z with symbols where they have entries, which generic numbers tell."""
    rng = np.random.default_rng(0)
    sparse = [ca.sparsify(J).sparsity() for J in problem.jacobians[:2]]
    E_z, E_l = (np.array(ca.DM(own, rng.uniform(1, 2, own.nnz()))).reshape(own.shape) for own in sparse)
    inverse = np.linalg.inv(E_z)
    for M in (inverse, inverse @ E_l):
        pattern = ca.DM((np.abs(M) > GENERIC_ZERO * np.abs(M).max(initial=0.0)).astype(float).reshape(M.shape))
        yield ca.SX.sym("entry", ca.sparsify(pattern).sparsity())


def _with_symbol_entries(symbol: ca.SX, entries: ca.SX) -> ca.SX:
    """The matrix with those entries that are no numbers read from a column, row by row."""
    matrix = ca.SX(entries)
    for i, j in zip(*entries.sparsity().get_triplet(), strict=True):
        if not entries[i, j].is_constant():
            matrix[i, j] = symbol[i * entries.shape[1] + j]
    return matrix


def _matrices_function(problem: OneStepProblem) -> str:
    read = {name: J for name, J in zip(_ARRAY_NAMES, problem.jacobians, strict=False) if J.numel()}
    return c_function("matrices", {"AT.h": problem.h}, read, "the Jacobians of E and Y")


def _array_tables(law: NumericLaw, lengths: tuple[float, ...]) -> str:
    """What stands for these numbers: the matrices kept of the step's length."""
    names = ["unit_z", "unit_size_E"]
    if law.size:
        names += ["unit_l", "unit_size_Y", "output_map", "output_max" if law.curved else "w_root"]
    return (
        "#define AT s->fixed.lengths[s->fixed.length] /* the matrices of the step's length */\n"
        + "".join(f"#define {name} AT.{name}\n" for name in names)
        + (c_table("bound_size", largest_bound(law), "MODEL_M") if law.size and not law.curved else "")
        + c_table("known_length", lengths, "", "lengths of steps whose matrices are formed at the start")
    )


def _functions_of_unknowns(step: _SymbolicStep) -> list[str]:
    """What each step has."""
    at, z, l = step.at, step.problem.z, step.problem.l
    known, E, Y, m = step.known, step.E, step.Y, bool(step.Y)
    E_0, Y_0 = E["E_0"], Y.get("Y_0", ca.SX())
    predicted = -step.inverse @ E_0
    moved = ca.fabs(E_0 + at.E_z @ at.guess) + ca.fabs(at.E_z) @ ca.fabs(z - at.guess)
    passed = {"felt_E": at.E_z @ z + (at.E_l @ l if m else 0)} | ({"felt_Y": at.Y_z @ z + at.Y_l @ l} if m else {})
    return [
        c_function("constant_part", known, {"E_0": at.E_0} | ({"Y_0": at.Y_0} if m else {}), "E and Y at z = 0, l = 0"),
        c_function(
            "predict", E | Y | step.numbers, {"z_0": predicted} | ({"b": Y_0 + at.Y_z @ predicted} if m else {}),
            "the solution without multipliers" + (", and y there" if m else ""),
        ),
        c_function(
            "residuals", E | Y | step.solution | step.numbers,
            {"E": E_0 + at.E_z @ z + (at.E_l @ l if m else 0)} | ({"Y": Y_0 + at.Y_z @ z + at.Y_l @ l} if m else {}),
        ),
        c_function(
            "scale_E", known | E | {"z": z}, {"scale": moved}, "what moves in the step"
        ),
        c_function(
            "round_off_E", known | step.solution, {"error": rounding_error_bound(at.E, ca.vertcat(z, l))},
            "running error bound in EPS/2"
        ),
        c_function(
            "passed_on", step.solution | step.numbers, passed, "what E and Y feel of errors of z" + (" and l" if m else "")
        ),
    ]  # fmt: skip


def _functions_of_law(step: _SymbolicStep, projection: bool) -> list[str]:
    """What a step with multipliers has besides."""
    at, z, l, Z, E_0 = step.at, step.problem.z, step.problem.l, step.Z, step.E["E_0"]
    z_0 = ca.SX.sym("z_0", E_0.numel())
    functions = [
        c_function("respond", {"z_0": z_0, "l": l} | step.numbers, {"z": z_0 + Z @ l}, "z = z_0 + Z l"),
        c_function(
            "scale_Y", {"l": l} | step.numbers, {"terms": ca.fabs(at.Y_z) @ ca.fabs(Z @ l) + ca.fabs(at.Y_l) @ ca.fabs(l)},
            "the terms of W l"
        ),
        c_function("round_off_Y", step.known | step.solution, {"error": rounding_error_bound(at.Y, ca.vertcat(z, l))}),
    ]  # fmt: skip
    if projection:
        reach = ca.sumsqr(z - at.guess) + ca.sumsqr(E_0 + at.E_z @ at.guess)
        functions.append(c_function("moved", step.known | step.E | {"z": z}, {"reach": reach}, "the square of what moves"))
    return functions


def _law_tables(M: StepMatrices, law: NumericLaw) -> str:
    """W, and the sizes by which the law is judged."""
    W, w_max = c_table("output_map", M.W.ravel(), "MODEL_M*MODEL_M", "W of y = W l + b"), np.abs(M.W).max(axis=1)
    if law.curved:
        return W + c_table("output_max", w_max, "MODEL_M", "max_j |W_ij|")
    w_root = c_table("w_root", np.sqrt(w_max), "MODEL_M", "sqrt(max_j |W_ij|)")
    return W + w_root + c_table("bound_size", largest_bound(law), "MODEL_M")


def _choice_tables(law: NumericLaw) -> str:
    """The codes of the index sets that are tried one by one."""
    if not index_set_count(law):
        return ""
    codes = row_code_choices(law)
    rows = ", ".join("{" + ", ".join(map(str, [*code, 0, 0][:3])) + "}" for code in codes)
    return f"static const signed char choices[MODEL_M][3] = {{{rows}}}; /* codes that a row can have */\n" + c_table(
        "choice_count", [len(code) for code in codes], "MODEL_M", kind="int"
    )


def _unit_tables(M: StepMatrices) -> str:
    """Units of z and l in which the step is well scaled, and the size of each row in them."""
    n, J = len(M.E_z), np.block([[M.E_z, M.E_l], [M.Y_z, M.Y_l]])
    units = equilibrate_matrix(J)[2]
    size = np.abs(J) @ units
    about = "units in which the step is well scaled"
    tables = c_table("unit_z", units[:n], "MODEL_N", about) + c_table("unit_size_E", size[:n], "MODEL_N", "of the rows in these")
    if len(J) == n:
        return tables
    return tables + c_table("unit_l", units[n:], "MODEL_M") + c_table("unit_size_Y", size[n:], "MODEL_M")


def _follow_tables(structure: StepStructure, E_z: np.ndarray) -> str:
    """The coefficients of the rows of E that give an unknown exactly."""
    rows = structure.follow_rows
    if not rows:
        return ""
    entries = [E_z[i, j] for i, needed in rows for j, _ in needed]
    return c_table("follow_entry", entries, "") + c_table("follow_own", [E_z[i, i] for i, _ in rows], "MODEL_FOLLOW")


def index_set_count(law: NumericLaw, most: int = MAX_TRIED_INDEX_SETS) -> int:
    """How many index sets there are, where they are at most ``most``; else, and with curved blocks, 0."""
    count = math.prod(map(len, row_code_choices(law)))
    return int(count) if count <= most and not law.curved else 0


def band_sizes(at: FactoredJacobian) -> dict[str, int]:
    """The constants of the header."""
    order = at.order
    upper = order.above + order.below  # of U, with what row interchanges fill in
    return {
        "SIZE": at.diagonal.size, "NONZEROS": at.J.nnz, "BELOW": order.below, "UPPER": upper, "BAND": order.below + upper + 1,
    }  # fmt: skip


def banded_code(problem: OneStepProblem, structure: StepStructure, h: float, at: FactoredJacobian) -> str:
    """The C functions and tables."""
    n, m = structure.n, structure.m
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
