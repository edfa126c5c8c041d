"""Event-driven runs of random models made to hide something from the coefficients of a series: none is silently wrong.

    python -m tests.search.hidden --count 2000 --json FILE   random scenes, each interpreted or in C

Pulses (Gauss, rational, compact C^infinity, a narrow tanh) on states that rest or move, in f, g, h, in walls, ends of laws,
potentials, inputs, in blocks with memory, under dry friction and under stiff modes; powers; conditions that are flat where a run
begins; poles; cuts and branch points; roots of high order, clusters of roots, shallow dips; hills in space; saturating functions
in many spellings; in each of the classes that have event-driven runs. Truth is a closed form, or SciPy's
quadrature with points placed by hand at what is hidden. An error above 10 rtol of the largest value, times what the scene
magnifies errors by, without a word is WRONG.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import random
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
from scipy.integrate import quad
from scipy.optimize import root_scalar

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    each_step,
    relay,
    signal,
    simulate,
)
from nsmodel.codegen import library
from nsmodel.errors import NsmodelError
from nsmodel.modeling.base import Model

RIGHT, SAID, WRONG, SLOW = "right", "said", "WRONG", "slow"
MOST_SECONDS = 60.0
t, x, l, q = (ca.SX.sym(name) for name in "txlq")
X = ca.SX.sym("x", 2)


class Scene(NamedTuple):
    """A model; its last state, None where it has none and the run must stop; the largest value; what it magnifies errors by."""

    model: Model
    exact: float | None
    size: float
    condition: float = 1.0
    method: str = "event-driven"


class Pulse(NamedTuple):
    """``of``: as an expression of t; ``at``: as a number; beyond ``reach`` of its centre it is at most 1e-20."""

    of: ca.SX
    at: Callable[[float], float]
    centre: float
    reach: float

    def integral(self, a: float, b: float) -> float:
        """From a to b."""
        ends = [min(max(self.centre + k * self.reach / 4, a), b) for k in range(-4, 5)]
        ends = sorted({a, *ends, b})
        return sum(quad(self.at, u, v, epsabs=1e-15, epsrel=1e-13, limit=400)[0] for u, v in itertools.pairwise(ends))


def pulse(r: random.Random, t_end: float) -> Pulse:
    """One of four kinds, somewhere inside."""
    c, w = r.uniform(0.3, 0.8) * t_end, t_end * 10 ** r.uniform(-3, -1)
    u = (t - c) / w
    kind = r.choice(["Gauss", "rational", "compact", "tanh"])
    if kind == "Gauss":
        return Pulse(ca.exp(-(u**2)), lambda s: math.exp(-(((s - c) / w) ** 2)), c, 7 * w)
    if kind == "rational":
        return Pulse(1 / (1 + u**2) ** 4, lambda s: (1 + ((s - c) / w) ** 2) ** -4.0, c, 300 * w)
    if kind == "tanh":
        of = 0.5 * (ca.tanh(u + 1) - ca.tanh(u - 1))
        return Pulse(of, lambda s: 0.5 * (math.tanh((s - c) / w + 1) - math.tanh((s - c) / w - 1)), c, 24 * w)
    inside = 1 - u**2
    of = ca.if_else(inside > 0, ca.exp(1 - 1 / inside), 0)

    def compact(s: float) -> float:
        v = 1 - ((s - c) / w) ** 2
        return math.exp(1 - 1 / v) if v > 1e-3 else 0.0

    return Pulse(of, compact, c, w)


def first_order(f: Any, x0: Any, t_end: float, state: ca.SX = x, **more: Any) -> Model:
    """X' = f."""
    return FirstOrderSystem(t=t, x=state, f=f, x0=x0, t_end=t_end, step=t_end / 1000, **more)


def of_a_pulse(r: random.Random) -> Scene:
    """x' = a pulse, from rest."""
    t_end = r.uniform(1, 20)
    p, a = pulse(r, t_end), 10 ** r.uniform(-2, 2)
    exact = a * p.integral(0, t_end)
    return Scene(first_order([a * p.of], [0], t_end), exact, exact)


