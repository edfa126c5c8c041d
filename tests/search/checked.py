"""Random models for the checker, of the kinds that users write; frozen: seeds and formulas do not change.

``draw("inclusion", 7)`` is always the same model: everything comes from ``default_rng([seed, number of the class])``, and numbers
are decimals of a few digits, so that no machine rounds them otherwise. A scene is drawn, then its arguments; where the class
refuses them (ModelError), scene and arguments are drawn again from the same stream, up to TRIES times.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import casadi as ca
import numpy as np

from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    FrictionOscillator,
    Items,
    LureSystem,
    ManyBodies,
    ModelError,
    MonotoneInclusion,
    SweepingProcess,
    ball,
    box,
    complementarity,
    polyhedron,
    product,
    relay,
    second_order_cone,
)
from nsmodel.modeling.base import Model
from nsmodel.modeling.laws import Law

Arguments = dict[str, Any]
TRIES = 50


class Numbers:
    """The random numbers of one model; ``named`` are those that became parameters."""

    def __init__(self, seed: int, kind: int) -> None:
        self.rng = np.random.default_rng([seed, kind])
        self.named: dict[ca.SX, float] = {}
        self.naming = False

    def chance(self, p: float = 0.5) -> bool:
        return bool(self.rng.random() < p)

    def one_of(self, *values: Any) -> Any:
        return values[int(self.rng.integers(len(values)))]

    def some(self, values: Sequence[Any], count: int) -> list[Any]:
        return [values[int(k)] for k in self.rng.permutation(len(values))[:count]]

    def by_weight(self, table: Mapping[Any, int]) -> Any:
        """A key of the table, as often as its weight says."""
        k = int(self.rng.integers(sum(table.values())))
        for key, weight in table.items():
            k -= weight
            if k < 0:
                return key
        raise AssertionError

    def count(self, low: int, high: int) -> int:
        return int(self.rng.integers(low, high + 1))

    def array(self, *shape: int) -> np.ndarray:
        """Coefficients of either sign: of two digits, or halves as papers like them."""
        raw = self.rng.normal(size=shape)
        return (np.round(2 * raw) / 2 if self.chance(0.4) else np.round(raw, 2)) + 0.0

    def vector(self, n: int) -> np.ndarray:
        """Coefficients, not all 0."""
        a = self.array(n)
        if not a.any():
            a[0] = 1.0
        return a

    def real(self) -> float:
        return float(self.array(1)[0])

    def between(self, low: float, high: float) -> float:
        return float(np.round(self.rng.uniform(low, high), 2))

    def positive(self, low: float = 0.2, high: float = 3.0) -> float:
        return self.one_of(1.0, 2.0, 0.5) if self.chance(0.3) else self.between(low, high)

    def weight(self, low: float = 0.2, high: float = 3.0) -> Any:
        """A positive number, in some models a parameter."""
        value = self.positive(low, high)
        if not (self.naming and self.chance()):
            return value
        symbol = ca.SX.sym(f"p{len(self.named)}")
        self.named[symbol] = value
        return symbol

    def sign(self, p: float = 0.5) -> float:
        return -1.0 if self.chance(p) else 1.0

    def unit(self) -> float:
        """1, in some models another unit of up to three decades."""
        return 1.0 if self.chance(0.8) else self.one_of(1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3)

    def psd(self, n: int) -> np.ndarray:
        """Positive definite with room, or R'R of small whole numbers, of any rank."""
        if self.chance(0.6):
            R = np.round(self.rng.normal(size=(n, n)), 1)
            return np.round(R.T @ R + self.one_of(0.1, 0.5, 1.0) * np.eye(n), 3)
        R = self.rng.integers(-2, 3, size=(self.count(0, n), n)).astype(float)
        return R.T @ R + 0.0

    def skew(self, n: int) -> np.ndarray:
        R = np.triu(self.array(n, n), 1)
        return R - R.T + 0.0

    def grid(self, unit: float = 1.0) -> Arguments:
        return {"step": self.one_of(1e-3, 1e-2, 0.1) * unit, "t_end": self.one_of(1.0, 2.0, 5.0) * unit}


def at(expression: ca.SX, symbols: Sequence[ca.SX], values: Sequence[Any]) -> float:
    """The value of an expression, for levels that are rounded afterwards."""
    return float(ca.Function("value", list(symbols), [expression])(*values))


def below(value: float, slack: float) -> float:
    """A level of two digits, below the value by the slack or a little more, but for rounding."""
    return float(np.floor(np.round(100 * (value - slack), 6)) / 100)


def vec(entries: Sequence[Any]) -> ca.SX:
    return ca.vertcat(*(ca.SX(entry) for entry in entries))


def affine(A: np.ndarray, x: ca.SX) -> ca.SX:
    return ca.mtimes(ca.DM(np.atleast_2d(A)), x)


# ---------------------------------------------------------------------------------------------- inclusions

CALM: Mapping[str, Callable[[ca.SX], ca.SX]] = {  # Growth at most linear.
    "linear": lambda z: z,
    "z/(1+z^2)": lambda z: z / (1 + z**2),
    "z^2/(1+z^2)": lambda z: z**2 / (1 + z**2),
    "z^3/(1+z^2)": lambda z: z**3 / (1 + z**2),
    "z/(1+|z|)": lambda z: z / (1 + ca.fabs(z)),
    "tanh": ca.tanh,
    "sin": ca.sin,
    "cos": ca.cos,
    "gauss": lambda z: ca.exp(-(z**2)),
    "z gauss": lambda z: z * ca.exp(-(z**2)),
    "tanh root": lambda z: ca.tanh(ca.sqrt(ca.fabs(z))),
    "root of 1+z^2": lambda z: ca.sqrt(1 + z**2),
    "log(1+z^2)": lambda z: ca.log(1 + z**2),
    "softplus": lambda z: ca.log(1 + ca.exp(z)),
    "atan": ca.atan,
    "logistic": lambda z: 1 / (1 + ca.exp(-z)),
    "ramp": lambda z: ca.fmax(z, 0),
    "saturation": lambda z: ca.fmin(ca.fmax(z, -1), 1),
    "dead zone": lambda z: z - ca.fmin(ca.fmax(z, -1), 1),
    "signed root": lambda z: ca.sign(z) * ca.sqrt(ca.fabs(z)),
    "root by cases": lambda z: ca.if_else(z > 0, ca.sqrt(ca.fmax(z, 0)), -ca.sqrt(ca.fmax(-z, 0))),
    "cube root": lambda z: ca.sign(z) * ca.fabs(z) ** (1 / 3),
    "z sin z": lambda z: z * ca.sin(z),
    "z tanh z": lambda z: z * ca.tanh(z),
    "z cos^2": lambda z: z * ca.cos(z) ** 2,
    "z logistic": lambda z: z / (1 + ca.exp(-z)),
}
STEEP: Mapping[str, Callable[[ca.SX], ca.SX]] = {  # Faster than linear.
    "cubic": lambda z: z**3,
    "z|z|": lambda z: z * ca.fabs(z),
    "sinh": ca.sinh,
    "z + z^5": lambda z: z + z**5,
    "z^3 - z": lambda z: z**3 - z,
    "z|z|^(1/2)": lambda z: z * ca.sqrt(ca.fabs(z)),
    "z log(1+z^2)": lambda z: z * ca.log(1 + z**2),
    "z exp(z^2/9)": lambda z: z * ca.exp(z**2 / 9),
    "exp - 1": lambda z: ca.exp(z) - 1,
    "cubic part": lambda z: ca.fmax(z, 0) ** 3 - ca.fmax(-z, 0),
    "square": lambda z: z**2,
}
JUMPING: Mapping[str, Callable[[ca.SX], ca.SX]] = {  # Increasing with jumps: an operator, or a field that jumps.
    "sign": ca.sign,
    "sgn(z)(1+|z|)": lambda z: ca.sign(z) * (1 + ca.fabs(z)),
    "sign and linear": lambda z: z + 2 * ca.sign(z),
    "staircase of signs": lambda z: ca.sign(z) + ca.sign(z - 1) + ca.sign(z + 1),
    "sgn(z)(1+z^2)": lambda z: ca.sign(z) * (1 + z**2),
    "sgn(z)|z|^(1/2)": lambda z: ca.sign(z) * ca.sqrt(ca.fabs(z)),
}
STAIRS: Mapping[str, Callable[[ca.SX], ca.SX]] = {
    "floor": ca.floor,
    "if_else": lambda z: ca.if_else(z > 0, 1 + z, -1),
    "rounded": lambda z: ca.floor(z + 0.5),
}


def _function(d: Numbers, steep: float = 0.28) -> Callable[[ca.SX], ca.SX]:
    table = STEEP if d.chance(steep) else CALM
    return table[d.one_of(*table)]


