"""Converters whose switch is an input: modes at its edges are chosen in C, the diode switches at events between them.

The truth is by matrix exponentials of the three positions (switch closed, diode conducts, neither), put together at the edges and
at roots of the current and of the diode's voltage.
"""

from __future__ import annotations

import itertools
from contextlib import suppress
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

import nsmodel
from nsmodel import FirstOrderSystem, LureSystem, box, complementarity, equality, product, pwm, simulate
from nsmodel.codegen.library import compiler
from nsmodel.modeling.base import Model
from nsmodel.simulation.piece_sources import InterpretedPieces

IN_C = pytest.mark.skipif(compiler() is None, reason="no C compiler")


class Converter(NamedTuple):
    """L i' = e + a s - b v, C v' = c i + d l - v/R, with s the voltage of a node, l the current of the diode.

    Switch: voltage w s + z, current i - k l. Diode: 0 <= l ⟂ r v + q s >= 0.
    """

    L: float
    C: float
    R: float
    e: float
    a: float
    b: float
    c: float
    d: float
    w: float
    z: float
    k: float
    r: float
    q: float


class Backwards(Exception):
    """The current is not one that the diode can take over when the switch opens: an equality has no solution there."""


class Run(NamedTuple):
    """A converter, its start, and what opens and closes its switch."""

    of: Converter
    x0: list[float]
    period: float
    duty: float
    phase: float


KINDS = ("buck", "boost", "buck-boost", "flyback")
PERIODS = 12


def drawn(kind: str, seed: int) -> Run:
    """A random one, in continuous or in discontinuous conduction."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    V, L, C, R = 10 ** rng.uniform(0, 2), 10 ** rng.uniform(-5, -3), 10 ** rng.uniform(-5, -3), 10 ** rng.uniform(0, 3)
    k = 10 ** rng.uniform(-1, 1) if kind == "flyback" else 1.0
    of = {
        "buck": Converter(L, C, R, 0, 1, 1, 1, 0, -1, V, k, 0, 1),
        "boost": Converter(L, C, R, V, -1, 0, 0, 1, 1, 0, k, 1, -1),
    }.get(kind, Converter(L, C, R, 0, 1, 0, 0, 1, -1, V, k, 1, k))
    x0 = [float(rng.choice([0.0, rng.uniform(0, 5)])), V * (rng.uniform(0.1, 0.9) if kind == "buck" else rng.uniform(0.1, 2))]
    period = 10 ** rng.uniform(-5.3, -4)
    return Run(of, x0, period, rng.uniform(0.1, 0.9), rng.choice([0, rng.uniform(0, 1)]) * period)


def symbols(run: Run) -> tuple[Converter, dict[ca.SX, float]]:
    """The converter with a parameter for each number: one library is that of all."""
    of = Converter(*map(ca.SX.sym, Converter._fields))
    return of, dict(zip(of, map(float, run.of), strict=True))


def as_first_order(run: Run, periods: int) -> Model:
    """The switch as an equality, u times its voltage and 1 - u times its current."""
    (i, v, s, l, u), (of, values) = map(ca.SX.sym, "ivslu"), symbols(run)
    return FirstOrderSystem(
        x=[i, v], lam=[s, l], f=[(of.e - of.b * v) / of.L, (of.c * i - v / of.R) / of.C],
        g=[of.a * s / of.L, of.d * l / of.C], h=[u * (of.w * s + of.z) + (1 - u) * (i - of.k * l), of.r * v + of.q * s],
        law=product(equality(1), complementarity(1)), parameters=values, **driven(run, u, periods), theta=0.5, gamma=0.5,
    )  # fmt: skip


def as_lure(run: Run, periods: int) -> Model:
    """The switch as a box of its voltage l_0 = -(w s + z), whose ends meet where it is closed; l_1 = l."""
    u, (of, values) = ca.SX.sym("u"), symbols(run)
    room, s, zero = (1 - u) * 1e4 * abs(run.of.z or run.of.e), -1 / of.w, ca.SX(0)
    return LureSystem(
        A=[[zero, -of.b / of.L], [of.c / of.C, -1 / (of.R * of.C)]], B=[[of.a * s / of.L, zero], [zero, of.d / of.C]],
        C=[[1, zero], [zero, of.r]], D=[[zero, -of.k], [of.q * s, zero]], f=[(of.e + of.a * s * of.z) / of.L, 0],
        e=[0, of.q * s * of.z], law=product(box([-room], [room]), complementarity(1)), parameters=values,
        **driven(run, u, periods),
    )  # fmt: skip


def driven(run: Run, u: ca.SX, periods: int) -> dict:
    signal = pwm(period=run.period, duty=run.duty, phase=run.phase)
    return {"x0": run.x0, "inputs": {u: signal}, "t_end": periods * run.period, "step": run.period / 20}


FORMS = {"first order": as_first_order, "Lur'e": as_lure}


def positions(of: Converter) -> dict[str, np.ndarray]:
    """(i, v, 1)' = A (i, v, 1) where the switch is closed, where the diode conducts, and where neither does and i = 0."""

    def matrix(s: np.ndarray, l: np.ndarray) -> np.ndarray:
        A = np.zeros((3, 3))
        A[0] = (np.array([0, -of.b, of.e]) + of.a * s) / of.L
        A[1] = (np.array([of.c, -1 / of.R, 0]) + of.d * l) / of.C
        return A

    none = np.zeros(3)
    found = {
        "closed": matrix(np.array([0, 0, -of.z / of.w]), none),
        "diode": matrix(np.array([0, -of.r / of.q, 0]), np.array([1 / of.k, 0, 0])),
        "neither": matrix(none, none),
    }
    found["neither"][0] = 0
    return found


