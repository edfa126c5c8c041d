"""Functions of one s >= 0 that are a polynomial on each of finitely many intervals, their cases settled in exact arithmetic."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca

from nsmodel.proof import polynomial, polynomial_signs
from nsmodel.proof.graph import replay

MOST_PIECES = 50
CONDITIONS = (ca.OP_LE, ca.OP_LT, ca.OP_EQ, ca.OP_NE)


class Piece(NamedTuple):
    """The expression on [low, high] (None: infinite) as a polynomial."""

    low: Fraction
    high: Fraction | None
    c: list[Fraction]


def pieces(expr: ca.SX, s: ca.SX) -> list[Piece] | None:
    """The expression as a piecewise polynomial, its cases settled exactly; None where that does not work."""
    done, left = [], [(Fraction(0), None)]
    while left:
        low, high = left.pop()
        settled, cut = _settled(expr, s, low, high)
        if cut is not None:
            left += [(low, cut), (cut, high)]
            continue
        (p,) = polynomial.read(settled, s)
        if p is None or len(done) + len(left) > MOST_PIECES:
            return None
        done.append(Piece(low, high, polynomial.coefficients(p)))
    done.sort(key=lambda piece: piece.low)
    for piece in done:  # the value at the joint itself, where a condition or sign may differ from both sides
        (p,) = polynomial.read(_settled(expr, s, piece.low, piece.low)[0], s)
        if p is None or polynomial_signs.at(polynomial.coefficients(p), piece.low) != polynomial_signs.at(piece.c, piece.low):
            return None
    return done


def _settled(expr: ca.SX, s: ca.SX, low: Fraction, high: Fraction | None) -> tuple[ca.SX, Fraction | None]:
    """The expression with the cases of (low, high) put in; or a place inside where one of them changes."""
    cuts: list[Fraction] = []
    middle = low + 1 if high is None else (low + high) / 2

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        (p,) = polynomial.read(args[0] if len(args) == 1 else args[0] - args[1], s)
        if p is None or polynomial.degree(p) > 1 or cuts:
            return None
        u = polynomial.coefficients(p)
        root = -u[0] / u[1] if len(u) > 1 else None
        if root is not None and low < root and (high is None or root < high):
            cuts.append(root)
            return None
        value = polynomial_signs.at(u, middle)
        if op in CONDITIONS:
            return ca.SX(int({ca.OP_LT: value < 0, ca.OP_LE: value <= 0, ca.OP_EQ: value == 0, ca.OP_NE: value != 0}[op]))
        if op == ca.OP_SIGN:
            return ca.SX(float((value > 0) - (value < 0)))
        case = value < 0
        if op == ca.OP_FABS:
            return -args[0] if case else args[0]
        return args[int(case)] if op == ca.OP_FMAX else args[1 - int(case)]

    settled = replay(expr, rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN, ca.OP_SIGN, *CONDITIONS), s, "expression")
    return settled, cuts[0] if cuts else None
