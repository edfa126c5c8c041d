"""Blocks that act at events, beside loops by hand: counters, toggles, resets, blocks that read each other, ticks and edges."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, each_step, hysteresis, pwm, relay, sampled, simulate, table
from nsmodel.errors import StepError, UsageError
from nsmodel.simulation import event_driven_rows


@dataclass(frozen=True)
class Rule:
    """A block: its memory at the start, and what it sets.

    ``comparisons(x, m)`` are what it compares, ``update(over, m, x)`` what it sets, ``over`` their sides; of numbers and symbols.
    """

    memory: dict[str, float]
    comparisons: Callable
    update: Callable


def choose(side, a, b):
    return ca.if_else(side, a, b) if isinstance(side, ca.SX) else (a if side else b)


def both(a, b):
    return ca.logic_and(a, b) if isinstance(a, ca.SX) or isinstance(b, ca.SX) else a and b


def edges(name, i, c, rising):
    """Counts crossings of c by x_i in one direction."""
    n, was = f"{name}_n", f"{name}_was"

    def update(over, m, x):
        now = over[0] if rising else ca_not(over[0])
        return {n: m[n] + choose(both(now, ca_not(over[1])), 1, 0), was: choose(now, 1, 0)}

    return Rule({n: 0.0, was: 1.0}, lambda x, m: [x[i] > c, m[was] > 0.5], update)


def ca_not(side):
    return ca.logic_not(side) if isinstance(side, ca.SX) else not side


def toggle(name, i, c):
    """Another value at each rise above c."""
    s, was = f"{name}_s", f"{name}_was"

    def update(over, m, x):
        return {s: choose(both(over[0], ca_not(over[1])), 1 - m[s], m[s]), was: choose(over[0], 1, 0)}

    return Rule({s: 0.0, was: 1.0}, lambda x, m: [x[i] > c, m[was] > 0.5], update)


def level(name, i, c):
    """Adds 1 whenever its comparison changes to above."""
    n = f"{name}_n"
    return Rule({n: 0.0}, lambda x, m: [x[i] > c], lambda over, m, x: {n: m[n] + choose(over[0], 1, 0)})


def threshold(name, of, k):
    """1 where what another block holds is above k."""
    u = f"{name}_u"
    return Rule({u: 0.0}, lambda x, m: [m[of] > k], lambda over, m, x: {u: choose(over[0], 1, 0)})


def copy_of(name, of, i, c):
    """What another block holds when x_i rises or falls through c."""
    z = f"{name}_z"
    return Rule({z: -1.0}, lambda x, m: [x[i] > c], lambda over, m, x: {z: choose(over[0], m[of], m[z])})


def made_rule(kind, name, i, c, of, k):
    if kind in ("rise", "fall"):
        return edges(name, i, c, kind == "rise")
    if kind == "threshold":
        return threshold(name, of, k)
    if kind == "copy":
        return copy_of(name, of, i, c)
    return {"toggle": toggle, "level": level}[kind](name, i, c)


def drawn(rng):
    """Oscillators x_i = a cos(w t + p) and blocks that look at them; (model, rules, exact x(t), frequencies)."""
    count = int(rng.integers(1, 3))
    a, w, p = rng.uniform(0.5, 2, count), rng.uniform(0.5, 3, count), rng.uniform(0, 2 * np.pi, count)
    rules, holds = [], []
    for k in range(int(rng.integers(1, 4))):
        i = int(rng.integers(count))
        c, name = float(np.round(rng.uniform(-0.8, 0.8) * a[i], 3)), f"b{k}"
        kinds = ["rise", "fall", "toggle", "level", *(["threshold", "copy"] if holds else [])]
        kind = kinds[int(rng.integers(len(kinds)))]
        of = holds[int(rng.integers(len(holds)))] if holds else ""
        rules.append(made_rule(kind, name, i, c, of, float(rng.integers(0, 4)) + 0.5))
        holds.append(next(iter(rules[-1].memory)))
    return model_of(rules, a, w, p), rules, lambda t: a * np.cos(w * t + p), (a, w, p)


def model_of(rules, a, w, p, t_end=12.0):
    count = len(a)
    x, v = ca.SX.sym("place", count), ca.SX.sym("speed", count)
    m = {name: ca.SX.sym(name) for rule in rules for name in rule.memory}
    positions = ca.vertsplit(x)
    blocks = []
    for k, rule in enumerate(rules):
        new = rule.update(rule.comparisons(positions, m), m, positions)
        memory = {m[name]: value for name, value in rule.memory.items()}
        blocks.append(each_step(f"block {k}", memory=memory, update={m[name]: value for name, value in new.items()}))
    return FirstOrderSystem(
        x=ca.vertcat(x, v), f=ca.vertcat(v, -(ca.DM(w) ** 2) * x), x0=[*(a * np.cos(p)), *(-a * w * np.sin(p))], t_end=t_end,
        step=1e-2, blocks=blocks,
    )  # fmt: skip


def by_hand(rules, exact, motion, t_end=12.0):
    """What is held at the end, and the times: all act at the start, then those whose comparisons changed, from old values."""
    a, w, p = motion
    held = {name: value for rule in rules for name, value in rule.memory.items()}
    thresholds = {(i, c) for rule in rules for i, c in looked_at(rule, len(a))}
    times = sorted(t for i, c in thresholds for t in crossings(a[i], w[i], p[i], c, t_end))
    acted: list[list[bool] | None] = [None] * len(rules)
    for t in (0.0, *times):
        x = exact(t + 1e-9)
        for _ in range(9):
            sides = [[bool(one) for one in rule.comparisons(x, held)] for rule in rules]
            new = dict(held)
            for k, rule in enumerate(rules):
                if sides[k] != acted[k]:
                    new |= {name: float(value) for name, value in rule.update(sides[k], held, x).items()}
            acted = sides
            if new == held:
                break
            held = new
    return held, times


def looked_at(rule, count):
    """(i, c) of the comparisons x_i > c of a rule, read off by probing."""

    class Probe:
        def __init__(self, i):
            self.i = i

        def __gt__(self, c):
            found.append((self.i, c))
            return True

    found: list[tuple[int, float]] = []
    rule.comparisons(
        [Probe(i) for i in range(count)], dict.fromkeys([*rule.memory, *(f"b{k}_{s}" for k in range(4) for s in "nszu")], 0.0)
    )
    return found


def crossings(a, w, p, c, t_end):
    """The times in (0, t_end) at which a cos(w t + p) = c."""
    angle = np.arccos(c / a)
    turns = np.arange(-2, w * t_end / (2 * np.pi) + 3)
    found = np.concatenate([(s * angle - p + 2 * np.pi * turns) / w for s in (1, -1)])
    return found[(found > 0) & (found < t_end)].tolist()


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("rtol", [1e-4, 1e-10])
def test_random_blocks_hold_what_a_loop_by_hand_holds(seed, rtol):
    for draw in range(20 if seed else 12):
        model, rules, exact, motion = drawn(np.random.default_rng([seed, draw]))
        held, times = by_hand(rules, exact, motion)
        if any(abs(b - a) < 1e-2 for a, b in itertools.pairwise(times)) or (times and 12.0 - times[-1] < 1e-2):
            continue  # which of two events is first is beyond rtol = 1e-4
        run = simulate(model, rtol=rtol)
        found = {name: float(run.inputs[-1, k]) for k, name in enumerate(model.input_names)}
        assert found == held, (seed, draw)


def counted(T, **options):
    """Rising edges of 3 cos t, by memory that is set once."""
    x, n, was = ca.SX.sym("x", 2), ca.SX.sym("n"), ca.SX.sym("was")
    rises = ca.logic_and(x[0] > 0, was < 0.5)
    block = each_step(
        "counter", memory={n: 0.0, was: 1.0}, update={n: n + ca.if_else(rises, 1, 0), was: ca.if_else(x[0] > 0, 1, 0)}
    )
    model = FirstOrderSystem(x=x, f=[x[1], -x[0]], x0=[3, 0], t_end=T, step=1e-2, blocks=[block], names=["a", "b"])
    return simulate(model, **options)


@pytest.mark.parametrize(("T", "count"), [(8, 1), (20, 3), (60, 9)])
def test_a_counter_counts_each_edge_once(T, count):
    for rtol in (1e-2, 1e-5, 1e-8, 1e-12):
        run = counted(T, rtol=rtol)
        assert run.n[-1] == count
        assert len(run.events) == round(T / np.pi)  # one event for each crossing of 0, none beside it
    assert counted(T).n[-1] == count


def test_events_of_a_hysteresis_are_those_that_switch():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    blocks = [hysteresis(u, x, 19, 21, start=1)]
    room = FirstOrderSystem(x=x, f=[(5 + 30 * u - x) / 2], x0=[15], blocks=blocks, t_end=2, step=1e-3, names=["T"])
    run = simulate(room, rtol=1e-10)
    switched = np.flatnonzero(np.diff(run.u)) + 1
    assert len(switched) == 5
    assert [event.t for event in run.events] == pytest.approx(run.t[switched - 1], abs=1e-12)
    for event in run.events:
        assert min(abs(event.x_before[0] - 19), abs(event.x_before[0] - 21)) <= 1e-7


def test_what_a_block_sets_may_let_another_one_act_at_once():
    """A latch that looks at a counter switches at the edge that it is counted at."""
    x, n, was, q = ca.SX.sym("x", 2), ca.SX.sym("n"), ca.SX.sym("was"), ca.SX.sym("q")
    rises = ca.logic_and(x[0] > 0, was < 0.5)
    counter = each_step(
        "counter", memory={n: 0.0, was: 1.0}, update={n: n + ca.if_else(rises, 1, 0), was: ca.if_else(x[0] > 0, 1, 0)}
    )
    latch = each_step("latch", memory={q: 0.0}, update={q: ca.if_else(n > 1.5, 1, 0)})
    model = FirstOrderSystem(
        x=x, f=[x[1], -x[0] + 0 * q], x0=[3, 0], t_end=20, step=1e-2, blocks=[latch, counter], names=["a", "b"]
    )
    run = simulate(model, rtol=1e-8)
    assert run.t[np.flatnonzero(run.q)[0]] - 3.5 * np.pi <= 2.0
    begins = [event.t for event in run.events if abs(event.t - 3.5 * np.pi) < 1e-6]
    assert begins
    assert run.q[-1] == 1


def test_integrate_and_fire_by_an_offset_that_memory_holds():
    """y = integral of 1 + sin t less what was fired: each time it comes to 1 an offset takes 1 away."""
    y, z = ca.SX.sym("y"), ca.SX.sym("z")
    t = ca.SX.sym("t")
    fire = each_step("fire", memory={z: 0.0}, update={z: z + ca.if_else(y - z > 1, 1, 0)})
    model = FirstOrderSystem(t=t, x=y, f=[1 + ca.sin(t)], x0=[0], t_end=20, step=1e-3, blocks=[fire], names=["whole"])
    run = simulate(model, rtol=1e-11)
    assert run.z[-1] == np.floor(20 + 1 - np.cos(20))
    times = [event.t for event in run.events]
    np.testing.assert_allclose([s + 1 - np.cos(s) for s in times], np.arange(1, len(times) + 1), atol=1e-8)


def test_a_tick_and_an_edge_at_one_time_set_what_each_sets():
    """A sampled counter ticks at whole times, where a comparison of another block changes too."""
    t, x, k, n, was = (ca.SX.sym(name) for name in ("t", "x", "k", "n", "was"))
    ticks = sampled("ticks", period=1.0, memory={k: 0.0}, update={k: k + 1})
    above = (t - 1) * (t - 2) * (t - 3) > 0
    counter = each_step(
        "counter",
        memory={n: 0.0, was: 0.0},
        update={n: n + ca.if_else(ca.logic_and(above, was < 0.5), 1, 0), was: ca.if_else(above, 1, 0)},
    )
    model = FirstOrderSystem(t=t, x=x, f=[n + 0.1 * k], x0=[0], t_end=4.5, step=1e-2, blocks=[ticks, counter], names=["way"])
    run = simulate(model, rtol=1e-9)
    assert (run.n[-1], run.k[-1]) == (2, 5)
    expected = sum(0.1 * (j + 1) * min(1, 4.5 - j) for j in range(5)) + (3 - 1) + 2 * (4.5 - 3)
    assert run.way[-1] == pytest.approx(expected, abs=1e-7)


def test_what_never_comes_to_rest_is_told():
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    flip = each_step("flip", memory={s: 0.0}, update={s: ca.if_else(x > 1, ca.if_else(s > 0.5, 0, 1), s)})
    model = FirstOrderSystem(x=x, f=[1.0], x0=[0], t_end=2, step=1e-2, blocks=[flip], names=["a"])
    with pytest.raises(StepError, match="values that block 'flip' set change their own"):
        simulate(model, rtol=1e-6, method="event-driven")


def test_a_copy_of_what_another_block_holds_is_refused_by_name():
    x, a, b = ca.SX.sym("x"), ca.SX.sym("a"), ca.SX.sym("b")
    blocks = [each_step("first", memory={a: 0.0}, update={a: ca.if_else(x > 1, 1, 0)}),
              each_step("second", memory={b: 0.0}, update={b: 2 * a})]  # fmt: skip
    model = FirstOrderSystem(x=x, f=[1.0], x0=[0], t_end=2, step=1e-2, blocks=blocks, names=["way"])
    with pytest.raises(UsageError, match="block 'second' sets what other blocks hold, at no switch"):
        simulate(model, rtol=1e-6, method="event-driven")


def test_events_are_made_once_and_are_what_the_pieces_say():
    run = counted(60, rtol=1e-8)
    assert run.events is run.events
    for event in run.events:
        assert event.x_before[0] == pytest.approx(0, abs=1e-7)
        assert run.at(event.t).x[0] == pytest.approx(event.x_after[:2], abs=1e-12)


@pytest.mark.parametrize("times", [None, 97])
def test_columns_of_inputs_do_not_depend_on_chunks(times, tmp_path, monkeypatch):
    """What is held just before a row, and just after the row before, where the pieces are in another chunk."""
    x, u, d, z = (ca.SX.sym(name) for name in ("x", "u", "d", "z"))
    outputs, update = {d: ca.fmin(ca.fmax(z, 0), 1)}, {z: z + 0.07 * (1 - x)}
    control = sampled("control", period=0.3, memory={z: 0.1}, outputs=outputs, update=update)
    of = {"inputs": {u: pwm(0.3, duty=d)}, "blocks": [control], "names": ["a"]}
    model = FirstOrderSystem(x=x, f=[u - x], x0=[0], t_end=6, step=1e-2, **of)
    rows = {} if times is None else {"times": np.linspace(0, 6, times)[1:].tolist()}
    whole = simulate(model, rtol=1e-6, **rows)
    monkeypatch.setattr(event_driven_rows, "CHUNK_BYTES", 1)
    parts = simulate(model, rtol=1e-6, out=tmp_path / "run", **rows)
    for name, array in whole.arrays.items():
        np.testing.assert_array_equal(parts.arrays[name], array, err_msg=name)
    if times is None:  # at the end of each period u is 0: its pulse has ended
        ends = np.abs(whole.t / 0.3 - np.round(whole.t / 0.3)) < 1e-9
        assert (whole.u[ends][1:] == 0).all()


@pytest.mark.parametrize("rtol", [1e-4, 1e-9])
def test_a_block_takes_what_an_input_jumps_to_while_its_comparison_stands(rtol):
    """z is u where x > 1/2, else as it was: u jumps at t = 1, 2, 3 while x > 1/2 from 1/2 on."""
    x, z, u = (ca.SX.sym(name) for name in ("x", "z", "u"))
    block = each_step("gate", memory={z: 0.0}, update={z: ca.if_else(x > 0.5, u, z)})
    given = {"inputs": {u: table([0, 1, 2, 3], [5, 6, 7, 8])}, "blocks": [block], "names": ["a"]}
    model = FirstOrderSystem(x=x, f=[1 + 0 * z], x0=[0], t_end=3.5, step=1e-3, **given)
    run = simulate(model, rtol=rtol)
    for t, held in ((0.4, 0), (0.6, 5), (1.5, 6), (2.5, 7), (3.4, 8)):
        assert run.z[np.searchsorted(run.t, t)] == held
    steps = simulate(model)
    assert [steps.z[np.searchsorted(steps.t, t)] for t in (0.4, 0.6, 1.5, 2.5, 3.4)] == [0, 5, 6, 7, 8]


def test_a_change_of_the_mode_at_a_comparison_is_an_event():
    """A relay switches where a comparison of a block changes that sets nothing new there."""
    x, l, z = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("z")
    block = each_step("latch", memory={z: 1.0}, update={z: ca.if_else(x > 1, 1, z)})
    model = FirstOrderSystem(x=x, lam=l, f=[1.0], g=[l / 2], h=[1 - x], law=relay(1), x0=[0], t_end=4, step=0.01, blocks=[block],
                             names=["a"])  # fmt: skip
    run = simulate(model, rtol=1e-8)
    changes = np.flatnonzero(np.diff(run.index_set[:, 0].astype(int)) != 0)[1:]
    assert len(run.events) == len(changes) == 1