def of_a_pulse_on_decay(r: random.Random) -> Scene:
    """x' = -k x + a pulse: moving, or at rest; k may be stiff: then the integral of x tells."""
    t_end, k = r.uniform(1, 20), 10 ** r.uniform(-1, 5)
    p, start = pulse(r, t_end), r.choice([0.0, 1.0])
    model = first_order([-k * (X[0] - p.of), X[0]], [start, 0], t_end, X)
    x_end = start * math.exp(-k * t_end) if k * t_end < 700 else 0.0
    c, reach = p.centre, p.reach
    ends = sorted({0.0, *(min(max(c + j * reach / 4, 0.0), t_end) for j in range(-4, 5)), t_end, max(t_end - 40 / k, 0.0)})
    for a, b in itertools.pairwise(ends):
        x_end += quad(lambda s: k * math.exp(-k * (t_end - s)) * p.at(s), a, b, epsabs=1e-16, epsrel=1e-12, limit=400)[0]
    exact = p.integral(0, t_end) + (start - x_end) / k
    return Scene(model, exact, exact)


def of_a_power(r: random.Random) -> Scene:
    """x' = (k + 1) (t/a)^k."""
    k, a = r.randint(3, 60), r.uniform(0.5, 3)
    t_end = a * r.uniform(0.8, 1.4)
    exact = a * (t_end / a) ** (k + 1)
    return Scene(first_order([(k + 1) * (t / a) ** k], [0], t_end), exact, exact)


def of_a_flat_condition(r: random.Random) -> Scene:
    """x' = l in -Sgn((t/a)^k - 1): up to a, then down."""
    k, a = r.randint(2, 60), r.uniform(0.5, 6)
    t_end = a * r.uniform(1.1, 1.9)
    model = first_order([0], [0], t_end, lam=l, g=[l], h=[(t / a) ** k - 1], law=relay(1))
    return Scene(model, a - (t_end - a), a)


def signed(roots: list[float], t_end: float, before: float) -> float:
    """The integral of -sgn y from 0 to the end, where the sign of y is ``before`` until the first root."""
    times, total = [0.0, *sorted(root for root in roots if 0 < root < t_end), t_end], 0.0
    for k, (a, b) in enumerate(itertools.pairwise(times)):
        total -= before * (-1) ** k * (b - a)
    return total


def of_a_root_of_high_order(r: random.Random) -> Scene:
    """x' = l in -Sgn((t - a)^k): k odd."""
    k, a, t_end = r.choice([3, 5, 7, 9, 11]), r.uniform(0.5, 3), r.uniform(3.5, 6)
    model = first_order([0], [0], t_end, lam=l, g=[l], h=[(t - a) ** k], law=relay(1))
    return Scene(model, signed([a], t_end, -1.0), t_end)


def of_a_cluster_of_roots(r: random.Random) -> Scene:
    """x' = l in -Sgn of a product of (t - a_i), a_i near each other."""
    count, a, t_end = r.randint(2, 5), r.uniform(0.5, 3), r.uniform(3.5, 6)
    near = 10 ** r.uniform(-6, -0.5)
    roots = [a + near * r.uniform(-1, 1) for _ in range(count)]
    h = math.prod((t - root for root in roots), start=ca.SX(1))
    model = first_order([0], [0], t_end, lam=l, g=[l], h=[h], law=relay(1))
    return Scene(model, signed(roots, t_end, (-1.0) ** count), t_end)


def of_a_dip(r: random.Random) -> Scene:
    """x' = l in -Sgn y, y a shallow dip below 0, or just above."""
    a, t_end, depth = r.uniform(0.5, 3), r.uniform(3.5, 6), 10 ** r.uniform(-13, -3) * r.choice([1, 1, 1, -1])
    if r.random() < 0.5:
        y, half = (t - a) ** 2 - depth, math.sqrt(max(depth, 0))
    else:
        y, half = 1 - depth - ca.cos(t - a), 2 * math.asin(math.sqrt(max(depth, 0) / 2))
    model = first_order([0], [0], t_end, lam=l, g=[l], h=[y], law=relay(1))
    return Scene(model, signed([a - half, a + half] if depth > 0 else [], t_end, 1.0), t_end)