def field_affine(d: Numbers, x: ca.SX) -> ca.SX:
    n = x.numel()
    A = d.one_of(-d.psd(n), d.skew(n) - d.psd(n), d.skew(n) - np.eye(n), d.array(n, n))
    return affine(A, x) + ca.DM(d.array(n))


def field_separable(d: Numbers, x: ca.SX) -> ca.SX:
    """b - a phi(x) in each state, with or without a linear coupling."""
    n, phi = x.numel(), _function(d)
    couple = affine(d.skew(n) if d.chance(0.6) else d.array(n, n), x) if n > 1 and d.chance(0.7) else ca.SX.zeros(n)
    same = d.chance()
    terms = [d.sign(0.75) * d.weight() * (phi if same else _function(d))(x[i]) for i in range(n)]
    return vec(terms) + couple + ca.DM(d.array(n)) * d.one_of(0, 1)


def field_ridge(d: Numbers, x: ca.SX) -> ca.SX:
    """A linear field with one nonlinear feedback of a'x."""
    n = x.numel()
    a = d.vector(n)
    b = -a if d.chance(0.6) else d.array(n)
    return field_affine(d, x) + ca.DM(b) * d.weight() * _function(d)(affine(a[None], x))


def field_radial(d: Numbers, x: ca.SX) -> ca.SX:
    """A x with a factor of |x|: drag, gravity, normal forms."""
    n, square = x.numel(), ca.sumsqr(x)
    factor = d.one_of(
        square, ca.sqrt(square + 1), 1 / (1 + square), square - 1, 1 / (1 + ca.norm_2(x)), ca.norm_2(x), ca.tanh(square),
        square / (1 + square), ca.log(1 + square), ca.exp(-square), square**2,
    )  # fmt: skip
    turn = affine(d.skew(n), x) if n > 1 else 0
    return turn - d.sign(0.15) * d.weight() * factor * x - d.one_of(0, 0, 1) * d.weight() * x + ca.DM(d.array(n)) * d.one_of(0, 1)


def field_named(d: Numbers, x: ca.SX) -> ca.SX:
    """What has a name in the literature; the number of states decides."""
    a, b, c = d.weight(), d.weight(), d.weight()
    if x.numel() == 1:
        z = x[0]
        return d.one_of(
            a * z * (1 - z / 2), a - b * z - z**3, a * z - z**3, -a * z * ca.fabs(z), a - b * ca.sqrt(ca.fabs(z)) * ca.sign(z),
            a * z**2 / (1 + z**2) - b * z, a * (1 - ca.exp(z)) - b * z, -ca.sinh(z) + a, a * z / (1 + z) - z,
        )  # fmt: skip
    u, v = x[0], x[1]
    w = x[2] if x.numel() > 2 else ca.SX(0)
    rest = [a - c * x[i] - x[i] ** d.one_of(1, 3) + b * d.one_of(u, v, w, ca.tanh(u)) for i in range(2, x.numel())]
    if x.numel() == 3 and d.chance():
        return d.one_of(
            vec([a * (v - u), u * (b - w) - v, u * v - c * w]),
            vec([-a * u * v, a * u * v - b * v, b * v]),
            vec([-u + v * w, -a * v - u * w + b, -w]),
            vec([a - b * u * v, b * u * v - v - c * v * w, c * v * w - w]),
            vec([-v - w, u + 0.2 * v, 0.2 + w * (u - a)]),
        )
    pair = d.one_of(
        [v, a * (1 - u**2) * v - u],
        [v, -a * u - b * v - u**3],
        [a * u - u * v, u * v - b * v],
        [u - u**3 / 3 - v + c, 0.08 * (u + 0.7 - 0.8 * v)],
        [a - (b + 1) * u + u**2 * v, b * u - u**2 * v],
        [v, -ca.sin(u) - b * v],
        [u * (1 - u) - a * u * v / (1 + u), -b * v + u * v / (1 + u)],
        [-v + u * (1 - u**2 - v**2), u + v * (1 - u**2 - v**2)],
        [a / (1 + v**2) - u, b / (1 + u**2) - v],
        [v, -b * v * ca.fabs(v) - a * u],
        [-u + a * ca.tanh(v), -v - b * ca.tanh(u)],
        [a - u - 4 * u * v / (1 + u**2), b * (u - u * v / (1 + u**2))],
        [v, -c * u - b * ca.tanh(v) - a * v**3],
        [-(u**3) + v, -u - v**3],
        [-u * v**2, -v * u**2],
        [-(u**3) + 2 * u * v**2, -v - 2 * u**2 * v],
    )
    return vec([*pair, *rest])


def field_polynomial(d: Numbers, x: ca.SX) -> ca.SX:
    """Random polynomials of degree 2 or 3, half of them with a damping that dominates."""
    n, degree = x.numel(), d.count(2, 3)
    rows = []
    for _ in range(n):
        row = ca.SX(d.real())
        for _ in range(d.count(1, 4)):
            term = ca.SX(d.real())
            for _ in range(d.count(1, degree)):
                term = term * x[d.count(0, n - 1)]
            row += term
        rows.append(row)
    damping = d.weight(1, 5) * (x**3 if d.chance() else ca.sumsqr(x) * x) if d.chance() else 0
    return vec(rows) - damping


def field_rational(d: Numbers, x: ca.SX) -> ca.SX:
    """Reactions of Michaelis-Menten and Hill, and what saturates in several states."""
    n, rows = x.numel(), []
    for i in range(n):
        y = x[d.count(0, n - 1)]
        gain = d.one_of(
            y / (1 + ca.fabs(y)), y**2 / (1 + y**2), 1 / (1 + y**2), x[i] * y / (1 + x[i] ** 2), x[i] * y / (1 + ca.sumsqr(x)),
            y / ca.sqrt(1 + ca.sumsqr(x)), y**4 / (1 + y**4), x[i] / (1 + ca.fabs(x[i]) + ca.fabs(y)), y / (2 + ca.sin(y)),
            y * ca.exp(-ca.fabs(y)), x[i] ** 2 * y / (1 + x[i] ** 2),
        )  # fmt: skip
        rows.append(d.sign() * d.weight() * gain - d.one_of(0, 1, 1) * d.weight() * x[i] + d.real() * d.one_of(0, 1))
    return vec(rows)


def field_switched(d: Numbers, x: ca.SX) -> ca.SX:
    """Products with signs and cases, continuous or not; staircases."""
    n = x.numel()
    z = affine(d.vector(n)[None], x) if d.chance(0.4) else x[d.count(0, n - 1)]
    shape = {**JUMPING, **STAIRS}[d.one_of("sgn(z)|z|^(1/2)", "sgn(z)|z|^(1/2)", *JUMPING, *STAIRS)](z)
    return field_affine(d, x) - d.sign(0.2) * d.weight() * ca.DM(d.vector(n)) * shape


FIELDS = {
    field_affine: 20, field_separable: 20, field_ridge: 13, field_radial: 12, field_named: 15, field_polynomial: 7,
    field_rational: 7, field_switched: 6,
}  # fmt: skip


def _potential(d: Numbers, x: ca.SX) -> Any:
    """A convex potential: kinks with weights, quadratics, quartics."""
    n, out = x.numel(), ca.SX(0)
    for _ in range(d.count(1, 2)):
        z = affine(d.vector(n)[None], x) - d.real() * d.one_of(0, 1)
        i = d.count(0, n - 1)
        out += d.weight() * d.one_of(
            ca.fabs(x[i]), ca.fabs(x[i]), ca.fabs(x[i]), ca.fabs(z), ca.fabs(z), ca.fmax(z, 0), ca.fmax(x[i], 0),
            ca.sumsqr(x) / 2,
            ca.norm_2(x) if n > 1 else ca.fabs(x[0]), ca.norm_2(x) if n > 1 else ca.fabs(x[0] - 1),
            ca.bilin(ca.DM(d.psd(n)), x, x) / 2, ca.bilin(ca.DM(d.psd(n)), x, x) / 2, ca.sumsqr(x) / 2 + ca.fabs(x[i]),
            x[i] ** 4 / 4, z**4 / 4, ca.log(1 + ca.exp(z)), ca.sqrt(1 + ca.sumsqr(x)),
            ca.exp(z), ca.sumsqr(x) ** 2 / 4, ca.fmax(z, 0) ** 2 / 2, ca.cosh(x[i]), ca.sumsqr(x) / 2 - ca.cos(x[i]),
            x[i] ** 4 / 4 - x[i] ** 2 / 2 + ca.fabs(x[i]),
        )  # fmt: skip
    return out


