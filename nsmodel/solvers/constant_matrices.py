"""A step whose matrices depend on h alone: everything but the index set is one CasADi function called through buffer().

With E = E_0 + E_z z + E_l l and Y = Y_0 + Y_z z + Y_l l, constant matrices give z = z_0 + Z l, y = W l + b with
Z = -E_z^{-1} E_l, W = Y_l + Y_z Z, and on an index set l = S b + s: S and s change with the index set only.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.verdict import BufferedFunction
from nsmodel.solvers import mlcp
from nsmodel.solvers.linearisation import BufferedStepFunction
from nsmodel.solvers.one_step_problem import OneStepProblem
from nsmodel.solvers.residuals import (
    CASADI_OPERATIONS,
    ROUNDING,
    UNRESOLVED,
    NumericLaw,
    output_scale,
    symbolic_box_residual,
    symbolic_index_set_check,
    symbolic_max,
)
from nsmodel.solvers.rounding_errors import UNIT_ROUND_OFF, equilibrate_matrix, is_elimination_fragile, least_condition_number
from nsmodel.solvers.step import extra_columns
from nsmodel.solvers.structure import StepStructure, with_exact_unknowns

MAX_UNKNOWN_ERROR = 1e-2  # Part of z that rounding may decide: then the step's matrix is called singular. (+)
ILL_CONDITIONED = 1e13  # Condition from which on a matrix counts as singular: three digits of 16 are left. (+)
MAX_CSE_SIZE = 80  # Unknowns up to which sharing common subexpressions pays for the time it takes.


class StepKernel:
    """The step for one value of h. ``evaluate(t, state)`` fills ``out`` for the index set given by ``load``.

    Raises:
        numpy.linalg.LinAlgError: E_z is singular at this h.
    """

    def __init__(self, problem: OneStepProblem, structure: StepStructure, law: NumericLaw, h: float, tolerance: float) -> None:
        E_z, E_l, Y_z, Y_l = matrices = step_matrices_at(problem, h)
        self.h, self._matrices = h, matrices
        inverse = regular_inverse(E_z)
        self.Z = -inverse @ E_l
        self.W = Y_l + Y_z @ self.Z
        function, self._b_function = _kernel_functions(problem, structure, law, h, tolerance, matrices, inverse, self.Z, self.W)
        self._function = BufferedFunction(function)
        self._t, self._state, self._S, self._s, self._free, one = self._function.inputs
        one[:] = 1.0
        # The packed row; 1 where no other index set is called for.
        self.out, self.consistent = (out.ravel("K") for out in self._function.outputs)
        self._maps: dict[bytes, tuple[np.ndarray, np.ndarray, bool, bool]] = {}
        self.loaded: np.ndarray | None = None
        self.fragile = False  # Whether the map in place loses digits that the whole system has;
        self.singular = False  # or is one of many, of a system that does not tell them apart.
        self.law = law

    def evaluate(self, t: float, state: np.ndarray) -> np.ndarray:
        """Fill and return ``out`` (not a copy)."""
        self._t[0] = t
        self._state[:] = state
        self._function.run()
        return self.out

    def load(self, index: np.ndarray) -> bool:
        """Put the index set's map l = S b + s in place; False where it has none (a bound that is infinite)."""
        key = index.tobytes()
        if key not in self._maps:
            if len(self._maps) > 256:
                self._maps.clear()
            found = _multiplier_map(self.W, self.law, index)
            if found is None:
                return False
            S, s, poor = found
            regular = not poor or self._is_regular(np.flatnonzero(index == 0))
            self._maps[key] = S, s, poor and regular, not regular
        self._S[:], self._s[:], self.fragile, self.singular = self._maps[key]
        self._free[:] = index == 0
        self.loaded = index
        return True

    def load_multiplier(self, l: np.ndarray, index: np.ndarray) -> None:
        """Make ``evaluate`` use this l."""
        self._S[:], self._s[:] = 0.0, l
        self._free[:] = index == 0
        self.loaded = None

    def _is_regular(self, free: np.ndarray) -> bool:
        """Whether the whole system is regular on an index set, as far as double precision tells."""
        E_z, E_l, Y_z, Y_l = self._matrices
        J = np.block([[E_z, E_l[:, free]], [Y_z[free], Y_l[np.ix_(free, free)]]])
        return bool(np.isfinite(J).all() and np.linalg.cond(equilibrate_matrix(J)[0]) <= ILL_CONDITIONED)

    def b(self, t: float, state: np.ndarray) -> np.ndarray:
        """The vector b of y = W l + b."""
        return self._b_function(t, state)[0]

    @cached_property
    def is_well_scaled(self) -> bool:
        """Whether the user's units are good enough for solving y = W l + b."""
        return mlcp.equilibrating_units(self.W, self.law) is None


