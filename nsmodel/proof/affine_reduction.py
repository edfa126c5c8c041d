"""Fewer coordinates: an expression that feels z only through a few affine functions of it, as |q_1 - q_2| does."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.expression_graph import Program, apply_operation, is_double, program
from nsmodel.proof.interval_bounds import natural_extension
from nsmodel.proof.interval_functions import OPERATIONS

# Instructions; longer programs keep their coordinates: an affine value is a sum of Fractions. 2000 instructions take 0.03 s.
MAX_PROGRAM_LENGTH = 3000


class ReducedExpression(NamedTuple):
    """``expr`` in the symbols d (r, 1), which stand for affine functions of z.

    Attributes:
        expr: as given, but in d.
        d: (r, 1).
        lower, upper: (r,) rigorous bounds of d over the box of z; (k, r) over k boxes.
        matrix, constant: d = matrix z + constant but for rounding, (r, n) and (r,).
    """

    expr: ca.SX
    d: ca.SX
    lower: np.ndarray
    upper: np.ndarray
    matrix: np.ndarray
    constant: np.ndarray


class _AffineFunction(NamedTuple):
    """coefficients z + constant, exactly."""

    coefficients: Mapping[int, Fraction]
    constant: Fraction

    def scaled(self, factor: Fraction) -> _AffineFunction:
        """Return factor times this."""
        return _AffineFunction({i: factor * c for i, c in self.coefficients.items() if factor}, factor * self.constant)

    def plus(self, other: _AffineFunction) -> _AffineFunction:
        """Return the sum."""
        total = dict(self.coefficients)
        for i, c in other.coefficients.items():
            total[i] = total.get(i, Fraction(0)) + c
        return _AffineFunction({i: c for i, c in total.items() if c}, self.constant + other.constant)


def reduce_coordinates(code: Program, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> ReducedExpression | None:
    """Return what a program computes, as a column, in fewer symbols than it holds, or None where it takes as many.

    The greatest affine parts of the expression are taken as new symbols, those that are multiples of one another (plus a
    number) as one. What holds for all d in their box holds for all z in theirs; d may range over more.
    """
    used = sorted(frozenset().union(*(code.uses[j] for j in code.outputs)))
    if (
        len(used) < 2
        or len(code.steps) > MAX_PROGRAM_LENGTH
        or any(step.sources and step.op not in OPERATIONS for step in code.steps)
    ):
        return None
    affine = _affine_values(code)
    atoms, links = _group_directions(affine, _maximal_affine_values(code, affine))
    if len(atoms) >= len(used):
        return None
    d = ca.SX.sym("d", len(atoms))
    nodes = _rebuild_expressions(code, dict(zip(used, ca.vertsplit(z[used]), strict=True)), {})
    exprs, matrix = [], np.zeros((len(atoms), code.inputs))
    for row, atom in enumerate(atoms):
        for i, c in atom.part.coefficients.items():
            matrix[row, i] = float(c)
        exprs.append(ca.dot(ca.SX(ca.DM(matrix[row])), z) if atom.node is None else nodes[atom.node])
    ends = natural_extension(program(ca.vertcat(*exprs), z), np.atleast_2d(lower), np.atleast_2d(upper))
    lo, hi = (end.T.reshape(*lower.shape[:-1], len(atoms)) for end in ends)
    values = _rebuild_expressions(code, {}, {i: factor * d[row] + offset for i, (row, factor, offset) in links.items()})
    constant = np.array([float(atom.part.constant) for atom in atoms])
    return ReducedExpression(ca.vertcat(*(values[j] for j in code.outputs)), d, lo, hi, matrix, constant)


def _affine_values(code: Program) -> dict[int, _AffineFunction]:
    """Return the values that are affine in z."""
    found: dict[int, _AffineFunction] = {}
    for i, step in enumerate(code.steps):
        if step.op == ca.OP_INPUT:
            found[i] = _AffineFunction({step.slot: Fraction(1)}, Fraction(0))
        elif step.op == ca.OP_CONST and np.isfinite(step.number):
            found[i] = _AffineFunction({}, Fraction(step.number))
        elif step.sources and all(j in found for j in step.sources):
            result = _combine_affine(step.op, [found[j] for j in step.sources])
            if result is not None:
                found[i] = result
    return found


def _combine_affine(op: int, args: list[_AffineFunction]) -> _AffineFunction | None:
    """Return the result of an operation where it is affine."""
    first, last = args[0], args[-1]
    if op in (ca.OP_ADD, ca.OP_SUB):
        return first.plus(last.scaled(Fraction(1 if op == ca.OP_ADD else -1)))
    if op in (ca.OP_NEG, ca.OP_TWICE):
        return first.scaled(Fraction(-1 if op == ca.OP_NEG else 2))
    if op == ca.OP_MUL and not (first.coefficients and last.coefficients):
        return last.scaled(first.constant) if last.coefficients else first.scaled(last.constant)
    if op == ca.OP_DIV and not last.coefficients and last.constant:
        return first.scaled(1 / last.constant)
    return None


def _maximal_affine_values(code: Program, affine: Mapping[int, _AffineFunction]) -> list[int]:
    """Return the affine values with symbols that others than affine values use."""
    wanted = set(code.outputs)
    for i, step in enumerate(code.steps):
        if i not in affine:
            wanted |= set(step.sources)
    return sorted(i for i in wanted if i in affine and affine[i].coefficients)


class _DirectionSymbol(NamedTuple):
    """What a new symbol stands for: an affine function with exact doubles in it, or else the value ``node`` itself."""

    part: _AffineFunction
    node: int | None


def _group_directions(
    affine: Mapping[int, _AffineFunction], parts: list[int]
) -> tuple[list[_DirectionSymbol], dict[int, tuple[int, float, float]]]:
    """Return an atom for each direction, and each part as (its atom, factor, offset), these two exact doubles."""
    atoms: list[_DirectionSymbol] = []
    rows: dict[frozenset[tuple[int, Fraction]], list[int]] = {}
    links: dict[int, tuple[int, float, float]] = {}
    for index in parts:
        own = affine[index]
        pivot = own.coefficients[min(own.coefficients)]
        plain = _AffineFunction({i: c / pivot for i, c in own.coefficients.items()}, Fraction(0))
        key = frozenset(plain.coefficients.items())
        if key not in rows and all(is_double(c) for c in plain.coefficients.values()):
            rows[key] = [len(atoms)]
            atoms.append(_DirectionSymbol(plain, None))
        for row in rows.setdefault(key, []):
            first = atoms[row].part
            factor = pivot / first.coefficients[min(first.coefficients)]
            offset = own.constant - factor * first.constant
            if is_double(factor) and is_double(offset):
                links[index] = row, float(factor), float(offset)
                break
        else:
            links[index] = len(atoms), 1.0, 0.0
            rows[key].append(len(atoms))
            atoms.append(_DirectionSymbol(own, index))
    return atoms, links


def _rebuild_expressions(code: Program, symbols: Mapping[int, ca.SX], known: Mapping[int, ca.SX]) -> list[ca.SX]:
    """Return all values as expressions; those in ``known`` are given, and what only they need is left out (NaN)."""
    values: list[ca.SX] = []
    for i, step in enumerate(code.steps):
        if i in known:
            values.append(known[i])
        elif step.op == ca.OP_INPUT:
            values.append(symbols.get(step.slot, ca.SX(np.nan)))
        elif step.op == ca.OP_CONST:
            values.append(ca.SX(step.number))
        else:
            values.append(apply_operation(step.op, [values[j] for j in step.sources]))
    return values
