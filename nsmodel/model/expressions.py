"""Questions about CasADi expressions: what they hold, whether they are constant, affine or concave, their values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import casadi as ca
import numpy as np

T = TypeVar("T")


def column(items: Iterable[ca.SX]) -> ca.SX:
    """Stack the items; (0, 1) where there are none."""
    return ca.vertcat(ca.SX(0, 1), *items)


def derivatives(expr: ca.SX, symbols: ca.SX) -> ca.SX:
    """The Jacobian, its entries that are numbers as numbers.

    Others stay as differentiation gives them: collecting terms, as `casadi.simplify` does, makes a (q - c) into a q - a c, which
    cancels far from 0.
    """
    J = ca.jacobian(expr, symbols)
    if J.is_constant():
        return J
    simple = ca.simplify(J)
    for k in range(J.nnz()):
        if simple.nz[k].is_constant():
            J.nz[k] = simple.nz[k]
    return J


def constants(expr: ca.SX) -> np.ndarray:
    """Return the numbers in an expression."""
    function = ca.Function("constants", [column(ca.symvar(expr))], [expr])
    where = [i for i in range(function.n_instructions()) if function.instruction_id(i) == ca.OP_CONST]
    return np.array([function.instruction_constant(i) for i in where])


def operations(expr: ca.SX) -> set[int]:
    """Return the codes of the operations in an expression."""
    function = ca.Function("operations", [column(ca.symvar(expr))], [expr])
    return {function.instruction_id(i) for i in range(function.n_instructions())}


def fold(expr: ca.SX, symbol: Callable[[ca.SX], T], number: Callable[[float], T], apply: Callable[[int, list[T]], T]) -> list[T]:
    """Go through the graph of ``expr`` in another algebra; one result for each entry, column by column.

    Args:
        expr: SX of any shape.
        symbol, number: what a symbol and a constant become.
        apply: what an operation (its code) on results becomes. OP_CALL is the call of a Function that cannot be looked into.
    """
    symbols = ca.symvar(expr)
    function = ca.Function("fold", [column(symbols)], [ca.densify(ca.vec(expr))])
    work: dict[int, T] = {}
    results: dict[int, T] = {}
    for i in range(function.n_instructions()):
        op, source, target = function.instruction_id(i), function.instruction_input(i), function.instruction_output(i)
        if op == ca.OP_OUTPUT:
            results[target[1]] = work[source[0]]
        elif op == ca.OP_INPUT:
            work[target[0]] = symbol(symbols[source[1]])
        elif op == ca.OP_CONST:
            work[target[0]] = number(function.instruction_constant(i))
        else:
            work |= dict.fromkeys(target, apply(op, [work[j] for j in source]))
    return [results[i] for i in range(expr.numel())]


def applied(op: int, args: Sequence[ca.SX]) -> ca.SX:
    """Return the expression of an operation on one or two arguments.

    Raises:
        ValueError: the operation calls a Function (CasADi itself would give 0).
    """
    if op == ca.OP_CALL:
        raise ValueError("a call cannot be built from its code")
    return ca.SX.unary(op, *args) if len(args) == 1 else ca.SX.binary(op, *args)


def keys(expr: ca.SX) -> set[int]:
    """Return what tells the symbols in an expression apart."""
    return {symbol.element_hash() for symbol in ca.symvar(expr)}


def same(a: ca.SX, b: ca.SX) -> bool:
    """Whether two expressions are the same node for node."""
    return a.shape == b.shape and ca.is_equal(a, b, 20)


def is_constant(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` does not change with z: read off, or else (y - y is not simplified) seen at sample points."""
    if not ca.depends_on(expr, z):
        return True
    values = evaluate(expr, z, points(z.numel(), 6))
    return bool(np.allclose(values, values[0], rtol=1e-9, atol=1e-12))


def is_affine(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` is affine in z."""
    return is_constant(ca.jacobian(expr, z), z)


def is_concave(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` is concave in z: read off where affine, else seen at sample points."""
    if is_affine(expr, z):
        return True
    n = z.numel()
    values = evaluate(ca.hessian(expr, z)[0], z, points(n, 32))
    spectra = np.linalg.eigvalsh(values[np.isfinite(values).all(axis=1)].reshape(-1, n, n))
    return bool((spectra <= 1e-9 * (1 + np.abs(spectra).max(initial=0))).all())


def points(n: int, count: int) -> np.ndarray:
    """Return sample points (count, n) of sizes from 0.1 to 10."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, n)) * 10.0 ** rng.uniform(-1, 1, (count, 1))


def evaluate(expr: ca.SX, z: ca.SX, samples: np.ndarray) -> np.ndarray:
    """Values (count, numel) of ``expr`` at samples (count, n) of z; each other symbol gets one number in (0.5, 2)."""
    own = keys(z)
    others = column(symbol for symbol in ca.symvar(expr) if symbol.element_hash() not in own)
    numbers = np.random.default_rng(0).uniform(0.5, 2, others.numel())
    function = ca.Function("values", [z, others], [ca.densify(ca.vec(expr))])
    return np.array(function(samples.T, numbers)).T