def _operator(d: Numbers, x: ca.SX) -> Any:
    """S: linear, a sum of increasing functions, switches, or a law."""
    n = x.numel()
    kind = d.by_weight({"linear": 3, "increasing": 4, "ridge": 3, "jumps": 4, "switching": 3, "law": 2, "radial": 2})
    if kind == "linear":
        return affine(d.one_of(d.psd(n), d.psd(n) + d.skew(n), d.array(n, n)), x)
    if kind == "law":
        return d.one_of(relay(n, -1, 1), relay(n, -d.positive(), d.positive()), relay(n, 0, 1))
    increasing = [CALM["tanh"], CALM["atan"], CALM["signed root"], CALM["ramp"], STEEP["cubic"], STEEP["z|z|"], STEEP["sinh"],
                  CALM["z^3/(1+z^2)"], CALM["z/(1+|z|)"], STEEP["exp - 1"], STEEP["z|z|^(1/2)"], CALM["softplus"]]  # fmt: skip
    if kind == "radial":
        return d.weight() * x * d.one_of(ca.sumsqr(x), ca.norm_2(x), 1 / ca.sqrt(1 + ca.sumsqr(x)), 1 + ca.sumsqr(x))
    if kind in ("ridge", "switching"):
        a = d.vector(n)
        b = a if d.chance(0.7) else d.vector(n)
        shape = d.one_of(*increasing) if kind == "ridge" else JUMPING[d.one_of(*JUMPING)]
        return affine(d.psd(n), x) * d.one_of(0, 1) + ca.DM(b) * d.weight() * shape(affine(a[None], x) - d.one_of(0.0, 0.5))
    shapes = [d.one_of(*increasing) if kind == "increasing" else JUMPING[d.one_of(*JUMPING)] for _ in range(n)]
    return vec([d.weight() * shape(x[i]) for i, shape in enumerate(shapes)]) + affine(d.skew(n), x) * d.one_of(0, 0, 1)


SETS = {
    "none": 26, "box": 20, "orthant": 10, "half-plane": 7, "ball": 15, "ellipsoid": 6, "paraboloid": 4, "cone": 6, "exp": 2,
    "strip": 4, "upper": 4, "second-order cone": 2, "simplex": 2, "lens": 4, "root": 2, "box and plane": 2,
}  # fmt: skip


def _set(d: Numbers, x: ca.SX, x0: np.ndarray) -> Arguments:
    """C around the start."""
    n, kind = x.numel(), d.by_weight(SETS)
    a, room = d.vector(n), d.one_of(0.1, 0.5, 1.0, 3.0)
    plane = affine(a[None], x) - below(float(a @ x0), room)
    radius = float(np.ceil(np.abs(x0).sum())) + room
    if kind == "box":
        return {"lower": np.minimum(x0, 0) - room, "upper": np.maximum(x0, 0) + d.positive()}
    if kind == "orthant":
        return {"lower": np.zeros(n) if (x0 >= 0).all() else np.minimum(x0, 0) - room}
    if kind == "upper":
        return {"upper": np.where(np.arange(n) % 2 == 0, np.maximum(x0, 0) + room, np.inf)}
    if kind == "strip":
        return {"lower": np.where(np.arange(n) == 0, x0 - room, -np.inf), "upper": np.where(np.arange(n) == 0, x0 + room, np.inf)}
    rows = {
        "none": {},
        "half-plane": {"plane": plane},
        "ball": {"ball": radius**2 - ca.sumsqr(x)},
        "ellipsoid": {"ellipsoid": 4 * n * radius**2 - sum((i + 1) * x[i] ** 2 for i in range(n))},
        "paraboloid": {"bowl": x[n - 1] - below(float(x0[n - 1] - x0[0] ** 2), room) - x[0] ** 2 if n > 1 else radius - x[0]},
        "cone": {"cone_a": plane, "cone_b": affine(d.vector(n)[None], x) + 10.0},
        "exp": {"exp": x[n - 1] + 10.0 - ca.exp(x[0] - 2) if n > 1 else 10.0 - ca.exp(x[0])},
        "second-order cone": {"cone": x[0] + radius * 3 - ca.sqrt(1 + ca.sumsqr(x[1:])) if n > 1 else x[0] + radius},
        "simplex": {"sum": float(n) * radius - ca.sum1(x)},
        "lens": {"one": radius**2 - ca.sumsqr(x), "two": 4 * radius**2 - ca.sumsqr(x - radius / 2)},
        "root": {"root": x[n - 1] + radius + 1.0 - (x[0] ** 4 / 4 if n > 1 else 0.0)},
        "box and plane": {"plane": plane},
    }[kind]
    out: Arguments = {"constraints": rows} if rows else {}
    if kind in ("simplex", "box and plane"):
        out["lower"] = np.minimum(x0, 0) - room
    return out


def inclusion(d: Numbers) -> Arguments:
    n = d.by_weight({1: 27, 2: 40, 3: 23, 4: 10})
    x = ca.SX.sym("x", n)
    x0 = np.abs(d.array(n)) * d.one_of(0.5, 1.0) if d.chance() else d.array(n)
    if d.chance(0.4):
        x0[d.count(0, n - 1)] = 0.0
    field = d.by_weight(FIELDS)
    out: Arguments = {"x": x, "field": field(d, x), "x0": x0, **_set(d, x, x0), "title": field.__name__.removeprefix("field_")}
    other = d.by_weight({"none": 45, "phi": 28, "operator": 27})
    if other == "phi":
        out["phi"] = _potential(d, x)
    elif other == "operator":
        out["operator"] = _operator(d, x)
    u = d.unit()
    if u != 1:
        out["field"] = u * ca.substitute(out["field"], x, x / u)
        out["x0"] = u * x0
        for key in {"lower", "upper"} & set(out):
            out[key] = u * out[key]
        if "phi" in out:
            out["phi"] = u**2 * ca.substitute(out["phi"], x, x / u)
        if isinstance(out.get("operator"), ca.SX):
            out["operator"] = u * ca.substitute(out["operator"], x, x / u)
        if "constraints" in out:
            out["constraints"] = {name: ca.substitute(row, x, x / u) for name, row in out["constraints"].items()}
    return {**out, **d.grid()}


# ---------------------------------------------------------------------------------------------- oscillators


def friction_law(d: Numbers, s: ca.SX) -> ca.SX:
    """theta(s): dry, viscous, Hertz, Stribeck, smoothed, by cases; most of them convex and nondecreasing."""
    mu, c, v, s0 = d.weight(), d.weight(), d.weight(), d.positive(0.3, 2)
    kind = d.by_weight({"dry": 18, "polynomial": 17, "pieces": 17, "forms": 22, "Stribeck": 10, "sums": 16})
    if kind == "dry":
        return mu * s
    if kind == "polynomial":
        return d.one_of(
            mu * s + c * s**2 / 2, mu * s + c * s**3 / 3, mu * s + s**2 - 0.2 * s**3, s**3 - 3 * s**2 + (3 + mu) * s,
            mu * s + s**4 / 12 - s**3 / 6 + s**2 / 8, s**2 / 2, mu * s - 0.1 * s**2,
            mu * s + s**4 / 12 - s**3 / 6 + c * s**2 / 10,
            mu * s + c * s**2 / 2 + s**5, mu * s - 0.05 * s**2 + 0.01 * s**3,
        )  # fmt: skip
    late = ca.fmax(0, s - s0)
    if kind == "pieces":
        return d.one_of(
            mu * s + late**1.5, mu * s + c * late**2, mu * s + c * late**1.5, mu * s + c * late**3, mu * s + c * late,
            ca.if_else(s <= s0, s**2 / (2 * s0), s - s0 / 2), mu * s + ca.if_else(s <= s0, 0, c * (s - s0) ** 2),
            mu * ca.if_else(s < 1, s**2 / 2, s - 0.5) + c * s, ca.fmax(mu * s, c * s**2), ca.if_else(s < s0, mu * s, mu * s + c),
            mu * s + late * ca.log(1 + late), mu * s + c * ca.if_else(s <= s0, 0, (s - s0) ** 1.5), mu * ca.fmin(s, s0) + late**2,
        )  # fmt: skip
    if kind == "Stribeck":
        fall = c * v * (1 - ca.exp(-s / v))
        return d.one_of(
            mu * s + fall, mu * s + fall + s**2, mu * s + fall + (c / v) * s**2, mu * s + c * ca.atan(s / v),
            mu * s + c * ca.log(1 + s), mu * s + c * ca.log(1 + s) + c * s**2, mu * s + 2 * c * (ca.sqrt(1 + s) - 1),
            mu * s - 0.5 * ca.log(1 + s**2) + s**2, mu * s + s**2 / 2 + ca.cos(s), (mu + 1) * s + ca.sin(s) + s**2 / 2,
        )  # fmt: skip
    form = d.one_of(
        s * ca.log(1 + s), (1 + s) * ca.log(1 + s) - s, ca.log(ca.cosh(s)), ca.exp(s / v) - 1, ca.sqrt(s**2 + 0.01) - 0.1,
        s * ca.atan(s) - ca.log(1 + s**2) / 2, ca.sqrt(1 + s**2), s**2 / (1 + s), v * (ca.exp(-s / v) - 1) + s, s**1.5,
        ca.sinh(s),
        s * ca.tanh(s), ca.log(1 + ca.exp(s)), s * ca.sqrt(1 + s**2), s - ca.log(1 + s), s**2 / ca.sqrt(1 + s**2), s**1.25,
        s * ca.exp(s / 4), s**2 / (1 + s**2), ca.sqrt(s**3 + s**4), ca.log(1 + s + s**2) + s**2, (1 + s**3) ** (1 / 3),
    )  # fmt: skip
    if kind == "forms":
        return c * form + d.one_of(0, 1, 1) * mu * s
    return mu * s + c * form + d.one_of(s**2 / 2, late**1.5, late**2, s**3 / 3, 0.1 * ca.sin(s) + s**2, ca.exp(s) - s - 1)


