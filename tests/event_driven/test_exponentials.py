"""Saturating functions have values, however they are spelt by exponentials: `pieces.exponentials`, and runs with them."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

import casadi as ca
import mpmath
import numpy as np
import pytest
from fuzz_models import share
from scipy.integrate import quad, solve_ivp

from nsmodel import FirstOrderSystem, relay, simulate
from nsmodel.errors import NsmodelError
from nsmodel.event_driven.recurrences import is_switched
from nsmodel.event_driven.stable_exponentials import rewrite_without_overflow

t, x, l = (ca.SX.sym(name) for name in "txl")
exp = ca.exp


def logistic(u: Any) -> Any:
    return 1 / (1 + mpmath.exp(-u))


def softplus(u: Any) -> Any:
    return mpmath.log1p(mpmath.exp(u))


# Each tends to 0 for small u; its values.
SPELLINGS: dict[str, tuple[Callable[[ca.SX], ca.SX], Callable]] = {
    "1/(1 + e^-u)": (lambda u: 1 / (1 + exp(-u)), logistic),
    "1 - 1/(1 + e^u)": (lambda u: 1 - 1 / (1 + exp(u)), logistic),
    "e^u/(1 + e^u)": (lambda u: exp(u) / (1 + exp(u)), logistic),
    "e^-u below": (lambda u: exp(u / 2) / (exp(u / 2) + exp(-u / 2)), logistic),
    "tanh, two exponentials": (lambda u: 0.5 + 0.5 * (exp(u / 2) - exp(-u / 2)) / (exp(u / 2) + exp(-u / 2)), logistic),
    "tanh, one exponential": (lambda u: 0.5 + 0.5 * (exp(u) - 1) / (exp(u) + 1), logistic),
    "expm1": (lambda u: 0.5 + 0.5 * ca.expm1(u) / (exp(u) + 1), logistic),
    "sinh/cosh": (lambda u: 0.5 + 0.5 * ca.sinh(u / 2) / ca.cosh(u / 2), logistic),
    "tanh": (lambda u: 0.5 + 0.5 * ca.tanh(u / 2), logistic),
    "a power of e": (lambda u: 1 / (1 + math.e ** (-u)), logistic),
    "a power of a sum": (lambda u: (1 + exp(-2 * u)) ** -0.5, lambda u: (1 + mpmath.exp(-2 * u)) ** -0.5),
    "e^u/sqrt(1 + e^2u)": (lambda u: exp(u) / ca.sqrt(1 + exp(2 * u)), lambda u: (1 + mpmath.exp(-2 * u)) ** -0.5),
    "e^u/(1 + e^u)^2": (lambda u: exp(u) / (1 + exp(u)) ** 2, lambda u: logistic(u) * logistic(-u)),
    "1/cosh^2": (lambda u: 0.25 / ca.cosh(u / 2) ** 2, lambda u: logistic(u) * logistic(-u)),
    "log(1 + e^u)": (lambda u: ca.log(1 + exp(u)), softplus),
    "log1p(e^u)": (lambda u: ca.log1p(exp(u)), softplus),
    "log cosh": (lambda u: ca.log(2 * ca.cosh(u / 2)) + u / 2, softplus),
    "atan(e^u)": (lambda u: ca.atan(exp(u)), lambda u: mpmath.atan(mpmath.exp(u))),
}  # fmt: skip
ACCURATE = 1e-11  # Beside the largest value; near the middle (e^u - 1)/(e^u + 1) cancels, in every spelling.


@pytest.mark.fast
@pytest.mark.parametrize("name", SPELLINGS)
def test_values_and_slopes_are_those_of_the_function(name: str) -> None:
    spelling, of = SPELLINGS[name]
    for k in (1.0, 1e3, 1e6):
        at = ca.Function("at", [x], [(written := rewrite_without_overflow(spelling(k * (x - 5)))), ca.jacobian(written, x)])
        for v in (-1e3, 0.0, 4.9, 4.999999, 5.0, 5.000001, 5.1, 1e4):
            value, slope = (float(a) for a in at(v))
            with mpmath.workdps(60):
                u = k * (mpmath.mpf(v) - 5)
                exact, h = of(u), mpmath.mpf("1e-20")
                steep = k * (of(u + h) - of(u - h)) / (2 * h)
            assert abs(value - float(exact)) <= ACCURATE * max(abs(float(exact)), 1), (k, v)
            assert abs(slope - float(steep)) <= ACCURATE * max(abs(float(steep)), k), (k, v)


@pytest.mark.fast
def test_expressions_without_such_quotients_stay_what_they_are() -> None:
    for expr in (exp(x), exp(x) - 1, x / (1 + x**2), 1 / (1 + x**4), ca.log(1 + x**2), exp(-x) * ca.sin(x), ca.tanh(1e6 * x)):
        assert ca.is_equal(rewrite_without_overflow(expr), expr, 30)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("below", "of"),
    [
        (ca.expm1(x), mpmath.expm1),
        (exp(x) - 1, mpmath.expm1),
        (1 - exp(-x), lambda v: -mpmath.expm1(-v)),
        (exp(x / 2) - exp(-x / 2), lambda v: 2 * mpmath.sinh(v / 2)),
        (ca.sinh(x), mpmath.sinh),
    ],
)
def test_differences_do_not_cancel_near_0(below: ca.SX, of: Callable) -> None:
    """x/(1 - e^-x), the rate of a channel (Hodgkin and Huxley 1952), and its like: about 1 at 0."""
    at = ca.Function("at", [x], [rewrite_without_overflow(x / below)])
    for v in (1e-9, -1e-6, 1e-3, 3.0, -5.0, 800.0, -800.0):
        with mpmath.workdps(50):
            exact = float(mpmath.mpf(v) / of(mpmath.mpf(v)))
        assert float(at(v)) == pytest.approx(exact, rel=1e-14)


@pytest.mark.fast
def test_a_threshold_of_the_least_double_is_a_switch() -> None:
    f = ca.if_else(x >= math.ulp(0.0), 1, 0)
    assert is_switched(rewrite_without_overflow(f))


@pytest.mark.fast
def test_random_expressions_keep_their_values() -> None:
    """Sums, quotients, powers, roots and logarithms of exponentials in each other: the same where the expression has a number."""
    y, seen, tries = ca.SX.sym("y"), 0, share(600, 150)

    def exponent(r: random.Random) -> ca.SX:
        return r.choice([x, y, x - y, y - x, 2 * x, -x, x / 3, x * y, 0.5 * x - 1, 1 - x])

    def made(r: random.Random, depth: int) -> ca.SX:
        if not depth:
            u = exponent(r)
            return r.choice([exp(u), exp(-u), ca.cosh(u), 2.0**u, ca.SX(r.choice([1, 2, -1, 0.5, -3])), u])
        a, b = made(r, depth - 1), made(r, r.randint(0, depth - 1))
        many = [a + b, a - b, a * b, a / b, -a, ca.sqrt(a), a**2, a**-0.5, a**-2, ca.log(a), ca.log1p(a), ca.atan(a), 1 / a]
        return r.choice([*many, exp(exponent(r)) * a, a**1.5, ca.sqrt(a * a), ca.log(a**2)])

    for seed in range(tries):
        r = random.Random(seed)
        given = made(r, r.randint(1, 4))
        written = rewrite_without_overflow(given)
        if written is given:
            continue
        both = ca.Function("both", [x, y], [given, written])
        for _ in range(4):
            p, q = r.uniform(-3, 3), r.uniform(-3, 3)
            near = [[float(v) for v in both(p * (1 + k * 1e-13), q * (1 - k * 1e-13))] for k in (-3, 0, 2)]
            value, spread = near[1][0], max(abs(one - near[1][0]) for one, _ in near)
            if all(map(math.isfinite, (one for one, _ in near))) and spread <= 1e-9 * abs(value):
                seen += 1
                assert near[1][1] == pytest.approx(value, rel=1e-7), (seed, p, q, str(given))
    assert seen > tries / 2


@pytest.mark.fast
def test_logarithms_of_powers_of_sums() -> None:
    y = ca.SX.sym("y")
    value = ca.Function("f", [x, y], [rewrite_without_overflow(ca.log((exp(x) + exp(y)) ** 1.5) / exp(x - y))])
    assert float(value(800, 799)) == pytest.approx(1.5 * np.logaddexp(800, 799) / math.e, rel=1e-14)


@pytest.mark.fast
def test_sums_of_three_exponentials_with_different_exponents() -> None:
    y = ca.SX.sym("y", 2)
    terms = [exp(1e3 * y[0]), exp(2e3 * y[1]), exp(-(y[0] ** 2))]
    shares = [one / (terms[0] + terms[1] + terms[2]) for one in terms]
    at = ca.Function("at", [y], [rewrite_without_overflow(ca.vertcat(*shares)), ca.log(1)])
    for point in ([1.0, 0.2], [1.0, 0.9], [-2.0, -3.0], [0.0, 0.0], [2.0, 1.0]):
        with mpmath.workdps(40):
            a, b = map(mpmath.mpf, point)
            exact = [mpmath.exp(1000 * a), mpmath.exp(2000 * b), mpmath.exp(-a * a)]
            exact = [float(one / sum(exact)) for one in exact]
        assert np.allclose(np.array(at(point)[0]).ravel(), exact, rtol=1e-12, atol=0)


@pytest.mark.fast
def test_what_is_written_is_no_switch() -> None:
    assert not is_switched(rewrite_without_overflow(ca.log(1 + exp(x))))
    assert is_switched(rewrite_without_overflow(1 / (1 + exp(ca.fabs(x)))))


def integral(of: Callable, k: float, end: float) -> float:
    """Of ``of(k (s - 5))`` from 0 to ``end``."""
    with mpmath.workdps(30):
        inner = [u for u in (-60, -6, 0, 6, 60) if -5 * k < u < (end - 5) * k]
        found: Any = mpmath.quad(of, [-5 * k, *inner, (end - 5) * k])
        return float(found / k)


STEEP = ["1/(1 + e^-u)", "e^u/(1 + e^u)", "e^u/sqrt(1 + e^2u)", "log(1 + e^u)", "atan(e^u)", "e^u/(1 + e^u)^2"]
IN_C = [("e^u/(1 + e^u)", 1e6, True), ("log(1 + e^u)", 1e3, True), ("e^u/(1 + e^u)^2", 1e6, True)]


@pytest.mark.parametrize(("name", "k", "compiled"), [*((name, k, False) for name in STEEP for k in (1e3, 1e6)), *IN_C])
def test_steep_ones_are_integrated(name: str, k: float, compiled: bool) -> None:
    spelling, of = SPELLINGS[name]
    model = FirstOrderSystem(t=t, x=x, f=[spelling(k * (t - 5))], x0=[0], t_end=8, step=1e-2)
    exact = integral(of, k, 8)
    for rtol in (1e-3, 1e-8):
        run = simulate(model, rtol=rtol, method="event-driven", compiled=compiled)
        assert abs(run.x[-1, 0] - exact) <= rtol * exact
        assert len(run.piece_start) < 1000
        assert not run.events


@pytest.mark.parametrize("name", [name for name in SPELLINGS if SPELLINGS[name][1] is logistic])
def test_all_spellings_have_one_solution(name: str) -> None:
    """x' = 1/(1 + e^u), u = k (x - 1), from 0: x + e^u/k = t, but for e^-k."""
    k, end = 1e4, 2.0
    model = FirstOrderSystem(x=x, f=[1 - SPELLINGS[name][0](k * (x - 1))], x0=[0], t_end=end, step=1e-2)
    run = simulate(model, rtol=1e-6, method="event-driven")
    with mpmath.workdps(30):
        exact = float(mpmath.findroot(lambda y: y + mpmath.exp(k * (y - 1)) / k - end, (1, 1.01), solver="bisect", maxsteps=200))
    assert abs(run.x[-1, 0] - exact) <= 1e-6 * exact


@pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "C"])
def test_in_conditions_and_in_output_rows(compiled: bool) -> None:
    """x' = l in -Sgn(s(1e4 (t - 3)) - 1/2): up until 3, then down."""
    h = 1 / (1 + exp(-1e4 * (t - 3))) - 0.5
    model = FirstOrderSystem(t=t, x=x, lam=l, f=[0], g=[l], h=[h], law=relay(1), x0=[0], t_end=5, step=1e-2)
    run = simulate(model, rtol=1e-8, method="event-driven", compiled=compiled)
    assert [event.t for event in run.events] == pytest.approx([3.0], abs=1e-9)
    assert run.x[-1, 0] == pytest.approx(1.0, abs=1e-7)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("written", "at"),
    [
        (ca.log(exp(x)), lambda v: v),
        (ca.log(3 * exp(2 * x)), lambda v: math.log(3) + 2 * v),
        (ca.log((exp(x) - 2) ** 2), lambda v: math.log((math.exp(v) - 2) ** 2)),
        (1 / ca.sqrt((exp(x) + exp(-x) - 3 + x) ** 2), lambda v: 1 / abs(math.exp(v) + math.exp(-v) - 3 + v)),
        (exp(x) / exp(x), lambda v: 1.0),
    ],
)
def test_one_exponential_and_even_powers(written: ca.SX, at: Callable[[float], float]) -> None:
    of = ca.Function("of", [x], [rewrite_without_overflow(written)])
    for v in (-3.0, -0.2, 0.3, 0.9, 4.0):
        assert float(of(v)) == pytest.approx(at(v), rel=1e-12)


