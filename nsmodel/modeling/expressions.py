"""Questions about CasADi expressions: what they hold, whether they are constant, affine or concave, their values.

Lookup tables: CasADi's linear interpolants of one variable written out, so that every part of the package can look into them.

table(x) = v_0 + s_0 (x - x_0) + sum_i (s_i - s_{i-1}) max(x - x_i, 0),     s_i the slope between x_i and x_{i+1}
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import EPS
from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.proof.expression_graph import (
    apply_operation,
    fold_graph,
    operation_codes,
    rewrite_nodes,
    stack_column,
    stored_entries,
    symbol_hashes,
)


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


def without_infinite_slopes(J: ca.SX, symbols: ca.SX) -> ca.SX:
    """Derivatives in which a root or a power of ``symbols`` that has no finite slope where its base is 0 adds nothing there.

    sqrt|s| has the slope sgn(s)/(2 sqrt|s|), and 0 at s = 0: the mean of those on both sides.
    """
    entries, left_out = stack_column(stored_entries(J)), []

    def rule(op: int, new: list[ca.SX], _: ca.SX) -> ca.SX | None:
        regular = _where_slope_is_finite(op, new)
        if regular is None:
            return None
        left_out.append(regular)
        return ca.SX.binary(ca.OP_IF_ELSE_ZERO, regular, apply_operation(op, new))

    codes = operation_codes(entries) if ca.depends_on(entries, symbols) else set()
    if ca.OP_CALL in codes or not codes & {*SINGULAR_OPERATIONS}:
        return J
    found = rewrite_nodes(entries, rule, SINGULAR_OPERATIONS, symbols, "the model")
    return ca.SX(J.sparsity(), found) if left_out else J


SINGULAR_OPERATIONS = (ca.OP_DIV, ca.OP_INV, ca.OP_POW, ca.OP_CONSTPOW)


def _where_slope_is_finite(op: int, args: list[ca.SX]) -> ca.SX | None:
    """What is 0 where a quotient by a root, or a power, is infinite; None where it is another operation, or never so."""
    last = args[-1]
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        if last.is_constant():
            return args[0] != 0 if float(last) < 0 else None
        return ca.logic_or(args[0] != 0, last >= 0)
    while not last.is_leaf() and last.op() == ca.OP_TWICE:
        last = last.dep(0)
    return last != 0 if not last.is_leaf() and last.op() == ca.OP_SQRT else None


def is_constant(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` does not change with z: read off, or else (y - y is not simplified) seen at sample points."""
    if not ca.depends_on(expr, z):
        return True
    values = evaluate_at_samples(expr, z, sample_points(z.numel(), 6))
    return bool(np.allclose(values, values[0], rtol=1e-9, atol=1e-12))


