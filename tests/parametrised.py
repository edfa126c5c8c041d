"""Models with numbers of theirs made parameters: rates, pushes, ends of laws, masses, constraints, starts, by their classes."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, MonotoneInclusion, SweepingProcess
from nsmodel.modeling import laws

NAMES = ("rate", "push", "ends", "side", "begin")


def with_parameters(model: Any, **more: Any) -> Any:
    """The model with factors ``NAMES``, which are 1 at first: of x' without l, of l in x', of K, of y, of the start."""
    rate, push, ends, side, begin = symbols = [ca.SX.sym(name) for name in NAMES]
    given = {"t_end": model.t_end, "parameters": dict.fromkeys(symbols, 1.0), "switch_times": model.switch_times} | more
    match model:
        case FirstOrderSystem():
            return FirstOrderSystem(
                t=model.t, x=model.x, lam=model.lam, f=rate * model.f, g=push * model.g, h=side * model.h,
                M=rate * model.M,
                law=scaled(model.law, ends), x0=begin * model.x0, **given,
            )  # fmt: skip
        case LureSystem():
            D = side * model.D if model.D.numel() else None
            return LureSystem(
                t=model.t, x=model.x, A=rate * model.A, f=rate * model.f, B=push * model.B, C=side * model.C, D=D,
                law=scaled(model.law, ends), x0=begin * model.x0, **given,
            )  # fmt: skip
        case SweepingProcess():
            rows = {f"c{i}": side * row for i, row in enumerate(ca.vertsplit(model.g))}
            given["parameters"] = {symbol: 1.0 for symbol in (rate, side, begin)}
            return SweepingProcess(t=model.t, q=model.q, f=rate * model.f, constraints=rows, q0=begin * model.q0, **given)
        case FrictionOscillator():
            rubbed = {e.name: (e.H, ends * e.theta) for e in model.elements}
            given["parameters"] = {symbol: 1.0 for symbol in (rate, ends, begin)}
            return FrictionOscillator(
                x=model.x, potential=rate * model.potential, friction=rubbed, s=model.s, damping=model.damping,
                x0=begin * model.x0, v0=begin * model.v0, **given,
            )  # fmt: skip
        case MonotoneInclusion():
            given["parameters"] = {symbol: 1.0 for symbol in (rate, side)}
            field, signs = rate * model.field, ca.sign(model.sign_arguments)
            operator = ca.substitute(model.operator, model.sign_symbols, signs) if signs.numel() else model.operator
            return MonotoneInclusion(
                t=model.t, x=model.x, field=field, operator=operator,
                lower=finite(side, model.lower), upper=finite(side, model.upper), constraints=dict(model.constraints),
                x0=model.x0, scheme=model.scheme, **given,
            )  # fmt: skip
    raise TypeError(type(model).__name__)


def scaled(law: Any, factor: ca.SX) -> Any:
    """Boxes with all ends times a factor, infinite ones too."""
    return laws.box(factor * law.lower, factor * law.upper)


def finite(factor: ca.SX, ends: ca.SX) -> ca.SX:
    """The ends of C that are there times a factor."""
    return ca.vertcat(*(end if str(end) in ("inf", "-inf") else factor * end for end in ca.vertsplit(ends)))
