"""The signs of curvature and slope of functions of one variable on an interval."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

Pieces = Callable[[float, float], tuple[int, int] | None]  # (curvature, slope) signs on [low, high], None where unknown


def even(low: float, high: float) -> tuple[int, int] | None:
    """Convex, with its least value at 0."""
    return 1, 1 if low >= 0 else -1 if high <= 0 else 0


def _odd(sign: int) -> Pieces:
    """Increasing, of curvature ``sign`` on the right and -sign on the left, as x^3 or tanh (sign -1)."""
    return lambda low, high: (sign, 1) if low >= 0 else (-sign, 1) if high <= 0 else None


def _on(least: float, curvature: int, slope: int, *, strict: bool) -> Pieces:
    """Defined above ``least`` only."""
    return lambda low, high: (curvature, slope) if (low > least if strict else low >= least) else None


UNARY: dict[int, Pieces] = {
    ca.OP_SQ: even, ca.OP_FABS: even, ca.OP_COSH: even,
    ca.OP_EXP: lambda low, high: (1, 1), ca.OP_EXPM1: lambda low, high: (1, 1),
    ca.OP_LOG: _on(0, -1, 1, strict=True), ca.OP_LOG1P: _on(-1, -1, 1, strict=True), ca.OP_SQRT: _on(0, -1, 1, strict=False),
    ca.OP_SINH: _odd(1), ca.OP_TANH: _odd(-1), ca.OP_ATAN: _odd(-1), ca.OP_ASINH: _odd(-1), ca.OP_ERF: _odd(-1),
}  # fmt: skip


def of_power(exponent: float) -> Pieces:
    """x^p, with real values on the range."""

    def pieces(low: float, high: float) -> tuple[int, int] | None:
        if exponent in (0, 1):
            return None
        if exponent == int(exponent) and exponent > 1:
            return even(low, high) if exponent % 2 == 0 else _odd(1)(low, high)
        if exponent < 0:
            return (1, -1) if low > 0 else None
        return ((1 if exponent > 1 else -1), 1) if low >= 0 else None

    return pieces


def of_inverse(low: float, high: float) -> tuple[int, int] | None:
    """1/x."""
    return (1, -1) if low > 0 else (-1, -1) if high < 0 else None