def is_affine(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` is affine in z."""
    return is_constant(ca.jacobian(expr, z), z)


def is_concave(expr: ca.SX, z: ca.SX) -> bool:
    """Whether ``expr`` is concave in z: read off where affine, else seen at sample points."""
    if is_affine(expr, z):
        return True
    n = z.numel()
    values = evaluate_at_samples(ca.hessian(expr, z)[0], z, sample_points(n, 32))
    spectra = np.linalg.eigvalsh(values[np.isfinite(values).all(axis=1)].reshape(-1, n, n))
    return bool((spectra <= 1e-9 * (1 + np.abs(spectra).max(initial=0))).all())


def sample_points(n: int, count: int) -> np.ndarray:
    """Return sample points (count, n) of sizes from 0.1 to 10."""
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, n)) * 10.0 ** rng.uniform(-1, 1, (count, 1))


def evaluate_at_samples(expr: ca.SX, z: ca.SX, samples: np.ndarray) -> np.ndarray:
    """Values (count, numel) of ``expr`` at samples (count, n) of z; each other symbol gets one number in (0.5, 2)."""
    own = symbol_hashes(z)
    others = stack_column(symbol for symbol in ca.symvar(expr) if symbol.element_hash() not in own)
    numbers = np.random.default_rng(0).uniform(0.5, 2, others.numel())
    function = ca.Function("values", [z, others], [ca.densify(ca.vec(expr))])
    return np.array(function(samples.T, numbers)).T


def check_finite(matrix: ca.SX, label: str, error: type[NsmodelError] = ModelError) -> None:
    """Refuse a constant entry that is not finite."""
    stored, symbols = stack_column(stored_entries(matrix)), stack_column(ca.symvar(matrix))
    values = np.array(ca.Function("values", [symbols], [stored])(np.full(symbols.numel(), 0.7))).ravel()
    where = np.column_stack(matrix.sparsity().get_triplet())
    for k in np.flatnonzero(~np.isfinite(values)):
        entry, (i, j) = stored[int(k)], where[k]
        if entry.is_constant():
            index = "" if matrix.numel() == 1 else f"[{i}]" if matrix.shape[1] == 1 else f"[{i}, {j}]"
            raise error(f"{label}{index} = {float(entry)}; expected a finite number")


def check_defined(expr: ca.SX, p: ca.SX, values: ca.DM, label: str) -> None:
    """Refuse an entry that is finite nowhere with these values of p, as a part of p alone is not finite: -x/k, x log(k) at k = 0.

    The numbers are put into the graph of the expression: CasADi makes 0 of inf - inf, and inf x is no constant.
    """
    if not ca.depends_on(expr, p):
        return
    own = symbol_hashes(p)
    others = stack_column(symbol for symbol in ca.symvar(expr) if symbol.element_hash() not in own)
    of = ca.Function("values", [p, others], [expr])
    if np.isfinite(of(values, np.full(others.numel(), 0.7)).nonzeros()).all():
        return
    finite = np.any([np.isfinite(of(values, point).nonzeros()) for point in sample_points(others.numel(), 12)], axis=0)
    stored = stored_entries(expr)
    where = np.column_stack(expr.sparsity().get_triplet())
    for k in np.flatnonzero(~finite):
        if _has_undefined_part(stored[int(k)], p, values):
            (i, j), text = where[k], str(stored[int(k)])
            index = "" if expr.numel() == 1 else f"[{i}]" if expr.shape[1] == 1 else f"[{i}, {j}]"
            raise UsageError(f"{label}{index} = {text:.60} is finite nowhere; expected a finite number")


def _has_undefined_part(entry: ca.SX, p: ca.SX, values: ca.DM) -> bool:
    """Whether a part of an entry that depends on p alone is not finite, or divides by 0."""
    known = {symbol.element_hash(): float(value) for symbol, value in zip(ca.vertsplit(p), ca.vertsplit(values), strict=True)}
    undefined: list[int] = []

    def apply(op: int, args: list[float | None]) -> float | None:
        if op == ca.OP_DIV and args[1] == 0:
            undefined.append(op)
        numbers = [ca.SX(arg) for arg in args if arg is not None]
        if op == ca.OP_CALL or len(numbers) < len(args):
            return None
        found = float(apply_operation(op, numbers))
        undefined.extend([] if np.isfinite(found) else [op])
        return found

    fold_graph(entry, lambda symbol: known.get(symbol.element_hash()), float, apply)
    return bool(undefined)


# Points of a table that is read off a CasADi interpolant: it becomes a sum of as many kinks; a longer one is left opaque.
MAX_TABLE_POINTS = 400
# Slopes that differ by less than this part of them are one: each is a quotient of two differences.
SAME_SLOPE_TOLERANCE = 8 * EPS


class InterpolationTable(NamedTuple):
    """Points (n,), increasing, and the values there (n,)."""

    points: np.ndarray
    values: np.ndarray


def expand_tables(expr: ca.SX) -> ca.SX:
    """Return the expression with each linear interpolant of one variable written out; others stay calls."""
    if not expr.numel() or ca.OP_CALL not in operation_codes(expr):
        return expr
    known: dict[int, ca.SX] = {}
    dense = ca.densify(expr)
    found = ca.SX(*dense.shape)
    for k in range(dense.numel()):
        found[k] = _rebuild_scalar(dense.nz[k], known)
    return found


def _rebuild_scalar(root: ca.SX, known: dict[int, ca.SX]) -> ca.SX:
    """A scalar with its tables written out, node by node."""
    work = [root]
    while work:
        node = work[-1]
        parts = _node_arguments(node)
        waiting = [part for part in parts if part.element_hash() not in known]
        if waiting:
            work += waiting
            continue
        work.pop()
        if node.element_hash() not in known:
            new = [known[part.element_hash()] for part in parts]
            known[node.element_hash()] = _rebuild_node(node, parts, new)
    return known[root.element_hash()]


def _node_arguments(node: ca.SX) -> list[ca.SX]:
    """What a node is made of; of the output of a call, the call's arguments."""
    if node.is_leaf():
        return []
    call = node.dep(0) if node.is_output() else node
    return [call.dep(k) for k in range(call.n_dep())]


def _rebuild_node(node: ca.SX, parts: list[ca.SX], new: list[ca.SX]) -> ca.SX:
    if node.is_leaf():
        return node
    if node.is_output():
        table = read_table(node.dep(0).which_function()) if len(parts) == 1 else None
        if table is not None:
            return table_expression(table, new[0])
        if all(ca.is_equal(a, b) for a, b in zip(parts, new, strict=True)):
            return node
        return node.dep(0).which_function()(*new) if len(parts) == 1 else node
    return node if all(ca.is_equal(a, b) for a, b in zip(parts, new, strict=True)) else apply_operation(node.op(), new)


def table_expression(table: InterpolationTable, x: ca.SX) -> ca.SX:
    """The table at x; the first and the last slope go on outside of it."""
    slopes = np.diff(table.values) / np.diff(table.points)
    total, slope = table.values[0] + slopes[0] * (x - table.points[0]), slopes[0]
    for point, after in zip(table.points[1:-1].tolist(), slopes[1:].tolist(), strict=True):
        if abs(after - slope) > SAME_SLOPE_TOLERANCE * (abs(after) + abs(slope)):
            total += (after - slope) * ca.fmax(x - point, 0)
            slope = after
    return total


def read_table(function: ca.Function) -> InterpolationTable | None:
    """The table behind a CasADi interpolant: read off its serialised form, and believed only where the function agrees.

    None where it is no linear interpolant of one variable with one value, or has more than MAX_TABLE_POINTS points.
    """
    if function.class_name() != "LinearInterpolant" or not function.n_in() == function.numel_in(0) == function.numel_out(0) == 1:
        return None
    text = function.serialize()
    data = bytes((ord(a) - ord("a")) | (ord(b) - ord("a")) << 4 for a, b in zip(text[::2], text[1::2], strict=False))
    for n in range(2, MAX_TABLE_POINTS + 1):
        head, between = struct.pack("<q", n), struct.pack("<4q", 2, 0, n, n)
        start = data.find(head)
        while start >= 0:
            middle = start + 8 + 8 * n
            if data[middle : middle + 32] == between:
                points, values = (np.array(struct.unpack_from(f"<{n}d", data, at)) for at in (start + 8, middle + 32))
                table = InterpolationTable(points, values)
                if _reproduces_table(function, table):
                    return table
            start = data.find(head, start + 1)
    return None


def _reproduces_table(function: ca.Function, table: InterpolationTable) -> bool:
    """Whether the function has the table's values at its points, between them and beyond."""
    points, values = table
    if not (np.isfinite(points).all() and np.isfinite(values).all() and (np.diff(points) > 0).all()):
        return False
    ends = np.array([2 * points[0] - points[1], 2 * points[-1] - points[-2]])
    at = np.concatenate([points, (points[1:] + points[:-1]) / 2, ends])
    beyond = [2 * values[0] - values[1], 2 * values[-1] - values[-2]]
    wanted = np.concatenate([values, (values[1:] + values[:-1]) / 2, beyond])
    given = np.array(function.map(at.size)(at[None, :])).ravel()
    steepest = float(np.abs(np.diff(values) / np.diff(points)).max())
    return bool((np.abs(given - wanted) <= 64 * EPS * (np.abs(values).max() + steepest * np.abs(at))).all())