@pytest.mark.fast
@pytest.mark.parametrize(
    ("written", "of", "at_0"),
    [
        (x / ca.expm1(x), lambda v: v / mpmath.expm1(v), 1.0),
        (0.1 * x / (1 - exp(-x / 10)), lambda v: v / 10 / -mpmath.expm1(-v / 10), 1.0),
        (x / ca.sinh(x), lambda v: v / mpmath.sinh(v), 1.0),
        (3 * x / (exp(x) - exp(-2 * x)), lambda v: 3 * v / (mpmath.exp(v) - mpmath.exp(-2 * v)), 1.0),
        (-2 * x / (4 * exp(-x) - 4 * exp(x)), lambda v: v / 4 / mpmath.sinh(v), 0.25),
    ],
)
def test_removable_singularities_have_values(written: ca.SX, of: Callable, at_0: float) -> None:
    value = ca.Function("value", [x], [(expr := rewrite_without_overflow(written)), ca.jacobian(expr, x)])
    assert float(value(0)[0]) == at_0
    for v in (1e-300, 1e-9, -1e-7, 0.3, -0.49, 0.4999999, 0.5, -0.51, 1.9, -2.1, 30.0, -700.0, 700.0):
        with mpmath.workdps(400):
            u, h = mpmath.mpf(v), mpmath.mpf("1e-20")
            exact, steep = float(of(u)), float((of(u + h) - of(u - h)) / (2 * h)) if abs(v) > 1e-15 else None
        found, slope = map(float, value(v))
        assert found == pytest.approx(exact, rel=1e-13, abs=1e-290)
        assert steep is None or slope == pytest.approx(steep, rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "C"])
