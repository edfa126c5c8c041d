"""Is a continuous function of time absolutely continuous: its graph is tame, so that it has finitely many monotone pieces.

What is made of arithmetic, powers, roots, exp and log, of moduli, maxima, signs and cases, and of sines and other analytic
functions on bounded arguments is definable in the o-minimal structure R_an,exp (van den Dries and Miller 1994). By its theorem on
monotonicity a compact interval falls into finitely many pieces on each of which it is C1 and monotone or constant; where it is
continuous, each piece is the integral of its derivative. t sin(1/t) is continuous, but sin has an unbounded argument.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.proof import interval
from nsmodel.proof.graph import apply_operation, fold_graph

TAME_OPERATIONS = frozenset({
    ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_INV, ca.OP_NEG, ca.OP_SQ, ca.OP_TWICE, ca.OP_SQRT, ca.OP_POW,
    ca.OP_CONSTPOW, ca.OP_EXP, ca.OP_EXPM1, ca.OP_LOG, ca.OP_LOG1P, ca.OP_SINH, ca.OP_COSH, ca.OP_TANH, ca.OP_ASINH, ca.OP_ACOSH,
    ca.OP_ATANH, ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN, ca.OP_SIGN, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR,
    ca.OP_NOT, ca.OP_IF_ELSE_ZERO, ca.OP_ASIN, ca.OP_ACOS, ca.OP_HYPOT,
})  # fmt: skip
TAME_ON_COMPACT_SETS = frozenset(
    {ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ATAN, ca.OP_ERF, ca.OP_FLOOR, ca.OP_CEIL}
)  # tame on compact intervals


def is_absolutely_continuous(expr: ca.SX, t: ca.SX, low: float, high: float) -> bool:
    """Whether each entry of an expression of t is proved to be absolutely continuous on [low, high].

    >>> t = ca.SX.sym("t")
    >>> [is_absolutely_continuous(f, t, 0.0, 1.0) for f in (ca.sqrt(t), t**0.3 * ca.sin(t), ca.sign(t - 0.5), t * ca.sin(1 / t))]
    [True, True, False, False]
    """
    ends = np.array([low]), np.array([high])
    arguments: list[ca.SX] = []
    tame = True

    def apply(op: int, args: list[ca.SX]) -> ca.SX:
        nonlocal tame
        tame = tame and op in TAME_OPERATIONS | TAME_ON_COMPACT_SETS
        if op in TAME_ON_COMPACT_SETS:
            arguments.append(args[0])
        return apply_operation(op, args)

    fold_graph(ca.densify(ca.vec(expr)), lambda symbol: symbol, ca.SX, apply)
    if not tame or not np.isfinite(interval.enclose(expr, t, *ends)).all():
        return False
    if arguments and not np.isfinite(interval.enclose(ca.vertcat(*arguments), t, *ends)).all():
        return False
    return interval.is_continuous(expr, t, *ends)
