"""D psd (4.1) and P = P' > 0 with P B = C' (5.1) where parameters have no value: exact conditions on the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import casadi as ca
import numpy as np

from nsmodel.hypotheses.equations import to_sympy
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.models.lure_system.passivity import D_PSD_HYPOTHESIS, STORAGE_HYPOTHESIS
from nsmodel.proof.verdict import connected_components

if TYPE_CHECKING:
    import sympy as sp

MAX_SYMBOLIC_MINOR = 6  # Blocks of more rows are not written out as minors: 2^6 of them, and one of n rows has up to n! terms.


class _ParameterConditions(NamedTuple):
    """Expressions that must be 0, those that must be > 0 (or >= 0), and remarks."""

    zero: list[sp.Expr]
    positive: list[sp.Expr]
    strict: bool
    remark: str = ""


def symbolic_findings(model: LureSystem) -> list[Finding]:
    """Return 4.1 and 5.1 as conditions on the parameters that have no value; those with one take it.

    ``holds`` is for all values of the parameters; ``unknown`` carries the exact conditions on them; ``violated`` means that
    no values help.
    """
    values = list(model.parameters.values())
    named = [model.p[i] for i, value in enumerate(values) if value is not None]
    numbers = [ca.SX(value) for value in values if value is not None]
    B, C, D = (to_sympy(ca.substitute([matrix], named, numbers)[0]) for matrix in (model.B, model.C, model.D))
    return [
        _condition_finding(D_PSD_HYPOTHESIS, _psd_conditions(D), "D"),
        _condition_finding(STORAGE_HYPOTHESIS, _pairing_conditions(B, C), "C B"),
    ]


def _condition_finding(hypothesis: Hypothesis, conditions: _ParameterConditions | str, name: str) -> Finding:
    if isinstance(conditions, str):
        return make_finding(hypothesis, UNKNOWN, conditions)
    relation = "> 0" if conditions.strict else ">= 0"
    texts = [f"{expr} = 0" for expr in conditions.zero]
    texts += [f"{expr} {relation}" for expr in conditions.positive if not getattr(expr, _sign_property(conditions))]
    witness = {"conditions": texts}
    count = {"conditions": len(texts)}
    never = [expr for expr in conditions.zero if expr.is_zero is False]
    if never:
        text = f"for no values of the parameters: {never[0]} = 0 fails"
        return make_finding(hypothesis, VIOLATED, text + conditions.remark, count, witness)
    opposite = "is_nonpositive" if conditions.strict else "is_negative"
    bad = [expr for expr in conditions.positive if getattr(expr, opposite)]
    if bad:
        text = f"for no values of the parameters: {bad[0]} {relation} fails"
        return make_finding(hypothesis, VIOLATED, text + conditions.remark, count, witness)
    always = _sign_property(conditions)
    if not conditions.zero and all(getattr(expr, always) for expr in conditions.positive):
        how = "for all values of the parameters, by SymPy over the rationals"
        how += f": {conditions.remark}" if conditions.remark and not conditions.positive else ""
        return make_finding(hypothesis, HOLDS, how, count, witness)
    how = f"holds if and only if {' and '.join(texts)}{conditions.remark}"
    if not conditions.zero and all(getattr(_with_positive_parameters(expr), always) for expr in conditions.positive):
        symbols = sorted({str(symbol) for expr in conditions.positive for symbol in expr.free_symbols})
        return make_finding(hypothesis, UNKNOWN, f"{how}; so for all values > 0 of {', '.join(symbols)}", count, witness)
    solved, numbers = _solve_for_parameter(conditions)
    return make_finding(hypothesis, UNKNOWN, how + solved, {**count, **numbers}, witness)


def _sign_property(conditions: _ParameterConditions) -> str:
    """SymPy's name of the property that is wanted."""
    return "is_positive" if conditions.strict else "is_nonnegative"


def _with_positive_parameters(expr: sp.Expr) -> sp.Expr:
    """The expression with all its parameters > 0."""
    import sympy as sp

    put: Any = {symbol: sp.Symbol(str(symbol), positive=True) for symbol in expr.free_symbols}
    return cast("sp.Expr", sp.factor(expr.subs(put, simultaneous=True)))


def _psd_conditions(M: sp.Matrix) -> _ParameterConditions | str:
    """M psd: all principal minors of the blocks of its symmetric part >= 0."""
    positive = []
    for block in connected_components(_coupling_pattern(S := _simplify_matrix((M + M.T) / 2))):
        if len(block) > MAX_SYMBOLIC_MINOR:
            return f"a block of {len(block)} rows: its minors are not written out; give the parameters values"
        sets = [rows for size in range(1, len(block) + 1) for rows in combinations(block, size)]
        positive += [_factor_if_short(S.extract(list(rows), list(rows)).det()) for rows in sets]
    return _ParameterConditions([], _distinct_expressions(positive, keep_zero=False), False)