def _bowl(d: Numbers, x: ca.SX, kind: str) -> ca.SX:
    """A potential of one of the kinds of textbooks."""
    n, k = x.numel(), d.weight()
    i = d.count(0, n - 1)
    j = (i + 1) % n
    u, v = x[i], x[j]
    z = affine(d.vector(n)[None], x)
    quadratic = ca.bilin(ca.DM(d.psd(n)), x, x) / 2
    if kind == "quadratic":
        R = d.array(n, n)
        return d.one_of(quadratic, quadratic, k * ca.sumsqr(x) / 2, ca.bilin(ca.DM(R + R.T), x, x) / 2)
    if kind == "quartic":
        a, b = d.one_of(1.0, 2.0), d.one_of(1.0, -1.0, 0.5)
        expanded = u**4 + 4 * b * u**3 * v + 6 * b**2 * u**2 * v**2 + 4 * b**3 * u * v**3 + b**4 * v**4
        return d.one_of(
            k * ca.sumsqr(x) / 2 + u**4 / 4, expanded + a * u**2, expanded + v**2 + u**4, u**4 + v**4 + a * u**2 * v**2,
            u**4 + v**4 + 6 * a * u**2 * v**2, z**4 / 4 + quadratic, ca.sumsqr(x) ** 2 / 4, (u - v) ** 4 + (u + v) ** 2,
            u**4 - u**3 + u**2 + v**2, (ca.sumsqr(x) + 1) ** 2, expanded, u**4 + v**4 + u**2 + u * v + v**2,
            (u**2 + u * v + v**2) ** 2 + u**2, u**4 / 4 + v**4 / 4 - u * v, u**4 + u**2 * v**2 + v**4 + 2 * u * v + u**2 + v**2,
            (u - v**2) ** 2 + u**2 + 3 * v**2,
        )  # fmt: skip
    if kind == "smooth":
        return d.one_of(
            ca.log(ca.exp(u) + ca.exp(v) + ca.exp(-u - v)) + quadratic, ca.log(ca.exp(z) + ca.exp(-z)) + k * ca.sumsqr(x) / 2,
            ca.sqrt(1 + ca.sumsqr(x)), ca.log(ca.cosh(z)) + quadratic, k * ca.sumsqr(x) - 0.5 * ca.cos(z), ca.cosh(u) + v**2,
            ca.exp(u) + ca.exp(-v) + quadratic, ca.exp(z) - z + ca.sumsqr(x), k * ca.sumsqr(x) / 2 + ca.log(1 + z**2) / 4,
            ca.sqrt(1 + u**2) + ca.sqrt(1 + (u - v) ** 2) + v**2, ca.log(1 + ca.exp(u) + ca.exp(v)) - u / 3 + v**2,
            ca.exp(ca.sumsqr(x) / 4), ca.sumsqr(x) * ca.log(1 + ca.sumsqr(x)), ca.sumsqr(x) + ca.sin(u) * ca.sin(v) / 2,
            ca.sumsqr(x) / (1 + ca.sqrt(1 + ca.sumsqr(x))), (ca.sqrt(1 + ca.sumsqr(x)) - 1) ** 2 + quadratic,
        )  # fmt: skip
    if kind == "kinks":
        return quadratic + d.one_of(
            k * ca.fabs(u), k * ca.fabs(u - v) if n > 1 else k * ca.fabs(u - 1), k * ca.norm_2(x) if n > 1 else ca.fabs(u),
            ca.fmax(z - 1, 0) ** 2, ca.fmax(z, 0), ca.fmax(u - 0.5, 0) ** 2.5, ca.fmax(ca.fabs(u) - 1, 0), ca.fmax(u, v),
            u**4 + k * ca.fabs(z), ca.fabs(u) ** 1.5, ca.fabs(z) ** 3, ca.fmax(u, 0) ** 1.5, ca.fmax(u**2, v**2),
        )  # fmt: skip
    if kind == "wells":
        return d.one_of(
            (u**2 - 1) ** 2 / 4 + v**2 / 2, k * (1 - ca.cos(u)) + quadratic, k * (1 - ca.cos(u)) + v**2 / 2,
            (1 - ca.exp(-u)) ** 2 + v**2, u**4 / 4 - k * u**2 / 2 + ca.sumsqr(x), u**2 / 2 - ca.exp(-(u**2)) + v**2,
            ca.sumsqr(x) / 2 + ca.cos(u) / 2, ca.sumsqr(x) / 2 + k * ca.cos(z), u**2 * v**2 + ca.sumsqr(x), u**3 + ca.sumsqr(x),
            u**2 / (1 + u**2) + v**2, ca.log(1 + u**2) + v**2, u**2 * v**2 + u**2 + v**2 + u**4 + v**4, u * v + u**4 + v**4,
        )  # fmt: skip
    return 9.81 * x[n - 1] + (k * ca.sumsqr(x[: n - 1]) / 2 if n > 1 else 0)


def oscillator(d: Numbers) -> Arguments:
    n = d.by_weight({1: 30, 2: 45, 3: 20, 4: 5})
    x, s = ca.SX.sym("x", n), ca.SX.sym("s")
    x0 = d.array(n)
    if n == 1 and d.chance(0.6):
        x0 = np.zeros(1)
    kind = d.by_weight({"quadratic": 22, "quartic": 22, "smooth": 20, "kinks": 14, "wells": 16, "weight": 6})
    g = _bowl(d, x, kind)
    friction: Any = friction_law(d, s)
    if d.chance(0.35):
        count = d.count(1, 2 if n == 1 else 3)
        friction = {
            f"e{i}": (d.one_of(np.eye(n), np.eye(n)[[i % n]], d.vector(n)[None]), friction_law(d, s)) for i in range(count)
        }
    out: Arguments = {"x": x, "s": s, "potential": g, "friction": friction, "x0": x0, "title": kind}
    if d.chance(0.6):
        out["v0"] = d.array(n)
    if d.chance(0.2):
        out["damping"] = d.one_of(d.psd(n), d.psd(n) + d.skew(n), d.array(n, n), d.psd(n))
    if d.chance(0.25):
        a = d.vector(n)
        r = float(np.ceil(np.abs(x0).sum())) + 1
        out["constraints"] = d.one_of(
            {"floor": x[n - 1] - below(float(x0[n - 1]), 0.5)}, {"wall": affine(a[None], x) - below(float(a @ x0), 0.2)},
            {"ball": r**2 - ca.sumsqr(x)}, {"low": x[0] + r, "high": r - x[0]}, {"bowl": x[n - 1] + r**2 + 1 - x[0] ** 2},
            {"rope": r - ca.sqrt(0.01 + ca.sumsqr(x))},
        )  # fmt: skip
    u = d.unit()
    if u != 1:
        out["potential"] = u**2 * ca.substitute(g, x, x / u)
        out["x0"] = u * x0
        if "v0" in out:
            out["v0"] = u * out["v0"]
        if "constraints" in out:
            out["constraints"] = {name: u * ca.substitute(row, x, x / u) for name, row in out["constraints"].items()}
    return {**out, **d.grid()}


# ---------------------------------------------------------------------------------------------- first order


def _mlcp(d: Numbers, m: int, kind: str) -> np.ndarray:
    """A matrix of whole numbers and halves: psd (also singular), a P-matrix that is not psd, or neither."""
    if kind == "psd":
        return d.psd(m) + d.skew(m) * d.one_of(0, 1)
    if kind == "P":
        return np.diag([d.positive(0.5, 2) for _ in range(m)]) + np.triu(4 * d.array(m, m), 1) + 0.0
    return d.array(m, m)