def of_a_hill_in_space(r: random.Random) -> Scene:
    """x'' = a force near x = c alone: v^2 = 1 - b exp(-((x - c)/w)^2), less what that is at x = 0."""
    c, w, b = r.uniform(2, 6), 10 ** r.uniform(-2, 0), r.uniform(0.2, 0.9)
    u, t_end = (X[1] - c) / w, c + r.uniform(1, 3)
    model = first_order([b / w * u * ca.exp(-(u**2)), X[0]], [1, 0], t_end, X)

    def lost(s: float) -> float:
        return (1 - b * (math.exp(-(((s - c) / w) ** 2)) - math.exp(-((c / w) ** 2)))) ** -0.5 - 1

    def later(distance: float) -> float:
        ends = sorted({0.0, *(min(max(c + k * w, 0.0), distance) for k in (-7, -2, -1, 0, 1, 2, 7)), distance})
        slower = (quad(lost, *ab)[0] for ab in itertools.pairwise(ends))
        return distance + sum(slower) - t_end

    last = root_scalar(later, bracket=(0.1, t_end + 1), xtol=1e-14).root
    return Scene(model, last, last, 10.0)


def of_a_saturating_function(r: random.Random) -> Scene:
    """x' = a logistic function of k (t - a), in one of many spellings."""
    k, a, t_end = 10 ** r.uniform(0, 6), r.uniform(0.5, 3), r.uniform(3.5, 6)
    u, e = k * (t - a), ca.exp
    f = r.choice([
        1 / (1 + e(-u)), 1 - 1 / (1 + e(u)), e(u) / (1 + e(u)), 0.5 + 0.5 * (e(u) - 1) / (e(u) + 1), 0.5 + 0.5 * ca.tanh(u / 2),
        0.5 + 0.5 * ca.sinh(u / 2) / ca.cosh(u / 2), e(u / 2) / (e(u / 2) + e(-u / 2)), 1 / (1 + math.e ** (-u)),
    ])  # fmt: skip

    def softplus(v: float) -> float:
        return v + math.log1p(math.exp(-v)) if v > 0 else math.log1p(math.exp(v))

    exact = (softplus(k * (t_end - a)) - softplus(-k * a)) / k
    return Scene(first_order([f], [0], t_end), exact, exact)


def of_a_pulse_in_a_condition(r: random.Random) -> Scene:
    """x' = l in -Sgn(level - pulse): down while the pulse is above the level."""
    t_end = r.uniform(5, 20)
    c, w, level = r.uniform(0.3, 0.7) * t_end, t_end * 10 ** r.uniform(-2.5, -1), r.uniform(0.1, 0.9)
    half = w * math.sqrt(-math.log(level))
    model = first_order([0], [0], t_end, lam=l, g=[l], h=[level - ca.exp(-(((t - c) / w) ** 2))], law=relay(1))
    return Scene(model, -(t_end - 2 * half) + 2 * half, t_end)


def of_a_pulse_on_friction(r: random.Random) -> Scene:
    """x' = a pulse - Sgn x from 0: it leaves 0 where the pulse is 1, and comes back where the integral is 0 again."""
    t_end = r.uniform(5, 20)
    c, w, a = r.uniform(0.3, 0.5) * t_end, t_end * 10 ** r.uniform(-2.5, -1.3), r.uniform(1.5, 20)
    half = w * math.sqrt(math.log(a))

    def moved(s: float) -> float:
        root = math.sqrt(math.pi) / 2 * w * a
        return root * (math.erf((s - c) / w) + math.erf(half / w)) - (s - c + half)

    top = moved(c + half)
    f = [a * ca.exp(-(((t - c) / w) ** 2))]
    back = root_scalar(moved, bracket=(c + half, c + half + top + 1)).root if moved(c + half + top + 1) < 0 else t_end
    stop = min(c + half + r.uniform(0.1, 2) * max(back - c - half, 0), t_end)
    model = LureSystem(t=t, A=[[0]], B=[1], C=[1], f=f, law=relay(1), x0=[0], t_end=stop, step=stop / 1000)
    return Scene(model, moved(stop) if stop < back else 0.0, top, 1 + a)


