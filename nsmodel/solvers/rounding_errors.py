"""What double precision can see of a row: the running error bound of its evaluation, as an expression (Wilkinson).

With u = 2^-53, each operation v = a o b of a graph is computed as v (1 + d), |d| <= u, and passes on what its arguments err by:

    err(a +- b) = |v| + err(a) + err(b)        err(a b) = |v| + |a| err(b) + |b| err(a)
    err(a / b)  = |v| + (err(a) + |v| err(b)) / |b|        err(f(a)) = |v| + |f'(a)| err(a)

in units of u, to first order (Higham, Accuracy and Stability of Numerical Algorithms, 3.3). What is given (t, h, the state,
numbers) errs by 0; an unknown w by |w|: nobody can know it better than to the nearest double.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.proof.expression_graph import apply_operation, fold_graph, operation_codes, stack_column, symbol_hashes

UNIT_ROUND_OFF = EPS / 2  # u, relative: what one operation is rounded by, at most.
# Nodes of a graph up to which its own bound is formed; beyond, its code would be many times that of the step.
MAX_BOUND_NODES = 10_000
PROBES = 8  # Sign vectors by which it is told what the unknowns err by, each a solve; of one alone terms may cancel. (+)
# FRAGILE: three of 16 digits.
FRAGILE = 1e3  # Condition of what elimination leaves up to which its answer is as good as that of the whole system. (+)
# WORTH: half of the digits are left.
WORTH = 1e8  # Condition up to which the rounding of the unknowns excuses a row: beyond, it could excuse any. (+)
INSIDE = 8  # Times EPS: the part of itself by which rounding may put an l out of its box: twice SUM_ERROR. (+)
SUM_ERROR = 4  # Times EPS: the part of its terms by which a sum may err: nine of them, and most longer ones. (+)
SPREAD, MIXED, STIRRED = 2654435769, 2246822519, 3266489917  # Factors of the hash whose bits are the signs of probes.
EXACT_OPERATIONS = frozenset({
    ca.OP_ASSIGN, ca.OP_NEG, ca.OP_FABS, ca.OP_SIGN, ca.OP_COPYSIGN, ca.OP_FMIN, ca.OP_FMAX, ca.OP_TWICE,
    ca.OP_IF_ELSE_ZERO, ca.OP_FLOOR, ca.OP_CEIL, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR,
})  # fmt: skip


class ValueWithError(NamedTuple):
    """A value of the graph and the bound of its error in units of u."""

    value: ca.SX
    error: ca.SX


def rounding_error_bound(rows: ca.SX, unknowns: ca.SX) -> ca.SX:
    """Return the bound of the rounding of each row, in units of u: an expression of the symbols of ``rows``.

    Args:
        rows: SX column.
        unknowns: symbols that are known to the nearest double only; all others are exact.
    """
    if uses_term_bound(rows):
        J = ca.jacobian(rows, unknowns)
        return ca.fabs(J) @ ca.fabs(unknowns) + ca.fabs(rows - J @ unknowns)
    unknown = symbol_hashes(unknowns)

    def symbol(s: ca.SX) -> ValueWithError:
        return ValueWithError(s, ca.fabs(s) if s.element_hash() in unknown else ca.SX(0))

    return stack_column(c.error for c in fold_graph(rows, symbol, lambda v: ValueWithError(ca.SX(v), ca.SX(0)), _propagate_error))


def uses_term_bound(rows: ca.SX) -> bool:
    """Whether the bound is that of the terms in the unknowns, and of the rest: of large graphs, and of Functions, whose inside
    cannot be seen.
    """
    large = ca.Function("rows", [stack_column(ca.symvar(rows))], [rows]).n_nodes() > MAX_BOUND_NODES
    return large or ca.OP_CALL in operation_codes(rows)


def _propagate_error(op: int, args: list[ValueWithError]) -> ValueWithError:
    value = apply_operation(op, [a.value for a in args])
    passed = ca.SX(0)
    if any(not a.error.is_zero() for a in args):
        for derivative, a in zip(_operation_derivatives(op, value, [a.value for a in args]), args, strict=True):
            passed += ca.SX(0) if a.error.is_zero() else _error_product(ca.fabs(derivative), a.error)
    return ValueWithError(value, passed if op in EXACT_OPERATIONS else passed + ca.fabs(value))


def _error_product(a: ca.SX, error: ca.SX) -> ca.SX:
    """a * error, 0 where the error is (a may be infinite there)."""
    return a * error if a.is_constant() else ca.if_else(error == 0, 0, a * error)


def _operation_derivatives(op: int, value: ca.SX, args: list[ca.SX]) -> list[ca.SX]:
    """The derivatives of an operation in its arguments."""
    if op in (ca.OP_ADD, ca.OP_SUB):
        return [ca.SX(1), ca.SX(1)]
    if op == ca.OP_MUL:
        return [args[1], args[0]]
    if op == ca.OP_DIV:
        return [1 / args[1], value / args[1]]
    symbols = [ca.SX.sym("a") for _ in args]
    derivatives = [ca.jacobian(apply_operation(op, symbols), s) for s in symbols]
    return ca.substitute(derivatives, symbols, args)


def probe_signs(n: int) -> np.ndarray:
    """PROBES vectors (PROBES, n) of +-1 that look random and are the same everywhere: bits of a hash of the entry's number."""
    x = (np.arange(n * PROBES, dtype=np.uint64) + 1) * SPREAD & 0xFFFFFFFF
    x = ((x ^ x >> 15) * MIXED) & 0xFFFFFFFF
    x = ((x ^ x >> 13) * STIRRED) & 0xFFFFFFFF
    return np.where(x >> 16 & 1, 1.0, -1.0).reshape(n, PROBES).T