def first_order(d: Numbers) -> Arguments:
    kind = d.by_weight({"linear": 53, "varying": 8, "nonlinear": 7, "bilinear": 3, "kinks": 3, "curved": 22, "smooth": 4})
    m = d.by_weight({1: 30, 2: 38, 3: 20, 4: 12})
    n = max(1, m + d.one_of(-2, -1, -1, 0, 0, 1))
    x, t, h = ca.SX.sym("x", n), ca.SX.sym("t"), d.one_of(1e-3, 1e-2, 0.1)
    if kind == "smooth":
        f = d.by_weight({field_affine: 2, field_separable: 3, field_named: 3, field_rational: 2, field_switched: 1})(d, x)
        return {"x": x, "f": f, "x0": d.array(n), "step": h, "t_end": 1.0, "title": kind}
    if kind == "curved" and m == 1:
        m, n = 2, 2
        x = ca.SX.sym("x", n)
    lam = ca.SX.sym("l", m)
    what = d.by_weight({"psd": 64, "P": 20, "neither": 16})
    A = d.one_of(-d.psd(n), d.skew(n) - np.eye(n), d.array(n, n), np.zeros((n, n)))
    f = affine(A, x) + ca.DM(d.array(n)) * d.one_of(0, 1)
    if d.chance(0.3):
        f = f + ca.DM(d.array(n)) * d.one_of(ca.sin(t), ca.cos(2 * t), 1 / (1 + t))
    D = _mlcp(d, m, what)
    B = d.array(n, m)
    C = B.T if what == "psd" or d.chance(0.4) else d.array(m, n)
    if d.chance(0.45):  # relays without feedthrough: W_mlcp is h C B
        D = np.zeros((m, m))
    if kind == "linear" and d.chance(0.15) and n == m:  # a P-matrix by C = I
        B, C, D = D + _mlcp(d, m, what), np.eye(n), np.zeros((m, m))
    y, r = affine(C, x) + affine(D, lam) + ca.DM(d.array(m)) * d.one_of(0, 1), affine(B, lam)
    ends = d.by_weight({"relay": 30, "complementarity": 38, "box": 18, "half": 14})
    law = {
        "relay": d.one_of(relay(m), relay(m, 0, 1), relay(m, -d.positive(), d.positive())),
        "complementarity": complementarity(m),
        "box": box(-np.round(d.rng.uniform(0, 2, m), 1), np.round(d.rng.uniform(0.1, 3, m), 1)),
        "half": box(np.where(np.arange(m) % 2 == 0, 0.0, -1.0), np.where(np.arange(m) % 2 == 0, np.inf, 1.0)),
    }[ends]
    z, w = x[d.count(0, n - 1)], x[d.count(0, n - 1)]
    k = d.count(0, m - 1)
    i = d.count(0, n - 1)
    if kind == "varying":
        factor = d.one_of(
            1 + z**2, 2 + ca.sin(t), 1 + 0.1 * z, ca.exp(z), 1 / (1 + z**2), 2 + ca.cos(z), 2 + ca.tanh(z), z, 1 + ca.sumsqr(x),
            t,
            1 + 0.2 * ca.sin(t),
        )  # fmt: skip
        where = d.one_of("B", "D", "both", "C", "D of one", "PB = C'")
        if where in ("B", "both"):
            r = factor * r
        if where in ("D", "both"):
            y = affine(C, x) + factor * affine(D, lam)
        if where == "C":
            y = factor * affine(C, x) + affine(D, lam)
        if where == "D of one":
            y[k] += factor * lam[k]
        if where == "PB = C'":
            potential = ca.sumsqr(x) / 2 + z**2 * w**2 / 4
            r, y = affine(C.T, lam), affine(C, ca.gradient(potential, x)) + affine(D, lam)
    elif kind == "nonlinear":
        bend = d.one_of(
            z**2, z**3, ca.sin(z), ca.tanh(z), z * w, ca.exp(z) - 1, ca.sqrt(1 + z**2), ca.log(1 + z**2), z / (1 + z**2)
        )
        where = d.by_weight({"f": 3, "h": 3, "both": 2, "device": 3})
        if where in ("f", "both"):
            f[i] += d.real() * bend
        if where in ("h", "both"):
            y[k] += d.real() * bend
        if where == "device":
            l = lam[k]
            y[k] += d.weight() * d.one_of(l**3, ca.tanh(l), l * ca.fabs(l), ca.exp(l) - 1, l + ca.sin(l), ca.sqrt(1 + l**2), l**2)
    elif kind == "bilinear" and m > 1:
        r[i] += d.real() * lam[0] * lam[1]
        if d.chance(0.4):
            r[0] += d.weight() * lam[0] * (1 - lam[m - 1])
        law = d.one_of(relay(m), relay(m, 0, 1))
    elif kind == "kinks":
        bend = d.one_of(
            ca.fabs(z), ca.fmax(z, 0), ca.fmin(z, w), ca.if_else(z > 0, z, 2 * z), ca.sign(z), ca.if_else(z > 0, 1, -1)
        )
        if d.chance():
            f[i] += d.real() * bend
        else:
            y[k] += d.real() * bend
    elif kind == "curved":
        H = np.vstack([np.eye(m), -np.ones((1, m))])
        law = d.one_of(ball(m), ball(m, d.positive()), second_order_cone(m), polyhedron(H, [0.0] * m + [-1.0]))
        if m > 2 and d.chance():
            law = product(relay(m - 2), ball(2, d.positive()))
        if d.chance(0.3):
            r = (1 + z**2) * r
    out: Arguments = {
        "t": t, "x": x, "lam": lam, "f": f, "h": y, "g": r, "law": law, "x0": d.array(n), "step": h, "t_end": 1.0,
        "title": f"{kind}, {what}",
    }  # fmt: skip
    if d.chance(0.2):
        out |= {"theta": 0.5, "gamma": d.one_of(1.0, 0.5)}
    if d.chance(0.25):
        out["M"] = np.diag([d.positive(0.5, 3) for _ in range(n)])
    u = d.unit()
    if u != 1:  # multipliers and forces in another unit
        out["h"] = ca.substitute(out["h"], lam, lam / u)
        out["g"] = ca.substitute(out["g"], lam, lam / u)
        if all(block.kind == "box" for block in law.blocks):
            out["law"] = box(u * np.array(ca.DM(law.lower)).ravel(), u * np.array(ca.DM(law.upper)).ravel())
    return out


# ---------------------------------------------------------------------------------------------- Lur'e


def _forcing(d: Numbers, t: ca.SX) -> ca.SX:
    return d.one_of(
        ca.sin(t), ca.cos(2 * t), 1 + ca.sin(t), ca.exp(-t), t, ca.sin(t) ** 2, 1 / (1 + t), ca.sqrt(1 + t), ca.sqrt(t),
        ca.sign(ca.sin(t)), ca.fabs(ca.sin(t)), ca.if_else(t < 1, 1, 0), ca.fmin(t, 1), ca.sin(t**2), ca.SX(1.0), ca.log(1 + t),
    )  # fmt: skip


def _nonlinear(d: Numbers, x: ca.SX) -> ca.SX:
    n = x.numel()
    j = d.count(0, n - 1)
    z = x[j]
    shape = d.one_of(
        z**3, ca.tanh(z), ca.sin(z), z * ca.fabs(z), z / (1 + z**2), ca.fabs(z), z**2, ca.sinh(z), ca.fmax(z, 0), ca.sign(z),
        ca.atan(z), z * ca.exp(-(z**2)),
    )  # fmt: skip
    k = j if d.chance(0.6) else d.count(0, n - 1)
    return vec([-d.sign(0.15) * d.weight() * shape if i == k else 0 for i in range(n)])