def regular_inverse(E_z: np.ndarray) -> np.ndarray:
    """The inverse of E_z.

    Raises:
        numpy.linalg.LinAlgError: E_z is singular, or rounding its entries moves z by more than MAX_UNKNOWN_ERROR in the best
            units: by 2 u times the spectral radius of |E_z^-1| |E_z|.
    """
    scaled, rows, columns = equilibrate_matrix(E_z)
    inverse = columns[:, None] * np.linalg.inv(scaled) * rows
    if not 2 * UNIT_ROUND_OFF * least_condition_number(np.abs(inverse), np.abs(E_z)) <= MAX_UNKNOWN_ERROR:
        raise np.linalg.LinAlgError
    return inverse


def step_matrices_at(problem: OneStepProblem, h: float) -> tuple[np.ndarray, ...]:
    """(E_z, E_l, Y_z, Y_l) at h, dense, where they depend on nothing else."""
    known = ca.vertcat(problem.t, problem.state, problem.z, problem.l)
    f = ca.Function("matrices", [problem.h, known], [ca.densify(J) for J in problem.jacobians])
    return tuple(np.array(v).reshape(v.shape) for v in f.call([ca.DM(h), ca.DM.zeros(known.numel())]))


def _multiplier_map(W: np.ndarray, law: NumericLaw, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool] | None:
    """S, s, and whether W keeps too little there; None where a bound is infinite."""
    m, fragile = law.size, False
    S, s = np.zeros((m, m)), np.where(index < 0, law.lower, np.where(index > 0, law.upper, 0.0))
    if not np.isfinite(s).all():
        return None
    free = np.flatnonzero(index == 0)
    if free.size:
        A = W[np.ix_(free, free)]
        inverse, regular = _inverse_or_pseudo_inverse(A)
        S[np.ix_(free, free)] = -inverse
        s[free] = -inverse @ (W[free] @ s)
        fragile = not regular or is_elimination_fragile(A, inverse)
    return S, s, fragile


def _inverse_or_pseudo_inverse(A: np.ndarray) -> tuple[np.ndarray, bool]:
    """A^-1, or the pseudo-inverse where A is singular, which is decided in units in which it is well scaled; and which."""
    scaled, rows, columns = equilibrate_matrix(A)
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(A), False
    if not np.abs(inverse).max() * np.abs(scaled).max() <= ILL_CONDITIONED:
        return np.linalg.pinv(A), False
    return columns[:, None] * inverse * rows, True


class FixedStepProblem(NamedTuple):
    """The problem at one value of h: expressions of (t, state) and of the symbols z and l; its constant matrices, sparse."""

    E: ca.SX
    Y: ca.SX
    E_0: ca.SX
    Y_0: ca.SX
    guess: ca.SX
    E_guess: ca.SX
    rest: list[ca.SX]
    E_z: ca.DM
    E_l: ca.DM
    Y_z: ca.DM
    Y_l: ca.DM


def fix_step_size(p: OneStepProblem, h: float | ca.SX, matrices: tuple[np.ndarray, ...]) -> FixedStepProblem:
    """The problem with this h, a number where it is not the problem's own symbol."""

    def substituted(e: ca.SX, z: ca.SX = p.z, l: ca.SX = p.l) -> ca.SX:
        return ca.substitute([e], [p.h, p.z, p.l], [ca.SX(h), z, l])[0] if e.numel() else e

    zero_z, zero_l = ca.SX.zeros(p.z.shape), ca.SX.zeros(p.l.shape)
    guess = substituted(p.guess, zero_z, zero_l)
    return FixedStepProblem(
        substituted(p.E), substituted(p.Y), substituted(p.E, zero_z, zero_l), substituted(p.Y, zero_z, zero_l), guess,
        substituted(p.E, guess, zero_l),
        [substituted(e) for e in (p.next_state, *extra_columns(p).values())], *(ca.sparsify(ca.DM(M)) for M in matrices),
    )  # fmt: skip