def _pairing_conditions(B: sp.Matrix, C: sp.Matrix) -> _ParameterConditions | str:
    """5.1 on columns of B that are independent for almost all parameters; the others' rows of C must follow."""
    if _simplify_matrix(C - B.T).is_zero_matrix:
        return _ParameterConditions([], [], True, "C = B': P = I")
    columns, echelon = list(B.rref(simplify=True)[1]), B.rref(simplify=True)[0]
    G = _simplify_matrix(C.extract(columns, list(range(C.cols))) * B.extract(list(range(B.rows)), columns))
    skew = G - G.T
    zero = [_factor_if_short(skew[i, j]) for i in range(G.rows) for j in range(i)]
    for j in sorted(set(range(B.cols)) - set(columns)):
        row = echelon[: len(columns), j].T * C.extract(columns, list(range(C.cols)))
        zero += [_factor_if_short(entry) for entry in (C.row(j) - row).flat()]
    positive = []
    for block in connected_components(_coupling_pattern(G)):
        if len(block) > MAX_SYMBOLIC_MINOR:
            return f"a block of {len(block)} rows of C B: its minors are not written out; give the parameters values"
        positive += [_factor_if_short(G.extract(block[:size], block[:size]).det()) for size in range(1, len(block) + 1)]
    remark = f" (where rank B = {len(columns)})" if B.free_symbols else ""
    return _ParameterConditions(
        _distinct_expressions(zero, keep_zero=False), _distinct_expressions(positive, keep_zero=True), True, remark
    )


def _simplify_matrix(M: sp.Matrix) -> sp.Matrix:
    return M.applyfunc(_factor_if_short)


def _factor_if_short(expr: Any) -> sp.Expr:
    """Factored where that is no longer, so that signs of factors can be read off."""
    import sympy as sp

    plain = cast("sp.Expr", sp.simplify(expr))
    factored = cast("sp.Expr", sp.factor(plain))
    return factored if sp.count_ops(factored) <= sp.count_ops(plain) + 2 else plain


def _distinct_expressions(expressions: Sequence[sp.Expr], *, keep_zero: bool) -> list[sp.Expr]:
    """Each expression once, without those that are 0."""
    kept: list[sp.Expr] = []
    for expr in expressions:
        if (keep_zero or expr != 0) and expr not in kept:
            kept.append(expr)
    return kept


def _coupling_pattern(S: sp.Matrix) -> np.ndarray:
    """Where S or S' is not 0."""
    pattern = np.array([[S[i, j] != 0 for j in range(S.cols)] for i in range(S.rows)], bool).reshape(S.shape)
    return pattern | pattern.T


def _solve_for_parameter(conditions: _ParameterConditions) -> tuple[str, dict[str, float]]:
    """The conditions solved for a parameter that enters linearly; of one other parameter, the extreme of that boundary."""
    import sympy as sp

    free: list[Any] = sorted({s for expr in conditions.positive for s in expr.free_symbols}, key=str)
    if conditions.zero or not conditions.positive or not 1 <= len(free) <= 2:
        return "", {}
    if len(free) == 1 and all(expr.is_rational_function(free[0]) for expr in conditions.positive):
        try:
            compare = sp.StrictGreaterThan if conditions.strict else sp.GreaterThan
            relation = [compare(expr, 0) for expr in conditions.positive]
            return f"; that is {sp.reduce_inequalities(relation, free[0])}", {}
        except (NotImplementedError, TypeError, ValueError):
            return "", {}
    if len(free) == 2 and len(conditions.positive) == 1:
        expr = conditions.positive[0]
        for symbol, other in (free, free[::-1]):
            if sp.degree(expr, symbol) == 1 if expr.is_polynomial(symbol) else False:
                boundary = _factor_if_short(sp.solve(expr, symbol)[0])
                return _boundary_extreme(symbol, other, boundary)
    return "", {}


def _boundary_extreme(symbol: sp.Symbol, other: sp.Symbol, boundary: sp.Expr) -> tuple[str, dict[str, float]]:
    """The boundary symbol = f(other), and its least absolute value: below that, the other parameter is free."""
    import sympy as sp
    from scipy.optimize import minimize_scalar

    f = sp.lambdify(other, boundary, "numpy")
    grid = np.linspace(-10, 10, 4001)
    with np.errstate(all="ignore"):
        values = np.abs(np.asarray(f(grid), float) + 0 * grid)
        values[~np.isfinite(values)] = np.inf
        least = np.flatnonzero(values <= values.min() * (1 + 1e-4))
        k = int(min(least, key=lambda i: (abs(grid[i]), -grid[i])))
        near: Any = minimize_scalar(
            lambda u: abs(float(f(u))), bounds=(grid[max(k - 1, 0)], grid[min(k + 1, 4000)]), method="bounded"
        )
    text = f"; the boundary is {symbol} = {boundary}"
    if not np.isfinite(near.fun) or near.fun <= 1e-9 or k in (0, 4000):
        return text, {}
    name = f"least |{symbol}| on the boundary"
    return f"{text}, where |{symbol}| >= {near.fun:.6g} (at {other} = {near.x:.6g})", {name: float(near.fun)}
