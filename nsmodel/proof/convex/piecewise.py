"""Functions of one s >= 0 that are a polynomial on each of finitely many intervals, their cases settled in exact arithmetic."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca

from nsmodel.proof import polynomial, polynomial_signs
from nsmodel.proof.convex.joints import exact_value
from nsmodel.proof.convex.pieces import split_by_cases
from nsmodel.proof.graph import fold_graph
from nsmodel.proof.one_variable import Cases


class PolynomialPiece(NamedTuple):
    """The expression on [low, high] (None: infinite) as a polynomial."""

    low: Fraction
    high: Fraction | None
    c: list[Fraction]


def polynomial_pieces(expr: ca.SX, s: ca.SX) -> list[PolynomialPiece] | None:
    """The expression as a piecewise polynomial, its cases settled exactly; None where that does not work."""
    if any(symbol.element_hash() != s.element_hash() for symbol in ca.symvar(expr)):
        return None
    found = split_by_cases([(Fraction(1), expr)], s)
    if found is None or any(end is not None and end[0] != end[1] for piece in found for end in (piece.low, piece.high)):
        return None
    done = []
    for piece in found:
        p = _piece_polynomial(expr, piece.cases[0])
        if p is None:
            return None
        low, high = piece.rational_ends
        done.append(PolynomialPiece(low, high, polynomial.univariate_coefficients(p)))
    if any(exact_value(expr, s, piece.low) != polynomial_signs.evaluate_at(piece.c, piece.low) for piece in done):
        return None  # the value at the joint itself, where a condition or sign may differ from both sides
    return done


def _piece_polynomial(expr: ca.SX, cases: Cases) -> polynomial.Polynomial | None:
    calls = iter(range(10**9))

    def apply(op: int, args: list[polynomial.Polynomial | None]) -> polynomial.Polynomial | None:
        case = cases.get(next(calls))
        if case is None:
            known = [arg for arg in args if arg is not None]
            return polynomial.apply_to_polynomials(op, known) if len(known) == len(args) and known else None
        total = polynomial.scale_polynomial({(): Fraction(1)}, case[1])
        for factor, arg in zip(case[0], args, strict=True):
            if factor:
                total = None if total is None or arg is None else polynomial.add_multiple(total, arg, Fraction(factor))
        return total

    return fold_graph(expr, lambda symbol: {((0, 1),): Fraction(1)}, polynomial.constant_polynomial, apply)[0]