def of_a_pulse_on_an_oscillator(r: random.Random) -> Scene:
    """x'' = a pulse - Sgn x' from rest: x once it has stopped again."""
    t_end = r.uniform(5, 20)
    c, w, a = r.uniform(0.3, 0.5) * t_end, t_end * 10 ** r.uniform(-2.5, -1.6), r.uniform(1.5, 20)
    half, s = w * math.sqrt(math.log(a)), ca.SX.sym("s")

    def moved(s: float) -> float:
        root = math.sqrt(math.pi) / 2 * w * a
        return root * (math.erf((s - c) / w) + math.erf(half / w)) - (s - c + half)

    back = root_scalar(moved, bracket=(c + half, c + half + moved(c + half) + 1)).root
    force = [a * ca.exp(-(((t - c) / w) ** 2))]
    model = FrictionOscillator(
        t=t, x=x, potential=0 * x, friction=s, s=s, force=force, x0=[0], t_end=back + 1, step=(back + 1) / 1000
    )
    ends = sorted({c - half, c, c + half, min(c + 7 * w, back), back})
    exact = sum(quad(moved, *ab, epsabs=1e-15, epsrel=1e-13)[0] for ab in itertools.pairwise(ends))
    return Scene(model, exact, exact, 1 + a)


def of_a_law_that_gives_way(r: random.Random) -> Scene:
    """x' in push - F(t) Sgn x, F = 1 - b times a pulse: it leaves 0 while F < push, and comes back."""
    t_end, push, b = r.uniform(5, 20), r.uniform(0.3, 0.9), r.uniform(0.2, 0.95)
    b = max(b, 1.1 * (1 - push))
    c, w = r.uniform(0.3, 0.5) * t_end, t_end * 10 ** r.uniform(-2.5, -1.3)
    half = w * math.sqrt(-math.log((1 - push) / b))

    def moved(s: float) -> float:
        return math.sqrt(math.pi) / 2 * w * b * (math.erf((s - c) / w) + math.erf(half / w)) - (1 - push) * (s - c + half)

    F, top = 1 - b * ca.exp(-(((t - c) / w) ** 2)), moved(c + half)
    far = c + half + 2 * (top + 1) / (1 - push) + 10 * w
    back = root_scalar(moved, bracket=(c + half, far)).root
    stop = min(c + half + r.uniform(0.1, 2) * (back - c - half), t_end)
    law = relay(1, -F, F)
    if r.random() < 0.5:
        model: Model = LureSystem(t=t, A=[[0]], B=[1], C=[1], f=[push], law=law, x0=[0], t_end=stop, step=stop / 1000)
    else:
        model = first_order([push], [0], stop, lam=l, g=[l], h=[x], law=law)
    return Scene(model, moved(stop) if stop < back else 0.0, top, 1 / (1 - push))


def of_a_potential_that_moves(r: random.Random) -> Scene:
    """x' in -k Sgn(x - a pulse), k more than its steepest slope: x is the pulse."""
    t_end, a = r.uniform(5, 20), r.uniform(0.2, 5)
    w = t_end * 10 ** r.uniform(-2.5, -1)
    c, k = t_end - w * r.uniform(-1.5, 1.5), 1.5 * math.sqrt(2 / math.e) * a / w
    of = a * ca.exp(-(((t - c) / w) ** 2))
    start, exact = (a * math.exp(-(((s - c) / w) ** 2)) for s in (0.0, t_end))
    model = MonotoneInclusion(t=t, x=x, field=[0], operator=k * ca.sign(x - of), x0=[start], t_end=t_end, step=t_end / 1000)
    return Scene(model, exact, a)


def of_an_input(r: random.Random) -> Scene:
    """x' = u, a pulse, or one that is on between two edges."""
    t_end, u = r.uniform(5, 20), ca.SX.sym("u")
    p, a = pulse(r, t_end), 10 ** r.uniform(-2, 2)
    begin, end = r.uniform(0, p.centre), r.uniform(p.centre, t_end)
    whole = a * p.integral(0, t_end)
    if r.random() < 0.5:
        return Scene(first_order([u], [0], t_end, inputs={u: signal(a * p.of)}), whole, whole)
    on = ca.if_else(ca.logic_and(t >= begin, t < end), a * p.of, 0)
    model = first_order([u], [0], t_end, inputs={u: signal(on, edges=[begin, end])})
    return Scene(model, a * p.integral(begin, end), whole)


def of_a_wall(r: random.Random) -> Scene:
    """q >= a pulse, from where that begins: it ends at its top."""
    t_end = r.uniform(5, 20)
    c, w, a = r.uniform(0.3, 0.8) * t_end, t_end * 10 ** r.uniform(-2.5, -1), r.uniform(0.2, 5)
    k = r.randint(2, 6)
    lower, start = a / (1 + ((t - c) / w) ** 2) ** k, a / (1 + (c / w) ** 2) ** k
    if r.random() < 0.5:
        model: Model = MonotoneInclusion(t=t, x=q, field=[0], lower=[lower], x0=[start], t_end=t_end, step=t_end / 1000)
    else:
        model = SweepingProcess(t=t, q=q, constraints={"wall": q - lower}, q0=[start], t_end=t_end, step=t_end / 1000)
    return Scene(model, a, a)