def _lure_law(d: Numbers, m: int) -> Arguments:
    kind = d.by_weight({"relay": 30, "complementarity": 30, "box": 8, "curved": 12, "product": 6, "phi": 14})
    if kind == "relay":
        return {"law": d.one_of(relay(m), relay(m), relay(m, -d.positive(), d.positive()), relay(m, 0, 1))}
    if kind == "complementarity":
        return {"law": complementarity(m)}
    if kind == "box":
        even = np.arange(m) % 2 == 0
        return {
            "law": d.one_of(box(np.where(even, 0.0, -1.0), np.where(even, np.inf, 1.0)), box(-np.ones(m), np.full(m, np.inf)))
        }
    if kind == "curved":
        H = np.vstack([np.eye(m), -np.ones((1, m))])
        return {
            "law": d.one_of(
                ball(m, d.positive()), second_order_cone(m), polyhedron(H, [0.0] * m + [-1.0]), polyhedron(H[:m], [0.0] * m)
            )
        }
    if kind == "product":
        return {"law": complementarity(1) if m == 1 else product(relay(1), complementarity(m - 1)) if m == 2 or d.chance() else
                product(complementarity(m - 2), d.one_of(ball(2), second_order_cone(2)))}  # fmt: skip
    y = ca.SX.sym("y", m)
    a = d.weight()
    phi = d.one_of(
        a * sum(ca.fabs(y[i]) for i in range(m)), a * (ca.norm_2(y) if m > 1 else ca.fabs(y[0])),
        a * ca.sumsqr(y) / 2 + ca.fabs(y[0]),
        a * ca.fmax(y[0], 0) + ca.sumsqr(y), ca.if_else(y[0] >= 0, ca.sumsqr(y) / 2, ca.inf), a * ca.sumsqr(y) / 2 + y[0] ** 4,
        ca.log(ca.cosh(y[0])) + ca.sumsqr(y), sum(ca.fmax(y[i], -2 * y[i]) for i in range(m)),
        ca.fmax(ca.fabs(y[0]) - 1, 0) + ca.sumsqr(y[1:]),
        ca.sqrt(1 + ca.sumsqr(y)),
    )  # fmt: skip
    return {"phi": phi, "y": y}


def lure(d: Numbers) -> Arguments:
    kind = d.by_weight({"mechanical": 24, "circuit": 18, "planted": 20, "random": 20, "contact": 8, "control": 10})
    m = d.by_weight({1: 45, 2: 35, 3: 20})
    D: Any = None
    if kind == "mechanical":
        dof = m
        mass = [d.weight(0.5, 4) for _ in range(dof)]
        K, R, H = d.psd(dof), d.psd(dof) * d.one_of(0, 0, 1), np.eye(dof) if d.chance(0.6) else d.array(m, dof)
        n = 2 * dof
        A, B, C = ca.SX.zeros(n, n), ca.SX.zeros(n, m), ca.SX.zeros(m, n)
        A[:dof, dof:] = ca.SX.eye(dof)
        for i in range(dof):
            A[dof + i, :dof] = -ca.DM(K[i])[:].T / mass[i]
            A[dof + i, dof:] = -ca.DM(R[i])[:].T / mass[i]
            B[dof + i, :] = ca.DM(H.T[i])[:].T / mass[i]
        C[:, dof:] = ca.DM(H)
    elif kind == "circuit":
        n = m + d.count(0, 2)
        exact = d.chance(0.6)
        P = [d.one_of(1.0, 2.0, 0.5, 4.0) if exact else d.one_of(1e-3, 1e-6, d.positive(0.5, 3)) for _ in range(n)]
        R, J, C = d.psd(n), d.skew(n), d.array(m, n)
        A = ca.diag(1 / ca.DM(P)) @ ca.DM(J - R)
        B = ca.diag(1 / ca.DM(P)) @ ca.DM(C.T)
        D = d.one_of(None, d.psd(m), d.psd(m) + d.skew(m), d.skew(m))
    elif kind == "planted":
        n = m + d.count(0, 2)
        R, S = (d.rng.integers(-2, 3, size=shape).astype(float) for shape in ((n, n), (n, m)))
        P, B = R.T @ R + np.eye(n), S / 2 + 0.0
        A, C = d.one_of(d.array(n, n), -d.psd(n), d.skew(n) - np.eye(n)), B.T @ P
        D = d.one_of(None, None, d.psd(m), d.skew(m))
    elif kind == "random":
        n = d.count(1, 4)
        A, B, C = d.one_of(d.array(n, n), -d.psd(n), d.skew(n)), d.array(n, m), d.array(m, n)
        if d.chance(0.5):
            C = B.T
        D = d.one_of(None, d.psd(m), d.array(m, m), d.skew(m))
    elif kind == "contact":
        m = min(m, 2)
        n = 2 * m
        Z, I = np.zeros((m, m)), np.eye(m)
        A, B, C = (
            np.block([[Z, I], [-d.psd(m), -d.psd(m) * d.one_of(0, 1)]]),
            np.vstack([Z, I]),
            np.hstack([I, d.one_of(Z, Z, I)]),
        )
    else:
        m, n = 1, d.count(2, 3)
        c = np.abs(d.vector(n))
        c[-1] = d.one_of(0.0, 1.0, 1.0, 2.0)
        A, B, C = np.eye(n, k=1), np.eye(n)[:, -1:], c[None]
        A[-1] = -np.abs(d.array(n))
    x, t = ca.SX.sym("x", n), ca.SX.sym("t")
    A = ca.mtimes(ca.SX(ca.DM(A)) if not isinstance(A, ca.SX) else A, x)
    title = kind
    if d.chance(0.3):
        A, title = A + _nonlinear(d, x), f"{kind}, nonlinear"
    out: Arguments = {
        "t": t, "x": x, "A": A, "B": B, "C": C, "x0": np.zeros(n) if d.chance(0.15) else d.array(n), **_lure_law(d, m),
        **d.grid(),
        "title": title,
    }  # fmt: skip
    if D is not None:
        out["D"] = D
    if d.chance(0.45):
        out["f"] = ca.DM(d.vector(n)) * _forcing(d, t)
    if d.chance(0.2):
        out["theta"] = 0.5
    return out


# ---------------------------------------------------------------------------------------------- sweeping processes


def _motion(d: Numbers, t: ca.SX) -> ca.SX:
    """How far something has moved; 0 at the start."""
    v = d.between(-1, 1)
    return d.one_of(
        v * t, v * ca.sin(t), v * (1 - ca.cos(t)), v * ca.sin(2 * t), v * t**2 / 2, v * (ca.sqrt(1 + t) - 1), v * t / (1 + t),
        v * (1 - ca.exp(-t)), v * ca.sqrt(t), v * ca.fmax(t - 0.5, 0), v * ca.fabs(ca.sin(3 * t)), v * ca.fmin(t, 0.5),
        v * ca.atan(t),
    )  # fmt: skip


def _moves(d: Numbers, t: ca.SX, p: float = 0.3) -> Any:
    return _motion(d, t) if d.chance(p) else 0.0


def segment_distance(q: ca.SX, a: np.ndarray, b: np.ndarray) -> ca.SX:
    """The distance of a point to the segment from a to b."""
    along = ca.DM(b - a)
    part = ca.fmin(ca.fmax(ca.dot(q - ca.DM(a), along) / float(np.round((b - a) @ (b - a), 4)), 0), 1)
    return ca.norm_2(q - ca.DM(a) - part * along)


def _away(d: Numbers, q0: np.ndarray, low: float = 0.5, high: float = 3.0) -> np.ndarray:
    """A point at some distance from the start, each coordinate of two digits."""
    c = d.array(q0.size)
    if np.abs(c).sum() < 0.3:
        c[0] = 1.0
    return np.round(q0 + c * d.between(low, high), 2)


