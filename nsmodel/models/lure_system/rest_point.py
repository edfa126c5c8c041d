"""Assumption 7.1 of a Lur'e system: is x = 0, l = 0, y = 0 a rest point?"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED, Finding, Hypothesis, make_finding
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import Halfspaces, Intervals
from nsmodel.models.lure_system.domains import TAU_COLUMN, AffineTerm, ConvexPotential, Domains
from nsmodel.models.lure_system.model import LureSystem
from nsmodel.proof import conic, exact
from nsmodel.proof.convex.piecewise import exact_operation
from nsmodel.proof.expression_graph import fold_graph
from nsmodel.proof.interval_arithmetic import IntervalPair, excludes
from nsmodel.proof.interval_functions import OPERATIONS

FORCE_TIMES = 1001  # Times at which f is looked at: the report says how many; 0 at all of them proves nothing.


def rest_point_finding(hypothesis: Hypothesis, model: LureSystem, potential: ConvexPotential | None, origin: Finding) -> Finding:
    """Decide 7.1 from its four parts; ``origin`` is the finding about 0 ∈ X_0."""
    parts = [
        ("0 in X_0", origin.verdict, dict(origin.witness), origin.how),
        _check_zero_drift(model),
        _check_origin_on_graph(model, potential),
        _check_zero_force(model),
    ]
    size = {"|A(0)|": _size_at_zero(model.A, model.x), "sup |f|": _sampled_force_size(model)[0]}
    for verdict in (VIOLATED, UNKNOWN, SAMPLED):
        own = [part for part in parts if part[1] == verdict]
        if own:
            how = "; ".join(f"{name} {_VERDICT_PHRASES[verdict]}: {why.rstrip('.')}" for name, _, _, why in own) + "."
            witness = {key: item for _, _, more, _ in own for key, item in more.items()} | {
                "part": ", ".join(part[0] for part in own)
            }
            return make_finding(hypothesis, verdict, how, size, witness)
    return make_finding(hypothesis, HOLDS, "Exactly: 0 is admissible, A(0) = 0, 0 is on the graph of the law, and f = 0.", size)


_VERDICT_PHRASES = {VIOLATED: "fails", UNKNOWN: "is not decided", SAMPLED: "is seen, not proved"}
RestPointPart = tuple[str, str, dict, str]


def _size_at_zero(expr: ca.SX, symbols: ca.SX) -> float:
    return float(np.abs(np.array(ca.Function("at0", [symbols], [ca.densify(expr)])(0))).max(initial=0.0))


def _check_zero_drift(model: LureSystem) -> RestPointPart:
    """A(0) = 0, in rational arithmetic where A allows it."""
    name = "A(0) = 0"
    values = exact_values_at_zero(model.A)
    rate = np.array(ca.Function("A", [model.x], [ca.densify(model.A)])(0)).ravel()
    wrong = [i for i, value in enumerate(values) if value is not None and value != 0]
    if np.isnan(rate).any():
        return name, VIOLATED, {"A(0)": rate}, "A has no value at 0"
    if wrong or np.abs(rate).max(initial=0.0) > 1e-9 * _drift_scale(model):
        return name, VIOLATED, {"A(0)": rate}, f"A(0) = {', '.join(f'{entry:.4g}' for entry in rate[:6])}"
    if all(value is not None for value in values):
        return name, HOLDS, {}, ""
    if not rate.any():
        return name, SAMPLED, {}, "A(0) is 0 in floating point"
    return name, UNKNOWN, {}, f"A(0) is {np.abs(rate).max():.2g}, which may be rounding"


def _drift_scale(model: LureSystem) -> float:
    """Size of A at states of size 1: what A(0) is compared with."""
    values = np.array(ca.Function("A", [model.x], [ca.densify(model.A)])(np.ones(model.x.numel())))
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0)) or 1.0


class _ValueAtZero(NamedTuple):
    """A number where it is known to be rational, and bounds of it; None: it is not proved to have a value."""

    exact: Fraction | None
    bounds: IntervalPair | None


def exact_values_at_zero(expr: ca.SX) -> list[Fraction | None]:
    """The values of the entries where all symbols are 0; None where one is not rational, or not proved to be defined.

    0 times what has a value is 0; 0 times what may have none is not.

    >>> x = ca.SX.sym("x")
    >>> exact_values_at_zero(ca.vertcat(x * ca.sin(x + 1), x * (1 / x + 1)))
    [Fraction(0, 1), None]
    """
    with np.errstate(all="ignore"):
        found = fold_graph(expr, lambda _: _value_of(Fraction(0)), _constant_value, _operation_at_zero)
    return [value.exact for value in found]


def _value_of(number: Fraction) -> _ValueAtZero:
    return _ValueAtZero(number, (np.array([exact.round_down(number)]), np.array([exact.round_up(number)])))


def _constant_value(number: float) -> _ValueAtZero:
    return _value_of(Fraction(number)) if np.isfinite(number) else _ValueAtZero(None, None)


def _operation_at_zero(op: int, args: list[_ValueAtZero]) -> _ValueAtZero:
    known, bounds = [arg.exact for arg in args], [arg.bounds for arg in args if arg.bounds is not None]
    number = exact_operation(op, known)
    if number is not None:
        return _value_of(number)
    if op not in OPERATIONS or len(bounds) < len(args):
        return _ValueAtZero(None, None)
    if (op == ca.OP_MUL and Fraction(0) in known) or (op == ca.OP_DIV and known[0] == 0 and bool(excludes(bounds[1]).all())):
        return _value_of(Fraction(0))
    result, rule = OPERATIONS[op].bounds(*bounds), OPERATIONS[op].continuous
    defined = np.isfinite(result).all() and (rule is None or OPERATIONS[op].jumps or bool(np.all(rule(result, *bounds))))
    return _ValueAtZero(None, result if defined else None)


def _sampled_force_size(model: LureSystem) -> tuple[float, float]:
    """The largest |f_i| at sampled times, and where."""
    times = np.linspace(0, float(model.t_end or 1.0), FORCE_TIMES)
    f = ca.Function("f", [model.t], [ca.densify(model.f)])
    size = np.abs(np.array(f.map(FORCE_TIMES)(times[None, :]))).max(axis=0, initial=0.0)
    return float(size.max()), float(times[int(size.argmax())])


def _check_zero_force(model: LureSystem) -> RestPointPart:
    """Section 7 is about f = 0."""
    name = "f = 0"
    if model.f.is_zero() or bool(ca.simplify(ca.sparsify(model.f)).is_zero()):
        return name, HOLDS, {}, ""
    size, when = _sampled_force_size(model)
    if np.isnan(size):
        return name, VIOLATED, {"t": when}, "f is not a number there"
    if size > 0:
        return name, VIOLATED, {"t": when}, "Section 7 is about the autonomous system, without f"
    return name, SAMPLED, {}, f"f is 0 at {FORCE_TIMES} times"


# -- 0 ∈ (D + dXi)^{-1}(0): y = 0, l = 0 on the graph of the law ----------------------------------------------------------


def _check_origin_on_graph(model: LureSystem, potential: ConvexPotential | None) -> RestPointPart:
    name = "0 in (D + dXi)^-1(0)"
    if not model.e.is_zero() and (model.law is None or not model.e.is_constant()):
        return name, UNKNOWN, {}, "y has an offset e, which moves what y = 0 is"
    if model.law is not None:
        return name, *_check_zero_in_law(model.law, model.multiplier_names, np.array(ca.DM(model.e)).ravel())
    if potential is None:
        return name, UNKNOWN, {}, "phi is not proved to be convex"
    return name, *_check_stationary_potential(model, potential)


def _check_zero_in_law(law: Law, names: tuple[str, ...], e: np.ndarray) -> tuple[str, dict, str]:
    """0 ∈ K and -e ∈ N_K(0), by its rows."""
    for rows, block in law.parts():
        own, shape = names[rows], block.shape()
        if isinstance(shape, Intervals):
            for name, low, up in zip(own, *shape, strict=True):
                if not low <= 0 <= up:
                    return VIOLATED, {"multiplier": name, "lower": low, "upper": up}, f"0 is not in the interval of {name}"
            for name, low, up, y in zip(own, *shape, e[rows], strict=True):
                if (low < 0 and y > 0) or (up > 0 and y < 0):
                    return VIOLATED, {"multiplier": name, "e": y}, f"at x = 0, l = 0 the law does not let {name} have y = {y:g}"
        elif isinstance(shape, Halfspaces) and max(shape.K, default=0) > 0:
            row = int(np.argmax(shape.K))
            return VIOLATED, {"row": row, "K": shape.K[row]}, f"l = 0 breaks row {row} of the polyhedron of {', '.join(own)}"
        elif shape is None:
            return UNKNOWN, {}, f"the set of {', '.join(own)} ({block.label}) has no exact form"
        if not isinstance(shape, Intervals) and e[rows].any():
            return UNKNOWN, {}, f"whether y = e is normal to the set of {', '.join(own)} at 0 is not read off"
    return HOLDS, {}, ""


def _check_stationary_potential(model: LureSystem, p: ConvexPotential) -> tuple[str, dict, str]:
    """0 ∈ dPhi(0): the gradient of the smooth part at 0 is the sum of J'l' with l' in the terms' multipliers at u = c."""
    values = exact_values_at_zero(ca.gradient(model.phi_split.smooth, model.y))
    if p.unknown or model.phi_split.tau.numel() or any(value is None for value in values):
        return UNKNOWN, {}, "the subdifferential of phi at y = 0 is not read off"
    gradient = np.array(values, dtype=object).reshape(-1, 1)
    found_ = Domains(len(values), loose=np.zeros(len(values), bool))
    curved = False
    for term in p.terms:
        outside = (term.kind == "indicator" and min(term.c) < 0) or (term.kind == "equality" and term.c.any())
        if outside or (term.kind == "cone" and (term.c[0] < 0 or term.c[0] ** 2 < sum(entry**2 for entry in term.c[1:]))):
            return VIOLATED, {"u(0)": exact.doubles(term.c)}, "y = 0 is outside the domain of phi"
        curved = curved or not _add_closed_multipliers(found_, term)
    fixed = sum(
        (exact.matrix_product(matrix, np.ones((len(own), 1))) for own, matrix in found_.k if own == TAU_COLUMN),
        exact.zeros(len(values), 1),
    )
    if not (gradient - fixed).any() or (not gradient.any() and not any(term.c.any() for term in p.terms)):
        return HOLDS, {}, ""
    if curved:
        return UNKNOWN, {}, "the subdifferential of phi at y = 0 is not a polyhedron"
    system = found_.system([*found_.k, (TAU_COLUMN, -gradient)])
    if 0 in conic.implied_zeros(system):
        return VIOLATED, {"gradient": exact.doubles(gradient.ravel())}, "0 is not in dPhi(0)"
    return HOLDS, {}, ""


def _add_closed_multipliers(found_: Domains, term: AffineTerm) -> bool:
    """Add J'l' with l' in the closed set of multipliers at u = c; False where that set is curved (and nothing is added)."""
    w = Fraction(term.weight)
    if term.kind in ("norm", "cone"):
        inside = term.kind == "cone" and term.c[0] > 0 and term.c[0] ** 2 > sum(entry**2 for entry in term.c[1:])
        return bool(inside)
    for row, u in zip(term.J, term.c, strict=True):
        column = row.reshape(-1, 1)
        if term.kind in ("abs", "max"):
            low, high = -w, w if term.kind == "abs" else Fraction(0)
            if u == 0:
                found_.between(row, low, high - low)
            else:
                found_.k.append((TAU_COLUMN, (low if u > 0 else high) * column))
        elif term.kind == "equality" or u == 0:
            found_.k.append((found_.add(1, "positive" if term.kind == "indicator" else "free"), column))
    return True