def of_a_pulse_in_g(r: random.Random) -> Scene:
    """x' = l times a pulse, l = -1 throughout."""
    t_end = r.uniform(1, 20)
    p, a = pulse(r, t_end), 10 ** r.uniform(-2, 2)
    model = first_order([0], [0], t_end, lam=l, g=[a * p.of * l], h=[1 + x * x], law=relay(1))
    exact = a * p.integral(0, t_end)
    return Scene(model, -exact, exact)


def of_a_pulse_that_a_block_counts(r: random.Random) -> Scene:
    """x' = n, how often a pulse has come above a level: 1 from then on."""
    t_end = r.uniform(5, 20)
    c, w, level = r.uniform(0.3, 0.7) * t_end, t_end * 10 ** r.uniform(-2.5, -1), r.uniform(0.1, 0.9)
    above = ca.exp(-(((t - c) / w) ** 2)) > level
    n, was = ca.SX.sym("n"), ca.SX.sym("was")
    update = {n: n + ca.if_else(ca.logic_and(above, was < 0.5), 1, 0), was: ca.if_else(above, 1, 0)}
    block = each_step("counter", memory={n: 0.0, was: 0.0}, update=update)
    exact = t_end - (c - w * math.sqrt(-math.log(level)))
    return Scene(first_order([n], [0], t_end, blocks=[block]), exact, exact)


def of_a_cluster_that_a_state_passes(r: random.Random) -> Scene:
    """x' = l in -Sgn of a product of (z - a_i), z' = 1, a_i near each other."""
    count, a, t_end = r.randint(2, 4), r.uniform(0.5, 3), r.uniform(3.5, 6)
    near = 10 ** r.uniform(-4, -0.5)
    roots = [a + near * r.uniform(-1, 1) for _ in range(count)]
    h = math.prod((X[0] - root for root in roots), start=ca.SX(1))
    model = first_order([1, 0], [0, 0], t_end, X, lam=l, g=[0, l], h=[h], law=relay(1))
    return Scene(model, signed(roots, t_end, (-1.0) ** count), t_end)


def of_a_cut(r: random.Random) -> Scene:
    """x' = the angle of a vector that goes straight past 0, or turns."""
    t_end = r.uniform(3.5, 6)
    if r.random() < 0.5:
        a, near = r.uniform(0.5, 3), r.choice([-1, 1]) * 10 ** r.uniform(-6, 0)

        def integral(u: float) -> float:
            """Of atan2(u, near)."""
            return u * math.atan(u / near) - near * math.log(math.hypot(u, near)) + (math.pi * abs(u) if near < 0 else 0)

        return Scene(first_order([ca.atan2(t - a, near)], [0], t_end), integral(t_end - a) - integral(-a), math.pi * t_end)
    w = 10 ** r.uniform(-2, 0)
    angle = math.remainder(t_end / w, 2 * math.pi)
    return Scene(first_order([ca.atan2(ca.sin(t / w), ca.cos(t / w))], [0], t_end), w * angle**2 / 2, math.pi * t_end)


def of_a_branch_point(r: random.Random) -> Scene:
    """x' has a root, a logarithm, an arcsine that touches 1, at the start or on the way."""
    t_end, a = r.uniform(3.5, 6), r.uniform(0.5, 3)
    above, below, turned, d = t_end - a, a, abs(math.remainder(t_end, 2 * math.pi)), 10 ** r.uniform(-8, -1)

    def smooth(u: float) -> float:
        """Of sqrt(u^2 + d^2)."""
        return (u * math.hypot(u, d) + d * d * math.asinh(u / d)) / 2

    f, exact = r.choice([
        (ca.sqrt(t), 2 / 3 * t_end**1.5),
        (t**1.5, 0.4 * t_end**2.5),
        (ca.log(t), t_end * (math.log(t_end) - 1)),
        (ca.sqrt(ca.fabs(t - a)), 2 / 3 * (above**1.5 + below**1.5)),
        (ca.fabs(t - a) ** 1.5, 0.4 * (above**2.5 + below**2.5)),
        (ca.log((t - a) ** 2), 2 * (above * (math.log(above) - 1) + below * (math.log(below) - 1))),
        (ca.asin(ca.sin(t)), turned**2 / 2 if turned < math.pi / 2 else math.pi**2 / 4 - (math.pi - turned) ** 2 / 2),
        (ca.acos(ca.cos(t)), turned**2 / 2 if t_end < math.pi else math.pi**2 - turned**2 / 2),
        (ca.sqrt((t - a) ** 2 + d * d), smooth(above) + smooth(below)),
    ])  # fmt: skip
    return Scene(first_order([f], [0], t_end), exact, 3 * t_end, method="auto")