def _obstacle(d: Numbers, q: ca.SX, t: ca.SX, q0: np.ndarray, kind: str) -> ca.SX:
    """g >= 0 at the start; q are the states of one body, or of a point."""
    n = q.numel()
    slack = d.one_of(0.05, 0.2, 1.0) if d.chance(0.9) else 0.0
    c, move = _away(d, q0), _moves(d, t)
    if kind == "plane":
        a = d.vector(n)
        value, shape = float(a @ q0), affine(a[None], q)
        return shape - below(value, slack) - move
    if kind == "segment":
        a, b = _away(d, q0, 1, 2), _away(d, q0, 1, 2)
        if np.abs(b - a).sum() < 0.2:
            b = a + 1.0
        shape = segment_distance(q, a, b)
        return shape - max(below(0.8 * at(shape, [q], [q0]), 0), 0.01)
    if kind == "disc":
        centre = ca.DM(c) + (vec([move, *[0] * (n - 1)]) if d.chance(0.6) else 0)
        shape = ca.norm_2(q - centre)
        radius = max(below(float(np.linalg.norm(q0 - c)), min(slack, 0.5 * float(np.linalg.norm(q0 - c)))), 0.01)
        return shape - radius - (0.0 if d.chance(0.7) else d.between(0, 0.3) * d.one_of(ca.sin(t) ** 2, -t, ca.sin(t)))
    p = q - ca.DM(c) - move * ca.DM(d.one_of(np.ones(n), np.eye(n)[0]))
    a, b = d.vector(n), d.vector(n)
    u, v = affine(a[None], p), affine(b[None], p)
    shape = {
        "ellipse": lambda: ca.bilin(ca.DM(np.diag([d.positive() for _ in range(n)])), p, p),
        "tilted ellipse": lambda: ca.bilin(ca.DM(d.psd(n) + 0.1 * np.eye(n)), p, p),
        "quartic": lambda: d.one_of(
            sum(p[i] ** 4 for i in range(n)), u**4 + v**2, ca.sumsqr(p) ** 2, sum(p[i] ** 4 for i in range(n)) + ca.sumsqr(p),
            u**4 + v**4 + u**2 * v**2, sum(p[i] ** 2 + p[i] ** 4 / 4 for i in range(n)),
            p[0] ** 4 + 4 * p[0] ** 3 * p[n - 1] + 6 * p[0] ** 2 * p[n - 1] ** 2 + 4 * p[0] * p[n - 1] ** 3 + p[n - 1] ** 4
            + ca.sumsqr(p),
        ),
        "smooth": lambda: d.one_of(
            ca.exp(u) + v**2, ca.log(ca.exp(u) + ca.exp(v) + ca.exp(-u - v)), ca.sqrt(1 + ca.sumsqr(p)),
            ca.log(1 + ca.exp(u)) + v,
            ca.cosh(u) + v**2, ca.exp(u) + ca.exp(-u) + v, p[n - 1] + p[0] ** 2, ca.sqrt(1 + u**2) + v, ca.exp(u) - v,
            ca.exp(p[0]) + ca.sumsqr(p), p[n - 1] + ca.log(ca.cosh(p[0])), ca.sumsqr(p) / 2 + ca.sin(p[0]) / 2,
            p[n - 1] + p[0] ** 4, ca.fmax(u, 0) ** 2 + v, ca.sqrt(0.01 + u**2) + ca.sqrt(0.01 + v**2),
            ca.log(ca.exp(u) + ca.exp(v)),
        ),
        "corner": lambda: d.one_of(ca.fmax(u, v), ca.fabs(u) + ca.fabs(v), ca.norm_2(p) + ca.fmax(u, 0)),
        "wrong": lambda: d.one_of(
            -ca.sumsqr(p), p[n - 1] + ca.sin(p[0]), u * v, p[n - 1] - p[0] ** 2, -ca.norm_2(p), v + ca.tanh(u),
        ),
    }[kind]()  # fmt: skip
    value = at(shape, [t, q], [0.0, q0])
    drop = slack if slack or d.chance(0.2) else 0.1
    level = below(value, drop)
    low = 0.05 if kind in ("ellipse", "tilted ellipse", "quartic") else -np.inf
    return shape - (level if level > low else min(low, below(value, 0)))


OBSTACLES = {
    "plane": 24, "disc": 24, "segment": 10, "ellipse": 9, "tilted ellipse": 5, "quartic": 9, "smooth": 13, "corner": 2,
    "wrong": 4,
}  # fmt: skip


def _velocity(d: Numbers, q: ca.SX, t: ca.SX) -> Any:
    n = q.numel()
    b, to = ca.DM(d.array(n)), q - ca.DM(d.array(n))
    kind = d.by_weight({"none": 6, "constant": 20, "linear": 20, "bounded": 20, "time": 24, "smooth": 10})
    if kind == "none":
        return None
    if kind == "constant":
        return b
    if kind == "linear":
        return affine(d.one_of(-np.eye(n), d.array(n, n), d.skew(n)), q) + b
    if kind == "bounded":
        return d.weight() * d.one_of(
            -to / ca.sqrt(1 + ca.sumsqr(to)), -ca.tanh(to), -to / (1 + ca.sumsqr(to)),
            -to * ca.fmin(1, 1 / ca.sqrt(0.01 + ca.sumsqr(to))),
            ca.sin(to), -ca.fmin(ca.fmax(to, -1), 1), -to / ca.norm_2(to), b * ca.exp(-ca.sumsqr(to)), -to / (1 + ca.fabs(to)),
            b * ca.if_else(q[0] > 0, 1, -1),
        )  # fmt: skip
    if kind == "time":
        shape = d.one_of(
            ca.sin(t), ca.cos(3 * t), 1 + ca.sin(t) / 2, 1 / (1 + t), ca.sqrt(t), ca.sqrt(1 + t), ca.exp(-t), 1 / (6 - t),
            ca.fabs(t - 0.5),
            ca.sqrt(ca.fabs(t - 0.5)), ca.log(1 + t), ca.sign(ca.sin(4 * t)), t / (1 + t**2), ca.if_else(t < 0.5, 1, 0), t**2,
            ca.sin(t) / (2 + ca.cos(t)), ca.sqrt(1 + ca.sin(t)), ca.fmin(t, 1),
        )  # fmt: skip
        return b * shape + d.one_of(0, 0, 1) * -to
    return d.one_of(
        -(to**3), -to * ca.sumsqr(to), vec([ca.sin(q[(i + 1) % n]) for i in range(n)]), -to + ca.tanh(q) * 2,
        -to * ca.exp(-ca.sumsqr(q)),
        -to + b * ca.cos(q[0]), -ca.sign(to) * ca.sqrt(ca.fabs(to)), q / (1 + q**2) - to,
    )  # fmt: skip


def scene_point(d: Numbers, t: ca.SX) -> tuple[ca.SX, np.ndarray, dict[str, ca.SX]]:
    """A point of 1 to 4 states among obstacles of all kinds."""
    n = d.by_weight({1: 6, 2: 60, 3: 24, 4: 10})
    q, q0 = ca.SX.sym("q", n), d.array(n) * d.one_of(1.0, 2.0, 4.0)
    rows = {}
    for i in range(d.by_weight({1: 20, 2: 36, 3: 24, 4: 13, 5: 7})):
        kind = d.by_weight(OBSTACLES)
        rows[f"{kind.split()[-1]}_{i}"] = _obstacle(d, q, t, q0, "plane" if n == 1 and kind != "wrong" else kind)
    return q, q0, rows


def scene_planes(d: Numbers, t: ca.SX) -> tuple[ca.SX, np.ndarray, dict[str, ca.SX]]:
    """Walls, some of which move."""
    n = d.count(1, 4)
    q, q0 = ca.SX.sym("q", n), d.array(n) * d.one_of(1.0, 2.0, 4.0)
    return q, q0, {f"wall_{i}": _obstacle(d, q, t, q0, "plane") for i in range(d.count(1, 5))}


def scene_discs(d: Numbers, t: ca.SX) -> tuple[ca.SX, np.ndarray, dict[str, ca.SX]]:
    """A point among discs or balls."""
    n = d.one_of(2, 2, 2, 3)
    q, q0 = ca.SX.sym("q", n), d.array(n) * d.one_of(1.0, 2.0, 4.0)
    return q, q0, {f"disc_{i}": _obstacle(d, q, t, q0, "disc") for i in range(d.count(1, 5))}


def scene_bodies(d: Numbers, t: ca.SX) -> tuple[ca.SX, np.ndarray, dict[str, ca.SX]]:
    """Discs (or balls) that keep apart, with or without a floor, a wall, a pillar or a segment."""
    dim, N = d.one_of(2, 2, 2, 3), d.by_weight({2: 50, 3: 35, 4: 15})
    q, r = ca.SX.sym("q", N * dim), np.round(d.rng.uniform(0.2, 0.5, N), 2)
    q0 = np.zeros((N, dim))
    for i in range(N):
        q0[i, 0] = 1.2 * i
        q0[i] += np.round(d.rng.uniform(-0.08, 0.08, dim), 2)
    part = [q[i * dim : (i + 1) * dim] for i in range(N)]
    rows = {
        f"pair_{i}{j}": ca.norm_2(part[i] - part[j]) - float(np.round(r[i] + r[j], 2)) for i in range(N) for j in range(i + 1, N)
    }
    beside = d.by_weight({"none": 35, "floor": 25, "wall": 12, "pillar": 14, "segment": 14})
    for i in range(N):
        if beside == "floor":
            rows[f"floor_{i}"] = part[i][dim - 1] + 0.6 - _moves(d, t, 0.1)
        elif beside == "wall" and i == 0:
            rows["wall"] = part[0][0] + 0.7 - _moves(d, t, 0.3)
        elif beside == "pillar":
            rows[f"pillar_{i}"] = ca.norm_2(part[i] - ca.DM([0.6, 1.5, 0.0][:dim])) - 0.4
        elif beside == "segment" and dim == 2:
            rows[f"segment_{i}"] = segment_distance(part[i], np.array([-1.0, 1.2]), np.array([4.0, 1.5])) - float(r[i])
    return q, q0.ravel(), rows