def solution_errors(
    solve: Callable[[np.ndarray], np.ndarray], error: np.ndarray, size: np.ndarray, units: np.ndarray
) -> np.ndarray:
    """What the solution of J w = r errs by where the rows do so by ``error``: J^-1 (+-error) (n, PROBES), in units of u.

    The largest of a few is rarely much less than |J^-1| error: no inverse is formed. What another row feels of them, of their
    cancelling parts too, is the largest of row @ J^-1 (+-error). Where J is so ill-conditioned (WORTH) that rounding could excuse
    any row, it excuses none.

    Args:
        solve: r -> J^-1 r, J the matrix (n, n) of the system that an index set makes of a step.
        error: (n,), >= 0.
        size, units: |J| units and the units (n,) of the unknowns in which J is well scaled: |J^-1| size / units is its condition.
    """
    probes = probe_signs(error.size)
    with np.errstate(over="ignore", invalid="ignore"):
        condition = np.max([np.abs(solve(s * size)) / units for s in probes], initial=0.0)
        if not condition <= WORTH:
            return np.zeros((error.size, 1))
        return np.column_stack([solve(s * error) for s in probes])


def row_maxima(rows: np.ndarray) -> np.ndarray:
    """The largest entry of each row, in absolute value."""
    return np.abs(rows).max(axis=1, initial=0.0)


def dense_solution_errors(J: np.ndarray, error: np.ndarray) -> np.ndarray:
    """`solution_errors` of a dense matrix (n, n); what is singular leaves unknowns free, not wrong."""
    scaled, rows, columns = equilibrate_matrix(J)
    inverse = np.linalg.pinv(scaled, rcond=1 / WORTH)
    return solution_errors(lambda r: columns * (inverse @ (rows * r)), error, np.abs(J) @ columns, columns)


def least_condition_number(inverse: np.ndarray, matrix: np.ndarray) -> float:
    """The spectral radius of |A^-1| |A|, the least condition number in all units, by the power method; of sizes."""
    v = np.ones(len(matrix))
    for _ in range(30):
        v = inverse @ (matrix @ v)
        v /= v.max(initial=0.0) or 1.0
    w = inverse @ (matrix @ v)
    return float(np.max(w[v > 0] / v[v > 0], initial=1.0))


def is_elimination_fragile(A: np.ndarray, inverse: np.ndarray) -> bool:
    """Whether A, what elimination has made of a system, keeps too little of it: answers are then refined on the whole.

    sum_ij |A^-1|_ij |A|_ji bounds the spectral radius of |A^-1| |A|, and is the same in all units of rows and columns.
    """
    return not float((np.abs(inverse) * np.abs(A.T)).sum()) <= FRAGILE * len(A)


def equilibrate_matrix(J: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J with its rows and columns in the units of `scales`, and these."""
    i, j = np.nonzero(J)
    rows, columns = ruiz_scales(i, j, np.abs(J[i, j]), len(J))
    return rows[:, None] * J * columns, rows, columns


def ruiz_scales(i: np.ndarray, j: np.ndarray, sizes: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Powers of 2 for the n rows and columns that bring the entries (i, j) near 1 (Ruiz' iteration); 1 where there is none."""
    rows, columns = np.ones(n), np.ones(n)
    for _ in range(8):
        entries = sizes * rows[i] * columns[j]
        for scale, at in ((rows, i), (columns, j)):
            most = np.zeros(n)
            np.maximum.at(most, at, entries)
            scale /= np.sqrt(np.where(most > 0, most, 1.0))
    return np.exp2(np.round(np.log2(rows))), np.exp2(np.round(np.log2(columns)))