def test_a_nerve_as_it_is_published(compiled: bool) -> None:
    """Hodgkin and Huxley, J. Physiol. 117, 1952: rates 0.1 (V + 40)/(1 - e^(-(V + 40)/10)), 0/0 where V passes -40 and -55."""
    V, m, h, n = (ca.SX.sym(name) for name in "Vmhn")
    opening = [
        0.1 * (V + 40) / (1 - exp(-(V + 40) / 10)),
        0.07 * exp(-(V + 65) / 20),
        0.01 * (V + 55) / (1 - exp(-(V + 55) / 10)),
    ]
    closing = [4 * exp(-(V + 65) / 18), 1 / (1 + exp(-(V + 35) / 10)), 0.125 * exp(-(V + 65) / 80)]
    gates = [a * (1 - q) - b * q for a, b, q in zip(opening, closing, (m, h, n), strict=True)]
    rate = 10 - 120 * m**3 * h * (V - 50) - 36 * n**4 * (V + 77) - 0.3 * (V + 54.4)
    model = FirstOrderSystem(x=ca.vertcat(V, m, h, n), f=[rate, *gates], x0=[-65, 0.05, 0.6, 0.32], t_end=30, step=1e-2)
    run = simulate(model, rtol=1e-7, method="event-driven", compiled=compiled)
    at = ca.Function("f", [model.x], [model.f])
    exact = solve_ivp(
        lambda _, y: np.array(at(y)).ravel(), (0, 30), [-65, 0.05, 0.6, 0.32], rtol=1e-11, atol=1e-12, method="DOP853"
    )
    assert np.abs(run.x[-1] - exact.y[:, -1]).max() <= 1e-7 * 100
    assert len(run.piece_start) < 200
    assert not run.metadata["warnings"]


@pytest.mark.parametrize("f", [ca.sin(t - 1) / (t - 1), (t - 1) / ca.tanh(t - 1), (t - 1) / ca.sin(t - 1), (t**2 - 1) / (t - 1)])
def test_other_removable_singularities_are_stepped_over(f: ca.SX) -> None:
    of = ca.Function("of", [t], [f])
    exact = sum(quad(lambda s: float(of(s)), a, b, epsabs=1e-13)[0] for a, b in ((0, 1), (1, 3)))
    for compiled in (False, True):
        run = simulate(
            FirstOrderSystem(t=t, x=x, f=[f], x0=[0], t_end=3, step=1e-2), rtol=1e-6, method="event-driven", compiled=compiled
        )
        assert run.x[-1, 0] == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize(
    "f",
    [
        *(1 / (1 - t), 1 / (1 - t) ** 2, ca.tan(math.pi / 2 * t), 1 / ca.sin(math.pi * t + 3), x**2 + 1),
        *(1 + 1e-6 / (1 - t), 1 + 1e-3 / (1.3 - t), 1 + 1e-12 / (1.3 - t), 1 + 1e-8 * ca.tan(1.2 * t)),
    ],
)
def test_poles_are_not(f: ca.SX) -> None:
    """However small their residue is beside the state and rtol."""
    model = FirstOrderSystem(t=t, x=x, f=[f], x0=[0], t_end=3, step=1e-2)
    for rtol, compiled in ((1e-1, False), (1e-3, False), (1e-3, True), (1e-8, False), (1e-8, True)):
        with pytest.raises(NsmodelError):
            simulate(model, rtol=rtol, method="event-driven", compiled=compiled)