def scene_rail(d: Numbers, t: ca.SX) -> tuple[ca.SX, np.ndarray, dict[str, ca.SX]]:
    """Bodies in a row, one state each, between stops or not."""
    n = d.count(2, 4)
    q, q0 = ca.SX.sym("q", n), np.arange(n) * 1.5
    rows = {f"gap_{i}": q[i + 1] - q[i] - d.between(0.5, 1.5) for i in range(n - 1)}
    if d.chance(0.6):
        rows["left"] = q[0] + 0.5 - _moves(d, t, 0.4)
    if d.chance(0.5):
        rows["right"] = 1.5 * n - q[n - 1] + _moves(d, t, 0.3)
    return q, q0, rows


def scene_corridor(d: Numbers, t: ca.SX) -> tuple[ca.SX, np.ndarray, dict[str, ca.SX]]:
    """Two walls, discs or a wedge that face each other."""
    q, q0, w = ca.SX.sym("q", 2), np.zeros(2), d.between(0.05, 1.0)
    a = d.between(0.05, 1.5)
    rows = d.one_of(
        {"low": q[1] + w, "high": w - q[1]},
        {"low": q[1] + w - _moves(d, t, 0.5), "high": w - q[1]},
        {"left": ca.norm_2(q + ca.vertcat(1 + w, 0)) - 1, "right": ca.norm_2(q - ca.vertcat(1 + w, 0)) - 1},
        {"left": a * q[0] + q[1] + w, "right": q[1] - a * q[0] + w},
        {"bowl": q[1] + w - a * q[0] ** 2 if d.chance(0.2) else q[1] + w + a * q[0] ** 2, "lid": 1 + w - q[1]},
        {"disc": ca.norm_2(q - ca.vertcat(0, 1 + w)) - 1, "floor": q[1] + w},
        {
            "a": ca.sumsqr(q - ca.vertcat(2, 0)) - 1,
            "b": ca.sumsqr(q + ca.vertcat(2, 0)) - 2,
            "c": ca.sumsqr(q - ca.vertcat(0, 2)) - 1,
        },
        {"left": ca.exp(q[0]) + q[1] - 0.5, "right": ca.exp(-q[0]) + q[1] - 0.5},
        {"u": q[1] + q[0] ** 4 + w, "v": q[0] + q[1] ** 4 + w},
    )
    return q, q0, rows


SCENES = {scene_point: 44, scene_planes: 9, scene_discs: 12, scene_bodies: 20, scene_rail: 6, scene_corridor: 9}


def sweeping(d: Numbers) -> Arguments:
    t, scene = ca.SX.sym("t"), d.by_weight(SCENES)
    q, q0, rows = scene(d, t)
    f = _velocity(d, q, t)
    u = d.unit()
    if u != 1:
        rows = {name: u * ca.substitute(row, q, q / u) for name, row in rows.items()}
        f, q0 = None if f is None else u * ca.substitute(ca.SX(f), q, q / u), u * q0
    title = scene.__name__.removeprefix("scene_")
    return {"t": t, "q": q, "f": f, "constraints": rows, "q0": q0, "title": title, **d.grid()}


# ---------------------------------------------------------------------------------------------- many bodies


def bodies(d: Numbers) -> Arguments:
    """Discs or balls on a loose lattice, with walls, pillars or a floor; a crowd in small."""
    dim, N = d.one_of(2, 2, 2, 3), d.count(3, 12)
    side = int(np.ceil(N ** (1 / dim)))
    lattice = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)[:N]
    q0 = lattice * 1.0 + np.round(d.rng.uniform(-0.08, 0.08, (N, dim)), 2)
    radii = np.round(d.rng.uniform(0.2, 0.4, N), 2) if d.chance(0.7) else np.full(N, 0.35)
    people = Bodies(q0, r=radii, v=np.round(d.rng.uniform(0.5, 1.5, N), 2))
    i, j, t = people.member("i"), people.member("j"), ca.SX.sym("t")
    families = {"pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)}
    if d.chance(0.1):
        families["pair"] = Family(ca.sumsqr(i.q - j.q) - (i.r + j.r) ** 2, i, j)
    if d.chance(0.5):
        normals = np.vstack([np.eye(dim), -np.eye(dim)[: d.count(0, dim)]])
        sides = Items(normal=normals, offset=np.where(normals.sum(axis=1) > 0, 0.6, side - 0.4))
        s = sides.member("s")
        families["side"] = Family(ca.dot(s.normal, i.q) + s.offset - i.r - _moves(d, t, 0.1), i, s)
    if d.chance(0.4):
        count = d.count(1, 2)
        pillars = Items(c=np.round(side + d.rng.uniform(0.6, 2, (count, dim)), 2), R=np.full(count, 0.3))
        p = pillars.member("p")
        families["pillar"] = Family(ca.norm_2(i.q - p.c) - i.r - p.R, i, p)
    if dim == 2 and d.chance(0.4):
        walls = Items(a=[(-1.0, -1.0)], b=[(side + 1.0, -1.2)])
        w = walls.member("w")
        along = w.b - w.a
        part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
        families["wall"] = Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w)
    to = ca.DM(np.round(d.rng.uniform(-1, side + 1, dim), 2)) - i.q
    f = d.one_of(
        ca.DM(d.array(dim)), to, i.v * to / ca.norm_2(to), i.v * to / ca.sqrt(1 + ca.sumsqr(to)),
        ca.DM(d.array(dim)) * ca.sin(t), -i.q,
        i.v * ca.tanh(to), ca.if_else(i.q[0] > 1, to, -to), to * ca.exp(-t), i.v * ca.fmin(ca.fmax(to, -1), 1),
    )  # fmt: skip
    return {"t": t, "bodies": people, "f": f, "constraints": families, "title": "bodies", "t_end": 1.0, "step": 0.02}


# ---------------------------------------------------------------------------------------------- all

MAKERS: Mapping[str, tuple[type[Model], Callable[[Numbers], Arguments]]] = {
    "sweeping": (SweepingProcess, sweeping), "oscillator": (FrictionOscillator, oscillator),
    "first_order": (FirstOrderSystem, first_order), "lure": (LureSystem, lure), "inclusion": (MonotoneInclusion, inclusion),
    "bodies": (ManyBodies, bodies),
}  # fmt: skip


def draw(class_name: str, seed: int) -> Model:
    """The model of a class ("sweeping", "oscillator", "first_order", "lure", "inclusion", "bodies") with this seed."""
    kind, maker = MAKERS[class_name]
    d = Numbers(seed, list(MAKERS).index(class_name))
    for _ in range(TRIES):
        d.named, d.naming = {}, d.chance(0.15)
        with suppress(ModelError):
            arguments = maker(d)
            used = {symbol: value for symbol, value in d.named.items() if _uses(arguments, symbol)}
            return kind(**arguments, **({"parameters": used} if used else {}))
    raise AssertionError(f"{class_name}:{seed}: {TRIES} models were refused")


def _uses(item: Any, symbol: ca.SX) -> bool:
    if isinstance(item, Mapping):
        return any(_uses(part, symbol) for part in item.values())
    if isinstance(item, list | tuple):
        return any(_uses(part, symbol) for part in item)
    return isinstance(item, ca.SX) and ca.depends_on(item, symbol)


SHOWN = (
    "title", "x", "q", "lam", "y", "f", "field", "operator", "sign_arguments", "phi", "A", "B", "C", "D", "h", "g", "M",
    "potential",
    "elements", "damping", "constraints", "law", "lower", "upper", "bodies", "x0", "q0", "v0", "parameters", "theta", "gamma",
    "step",
    "t_end",
)  # fmt: skip


def text(model: Model) -> str:
    """The model in one line for each argument, for people and for the fingerprint."""
    lines = [type(model).__name__]
    for name in SHOWN:
        value = getattr(model, name, None)
        if value is not None and not callable(value):
            lines.append(f"{name}: {_written(value)}")
    return "\n".join(lines)


def _written(value: Any) -> str:
    if isinstance(value, ca.SX):
        return str(ca.densify(value))
    if isinstance(value, Law):
        return "; ".join(
            f"{b.label} {low} {ca.repmat(b.radius, b.size, 1) if b.kind == 'ball' else up}"
            + (f" {b.H.tolist()} {b.K.tolist()}" if b.kind == "polyhedron" else "")
            for b in value.blocks
            for low, up in [b.ends]
        )
    if isinstance(value, Bodies | Items):
        return _written(dict(value.numbers))
    if isinstance(value, Family):
        return f"{value.g} over {value.count}" + ("" if value.second is None else f" with {_written(value.second.group)}")
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_written(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "(" + ", ".join(_written(item) for item in value) + ")"
    return str(value.tolist()) if isinstance(value, np.ndarray) else str(value)


def fingerprint(class_name: str, seeds: Sequence[int]) -> str:
    """A hash of the texts of these models."""
    whole = "\n".join(text(draw(class_name, seed)) for seed in seeds)
    return hashlib.sha256(whole.encode()).hexdigest()[:16]
