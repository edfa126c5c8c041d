"""All orders of a mode as one text: the same bits as order by order, and nothing else where it has none."""

import functools
import math
import operator

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel.event_driven import multipliers, recurrences
from nsmodel.event_driven.integrator import Integrator
from nsmodel.event_driven.mode_series import TooManyOperations, TracingTape
from nsmodel.simulation.event_driven import event_driven_problem

NAMES = (
    "friction_oscillator", "sliding_relay", "relay_oscillator", "diode_bridge", "gene_network", "point_past_disc", "obstacle",
    "repressilator", "full_wave_rectifier", "boost", "tumbler", "toggle_switch", "zhuravlev_ivanov",
)  # fmt: skip


def of_conditions() -> nsmodel.FirstOrderSystem:
    """Rows of which each depends on its neighbours, conditions of conditions, and a side without a number."""
    x, l = ca.SX.sym("x", 3), ca.SX.sym("l", 3)
    both, one = ca.logic_and(x[0] > 0, x[1] != 0), ca.logic_or(x[1] > 1, ca.logic_not(x[2] > 0.5))
    f = [
        ca.if_else(both, x[1] + ca.sin(x[2]), -x[0]) - x[0],
        ca.if_else(one, x[0] * x[2], ca.cos(x[1])) - 2 * x[1],
        ca.if_else(ca.logic_and(both, x[0] == 7), ca.log(x[0] - 7), ca.if_else(both, -x[2], ca.log(x[0]))),
    ]
    D = np.array([[2, 0.5, 0], [-0.5, 2, 1], [0, 0.25, 2]])
    return nsmodel.FirstOrderSystem(
        x=x, lam=l, f=f, g=[l[0], -l[1], l[2]], h=x - 0.3 + D @ l, law=nsmodel.relay(3), x0=[0.6, 0.5, 0.4], t_end=2, step=1e-2
    )  # fmt: skip


def rows(system, orders: int, how) -> list[list[float]]:
    """What is known of x, l and y, and of what branches look at."""
    watched = [part.rows[b.row] for part in system.parts.values() for b in part.jets.branches]
    known = orders if how.through is None else orders - 1
    return [row[: orders + 1] for row in (*system.x, *watched)] + [row[: known + 1] for row in (*system.l, *system.y)]


@pytest.fixture(name="plain_sums")
def make_plain_sums(monkeypatch):
    """Additions one after the other: from Python 3.12 on ``sum`` makes up for the rounding of floats."""
    for module in (recurrences, multipliers):
        monkeypatch.setattr(module, "sum", lambda values: functools.reduce(operator.add, values, 0), raising=False)


@pytest.mark.usefixtures("plain_sums")
@pytest.mark.parametrize("name", [*NAMES, of_conditions])
@np.errstate(all="ignore")  # as in a run
def test_the_same_bits_as_order_by_order(name):
    made = Integrator(event_driven_problem(nsmodel.load(name) if isinstance(name, str) else name()), 1e-6)
    system, place = made.system, made.place
    written = system._unrolled
    compared = 0
    for _ in range(12):
        if made.stopped is not None:
            break
        start = [row[0] for row in system.l]
        found = []
        for unrolled in (written, None):
            for row, l in zip(system.l, start, strict=True):
                row[0] = l
            system._unrolled = unrolled
            how = system.expand(place.t, place.x, place.codes, place.tau, made.order)
            assert how is not None
            compared += system._has_all_orders
            found.append(rows(system, made.order, how))
        assert found[0] == found[1]
        system._unrolled = written
        made._selected_solver = None
        made.advance()
    assert compared


def test_what_has_no_number_is_left_to_the_recurrences():
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    side = ca.if_else(x > 0, ca.sqrt(x), 1 / x)
    model = nsmodel.FirstOrderSystem(
        x=[x], lam=[l], f=[-1 - 0 * side], h=[x + 1], g=[l], law=nsmodel.complementarity(1), x0=[0.5], t_end=2, step=1e-2
    )
    run = nsmodel.simulate(model, rtol=1e-9, compiled=False, method="event-driven")
    assert abs(run.x[:, 0] - np.maximum(0.5 - run.t, -1)).max() < 1e-12


def test_operations_are_noted_once_and_in_their_order():
    tape = TracingTape(20)
    known = tape.known({"sin": math.sin})
    a, b = tape.note("a[0]"), tape.note("b[0]")
    both = (a + 0.0) * 1.0 - b / 3
    assert (0.0 * a, both.place) == (0.0, (a - b / 3).place)
    c = known["where"](a > 2.0, known["sin"](both), -known["sin"](both)) + known["sin"](0.5)
    given, made = {"a": [0.3], "b": [0.7], "out": [0.0, 0.0]}, {"sin": math.sin}
    exec(tape.written(list(given), "", [("out[:]", [c, 1.5])]), made)
    made["make"](**given)()
    assert given["out"] == [-math.sin(0.3 - 0.7 / 3) + math.sin(0.5), 1.5]
    with pytest.raises(TooManyOperations):
        _ = [tape.note("a[{}]", k) for k in range(30)]