def _kernel_functions(
    p: OneStepProblem, structure: StepStructure, law: NumericLaw, h: float, tolerance: float, matrices: tuple[np.ndarray, ...],
    inverse: np.ndarray, Z: np.ndarray, W: np.ndarray,
) -> tuple[ca.Function, BufferedStepFunction]:  # fmt: skip
    """The packed step and whether it is settled as a function of (t, state, S, s, free), and b as a function of (t, state).

    Between solving and judging stands a factor ``one``, an input that is 1: in one expression graph the residual would be
    simplified with the formula that produced the answer, and a NaN would vanish.
    """
    at, m = fix_step_size(p, h, matrices), structure.m
    S, s, free = ca.SX.sym("S", m, m), ca.SX.sym("s", m), ca.SX.sym("free", m)
    inverse_sx, Z_sx = (ca.sparsify(ca.DM(M)) for M in (inverse, Z))
    z_0 = -inverse_sx @ at.E_0
    b = at.Y_0 + at.Y_z @ z_0
    l = S @ b + s
    z = z_0 + Z_sx @ l
    z = with_exact_unknowns(structure, free, z, at.E_0, at.Y_0, at.E_z)
    one = ca.SX.sym("one")
    judged = _residual_function(p, at, structure, law, tolerance, Z, W).call(
        [p.t, p.state, *(one * ca.densify(e) for e in (z, l, b)), free]
    )
    step = ca.Function("step", [p.t, p.state, S, s, free, one], judged, {"cse": structure.n + m < MAX_CSE_SIZE})
    return step, BufferedStepFunction("b", [p.t, p.state], [b])


def _residual_function(
    p: OneStepProblem, at: FixedStepProblem, structure: StepStructure, law: NumericLaw, tolerance: float, Z: np.ndarray,
    W: np.ndarray
) -> ca.Function:  # fmt: skip
    """The certificate and the packed row as a function of (t, state, z, l, b, free): `NewtonSolver.judge` in symbols.

    Of the rounding only that of the unknowns counts here, a part of the whole: what fails by it is judged by `NewtonSolver`.
    """
    n, m, z, l = structure.n, structure.m, p.z, p.l
    b, free = ca.SX.sym("b", m), ca.SX.sym("free", m)
    rounding = ROUNDING * UNIT_ROUND_OFF
    error_E = rounding * (ca.fabs(at.E_z) @ ca.fabs(z) + ca.fabs(at.E_l) @ ca.fabs(l))
    error_Y = rounding * (ca.fabs(at.Y_z) @ ca.fabs(z) + ca.fabs(at.Y_l) @ ca.fabs(l))
    # The scale of E: what moves in the step, not where it happens (positions far from 0 do not excuse an error).
    s_E = ca.fabs(at.E_guess) + ca.fabs(at.E_z) @ ca.fabs(z - at.guess)
    s_E = ca.fmax(s_E + error_E / tolerance, UNRESOLVED)
    # An infinite scale excuses nothing.
    ratios = [ca.if_else(s_E[i] < ca.inf, ca.fabs(at.E[i]) / s_E[i], ca.inf) for i in range(n)]
    residual = symbolic_max([ca.if_else(at.E[i] == 0, 0, ratios[i]) for i in range(n)])
    consistent = ca.SX(1)
    if m:
        w_max = np.abs(W).max(axis=1)
        terms = ca.fabs(at.Y_z) @ ca.fabs(ca.sparsify(ca.DM(Z)) @ l) + ca.fabs(at.Y_l) @ ca.fabs(l)
        s_y = output_scale(b, terms, w_max, CASADI_OPERATIONS)
        s_y = ca.fmax(s_y + error_Y / tolerance, UNRESOLVED)
        box = [i for i in range(m) if not any(rows.start <= i < rows.stop for rows, _ in law.curved)]
        residual = ca.fmax(residual, symbolic_box_residual(law, box, w_max, l, at.Y, s_y))
        consistent = symbolic_index_set_check(law, box, l, at.Y, free, error_Y)
    if structure.projection:  # <l, y> bounds the square of the distance to the projection
        gap = ca.dot(ca.fmax(l, 0), ca.fmax(at.Y, 0))
        reach = ca.sumsqr(z - at.guess) + ca.sumsqr(at.E_guess)
        unseen = ca.dot(ca.fabs(l), error_Y)
        residual = ca.fmax(residual, ca.if_else(gap > unseen, gap / ca.fmax(reach, UNRESOLVED), 0))
    residual = ca.if_else(residual < ca.inf, residual, ca.inf)
    y = ca.if_else(free, 0, at.Y) if m else at.Y
    rest = [ca.substitute(e, p.y, y) if e.numel() and m else e for e in at.rest]
    packed = ca.densify(ca.vertcat(rest[0], l, y, residual, 1, *rest[1:]))
    return ca.Function("judge", [p.t, p.state, z, l, b, free], [packed, ca.densify(consistent)])