def exact(run: Run, periods: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Edges, the states (i, v) there, and how often the diode switches between them."""
    A, end = positions(run.of), periods * run.period
    all_of = [run.phase + (k + part) * run.period for k in range(-1, periods + 1) for part in (0, run.duty)]
    edges = np.array([0.0, *sorted(t for t in all_of if 0 < t < end), end])
    x, none, out, switched = np.array([*run.x0, 1.0]), np.zeros(3), [], 0
    for begin, until in itertools.pairwise(edges):
        closed = ((begin + until) / 2 - run.phase) % run.period < run.duty * run.period
        where, t = "closed" if closed else "diode" if x[0] > 0 or (A["diode"] @ x)[0] > 0 else "neither", begin
        while t < until:
            ended = {"closed": none, "diode": np.array([1.0, 0, 0]), "neither": -A["diode"][0]}[where]
            times = np.linspace(0, until - t, 60)
            step, at, k = expm(A[where] * times[1]), x, 0
            while k < 59 and (k == 0 or ended @ at >= 0):
                at, k = step @ at, k + 1
            beyond, time = ended @ at < 0, until - t
            if beyond:
                bounds = times[k - 1] or times[1] / 1e6, times[k]
                time = brentq(lambda s, *of: of[0] @ expm(of[1] * s) @ of[2], *bounds, (ended, A[where], x), xtol=1e-18)
            x, t = expm(A[where] * time) @ x, t + time if beyond else until
            if beyond:
                x[0], where, switched = 0.0, "neither" if where == "diode" else "diode", switched + 1
        if x[0] < -1e-12:
            raise Backwards
        out.append(x[:2])
    return edges[1:], np.array(out), switched


def solved(kind: str, count: int, periods: int = PERIODS) -> list[tuple[Run, tuple[np.ndarray, np.ndarray, int]]]:
    """So many drawn ones, with the truth."""
    found = []
    for seed in itertools.count():
        run = drawn(kind, seed)
        with suppress(Backwards):
            found.append((run, exact(run, periods)))
        if len(found) == count:
            return found
    raise AssertionError


def pieces(model: Model, *, compiled: bool, rtol: float = 1e-10):
    return simulate(model, rtol=rtol, method="event-driven", compiled=compiled)


@pytest.fixture
def c_alone(monkeypatch):
    """No piece is interpreted."""
    monkeypatch.setattr(InterpretedPieces, "make_pieces", lambda *_: pytest.fail("a piece was left to the integrator"))


def agrees(found: nsmodel.Trajectory, run: Run, truth: tuple[np.ndarray, np.ndarray, int], tolerance: float) -> None:
    times, states, _ = truth
    at = found.at(times).x[:, :2]
    assert found.status == "done"
    assert not found.metadata["warnings"]
    assert (np.abs(at - states) / np.maximum(np.abs(states).max(axis=0), np.abs(run.x0))).max() <= tolerance


@IN_C
@pytest.mark.parametrize("form", ["first order", pytest.param("Lur'e", marks=pytest.mark.long)])
def test_random_converters_run_in_c_alone(form, c_alone):
    continuous = discontinuous = 0
    for kind in KINDS:
        for run, truth in solved(kind, 8):
            agrees(pieces(FORMS[form](run, PERIODS), compiled=True), run, truth, 1e-11)
            continuous, discontinuous = continuous + (truth[2] == 0), discontinuous + (truth[2] > 0)
    assert min(continuous, discontinuous) >= 5


@IN_C
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", KINDS)
def test_interpreted_and_compiled_are_the_same(kind, form):
    for run, _ in solved(kind, 2):
        model = FORMS[form](run, 4)
        one, other = (pieces(model, compiled=compiled) for compiled in (False, True))
        assert one.t.shape == other.t.shape
        np.testing.assert_allclose(one.t, other.t, rtol=1e-11, atol=0)
        np.testing.assert_array_equal(one.index_set, other.index_set)
        assert (np.abs(one.x - other.x) <= 1e-11 * np.abs(one.x).max(axis=0)).all()
        assert one.metadata["totals"]["unique"] == other.metadata["totals"]["unique"]


@IN_C
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", KINDS)
def test_four_hundred_edges(kind, form, c_alone):
    ((run, truth),) = solved(kind, 1, 200)
    found = pieces(FORMS[form](run, 200), compiled=True)
    assert found.metadata["totals"]["events"] >= 399
    agrees(found, run, truth, 1e-9)


def from_rest(kind: str, seed: int, part: float) -> Run:
    """A random converter from i = v = 0, its first pulse after this part of a period: the diode may conduct nothing, or block."""
    run = drawn(kind, seed)
    return run._replace(x0=[0.0, 0.0], phase=part * run.period)


@pytest.mark.parametrize("kind", KINDS)
def test_from_rest(kind):
    for seed, part in itertools.product(range(3), (0.0, 0.37)):
        run = from_rest(kind, seed, part)
        one, other = (pieces(FORMS[form](run, 3), compiled=False) for form in FORMS)
        assert not [*one.metadata["warnings"], *other.metadata["warnings"]]
        assert (np.abs(one.x[-1, :2] - other.x[-1, :2]) <= 1e-9 * np.abs(one.x[:, :2]).max(axis=0)).all()


@IN_C
def test_sizes_of_rows_at_rest_are_the_same_in_c():
    """Rounding of i and of y = i - l, all that there is of them before the first pulse, is measured beside what l pushes by."""
    model = as_lure(from_rest("buck-boost", 2, 0.37), 3)
    for compiled in (False, True):
        found = pieces(model, compiled=compiled)
        assert not found.metadata["warnings"]
        assert 0 < found.metadata["totals"]["worst_residual"] < 1e-15
