"""Analytic functions on a disc |z| <= R: a bound of their values that ends at poles, branch points and overflow.

A **form** of degree m says that u(z) = sum_(k <= m) c_k (z/R)^k + e(z), |e| <= rest on the disc, with real c_k; of degree 0 it is
a **ball**, c_0 and a radius. An expression of forms is a form if every one of its operations is analytic on the disc; else its
rest is infinite. Products bound what is cut off by the product of the sums of sizes less the coefficients that are kept; a
function phi(c_0 + v) by a majorant Phi, |phi_j| <= Phi_j: the rest is Phi(|v|) less what [Phi o |v|] keeps (Taylor models with
real coefficients, on a disc: Neumaier, Taylor forms, 2003). `jets` run on them at order 0 (see `evaluated`).

A system's f, g and h, and what its branches look at, on a disc: of t, x and l as balls or forms (see `discs`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from nsmodel._utils import EPS, sum_in_order
from nsmodel.event_driven.mode_series import ModeSeries
from nsmodel.event_driven.recurrence_code import PYTHON_DIALECT, compile_recurrences
from nsmodel.event_driven.recurrences import ORDER_0_FUNCTIONS, RECURRENCES, TWO_OVER_ROOT_PI, TaylorRecurrences

INF = math.inf
_DISC_DIALECT = PYTHON_DIALECT._replace(choose="pass")  # The sides of branches are given.
_ROUNDED_DIALECT = _DISC_DIALECT._replace(kept="rounded({0})")
# PRODUCT_ROUNDINGS: One is EPS/2 at most, and is counted as EPS: half is room.
PRODUCT_ROUNDINGS, FUNCTION_ROUNDINGS = 3, 8  # Roundings of a coefficient beside one for each coefficient.
MAX_EXP_ARGUMENT = 700.0  # exp of less is a double: log of the largest one is 709.8.


class _OnDisc:
    """What is known of a function on a disc: its centre or coefficients c, and what it may be off these by, r."""

    __slots__ = ("c", "r")

    def __init__(self, c: Any, r: float = 0.0) -> None:
        self.c, self.r = c, r if r == r else INF

    def __neg__(self) -> Self:
        return type(self)(-self.c, self.r)

    def __truediv__(self, other: Any) -> Any:
        return self * other.inverse() if type(other) is type(self) else type(self)(self.c / other, self.r / abs(other))

    def __rtruediv__(self, other: float) -> Any:
        return self.inverse() * other

    def inverse(self) -> Any:
        """The enclosure of 1/u."""
        raise NotImplementedError


class DiscBall(_OnDisc):
    """|u - c| <= r on the disc: a form of degree 0. Rounding is not counted: what is bounded by it is cut off, and small."""

    __slots__ = ()

    @property
    def moves(self) -> float:
        """How far it is from its centre at most."""
        return self.r

    def __add__(self, other: Any) -> DiscBall:
        return DiscBall(self.c + other.c, self.r + other.r) if type(other) is DiscBall else DiscBall(self.c + other, self.r)

    __radd__ = __add__

    def __sub__(self, other: Any) -> DiscBall:
        return DiscBall(self.c - other.c, self.r + other.r) if type(other) is DiscBall else DiscBall(self.c - other, self.r)

    def __rsub__(self, other: float) -> DiscBall:
        return DiscBall(other - self.c, self.r)

    def __gt__(self, other: float) -> bool:
        """Whether the centre is larger than a number."""
        return self.c > other

    def __mul__(self, other: Any) -> DiscBall:
        if type(other) is not DiscBall:
            return DiscBall(self.c * other, self.r * abs(other) if other else 0.0)
        a, b, r, q = self.c, other.c, self.r, other.r
        if self is other:
            return DiscBall(a * a, (2 * abs(a) + r) * r if r else 0.0)
        return DiscBall(a * b, (abs(a) * q if a else 0.0) + (r * (abs(b) + q) if r else 0.0))

    __rmul__ = __mul__

    def inverse(self) -> DiscBall:
        """The enclosure of 1/u."""
        a, r = abs(self.c), self.r
        return DiscBall(1 / self.c, r / (a * (a - r))) if r < a else DiscBall(0.0, INF)


def _ball_function(of: Callable[[float, float], tuple[float, float]]) -> Callable[[DiscBall], DiscBall]:
    """A function of balls by (c, r) -> (its value at c, how far it is from that)."""

    def evaluate(u: DiscBall) -> DiscBall:
        try:
            return DiscBall(*of(u.c, u.r))
        except (ValueError, OverflowError, ZeroDivisionError):
            return DiscBall(0.0, INF)

    return evaluate


def _ball_sqrt(c: float, r: float) -> tuple[float, float]:
    y = math.sqrt(c)
    return y, (r / (y + math.sqrt(c - r)) if r < c else 0.0 if r == 0 else INF)


_BALL_VALUES: dict[str, Callable[[float, float], tuple[float, float]]] = {
    "exp": lambda c, r: (math.exp(c), -math.exp(c + r) * math.expm1(-r)),
    "sin": lambda c, r: (math.sin(c), abs(math.cos(c)) * math.sinh(r) + abs(math.sin(c)) * (math.cosh(r) - 1)),
    "cos": lambda c, r: (math.cos(c), abs(math.sin(c)) * math.sinh(r) + abs(math.cos(c)) * (math.cosh(r) - 1)),
    "sqrt": _ball_sqrt,
    "log": lambda c, r: (math.log(c), -math.log1p(-r / c) if r < c else INF),
    "log1p": lambda c, r: (math.log1p(c), -math.log1p(-r / (1 + c)) if r < 1 + c else INF),
    "erf": lambda c, r: (math.erf(c), r * TWO_OVER_ROOT_PI * math.exp((2 * abs(c) + r) * r - c * c) if r else 0.0),
}  # A function at c, and how far it is from that on the disc |u - c| <= r.


def _ball_function_from_slope(
    function: Callable[[float], float], slope: Callable[[float, float], float]
) -> Callable[[DiscBall], DiscBall]:
    """``slope(c, r)``: the largest slope on the disc; 0 or less where it has none."""

    def value_and_radius(c: float, r: float) -> tuple[float, float]:
        steepest = slope(c, r) if r else 0.0
        return function(c), r * steepest if steepest >= 0 else INF

    return _ball_function(value_and_radius)


def _reciprocal_slope(distance: float) -> float:
    return 1 / distance if distance > 0 else -1.0


def _disc_tanh(u: Any) -> Any:
    """By exp(2 u) where u <= 0: where tanh is saturated, so is what it is bounded by."""
    if _centre_value(u) > 0:
        return -_disc_tanh(-u)
    e = _DISC_FUNCTIONS["exp"](2.0 * u)
    return 2.0 * (e / (e + 1.0)) - 1.0


def _disc_power(u: Any, p: Any) -> Any:
    if isinstance(p, DiscBall | TaylorForm):
        return _DISC_FUNCTIONS["exp"](p * _DISC_FUNCTIONS["log"](u))
    if not isinstance(u, DiscBall | TaylorForm):
        return ORDER_0_FUNCTIONS["pow"](u, p)
    if not u.moves:
        return _finite_constant_like(ORDER_0_FUNCTIONS["pow"](_centre_value(u), p), u)
    return _ball_power(u, p) if isinstance(u, DiscBall) else _form_power(u, p)


def _ball_power(u: DiscBall, p: float) -> DiscBall:
    c, r = u.c, u.r
    if not 0 <= r < abs(c) or (c < 0 and p != int(p)):
        return DiscBall(0.0, INF)
    try:
        return DiscBall(c**p, abs(p) * r * (abs(c) + (r if p >= 1 else -r)) ** (p - 1))
    except OverflowError:
        return DiscBall(0.0, INF)


def _disc_atan2(a: Any, b: Any) -> Any:
    """atan2: turned to its centre, where the real piece, and with it the disc, does not meet the cut."""
    a, b = _constant_like(a, b), _constant_like(b, a)
    a0, b0 = _centre_value(a), _centre_value(b)
    if not (abs(a0) > a.moves or b0 > b.moves):
        return _unbounded_like(a)
    return _DISC_FUNCTIONS["atan"]((a * b0 - b * a0) / (a * a0 + b * b0)) + math.atan2(a0, b0)


# ---------------------------------------------------------------------------------------------- forms


class TaylorForm(_OnDisc):
    """Coefficients c_0, ..., c_m and the rest, of z/R."""

    __slots__ = ()

    @property
    def sum(self) -> float:
        """The largest value."""
        return float(np.abs(self.c).sum()) + self.r

    @property
    def moves(self) -> float:
        """How far it is from its centre at most."""
        return float(np.abs(self.c[1:]).sum()) + self.r

    def __add__(self, other: Any) -> TaylorForm:
        if type(other) is TaylorForm:
            return TaylorForm(self.c + other.c, self.r + other.r)
        c = self.c.copy()
        c[0] += other
        return TaylorForm(c, self.r)

    __radd__ = __add__

    def __sub__(self, other: Any) -> TaylorForm:
        return TaylorForm(self.c - other.c, self.r + other.r) if type(other) is TaylorForm else self + -other

    def __rsub__(self, other: float) -> TaylorForm:
        return -self + other

    def __gt__(self, other: float) -> bool:
        """Whether the value at the centre is larger than a number."""
        return bool(self.c[0] > other)

    def __mul__(self, other: Any) -> TaylorForm:
        if type(other) is not TaylorForm:
            return TaylorForm(self.c * other, self.r * abs(other) if other else 0.0)
        n, whole = len(self.c), self.sum * other.sum
        product = np.convolve(self.c, other.c)[:n]
        if not whole < INF:
            return TaylorForm(product, INF if whole else 0.0)
        kept = float(np.convolve(np.abs(self.c), np.abs(other.c))[:n].sum())
        return TaylorForm(product, max(whole - kept, 0.0) + (n + PRODUCT_ROUNDINGS) * EPS * whole)

    __rmul__ = __mul__

    def inverse(self) -> TaylorForm:
        """The enclosure of 1/u."""
        a, v = float(self.c[0]), self.moves
        if not v < abs(a):
            return _unbounded_like(self)
        phi = (-1.0) ** np.arange(len(self.c))
        return _compose_series(self / a, phi, np.abs(phi), 1 / (1 - v / abs(a))) / a


def ball_of_polynomial(row: Sequence[float], R: float) -> DiscBall:
    """A polynomial on the disc |z| <= R."""
    r = 0.0
    for c in reversed(row[1:]):
        r = (r + abs(c)) * R
    return DiscBall(row[0], r)


def form_of_polynomial(row: Sequence[float], R: float, m: int) -> TaylorForm:
    """The same as a form of degree m."""
    c = np.zeros(max(m + 1, len(row)))
    c[: len(row)] = row
    c *= R ** np.arange(len(c))
    return TaylorForm(c[: m + 1].copy(), float(np.abs(c[m + 1 :]).sum()))


def _unbounded_like(u: Any) -> Any:
    return DiscBall(0.0, INF) if type(u) is DiscBall else TaylorForm(np.zeros(len(u.c)), INF)


def _centre_value(u: Any) -> float:
    return u if isinstance(u, float) else u.c if type(u) is DiscBall else float(u.c[0])


def _constant_like(u: Any, other: Any) -> Any:
    """A number as what the other one is."""
    if isinstance(u, DiscBall | TaylorForm):
        return u
    if type(other) is TaylorForm:
        c = np.zeros(len(other.c))
        c[0] = u
        return TaylorForm(c)
    return DiscBall(float(u))


def _finite_constant_like(value: float, u: Any) -> Any:
    """A number as what u is; lost where it is none."""
    return _constant_like(value, u) if math.isfinite(value) else _unbounded_like(u)


def _compose_series(u: TaylorForm, phi: np.ndarray, majorant: np.ndarray, whole: float) -> TaylorForm:
    """phi(u) by its coefficients at the centre and those of the majorant; ``whole``: the majorant itself of ``u.moves``."""
    n, v = len(u.c), u.c.copy()
    v[0] = 0
    size, y, Y = np.abs(v), np.zeros(n), np.zeros(n)
    for j in range(n - 1, -1, -1):
        y, Y = np.convolve(y, v)[:n], np.convolve(Y, size)[:n]
        y[0] += phi[j]
        Y[0] += majorant[j]
    rest = max(whole - float(Y.sum()), 0.0) + (n + FUNCTION_ROUNDINGS) * EPS * whole if whole < INF else INF
    return TaylorForm(y, rest)


def _form_function(of: Callable[[TaylorForm, float, float, int], TaylorForm]) -> Callable[[TaylorForm], TaylorForm]:
    """A function of forms by (u, its centre, how far it moves, how many coefficients)."""

    def evaluate(u: TaylorForm) -> TaylorForm:
        try:
            return of(u, float(u.c[0]), u.moves, len(u.c))
        except (ValueError, OverflowError, ZeroDivisionError):
            return _unbounded_like(u)

    return evaluate


def _form_exp(u: TaylorForm, a: float, v: float, n: int) -> TaylorForm:
    phi = math.exp(a) / np.array([float(math.factorial(j)) for j in range(n)])
    return _compose_series(u, phi, phi, math.exp(a + v))


def _form_sin_or_cos(first: int) -> Callable[[TaylorForm, float, float, int], TaylorForm]:
    """Sin (0) and cos (1): derivatives in a circle of four."""

    def compose(u: TaylorForm, a: float, v: float, n: int) -> TaylorForm:
        circle = [math.sin(a), math.cos(a), -math.sin(a), -math.cos(a)]
        phi = np.array([circle[(first + j) % 4] / math.factorial(j) for j in range(n)])
        whole = abs(circle[first]) * math.cosh(v) + abs(circle[first + 1]) * math.sinh(v)
        return _compose_series(u, phi, np.abs(phi), whole)

    return compose


def _form_power(u: TaylorForm, p: float) -> TaylorForm:
    a, n, v = float(u.c[0]), len(u.c), u.moves
    if not (a > 0 and v < a):
        return _unbounded_like(u)
    phi, majorant, x = [1.0], [1.0], v / a
    for j in range(n - 1):
        phi.append(phi[-1] * (p - j) / (j + 1))
        majorant.append(majorant[-1] * (abs(p) + j) / (j + 1))
    if p == 0.5:
        return _compose_series(u / a, np.array(phi), np.abs(phi), 2 - math.sqrt(1 - x)) * math.sqrt(a)
    return _compose_series(u / a, np.array(phi), np.array(majorant), (1 - x) ** -abs(p)) * a**p


def _form_log(u: TaylorForm, a: float, v: float, n: int) -> TaylorForm:
    if not (a > 0 and v < a):
        return _unbounded_like(u)
    phi = np.array([math.log(a), *((-1.0) ** (j + 1) / j for j in range(1, n))])
    return _compose_series(u / a, phi, np.abs(phi), abs(phi[0]) - math.log1p(-v / a))


def _integrate_coefficients(start: float, slope: Sequence[float]) -> np.ndarray:
    return np.array([start, *(d / (j + 1) for j, d in enumerate(slope[:-1]))])


def _form_atan(u: TaylorForm, a: float, v: float, n: int) -> TaylorForm:
    radius = math.sqrt(1 + a * a)
    if not v < radius:
        return _unbounded_like(u)
    d: list[float] = []
    for k in range(n):  # 1 / (1 + (a + w)^2)
        d.append(((k == 0) - (2 * a * d[k - 1] if k else 0.0) - (d[k - 2] if k > 1 else 0.0)) / (1 + a * a))
    majorant = np.array([abs(math.atan(a)), *(1 / j / radius**j for j in range(1, n))])
    return _compose_series(u, _integrate_coefficients(math.atan(a), d), majorant, abs(math.atan(a)) - math.log1p(-v / radius))


def _form_asin(u: TaylorForm, a: float, v: float, n: int) -> TaylorForm:
    if not abs(a) + v < 1:
        return _unbounded_like(u)
    g, d = [1 - a * a, -2 * a, -1.0], [(1 - a * a) ** -0.5]
    for k in range(1, n):  # g^(-1/2)
        d.append(sum_in_order((-0.5 * j - (k - j)) * g[j] * d[k - j] for j in range(1, min(k, 2) + 1)) / (k * g[0]))
    phi = _integrate_coefficients(math.asin(a), d)
    return _compose_series(u, phi, np.abs(phi), math.asin(abs(a) + v))


def _form_erf(u: TaylorForm, a: float, v: float, n: int) -> TaylorForm:
    slope = TWO_OVER_ROOT_PI * math.exp(-a * a)

    def density(one: float, two: float) -> list[float]:
        y = [slope]
        for j in range(1, n):
            y.append((one * y[j - 1] + (2 * two * y[j - 2] if j > 1 else 0.0)) / j)
        return y

    majorant = _integrate_coefficients(abs(math.erf(a)), density(2 * abs(a), 1.0))
    whole = abs(math.erf(a)) + v * TWO_OVER_ROOT_PI * math.exp((2 * abs(a) + v) * v - a * a)
    return _compose_series(u, _integrate_coefficients(math.erf(a), density(-2 * a, -1.0)), majorant, whole)


def _ball_or_form_function(
    of_ball: Callable[[DiscBall], DiscBall], of_form: Callable[[Any], Any], name: str
) -> Callable[[Any], Any]:
    number = ORDER_0_FUNCTIONS[name]

    def evaluate(u: Any) -> Any:
        if type(u) is DiscBall:
            return of_ball(u)
        if type(u) is not TaylorForm:
            return number(u)
        return of_form(u) if u.moves else _finite_constant_like(number(float(u.c[0])), u)

    return evaluate


def _disc_quotient(a: Any, b: Any) -> Any:
    return a / b if isinstance(a, DiscBall | TaylorForm) or isinstance(b, DiscBall | TaylorForm) else RECURRENCES["divided"](a, b)


_DISC_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "divided": _disc_quotient,
    "pow": _disc_power,
    "atan2": _disc_atan2,
    "tanh": _disc_tanh,
}
_DISC_FUNCTIONS |= {
    name: _ball_or_form_function(_ball_function(_BALL_VALUES[name]), _form_function(form), name)
    for name, form in (
        ("exp", _form_exp), ("sin", _form_sin_or_cos(0)), ("cos", _form_sin_or_cos(1)), ("log", _form_log),
        ("sqrt", lambda u, a, v, n: _form_power(u, 0.5)), ("erf", _form_erf),
    )
}  # fmt: skip
_DISC_FUNCTIONS |= {
    "atan": _ball_or_form_function(
        _ball_function_from_slope(
            math.atan, lambda c, r: _reciprocal_slope((math.sqrt(1 + c * c) - r) * abs(math.sqrt(1 + c * c) - r))
        ),
        _form_function(_form_atan), "atan",
    ),
    "asin": _ball_or_form_function(
        _ball_function(lambda c, r: (math.asin(c), max(math.asin(abs(c) + r) - math.asin(abs(c)), 0.0))),
        _form_function(_form_asin), "asin",
    ),
    "asinh": _ball_or_form_function(
        _ball_function_from_slope(math.asinh, lambda c, r: _reciprocal_slope(math.sqrt(1 + c * c) - r)),
        lambda u: _DISC_FUNCTIONS["log"](u + _DISC_FUNCTIONS["sqrt"](u * u + 1.0)), "asinh",
    ),
    "acosh": _ball_or_form_function(
        _ball_function_from_slope(
            math.acosh, lambda c, r: math.sqrt(_reciprocal_slope((c - 1 - r) * (c + 1 - r))) if c - 1 > r else -1.0
        ),
        lambda u: _DISC_FUNCTIONS["log"](u + _DISC_FUNCTIONS["sqrt"](u * u - 1.0)), "acosh",
    ),
    "atanh": _ball_or_form_function(
        _ball_function_from_slope(
            math.atanh, lambda c, r: _reciprocal_slope((1 - abs(c) - r) * (1 + abs(c) + r)) if abs(c) + r < 1 else -1.0
        ),
        lambda u: 0.5 * _DISC_FUNCTIONS["log"]((1.0 + u) / (1.0 - u)), "atanh",
    ),
    "log1p": _ball_or_form_function(_ball_function(_BALL_VALUES["log1p"]), lambda u: _DISC_FUNCTIONS["log"](u + 1.0), "log1p"),
    "expm1": lambda u: _DISC_FUNCTIONS["exp"](u) - 1.0,
    "acos": lambda u: math.pi / 2 - _DISC_FUNCTIONS["asin"](u),
    "sinh": lambda u: 0.5 * (_DISC_FUNCTIONS["exp"](u) - _DISC_FUNCTIONS["exp"](-u)),
    "cosh": lambda u: 0.5 * (_DISC_FUNCTIONS["exp"](u) + _DISC_FUNCTIONS["exp"](-u)),
    "tan": lambda u: _disc_quotient(_DISC_FUNCTIONS["sin"](u), _DISC_FUNCTIONS["cos"](u)),
    "hypot": lambda a, b: _DISC_FUNCTIONS["sqrt"](a * a + b * b),
    "rounded": lambda u: DiscBall(u.c, u.r + EPS * abs(u.c)) if type(u) is DiscBall else u,
}  # fmt: skip


class DiscEvaluator:
    """Some jets, of which order 0 is computed with balls or forms in place of numbers."""

    def __init__(self, recurrences: TaylorRecurrences, choice: list[float], *, rounded: bool = False) -> None:
        """``choice``: the sides of branches, as they are when it is computed; ``rounded``: balls grow by the rounding of each."""
        self._recurrences, self._rows = recurrences, [[0.0] for _ in range(recurrences.count)]
        for row, value in recurrences.numbers.items():
            self._rows[row][0] = value
        self._first, _ = compile_recurrences(
            recurrences, self._rows, choice, _ROUNDED_DIALECT if rounded else _DISC_DIALECT, _DISC_FUNCTIONS
        )

    def __call__(self, inputs: dict[tuple[int, int], Any]) -> tuple[list[Any], list[Any]]:
        """The outputs and what branches look at; numbers where they do not depend on the inputs."""
        rows = self._rows
        for place, row in self._recurrences.inputs.items():
            rows[row][0] = inputs[place]
        self._first()
        return [rows[row][0] for row in self._recurrences.outputs], [rows[branch.row][0] for branch in self._recurrences.branches]


class DiscValues(NamedTuple):
    """``rate``: f + g; ``free``: f alone where g = B l, else f + g; ``y``: h; ``looked``: of each branch of the system."""

    rate: list[Any]
    free: list[Any]
    y: list[Any]
    looked: list[Any]


class EquationsOnDisc:
    """The equations of a system, on the sides of its branches that it stands on."""

    def __init__(self, system: ModeSeries, *, rounded: bool = False) -> None:
        """``rounded``: see `DiscEvaluator`."""
        self._system = system
        self._parts = {
            name: DiscEvaluator(system.jets[name], part.choice, rounded=rounded) for name, part in system.parts.items()
        }

    def __call__(self, t: Any, x: Sequence[Any], l: Sequence[Any]) -> DiscValues:
        """The values of f, g and h, and of the arguments of their branches."""
        system, given = self._system, _input_table(t, x, l)
        found = {name: part(given) for name, part in self._parts.items()}
        free = found["f"][0]
        rate = (
            [a + b for a, b in zip(free, found["g"][0], strict=True)] if "g" in found else add_multiplier_terms(free, system.B, l)
        )
        y = found["h"][0] if system.D is None else add_multiplier_terms(found["h"][0], system.D, l)
        looked = [found[name][1][i] for name, i in system.branches]
        return DiscValues(rate, rate if "g" in found else free, y, looked)

    def f(self, t: Any, x: Sequence[Any], l: Sequence[Any]) -> list[Any]:
        """The value of f."""
        return self._parts["f"](_input_table(t, x, l))[0]

    def watched(self) -> list[list[float]]:
        """The rows of the system that branches look at."""
        system = self._system
        return [system.parts[name].rows[system.jets[name].branches[i].row] for name, i in system.branches]


def _input_table(t: Any, x: Sequence[Any], l: Sequence[Any]) -> dict[tuple[int, int], Any]:
    given: dict[tuple[int, int], Any] = {(0, 0): t}
    return given | {(1, i): one for i, one in enumerate(x)} | {(2, i): one for i, one in enumerate(l)}


def add_multiplier_terms(of: list[Any], B: Any, l: Sequence[Any]) -> list[Any]:
    """What multipliers make of it: of + B l."""
    out = list(of)
    for i, j in zip(*np.nonzero(B), strict=True):
        out[i] = l[j] * float(B[i, j]) + out[i]
    return out


def linear_combination(row: np.ndarray, of: Sequence[Any]) -> Any:
    """The sum of so much of each."""
    total: Any = 0.0
    for a, one in zip(row.tolist(), of, strict=True):
        if a:
            total = one * a + total
    return total


def remainder_radius(of: Any) -> float:
    """What of a disc is not a coefficient; of a number, which depends on nothing, 0."""
    return of.r if isinstance(of, DiscBall | TaylorForm) else 0.0 if of == of else math.inf


def error_ratio(bound: float, most: float) -> float:
    """How much of what it may be a bound is."""
    return 0.0 if bound == 0 else bound / most if most > 0 and bound == bound else math.inf
