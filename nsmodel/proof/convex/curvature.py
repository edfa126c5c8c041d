"""The signs of curvature and slope of functions of one variable on an interval."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca

CurvatureRule = Callable[[float, float], tuple[int, int] | None]  # (curvature, slope) signs on [low, high], None where unknown


def even_curvature(low: float, high: float) -> tuple[int, int] | None:
    """Convex, with its least value at 0."""
    return 1, 1 if low >= 0 else -1 if high <= 0 else 0


def _odd_curvature(sign: int) -> CurvatureRule:
    """Increasing, of curvature ``sign`` on the right and -sign on the left, as x^3 or tanh (sign -1)."""
    return lambda low, high: (sign, 1) if low >= 0 else (-sign, 1) if high <= 0 else None


def _curvature_above(least: float, curvature: int, slope: int, *, strict: bool) -> CurvatureRule:
    """Defined above ``least`` only."""
    return lambda low, high: (curvature, slope) if (low > least if strict else low >= least) else None


UNARY_CURVATURES: dict[int, CurvatureRule] = {
    ca.OP_SQ: even_curvature, ca.OP_FABS: even_curvature, ca.OP_COSH: even_curvature,
    ca.OP_EXP: lambda low, high: (1, 1), ca.OP_EXPM1: lambda low, high: (1, 1),
    ca.OP_LOG: _curvature_above(0, -1, 1, strict=True), ca.OP_LOG1P: _curvature_above(-1, -1, 1, strict=True),
    ca.OP_SQRT: _curvature_above(0, -1, 1, strict=False),
    ca.OP_SINH: _odd_curvature(1), ca.OP_TANH: _odd_curvature(-1), ca.OP_ATAN: _odd_curvature(-1),
    ca.OP_ASINH: _odd_curvature(-1), ca.OP_ERF: _odd_curvature(-1),
}  # fmt: skip


def power_curvature(exponent: float) -> CurvatureRule:
    """x^p, with real values on the range."""

    def rule(low: float, high: float) -> tuple[int, int] | None:
        if exponent in (0, 1):
            return None
        if exponent == int(exponent) and exponent > 1:
            return even_curvature(low, high) if exponent % 2 == 0 else _odd_curvature(1)(low, high)
        if exponent < 0:
            return (1, -1) if low > 0 else None
        return ((1 if exponent > 1 else -1), 1) if low >= 0 else None

    return rule


def inverse_curvature(low: float, high: float) -> tuple[int, int] | None:
    """1/x."""
    return (1, -1) if low > 0 else (-1, -1) if high < 0 else None