def of_a_pole(r: random.Random) -> Scene:
    """A run that has no end."""
    t_end, where = 2.0, r.uniform(0.3, 1.8)
    f, x0 = r.choice([
        (ca.tan(math.pi / 2 * t / where), 0.0), (x * x / where, 1.0), (1 / (where - t), 0.0), (1 / (where - t) ** 2, 0.0),
        ((1 + x * x) * math.pi / 2 / where, 0.0),
    ])  # fmt: skip
    return Scene(first_order([f], [x0], t_end), None, 1)


KINDS: dict[str, Callable[[random.Random], Scene]] = {
    "pulse": of_a_pulse, "decay": of_a_pulse_on_decay, "power": of_a_power, "flat condition": of_a_flat_condition,
    "pulse in a condition": of_a_pulse_in_a_condition, "friction": of_a_pulse_on_friction, "wall": of_a_wall, "pole": of_a_pole,
    "pulse in g": of_a_pulse_in_g, "block": of_a_pulse_that_a_block_counts, "high order": of_a_root_of_high_order,
    "cluster": of_a_cluster_of_roots, "dip": of_a_dip, "hill": of_a_hill_in_space, "saturating": of_a_saturating_function,
    "oscillator": of_a_pulse_on_an_oscillator, "law": of_a_law_that_gives_way, "potential": of_a_potential_that_moves,
    "input": of_an_input, "cluster of a state": of_a_cluster_that_a_state_passes, "cut": of_a_cut,
    "branch point": of_a_branch_point,
}  # fmt: skip


def trial(seed: int, kind: str | None = None) -> dict[str, Any]:
    """One scene, of a kind or of any, at one rtol."""
    r = random.Random(seed)
    kind = kind or r.choice(list(KINDS))
    scene, rtol = KINDS[kind](r), 10.0 ** -r.uniform(2, 12)
    compiled = r.random() < 0.5 and library.compiler() is not None and not scene.model.blocks
    about: dict[str, Any] = {"seed": seed, "kind": kind, "rtol": rtol, "compiled": compiled}
    start = time.monotonic()
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            run = simulate(scene.model, rtol=rtol, method=scene.method, compiled=compiled)
    except NsmodelError as error:
        return about | {"verdict": SAID if scene.exact is not None else RIGHT, "words": str(error)}
    except Exception as error:
        return about | {"verdict": WRONG, "words": repr(error)}
    found = float(run.x[-1, -1])
    about |= {"found": found, "exact": scene.exact, "pieces": len(run), "seconds": time.monotonic() - start}
    if scene.exact is None:
        return about | {"verdict": WRONG}
    about["error"] = abs(found - scene.exact) / (rtol * scene.size * scene.condition)
    if about["error"] > 10:
        return about | {"verdict": SAID if told or run.metadata["warnings"] else WRONG}
    return about | {"verdict": RIGHT if about["seconds"] < MOST_SECONDS else SLOW}


def main() -> int:
    """See the text of the module; 1 where a run was silently wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=list(KINDS))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found = []
    for seed in range(given.seed, given.seed + given.count):
        found.append(trial(seed, given.kind))
        if found[-1]["verdict"] != RIGHT:
            print(json.dumps(found[-1]), flush=True)
    print("; ".join(f"{kind}: {dict(Counter(one['verdict'] for one in found if one['kind'] == kind))}" for kind in KINDS))
    if given.json:
        given.json.parent.mkdir(parents=True, exist_ok=True)
        given.json.write_text(json.dumps(found, indent=1))
    return int(any(one["verdict"] == WRONG for one in found))


if __name__ == "__main__":
    sys.exit(main())
