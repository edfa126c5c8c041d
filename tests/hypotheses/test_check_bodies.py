"""Hypotheses of many bodies: against the model written out, closed forms, brute force, and scenes made to break each of them."""

from __future__ import annotations

import json
from fractions import Fraction
from itertools import combinations

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog

from nsmodel import Bodies, Family, Items, ManyBodies, UsageError, check, neighbours, pwm, simulate, table, within
from nsmodel.crowd import Room, crowd, place
from nsmodel.files.storage import dumps
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VIOLATED
from nsmodel.models.many_bodies import check as deciding
from nsmodel.models.many_bodies import contact_network, representatives
from nsmodel.models.sweeping_process.check import HYPOTHESES
from nsmodel.models.sweeping_process.mfcq_constant import disc_row_gamma
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study import study
from nsmodel.study.stress import stress

SQRT2 = np.sqrt(2)
t = ca.SX.sym("t")


@pytest.fixture
def by_families(monkeypatch):
    """A5 by the means for many bodies, however few there are."""
    monkeypatch.setattr(deciding, "MAX_ONE_BY_ONE", (0, 0))


def discs(q0, r, f=None, others=None, **options):
    """Bodies that may not overlap, and ``others(i)`` {name: g} for each alone."""
    bodies = Bodies(q0, r=r)
    i, j = bodies.member("i"), bodies.member("j")
    constraints = {"pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)}
    constraints |= {name: Family(g, i) for name, g in ({} if others is None else others(i)).items()}
    velocity = None if f is None else f(i)
    return ManyBodies(**{"t": t, "t_end": 1, "step": 0.02} | options, bodies=bodies, f=velocity, constraints=constraints)


def room(n=12, seed=1, **options):
    """People on a grid behind a door; the velocity is that towards it, and past it straight on."""
    rng = np.random.default_rng(seed)
    rows = int(np.ceil(np.sqrt(n)))
    L, k = max(0.6 * rows, 2.4), np.arange(n)
    places = np.column_stack([L - 0.6 * (k // rows + 0.5), (L - 0.6 * rows) / 2 + 0.6 * (k % rows + 0.5)])
    low, high = (L - 1.2) / 2, (L + 1.2) / 2
    ends = np.array([[(0, 0), (0, L)], [(0, 0), (L, 0)], [(0, L), (L, L)], [(L, 0), (L, low)], [(L, high), (L, L)]], float)
    people = Bodies(places + rng.uniform(-0.05, 0.05, (n, 2)), r=rng.uniform(0.2, 0.25, n))
    walls = Items(a=ends[:, 0], b=ends[:, 1])
    i, j, w = people.member("i"), people.member("j"), walls.member("w")
    goal = ca.vertcat(L + 0.3, ca.fmin(ca.fmax(i.q[1], low + 0.25), high - 0.25))
    along = w.b - w.a
    part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
    constraints = {
        "pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j),
        "wall": Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w),
    }
    f = ca.if_else(i.q[0] < L, (goal - i.q) / ca.norm_2(goal - i.q), ca.vertcat(1, 0))
    return ManyBodies(**{"bodies": people, "f": f, "constraints": constraints, "t_end": 0.4, "step": 0.02} | options)


def passing():
    return discs([[-1, 0.02], [1, -0.02]], [0.2, 0.3], lambda i: ca.vertcat(-ca.sign(i.r - 0.25), 0))


def chain(n=6):
    rng = np.random.default_rng(0)
    bodies = Bodies(np.column_stack([1.1 * np.arange(n), 0.6 + 0.2 * rng.random(n)]), r=rng.uniform(0.3, 0.5, n))
    i, j = bodies.member("i"), bodies.member("j")
    links = Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j, neighbours(n))
    floor = Family(i.q[1] - i.r, i)
    f = ca.vertcat(-i.q[0] / 2, -1)
    return ManyBodies(bodies=bodies, f=f, constraints={"link": links, "floor": floor}, t_end=1, step=0.02)


def balls(n=12):
    rng, k = np.random.default_rng(1), np.arange(n)
    places = np.column_stack([k % 3, k // 3 % 3, 0.5 + k // 9]) + rng.uniform(-0.05, 0.05, (n, 3))
    f = lambda i: ca.vertcat(ca.sin(i.q[0]), 0, -1)  # noqa: E731
    return discs(places, rng.uniform(0.3, 0.4, n), f, lambda i: {"floor": i.q[2] - i.r})


# -- the same as written out -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", [passing, chain, balls])
def test_the_findings_are_those_of_the_model_written_out(scene, by_families):
    model = scene()
    own, other = check(model, ()), check(model.written_out(), ())
    assert [finding.id for finding in own.findings] == [hypothesis.id for hypothesis in HYPOTHESES]
    for finding in own.findings:
        assert finding.verdict == other[finding.id].verdict == HOLDS
    for id in ("S-convex", "A0", "A1", "A2", "A3", "A4", "S-start"):
        assert dict(own[id].value) == pytest.approx(dict(other[id].value), rel=1e-12)
    assert own["S-f"].value["K_f"] == pytest.approx(other["S-f"].value["K_f"], abs=1e-9)
    assert own["A5"].value["gamma"] >= other["A5"].value["gamma"] - 1e-12
    for consequence, theirs in zip(own.consequences, other.consequences, strict=True):
        assert (consequence.name, consequence.verdict) == (theirs.name, theirs.verdict)


def test_a_room_with_a_door_has_the_same_verdicts_as_written_out():
    model = room(9)
    own, other = check(model, (), quick=True), check(model.written_out(), (), quick=True)
    assert {f.id: f.verdict for f in own.findings} == {f.id: f.verdict for f in other.findings}
    for id in ("A0", "A1", "A4", "S-start"):
        assert dict(own[id].value) == pytest.approx(dict(other[id].value), rel=1e-12)
        assert own[id].witness.get("constraint") == other[id].witness.get("constraint")


def test_the_constants_of_discs_come_from_the_two_smallest():
    r = np.array([0.5, 0.2, 0.9, 0.3])
    report = check(discs(3.0 * np.arange(8).reshape(4, 2), r), ())
    assert report["A1"].value == {"a": pytest.approx(SQRT2), "b": pytest.approx(SQRT2)}
    assert report["A0"].value["c"] == pytest.approx(0.5 / 2 / SQRT2)
    assert report["A4"].value["M_contact"] == pytest.approx(2 / 0.5)
    assert report["A4"].witness["M of"] == "pair 1-3"
    assert report["A5'"].value["gamma"] == pytest.approx(1.4 / 0.5 * disc_row_gamma(4))


def test_ranges_of_numbers_stand_for_many_members(monkeypatch):
    model = discs(3.0 * np.arange(8).reshape(4, 2), [0.5, 0.2, 0.9, 0.3])
    monkeypatch.setattr(representatives, "MAX_LISTED_MEMBERS", 0)
    report = check(model, ())
    assert report["A0"].verdict == HOLDS
    assert report["A0"].value["c"] == pytest.approx(0.4 / 2 / SQRT2)
    assert report["A0"].witness["c of"] == "pair 1-3"


def test_products_of_numbers_are_taken_in_all_their_combinations():
    w = np.array([1.0, 2.0, 4.0])
    bodies = Bodies(9.0 * np.eye(3)[:, :2], w=w)
    i, j = bodies.member("i"), bodies.member("j")
    model = ManyBodies(bodies=bodies, constraints={"pair": Family(i.w * j.w * ca.norm_2(i.q - j.q) - 1, i, j)}, t_end=1, step=0.1)
    report = check(model, ())
    assert dict(report["A1"].value) == pytest.approx({"a": 2 * SQRT2, "b": 8 * SQRT2})
    assert report["A4"].value["M_contact"] == pytest.approx(2 * 8**2)
    assert report["A1"].witness == {"a of": "pair 0-1", "b of": "pair 1-2"}


def test_a_body_is_no_pair_with_itself(monkeypatch):
    """Only one body has radius 0, so that no pair has two of them."""
    monkeypatch.setattr(representatives, "MAX_LISTED_MEMBERS", 0)
    bodies = Bodies(3.0 * np.arange(8).reshape(4, 2), r=[0, 0.3, 0.3, 0.3])
    i, j = bodies.member("i"), bodies.member("j")
    pair = Family(ca.norm_2(i.q - j.q) - i.r - j.r * (1 + t), i, j)
    report = check(ManyBodies(t=t, bodies=bodies, constraints={"pair": pair}, t_end=1, step=0.1), (), quick=True)
    assert [report[id].verdict for id in ("A0", "A1", "A4")] == [HOLDS] * 3
    assert report["A4"].value["M_contact"] == pytest.approx(2 / 0.3)


@pytest.mark.parametrize("added", [lambda a, b: a + b, lambda a, b: ca.sqrt(a * b)])
@pytest.mark.parametrize("order", [1, -1])
def test_numbers_below_the_rounding_of_others_count(added, order):
    r = np.array([1e-17, 2e-17, 5e-17])[::order]
    bodies = Bodies([[0, 0], [1, 0], [2, 0]], r=r)
    i, j = bodies.member("i"), bodies.member("j")
    pair = Family(ca.norm_2(i.q - j.q) - added(i.r, j.r), i, j)
    report = check(ManyBodies(bodies=bodies, constraints={"pair": pair}, t_end=1, step=0.1), (), quick=True)
    least = min(float(added(a, b)) for a, b in combinations(r, 2))
    assert report["A4"].verdict == HOLDS
    assert report["A4"].value["M_contact"] == pytest.approx(2 / least)
    assert report["A0"].value["c"] == pytest.approx(least / 2 / SQRT2)


def test_left_out_combinations_prove_nothing(monkeypatch):
    monkeypatch.setattr(representatives, "MAX_COMBINATIONS", 2)
    bodies = Bodies(9.0 * np.arange(5.0), w=1.0 + np.arange(5))
    i = bodies.member("i")
    model = ManyBodies(bodies=bodies, constraints={"floor": Family(i.w * i.q + 1, i)}, t_end=1, step=0.1)
    report = check(model, ())
    assert report["A1"].verdict == SAMPLED
    assert "'floor' at 2 of its 5" in report["A1"].how


# -- each of them broken -----------------------------------------------------------------------------------------------


def alone(g, q0=((1, 0.5), (3, 0.5)), **options):
    bodies = Bodies(q0, r=[0.1, 0.2])
    i = bodies.member("i")
    return ManyBodies(t=t, bodies=bodies, constraints={"own": Family(g(i), i)}, t_end=3, step=0.1, **options)


@pytest.mark.parametrize(
    ("id", "model"),
    [
        ("S-convex", lambda: alone(lambda i: 9 + i.r - ca.sumsqr(i.q) / 4)),
        ("A0", lambda: alone(lambda i: ca.norm_2(i.q) + 0 * i.r)),
        ("A1", lambda: alone(lambda i: ca.sumsqr(i.q) + i.r)),
        ("A2", lambda: alone(lambda i: i.q[1] - i.r + ca.if_else(t < 1, 0.0, 0.3))),
        ("A3", lambda: alone(lambda i: i.q[1] + ca.if_else(t < 1, 0.0, 1.0) * i.q[0] - i.r)),
        ("A4", lambda: alone(lambda i: ca.fmax(i.q[0], i.q[1]) - i.r)),
        ("S-start", lambda: discs([[9, 9], [0, 0], [0.4, 0]], [0.2, 0.2, 0.3])),
    ],
)
def test_a_scene_that_breaks(id, model, by_families):
    own, other = check(model(), (), quick=True)[id], check(model().written_out(), (), quick=True)[id]
    assert own.verdict == other.verdict == VIOLATED
    assert own.witness


def test_opposing_normals_are_violated_where_the_point_is_proved_and_unknown_where_it_is_one_of_rounding(by_families):
    model = discs([[0, 0.5], [3, 0.5]], [0.5, 0.5], None, lambda i: {"low": i.q[1] - i.r, "high": 1 - i.q[1] - i.r})
    own, other = check(model, (), quick=True)["A5'"], check(model.written_out(), (), quick=True)["A5'"]
    assert other.verdict == VIOLATED
    assert own.verdict == UNKNOWN
    assert "admissible to rounding" in own.how
    assert own.witness["constraints"]


def test_a_leash_is_not_convex_and_the_pair_is_named():
    bodies = Bodies([[0, 0], [0.5, 0], [4, 0.6]], c=[1, 1.2, 3.4])
    i, j = bodies.member("i"), bodies.member("j")
    model = ManyBodies(bodies=bodies, constraints={"leash": Family(i.c + j.c - ca.norm_2(i.q - j.q), i, j)}, t_end=1, step=0.1)
    report = check(model, (), quick=True)
    assert report["S-convex"].verdict == VIOLATED
    assert report["S-convex"].witness["constraint"] == "leash 1-2"
    assert [item.verdict for item in report.consequences if "S-convex" in item.rests_on] == [UNKNOWN] * 7
    assert any("not convex" in warning for warning in simulate(model, t_end=0.1).metadata["warnings"])


def test_a_wall_that_rounding_bends_is_a_plane():
    """The Hessian of its distance, 0, has an eigenvalue of -1e-32 here."""
    body, wall = Bodies([[4.6, 2.22]], r=[0.2]), Items(a=[[3.6, 1.8]], b=[[3.6, 4.4]])
    i, w = body.member("i"), wall.member("w")
    along = w.b - w.a
    part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
    model = ManyBodies(
        bodies=body, constraints={"wall": Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w)}, t_end=1, step=0.1
    )
    assert simulate(model, t_end=0.1).metadata["warnings"] == []


def test_an_overlap_at_the_start_names_the_bodies():
    finding = check(discs([[9, 9], [0, 0], [0.4, 0]], [0.2, 0.2, 0.3]), (), quick=True)["S-start"]
    assert finding.value["min g"] == pytest.approx(-0.1)
    assert finding.witness["constraint"] == "pair 1-2"
    assert finding.witness["body 2"] == [0.4, 0.0]


def test_contact_at_the_start_is_decided_exactly():
    touching = discs([[0, 0], [0.5, 0], [0.5, 0.75]], [0.25, 0.25, 0.5])
    assert check(touching, (), quick=True)["S-start"].verdict == HOLDS
    tenth = check(discs([[0, 0], [0.3, 0]], [0.1, 0.2]), (), quick=True)["S-start"]  # In doubles 0.3 < 0.1 + 0.2.
    assert tenth.verdict == SAMPLED
    assert "rounding" in tenth.how


def apart(places, g=None, **numbers):
    bodies = Bodies(places, **numbers)
    i, j = bodies.member("i"), bodies.member("j")
    pair = Family(ca.norm_2(i.q - j.q) if g is None else g(i, j), i, j)
    return ManyBodies(bodies=bodies, constraints={"pair": pair}, t_end=1, step=0.1)


def starts(model):
    return {check(one, (), quick=True)["S-start"].verdict for one in (model, model.written_out())}


def test_two_bodies_in_one_place_are_admissible_where_nothing_forbids_it():
    assert starts(apart([[1, 0], [1, 0]])) == {HOLDS}


def test_an_overlap_is_seen_however_far_somebody_else_is():
    touching = lambda i, j: ca.norm_2(i.q - j.q) - 0.4  # noqa: E731
    assert starts(apart([[0, 0], [0.3999, 0], [1e9, 0]], touching)) == {VIOLATED}


def test_numbers_that_cancel_may_hide_a_negative_constraint():
    """g = -3.8e-5 is rounded to 1.2e-4, which is not the least g."""
    bodies = Bodies([[6.2e-5, 0], [5, 0]], a=[1e12, 0], s=[-5e-5, 0])
    i = bodies.member("i")
    own = Family(i.q[0] + i.a + i.s + i.s - i.a, i)
    model = ManyBodies(bodies=bodies, constraints={"own": own, "low": Family(i.q[1], i)}, t_end=1, step=0.1)
    finding = check(model, (), quick=True)["S-start"]
    assert finding.verdict == SAMPLED
    assert finding.witness["constraint"] == "own 0"


def test_numbers_of_members_are_added_exactly():
    sums = lambda i, j: ca.norm_2(i.q - j.q) - (i.r + j.r)  # noqa: E731
    for a, b, c in ((0.1, 0.7, 0.8), (0.1, 0.2, 0.3), (0.25, 0.5, 0.75), (0.3, 0.6, 0.9), (1.1, 2.2, 3.3)):
        met = Fraction(c) >= Fraction(a) + Fraction(b)
        finding = check(apart([[0, 0], [c, 0]], sums, r=[a, b]), (), quick=True)["S-start"]
        assert finding.verdict == (HOLDS if met else SAMPLED)
    times = check(apart([[0, 0], [0.03, 0]], lambda i, j: ca.norm_2(i.q - j.q) - i.r * j.r, r=[0.1, 0.3]), (), quick=True)
    assert times["S-start"].verdict == (HOLDS if Fraction(0.03) >= Fraction(0.1) * Fraction(0.3) else SAMPLED)


@pytest.mark.parametrize(
    "g",
    [
        lambda i, j: ca.norm_2(i.q - j.q) - i.r - j.r - ca.fmax(0, ca.norm_2(i.q) - 5000),
        lambda i, j: ca.norm_2(i.q - j.q) - i.r - j.r + ca.if_else(ca.norm_2(i.q - j.q) > 2, -9, 0),
        lambda i, j: ca.fmod(ca.norm_2(i.q - j.q), 5) - i.r - j.r,
        lambda i, j: ca.norm_2(i.q - j.q + ca.floor(i.q / 5000)) - i.r - j.r,
    ],
)
def test_what_is_a_distance_near_the_origin_alone_is_not_searched_for(g):
    model = apart([[0, 0], [6000, 0], [6003, 0]], g, r=[0.2, 0.2, 0.2])
    assert model.constraints["pair"].reach is None


@pytest.mark.parametrize(
    "g",
    [
        lambda i, j: ca.norm_2(i.q - j.q) - i.r - j.r,
        lambda i, j: -(i.r * j.r * (1 + t)) + ca.norm_2(j.q - i.q),
        lambda i, j: ca.sqrt((i.q[0] - j.q[0]) ** 2 + (i.q[1] - j.q[1]) * (i.q[1] - j.q[1])) - ca.fmax(i.r, j.r),
    ],
)
def test_distances_are_searched_for(g):
    bodies = Bodies([[0, 0], [6000, 0]], r=[0.2, 0.2])
    i, j = bodies.member("i"), bodies.member("j")
    assert Family(g(i, j), i, j).reach is not None


def test_who_enters_later_does_not_overlap_at_the_start():
    model = discs([[0, 0], [0.1, 0]], [0.2, 0.2], enter=[0, 5])
    assert check(model, (), quick=True)["S-start"].verdict == HOLDS
    assert any("enter" in note for note in check(model, (), quick=True).notes)


def test_a_velocity_that_switches_is_found_and_a_body_moved_there():
    model = discs([[-1, 0], [1, 0.5]], [0.1, 0.2], lambda i: ca.vertcat(ca.if_else(i.q[0] < 0.25 + i.r, 1, -1), 0))
    finding = check(model, ())["S-f"]
    assert finding.verdict == VIOLATED
    assert finding.value["jump"] == pytest.approx(2)
    body = int(finding.witness["moved"].split()[1])
    assert finding.witness["to"][0] == pytest.approx(0.25 + model.bodies.numbers["r"][body, 0])
    assert check(model, (), quick=True)["S-f"].verdict == UNKNOWN


def test_a_switch_that_no_body_can_reach_is_no_violation():
    """f jumps at |q| = 1/2, and nobody comes nearer to 0 than 1."""
    f = lambda i: ca.vertcat(ca.if_else(ca.norm_2(i.q) < 0.5, 1, -1), 0)  # noqa: E731
    model = discs([[-1.5, 0], [1.5, 0]], [0.1, 0.2], f, lambda i: {"post": ca.norm_2(i.q) - 1})
    assert check(model, ())["S-f"].verdict == SAMPLED


def test_lipschitz_constants_take_all_numbers_in():
    bodies = Bodies([[0.0, 0], [3, 0], [6, 0]], k=[1, 2, 3])
    i = bodies.member("i")
    model = ManyBodies(t=t, bodies=bodies, f=ca.vertcat(i.k * ca.sin(i.q[0]), 2 * ca.cos(t)), t_end=1, step=0.1)
    finding = check(model, ())["S-f"]
    assert finding.verdict == HOLDS
    assert finding.value["K_f"] == pytest.approx(3, rel=1e-6)
    assert 2 * np.sin(1) * np.sqrt(3) <= finding.value["L_t"] <= 1.01 * 2 * np.sqrt(3)


def test_a_function_of_arrays_is_sampled():
    model = discs([[0, 0], [3, 0]], [0.1, 0.2])
    model = ManyBodies(bodies=model.bodies, f=lambda time, q: 2 * (q.mean(axis=0) - q), t_end=1, step=0.1)
    finding = check(model, ())["S-f"]
    assert finding.verdict == SAMPLED
    assert 0 < finding.value["K_f"] <= 2 + 1e-9
    assert finding.value["L_t"] == np.inf


KINKS = [
    lambda q: ca.if_else(q > 0, q, 0),
    lambda q: q * ca.sign(q),
    lambda q: ca.if_else(q > 1, q - 1, 0),
    lambda q: ca.if_else(q < 0.1, 0.1 - q, 0),
]


@pytest.mark.parametrize("kink", KINKS)
def test_a_kink_is_no_jump(kink):
    bodies = Bodies([[0.5, 0], [3, 1]])
    model = ManyBodies(bodies=bodies, f=[kink(bodies.member("i").q[0]), 0], t_end=1, step=0.1)
    for one in (model, model.written_out()):
        finding = check(one, ())["S-f"]
        assert finding.verdict != VIOLATED
        assert finding.value["K_f"] == pytest.approx(1)


def test_a_switch_in_time_is_no_jump_in_the_state():
    bodies = Bodies([[0.5, 0], [3, 1]])
    model = ManyBodies(t=t, bodies=bodies, f=[ca.if_else(t < 0.5, 1, -1) * bodies.member("i").q[0], 0], t_end=1, step=0.1)
    assert check(model, (), region={"i.q": (-3, 3)})["S-f"].verdict != VIOLATED


def test_bodies_on_a_line_with_a_velocity_in_time():
    model = ManyBodies(t=t, bodies=Bodies([0.0, 3]), f=[ca.cos(t)], t_end=1, step=0.1)
    assert check(model, (), quick=True)["S-f"].verdict == HOLDS


def test_a_velocity_where_nobody_is_there_yet():
    bodies = Bodies([[0.5, 0], [3, 1]])
    model = ManyBodies(bodies=bodies, f=[ca.sqrt(ca.fabs(bodies.member("i").q[0])), 0], enter=[0.5, 0.5], t_end=1, step=0.1)
    assert check(model, ())["S-f"].verdict == SAMPLED
    called = ManyBodies(bodies=bodies, f=lambda time, q: -q, enter=[0.5, 0.5], t_end=1, step=0.1)
    assert check(called, ())["S-f"].verdict == UNKNOWN


@pytest.mark.parametrize(
    ("f", "why"),
    [
        (lambda time, q: None, "shape"),
        (lambda time, q: q[0], "shape"),
        (lambda time, q: q / 0 * 0, "finite"),
        (lambda time, q: [][0], "IndexError"),
    ],
)
def test_a_function_of_arrays_that_fails_is_told(f, why):
    finding = check(ManyBodies(bodies=Bodies([[0.5, 0], [3, 1]]), f=f, t_end=1, step=0.1), ())["S-f"]
    assert finding.verdict == UNKNOWN
    assert why in finding.how


def test_a_function_of_arrays_does_not_change_the_run():
    bodies = Bodies([[0.5, 0], [3, 1]])
    run = simulate(ManyBodies(bodies=bodies, f=lambda time, q: -q, t_end=1, step=0.1))

    def spoils(time, q):
        q[:] = 7
        return q

    before = run.x.copy()
    check(ManyBodies(bodies=bodies, f=spoils, t_end=1, step=0.1), [run], quick=True)
    assert np.array_equal(run.x, before)


def test_numbers_that_nobody_has_are_no_witness():
    bodies = Bodies([[0.1, 0], [3, 0], [5, 5]], k=[0, 2, 0])
    i = bodies.member("i")
    steep = ca.if_else(i.k == 1, ca.sqrt(ca.fabs(i.q[0])), -i.q[0])
    assert check(ManyBodies(bodies=bodies, f=[steep, 0], t_end=1, step=0.1), ())["S-f"].verdict != VIOLATED
    bodies = Bodies([[0.1, 0], [3, 0], [5, 5]], k=[0, 1, 0])
    i = bodies.member("i")
    steep = ca.if_else(i.k == 1, ca.sqrt(ca.fabs(i.q[0])), -i.q[0])
    found = check(ManyBodies(bodies=bodies, f=[steep, 0], t_end=1, step=0.1), ())["S-f"]
    assert found.verdict == VIOLATED
    assert found.witness["moved"] == "body 1"


def test_a_steep_place_must_be_admissible_at_its_own_time():
    """f is steep at q_0 = 0 while t >= 1/2, when the wall at 2 t keeps everybody away from there."""
    bodies = Bodies([[0.5, 0], [3, 1]])
    i = bodies.member("i")
    f = [ca.sqrt(ca.fabs(i.q[0])) * ca.fmax(t - 0.5, 0), 0]
    wall = {"wall": Family(i.q[0] - 2 * t + 0.4, i)}
    model = ManyBodies(t=t, bodies=bodies, f=f, constraints=wall, t_end=1, step=0.1)
    for one in (model, model.written_out()):
        assert check(one, ())["S-f"].verdict != VIOLATED


def test_a_jump_must_be_admissible_for_all_bodies_at_its_time():
    """f jumps after t = 1/2 alone; then the wall has passed where the bodies stood at the start."""
    bodies = Bodies([[1, 0], [3, 1]])
    i = bodies.member("i")
    f = [ca.if_else(ca.logic_and(t > 0.5, i.q[0] > 5), 1, -1), 0]
    wall = {"wall": Family(i.q[0] - 4 * t, i)}
    model = ManyBodies(t=t, bodies=bodies, f=f, constraints=wall, t_end=1, step=0.1)
    assert check(model, (), region={"i.q": (0, 9)})["S-f"].verdict != VIOLATED


def test_walls_that_close_are_found_along_the_run(by_families):
    """A disc of diameter 0.4 between walls that meet it after 1.5: the step that would squeeze it fails, and A5' says why."""
    close = lambda i: {"low": i.q[1] - i.r - 0.2 * t, "high": 1 - 0.2 * t - i.q[1] - i.r}  # noqa: E731
    model = discs([[0, 0.5], [3, 0.5]], [0.2, 0.2], None, close, t_end=1.5, step=0.1)
    report = check(model)
    assert report["A5'"].verdict == UNKNOWN
    assert "opposing normals" in report["A5'"].how
    assert set(report["A5'"].witness["constraints"]) in (
        {"low 0", "high 0"},
        {"low 1", "high 1"},
    )
    assert report["run-mfcq"].verdict == VIOLATED
    assert check(model, ())["A5'"].verdict == SAMPLED  # At the start alone nothing touches.


# -- gamma of a network ------------------------------------------------------------------------------------------------


def brute_force(N):
    """min |v| over N v >= 1: the best of the points of least norm of all faces that are feasible."""
    best = np.inf
    for size in range(1, min(N.shape) + 1):
        for face in map(list, combinations(range(len(N)), size)):
            v = np.linalg.lstsq(N[face], np.ones(size), rcond=None)[0]
            if (N @ v >= 1 - 1e-9).all():
                best = min(best, float(np.linalg.norm(v)))
    return best


def random_contacts(rng, bodies, count):
    first, second = np.array(list(combinations(range(bodies), 2)))[rng.permutation(bodies * (bodies - 1) // 2)[:count]].T
    u = rng.normal(size=(len(first), 2))
    u /= np.linalg.norm(u, axis=1)[:, None]
    second = np.where(rng.random(len(first)) < 0.25, -1, second)
    other = np.where(second[:, None] < 0, 0.0, -u)
    N = np.zeros((len(first), 2 * bodies))
    for k, (i, j) in enumerate(zip(first, second, strict=True)):
        N[k, 2 * i : 2 * i + 2] = u[k]
        if j >= 0:
            N[k, 2 * j : 2 * j + 2] = -u[k]
    return (u, other), first, second, N / np.linalg.norm(N, axis=1)[:, None]


@pytest.mark.parametrize("small", [contact_network.MAX_WOLFE_GROUP, 1])
def test_gamma_of_small_networks_agrees_with_brute_force(small, monkeypatch):
    """With SMALL = 1 every group goes to the interior point method. A linear program says whether there is any escape."""
    monkeypatch.setattr(contact_network, "MAX_WOLFE_GROUP", small)
    rng, opposed = np.random.default_rng(2), 0
    for _ in range(60):
        slopes, first, second, N = random_contacts(rng, int(rng.integers(2, 5)), int(rng.integers(1, 8)))
        free = linprog(np.zeros(N.shape[1]), A_ub=-N, b_ub=-np.ones(len(N)), bounds=(None, None)).status == 0
        found = contact_network.network_constant(slopes, first, second)
        assert np.isfinite(found.gamma) == free
        opposed += not free
        if free:
            assert found.gamma == pytest.approx(brute_force(N), rel=1e-6)
            assert found.attained <= found.gamma * (1 + 1e-9)
    assert 0 < opposed < 60


def test_gamma_of_a_long_row_of_discs_and_of_groups():
    i = np.arange(299)
    e = np.tile([1.0, 0.0], (299, 1))
    found = contact_network.network_constant((-e, e), i, i + 1)
    assert found.gamma == pytest.approx(disc_row_gamma(300), rel=1e-6)
    assert found.attained <= disc_row_gamma(300) * (1 + 1e-9)
    two = contact_network.network_constant(
        (np.vstack([-e, -e]), np.vstack([e, e])), np.append(i, i + 500), np.append(i + 1, i + 501)
    )
    assert two.gamma == pytest.approx(SQRT2 * disc_row_gamma(300), rel=1e-6)


def parts_that_keep_apart(n=2):
    """Two discs in each body, none of which may meet any other."""
    bodies = Bodies([[2.0 * k, 0, 2.0 * k + 1, 0] for k in range(n)])
    i, j = bodies.member("i"), bodies.member("j")
    g = lambda u, v: ca.norm_2(u - v) - 1  # noqa: E731
    a, b = slice(0, 2), slice(2, 4)
    return bodies, {"own": Family(g(i.q[a], i.q[b]), i)} | {
        name: Family(g(i.q[u], j.q[v]), i, j) for name, u, v in (("aa", a, a), ("bb", b, b), ("ab", a, b), ("ba", b, a))
    }


def crossed():
    bodies = Bodies([[0.0, 0], [0, 1], [2, 2]])
    i, j = bodies.member("i"), bodies.member("j")
    return bodies, {"crossed": Family(ca.norm_2(i.q - ca.vertcat(j.q[1], j.q[0])) - 1, i, j)}


def within_each():
    bodies = Bodies([[0.0, 1], [3, 4]])
    i = bodies.member("i")
    return bodies, {"own": Family(ca.fabs(i.q[0] - i.q[1]) - 1, i)}


@pytest.mark.parametrize("scene", [parts_that_keep_apart, crossed, within_each])
def test_states_tied_otherwise_are_no_discs(scene, by_families):
    bodies, constraints = scene()
    model = ManyBodies(bodies=bodies, constraints=constraints, t_end=1, step=0.1)
    for id in ("A5", "A5'"):
        finding = check(model, (), quick=True)[id]
        assert finding.verdict == SAMPLED
        assert finding.value["gamma"] >= finding.value["attained"]
    if scene is parts_that_keep_apart:
        assert finding.value["gamma"] == pytest.approx(np.sqrt(10))


def corridor(q0, low, high):
    bodies = Bodies(q0)
    i = bodies.member("i")
    constraints = {"low": Family(low(i), i), "high": Family(high(i), i)}
    return ManyBodies(bodies=bodies, f=lambda time, q: 0 * q, constraints=constraints, t_end=1, step=0.1)


def test_what_is_far_does_not_make_walls_touch():
    """The widest distance of the scene is 1e9; both walls are 1/4 away from everybody."""
    report = check(corridor([[0, 0.25], [1e9, 0.25]], lambda i: i.q[1], lambda i: 0.5 - i.q[1]), (), quick=True)
    assert report["A5"].verdict != VIOLATED
    assert report["A5'"].verdict != VIOLATED


def test_a_large_gamma_is_not_infinite():
    report = check(corridor([[0.0, 0]], lambda i: i.q[1], lambda i: 1e-8 * i.q[0] - i.q[1]), (), quick=True)
    assert report["A5'"].verdict == SAMPLED
    assert report["A5'"].value["gamma"] == pytest.approx(2e8, rel=1e-6)


def test_opposing_normals_of_a_large_group_are_still_found(monkeypatch):
    monkeypatch.setattr(contact_network, "MAX_WOLFE_GROUP", 1)
    e = np.tile([1.0, 0.0], (100, 1))
    i = np.arange(99)
    G, H = np.vstack([-e[:99], e[:1], -e[:1]]), np.vstack([e[:99], 0 * e[:2]])
    found = contact_network.network_constant((G, H), np.append(i, [0, 99]), np.append(i + 1, [-1, -1]))
    assert np.isinf(found.attained)


# -- along a run -------------------------------------------------------------------------------------------------------


def test_a_run_of_a_room_meets_what_the_theory_promises():
    model = room(20, t_end=1.0)
    report = check(model, [simulate(model)])
    ids = [finding.id for finding in report.findings if finding.id.startswith("run-")]
    assert ids == ["run-residual", "run-feasible", "run-mfcq", "run-motion"]
    assert all(report[id].verdict == HOLDS for id in ids)
    assert report["run-motion"].value["largest |q_{k+1} - q_k| / (h |f|)"] <= 1 + 1e-9
    assert report["A5"].verdict == SAMPLED
    assert report["A5"].value["gamma"] > 1
    document = json.loads(dumps(report.document()))
    assert document["model_class"] == "ManyBodies"
    assert len(document["findings"]) == 14
    assert "(190 constraints)" in report.markdown()
    assert "pair" in report.text()


def test_a_run_that_overlaps_or_is_pushed_is_found_out():
    model = discs([[-0.5, 0], [0.5, 0.1]], [0.2, 0.2], lambda i: ca.vertcat(-i.q[0], 0), t_end=0.2)
    run = simulate(model)
    bad = run.x.copy()
    bad[4] = [0, 0, 0.3, 0]
    arrays = run.arrays | {"x": bad, "gap_min": np.where(np.arange(len(run.t)) == 4, -0.1, run.gap_min)}
    report = check(model, [Trajectory(arrays, run.metadata)], quick=True)
    assert report["run-feasible"].verdict == VIOLATED
    assert report["run-feasible"].witness["constraint"] == "pair 0-1"
    assert report["run-feasible"].value["least value"] == pytest.approx(-0.1)
    assert report["run-motion"].verdict == VIOLATED
    assert check(model, [run], quick=True)["run-motion"].verdict == HOLDS


def test_a_gap_that_only_the_run_notes_counts():
    model = discs([[-0.5, 0], [0.5, 0.1]], [0.2, 0.2], t_end=0.2)
    run = simulate(model)
    arrays = run.arrays | {"gap_min": np.where(np.arange(len(run.t)) == 4, -0.1, run.gap_min)}
    finding = check(model, [Trajectory(arrays, run.metadata)], quick=True)["run-feasible"]
    assert finding.verdict == VIOLATED
    assert finding.value["least value"] == pytest.approx(-0.1)
    assert finding.witness["t"] == run.t[4]


def test_the_check_makes_its_own_runs():
    report = check(room(4))
    assert report["run-feasible"].verdict == HOLDS
    assert "observed order" in [consequence.name for consequence in report.consequences]


# -- sizes, and what is refused ----------------------------------------------------------------------------------------


@pytest.mark.long
def test_twenty_thousand_are_decided_without_their_pairs():
    import tracemalloc

    model = room(20_000)
    tracemalloc.start()
    report = check(model, (), quick=True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 500e6  # All pairs would be 3.2 GB.
    assert [report[id].verdict for id in ("S-convex", "A0", "A1", "A2", "A3", "A4", "S-start")] == [HOLDS] * 7
    r = model.bodies.numbers["r"]
    assert report["A4"].value["M_contact"] == pytest.approx(1 / r.min())  # of a wall: 1/r; of a pair: 2/(2r)


def test_the_region_is_that_of_one_body():
    model = passing()
    assert check(model, (), region={"i.q_0": (-3, 4)}, quick=True).region.startswith("i.q_0 in [-3, 4]")
    with pytest.raises(UsageError, match=r"'q_0' is not a state; the model has i.q_0, i.q_1"):
        check(model, (), region={"q_0": (-3, 4)}, quick=True)


@pytest.mark.parametrize("tool", [study, stress])
def test_tools_for_small_models_say_how_to_use_them(tool):
    with pytest.raises(UsageError, match=r"written_out\(\)"):
        tool(passing())


@pytest.mark.parametrize("seed", [3, 9])  # rounding bends a wall by 1e-33 there
def test_a_wall_bent_by_rounding_is_no_obstacle_to_warn_of(seed):
    walls = [[(0, 0), (5, 0)], [(5, 0), (5, 1.9)], [(5, 3.1), (5, 5)], [(5, 5), (0, 5)], [(0, 5), (0, 0)]]
    room = Room(walls=walls, exits={"door": [(5, 1.9), (5, 3.1)]})
    assert not simulate(crowd(room, place(room, 25, seed=seed), t_end=0.04, step=0.04)).metadata["warnings"]


# ---------------------------------------------------------------------------------------------- inputs and boxes of parameters

u, w, k = (ca.SX.sym(name) for name in "uwk")


def blown(f=lambda q, c: [u - q[0], c * w], **options):
    """Three discs that a wind u and a wave w, stronger for some, move."""
    bodies = Bodies([[0, 0], [1, 0.3], [2, 0.0]], r=[0.3] * 3, c=[0.1, 0.2, 0.3])
    i, j = bodies.member("i"), bodies.member("j")
    given = {"inputs": {u: pwm(0.1, 0.5), w: table([0, 1], [0, 1], "linear")}, "t_end": 1, "step": 0.01} | options
    pairs = {"pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)}
    return ManyBodies(bodies=bodies, f=ca.vertcat(*f(i.q, i.c)), constraints=pairs, **given)


def test_what_moves_one_body_by_any_measurable_signal_is_well_posed_for_all():
    model = blown()
    many, one = (check(m, (), quick=True) for m in (model, model.written_out()))
    assert {f.id: f.verdict for f in many.findings} == dict.fromkeys((f.id for f in many.findings), "holds")
    assert many["S-f"].value["K_f"] == pytest.approx(one["S-f"].value["K_f"], rel=1e-12)
    assert "L_t" not in many["S-f"].value
    followed = {item.name: item for item in many.consequences}
    assert followed["well posed"].verdict == "holds"
    assert followed["well posed"].statement.startswith("for each signal ")
    assert followed["order 1/2"].verdict == "unknown"


def test_rates_of_inputs_bound_how_fast_the_velocity_of_many_bodies_changes():
    report = check(blown(), (), bounds={u: within(-1, 1, rate=5), w: within(-1, 1, rate=2)}, quick=True)
    largest = np.sqrt(3 * 5**2 + (0.1**2 + 0.2**2 + 0.3**2) * 2**2)  # |f_u u' + f_w w'| over all bodies
    assert largest <= report["S-f"].value["L_t"] <= np.sqrt(3 * (5**2 + 0.6**2)) * (1 + 1e-9)  # the worst body for each
    assert {item.name: item.verdict for item in report.consequences}["order 1/2"] == "holds"


@pytest.mark.parametrize("f", [lambda q, c: [u * ca.sign(q[0] - 0.5), w], lambda q, c: [u * ca.sqrt(ca.fabs(q[0])), w]])
@pytest.mark.long
def test_a_velocity_that_jumps_or_is_steep_where_it_is_multiplied_by_an_input_is_not_proved(f):
    report = check(blown(f), (), bounds={u: within(1, 2)}, quick=True)
    assert report["S-f"].verdict != "holds"
    assert report["A5"].verdict == "holds"
    assert {item.name: item.verdict for item in report.consequences}["well posed"] != "holds"


def test_a_box_of_parameters_is_decided_as_on_the_model_written_out():
    model = blown(lambda q, c: [k * ca.sin(q[0]), c], inputs={}, parameters={k: 1.0})
    many, one = (check(m, (), parameters={k: (0.5, 3)}, quick=True) for m in (model, model.written_out()))
    assert many["S-f"].verdict == one["S-f"].verdict == "holds"
    assert 3 <= many["S-f"].value["K_f"] <= 3 * (1 + 1e-6)
    assert many["A5"].value["gamma"] == pytest.approx(one["A5"].value["gamma"])
    grown = blown(inputs={}, parameters={k: 1.0}, f=lambda q, c: [0, 0])
    pairs = {"pair": Family(grown.constraints["pair"].g - k, grown.constraints["pair"].first, grown.constraints["pair"].second)}
    wide = ManyBodies(bodies=grown.bodies, constraints=pairs, parameters={k: 0.1}, t_end=1, step=0.1)
    many, one = (check(m, (), parameters={k: (0.0, 0.1)}, quick=True) for m in (wide, wide.written_out()))
    for id in ("S-convex", "A0", "A1", "A2", "A3", "A4", "A5", "A5'", "S-start"):
        assert many[id].verdict == one[id].verdict == "holds"
        assert dict(many[id].value) == pytest.approx(dict(one[id].value))
    assert check(wide, (), parameters={k: (0.0, 0.9)}, quick=True)["S-start"].verdict == "violated"


@pytest.mark.parametrize(("width", "q0"), [(0.9, [[0.5, 0.0]]), (3.0, [[0.5], [2.5]])])
def test_of_a_corridor_narrower_than_its_bodies_nothing_holds(width, q0):
    """One disc of radius 0.5 in 0.9; two of radius 1 one after the other in 3, on a line."""
    r = [0.5] if len(q0) == 1 else [1.0, 1.0]
    model = discs(q0, r, others=lambda i: {"left": i.q[0] - i.r, "right": width - i.q[0] - i.r})
    for quick in (True, False):
        report = check(model, [], quick=quick)
        assert report["S-start"].verdict == VIOLATED
        assert "Q(0) is empty" in report["S-start"].how
        assert {report["A5"].verdict, report["A5'"].verdict, *(item.verdict for item in report.consequences)} == {UNKNOWN}
    wide = discs(q0, r, others=lambda i: {"left": i.q[0] - i.r, "right": 4.5 - i.q[0] - i.r})
    assert all("empty" not in item.statement for item in check(wide, [], quick=True).consequences)


def test_many_bodies_whose_start_is_not_admissible():
    """Two of forty discs overlap: of the points of a set that is not shown to have any nothing holds."""
    rng = np.random.default_rng(0)
    q0 = rng.uniform(0, 30, (40, 2))
    q0[1] = q0[0] + 0.1
    report = check(discs(q0, np.full(40, 0.2)), [], quick=True)
    assert report["S-start"].verdict == VIOLATED
    assert {item.verdict for item in report.consequences} == {UNKNOWN}
