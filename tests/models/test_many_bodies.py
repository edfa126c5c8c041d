"""Many bodies: against the same model written out constraint by constraint, all pairs by brute force, another QP solver."""

from __future__ import annotations

import importlib
import os
import signal
import sys

import casadi as ca
import clarabel
import numpy as np
import pytest
import scipy.sparse as sp
from conftest import SHARED
from processes import kill_when_there, start

import nsmodel
from nsmodel import Bodies, Family, Items, ManyBodies, ModelError, StepError, StorageError, Trajectory, UsageError, neighbours
from nsmodel.modeling.fingerprint import fingerprint
from nsmodel.modeling.time_grid import make_grid
from nsmodel.models.many_bodies.contact_search import least_gap, near_contact_rows
from nsmodel.models.many_bodies.contact_solver import BODIES_SOLVERS, COLD_BODIES_START, BodiesStepper
from nsmodel.models.many_bodies.schemes import BodiesProblem
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.solvers.contacts import Contacts

loop, walk = (importlib.import_module(f"nsmodel.simulation.{name}") for name in ("loop", "propagator"))


def simulate(model, **options):
    """The interpreted steps."""
    return nsmodel.simulate(model, compiled=False, **options)


def discs(q0, r, f=0, *, walls=None, t_end=1.0, step=0.01, **more):
    """Discs that keep apart, and above the lines a . q >= b of ``walls``."""
    bodies = Bodies(q0, r=r)
    i, j = bodies.member("i"), bodies.member("j")
    constraints = {"pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)}
    if walls is not None:
        w = Items(a=[wall[0] for wall in walls], b=[wall[1] for wall in walls]).member("w")
        constraints["wall"] = Family(ca.dot(w.a, i.q) - w.b - i.r, i, w)
    f = f(i) if callable(f) and f.__code__.co_argcount == 1 else f
    return ManyBodies(bodies=bodies, f=f, constraints=constraints, t_end=t_end, step=step, **more)


def scattered(n, seed, d=2, free=0.4, **more):
    """Discs at random in a box that they do not fill, all drawn to its middle."""
    rng = np.random.default_rng(seed)
    side = (n / free) ** (1 / d)
    cells = np.stack(np.meshgrid(*[np.arange(int(np.ceil(n ** (1 / d))))] * d), -1).reshape(-1, d)[:n]
    q0 = (cells - cells.mean(axis=0)) * 1.25 + rng.uniform(-0.1, 0.1, (n, d))
    walls = [(sign * axis, -side) for axis in np.eye(d) for sign in (1, -1)]
    return discs(q0, rng.uniform(0.3, 0.5, n), lambda i: -i.q / ca.sqrt(ca.sumsqr(i.q) + 0.01), walls=walls, **more)


def programme(model, t, q):
    """h f, G, g of one step of discs and lines, all constraints written down here, and {(family, first, second): row}."""
    n, d = q.shape
    r = model.bodies.numbers["r"].ravel()
    if isinstance(model.f, ca.SX):
        own = ca.Function("f", [model.me.symbols], [model.f])
        f = np.array([own(row) for row in np.column_stack([q, r])]).reshape(n, d)
    else:
        f = model.f(t, q)
    i, j = np.triu_indices(n, 1)
    distance = np.linalg.norm(q[i] - q[j], axis=1)
    e = (q[i] - q[j]) / distance[:, None]
    G = np.zeros((i.size, n, d))
    G[np.arange(i.size), i], G[np.arange(i.size), j] = e, -e
    rows, gaps = [G.reshape(i.size, -1)], [distance - r[i] - r[j]]
    keys = [(0, one, other) for one, other in zip(i.tolist(), j.tolist(), strict=True)]
    if "wall" in model.constraints:
        lines = model.constraints["wall"].second.group.numbers
        for k, (a, b) in enumerate(zip(lines["a"], lines["b"].ravel(), strict=True)):
            rows.append(np.kron(np.eye(n), a))
            gaps.append(q @ a - b - r)
            keys += [(1, one, k) for one in range(n)]
    return model.step * f, np.vstack(rows), np.concatenate(gaps), {key: row for row, key in enumerate(keys)}


def projected(model, t, q):
    """q + d of one step by Clarabel."""
    hf, G, g, _ = programme(model, t, q)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
    size = np.abs(hf).max()
    cone = [clarabel.NonnegativeConeT(g.size)]
    eye = sp.eye(hf.size, format="csc")
    found = clarabel.DefaultSolver(eye, -hf.ravel() / size, -sp.csc_matrix(G), g / size, cone, settings).solve()
    assert str(found.status) == "Solved"
    return q + size * np.array(found.x).reshape(q.shape)


def misfit(model, t, q, found):
    """How far a step is from optimality: d = h f + G' m, 0 <= m, 0 <= y, m y = 0 over all constraints, in lengths."""
    hf, G, g, row_of = programme(model, t, q)
    acting = zip(*(part.tolist() for part in found.contacts[:3]), strict=True)
    m = np.zeros(g.size)
    m[[row_of[key] for key in acting]] = found.contacts.reaction * model.step
    d = (found.q - q).ravel()
    y = g + G @ d
    return max(np.abs(d - hf.ravel() - G.T @ m).max(), -m.min(), -y.min(), np.minimum(m, np.abs(y)).max())


def one_step(model, q=None, t=0.0, solver="auto"):
    """The step from t, without a run."""
    bound = model.bind()
    q = bound.bodies.q0 if q is None else q
    return BodiesStepper(BodiesProblem(bound), solver, 1e-9)(t, model.step, q)


def all_gaps(q, r):
    """The gaps of all pairs of those that are there."""
    there = np.isfinite(q).all(axis=1)
    q, r = q[there], r[there]
    i, j = np.triu_indices(len(q), 1)
    return np.linalg.norm(q[i] - q[j], axis=1) - r[i] - r[j]


# ---------------------------------------------------------------------------------------------- against the written-out model


def test_a_crowd_is_that_of_the_written_out_model(load_case):
    model = load_case("crowd", n=18)
    run, small = simulate(model, t_end=0.7), nsmodel.simulate(model.written_out(), t_end=0.7, compiled=False)
    assert np.isfinite(run.x).all()  # nobody is out yet
    assert run.x == pytest.approx(small.x, abs=1e-9)
    assert run.q.shape == (36, 36)
    assert run.gap_min[1:] == pytest.approx(small.gap[1:].min(axis=1), abs=1e-12)
    for row in (1, 20, 35):
        found = run.contacts(row)
        mine = dict(zip(zip(*found[:3], strict=True), found.reaction, strict=True))
        theirs = {}
        for name, reaction in zip(small.metadata["multiplier_names"], small.reactions[row], strict=True):
            family, members = name.split()
            if reaction > 0:
                theirs[(run.metadata["families"].index(family), *map(int, members.split("-")))] = reaction
        assert mine.keys() == theirs.keys()
        assert list(mine.values()) == pytest.approx([theirs[key] for key in mine], abs=1e-9)


@pytest.mark.parametrize(("d", "n"), [(1, 12), (2, 25), (3, 30)])
def test_steps_are_the_projection_on_all_constraints(d, n):
    model = scattered(n, d, d, step=0.1)
    q = model.bodies.q0
    for k in range(4):
        found = one_step(model, q, 0.1 * k)
        assert found.q == pytest.approx(projected(model, 0.1 * k, q), abs=1e-8)
        assert misfit(model, 0.1 * k, q, found) <= 1e-12
        q = found.q
    assert found.solver != "none needed"
    assert found.residual <= 1e-9


def test_quadratic_programmes_of_a_crowd():
    for n in (10, 200, 1000):
        path = SHARED / "data" / "crowd" / f"crowd_qp_N{n}.npz"
        if not path.is_file():
            pytest.skip(f"no reference data: {path}")
        data = np.load(path)
        q, V, L = data["q_k"].reshape(-1, 2), data["V"].reshape(-1, 2), max(0.6 * np.ceil(np.sqrt(n)), 2.4)
        low, high = L / 2 - 0.6, L / 2 + 0.6
        ends = np.array([[(0, 0), (0, L)], [(0, 0), (L, 0)], [(0, L), (L, L)], [(L, 0), (L, low)], [(L, high), (L, L)]])
        people, walls = Bodies(q, r=data["r"]), Items(a=ends[:, 0], b=ends[:, 1])
        i, j, w = people.member("i"), people.member("j"), walls.member("w")
        along = w.b - w.a
        part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
        families = {
            "pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j),
            "wall": Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w),
        }
        model = ManyBodies(bodies=people, f=lambda t, q, V=V: V, constraints=families, t_end=1, step=float(data["h"]))
        for solver in ("auto", "clarabel") if n < 1000 else ("auto",):
            found = one_step(model, solver=solver)
            assert found.q.ravel() == pytest.approx(data["q_star"], abs=1e-8)
            assert found.residual <= 1e-9
            assert len(found.contacts.first) == np.count_nonzero(data["lam_star"] > 1e-9)


def test_nobody_overlaps_in_a_crowd(load_case):
    model = load_case("crowd", n=200)
    run = simulate(model, t_end=2)
    r = model.bodies.numbers["r"].ravel()
    gaps = np.array([all_gaps(x.reshape(-1, 2), r).min() for x in run.x])
    assert gaps.min() >= -1e-10
    places = run.x.reshape(len(run.t), -1, 2)
    for a, b in model.scene["walls"]:
        along = b - a
        part = np.clip((places - a) @ along / (along @ along), 0, 1)
        assert np.nanmin(np.linalg.norm(places - a - part[..., None] * along, axis=-1) - r) >= -1e-10
    assert run.residual[1:].max() <= 1e-9
    assert (run.gap_min <= gaps + 1e-14).all()
    assert run.gap_min[4:].max() <= 1e-9  # by then they touch


# ---------------------------------------------------------------------------------------------- what is left out


SIDE = 30


def squirt():
    """Two rows on a floor press a disc between them from below; it flies faster than any wants to go, and hits one above."""
    lift = 0.25
    left = np.column_stack([-np.sqrt(1 - lift**2) - np.arange(SIDE), np.zeros(SIDE)])
    q0 = np.vstack([left, left * [-1, 1], [[0, lift], [0, lift + 1 + 0.053]]])
    f = np.zeros((2 * SIDE + 2, 2))
    f[:SIDE, 0], f[SIDE:-2, 0] = 1, -1
    return q0, f


def pressing(q0, f):
    return discs(q0, np.full(len(q0), 0.5), lambda t, q: f, walls=[((0.0, 1.0), -0.5)], step=0.02)


def pairs_of(rows):
    return {(i, j) for family, i, j in zip(rows.family, rows.first.tolist(), rows.second.tolist(), strict=True) if family == 0}


def test_a_fast_body_meets_one_beyond_the_first_cut_off():
    q0, f = squirt()
    model, last = pressing(q0, f), (2 * SIDE, 2 * SIDE + 1)
    first = near_contact_rows(BodiesProblem(model.bind()), 0.02, q0, np.ones(len(q0), bool), 1.25 * 0.02 * 2)
    assert last not in pairs_of(first)
    found = one_step(model)
    assert last in pairs_of(found.contacts)
    assert np.linalg.norm(found.q[-2] - q0[-2]) > 2 * 0.02  # none wants to go faster than 1
    assert misfit(model, 0.0, q0, found) <= 1e-12
    assert found.gap_min >= -1e-12


def test_the_search_finds_the_pairs_that_brute_force_finds():
    rng = np.random.default_rng(0)
    for d, alike in [(1, True), (2, True), (3, True), (1, False), (2, False), (3, False)]:
        q, r = rng.uniform(-3, 3, (40, d)), rng.uniform(0.01, 0.3, 40) if alike else 10 ** rng.uniform(-4, 0.5, 40)
        q[5] = q[3]
        problem = BodiesProblem(discs(q, r).bind())
        there = rng.random(40) < 0.8
        rows = near_contact_rows(problem, 0.0, q, there, 0.5)
        i, j = np.triu_indices(40, 1)
        gap = np.linalg.norm(q[i] - q[j], axis=1) - r[i] - r[j]
        expected = (gap < 0.5) & there[i] & there[j]
        assert list(zip(rows.first.tolist(), rows.second.tolist(), strict=True)) == list(
            zip(i[expected].tolist(), j[expected].tolist(), strict=True)
        )
        assert rows.g == pytest.approx(gap[expected], abs=1e-14)
        assert least_gap(problem, 0.0, q, there) == pytest.approx(gap[there[i] & there[j]].min(), abs=1e-14)


def test_a_reach_that_is_no_sum_is_searched_too():
    bodies = Bodies([[0.0], [1.5], [3.5]], r=[1, 2, 3])
    i, j = bodies.member("i"), bodies.member("j")
    g = ca.norm_2(i.q - j.q) - 0.5 * ca.sqrt(i.r * j.r)
    model = ManyBodies(bodies=bodies, f=[1 - i.r], constraints={"pair": Family(g, i, j)}, t_end=2, step=0.05)
    problem = BodiesProblem(model.bind())
    assert problem.reach(0, 0.0) == pytest.approx(0.5 * np.sqrt(9), abs=1e-12)  # of all numbers, a bound
    run, small = simulate(model), nsmodel.simulate(model.written_out(), compiled=False)
    assert run.x == pytest.approx(small.x, abs=1e-10)


@pytest.mark.parametrize(
    ("reach", "largest"),
    [
        (lambda a, b: ca.if_else(a * b > 3, 3, 0.5), 3),
        (lambda a, b: ca.if_else(a == b, 3, 0.5), 3),
        (lambda a, b: ca.fmax(a, b) + ca.fmin(a, b), 4),
        (lambda a, b: ca.sign(a * b - 3) + 2, 3),
        (lambda a, b: ca.if_else(a > 1.5, 2 * a, a) + b, 6),
    ],
)
def test_a_reach_with_steps_is_that_of_all_pairs(reach, largest):
    bodies = Bodies([[0.0, 0], [2, 0], [10, 0], [11.5, 0]], k=[1, 1, 2, 2])
    i, j = bodies.member("i"), bodies.member("j")
    pair = Family(ca.norm_2(i.q - j.q) - reach(i.k, j.k), i, j)
    model = ManyBodies(bodies=bodies, constraints={"pair": pair}, t_end=1, step=0.1)
    assert BodiesProblem(model.bind()).reach(0, 0.0) == pytest.approx(largest, abs=1e-11)


def test_groups_that_do_not_touch_are_solved_apart():
    q0, f = squirt()
    shifts = [np.array([x, 0.0]) for x in (0, 100, 200)]
    alone = one_step(pressing(q0, f), solver="clarabel")
    together = one_step(pressing(np.vstack([q0 + shift for shift in shifts]), np.vstack([f, f, f])), solver="clarabel")
    assert alone.groups >= 1
    assert together.groups == 3 * alone.groups
    for k, shift in enumerate(shifts):
        assert together.q[k * len(q0) : (k + 1) * len(q0)] - shift == pytest.approx(alone.q, abs=1e-12)


# ---------------------------------------------------------------------------------------------- solvers


@pytest.mark.parametrize("solver", [name for name in BODIES_SOLVERS if name not in ("piqp", "proxqp", "highs", "ipqp")])
def test_a_forced_solver_gives_the_certified_answer(solver):
    model = scattered(16, 4, step=0.1)
    found = one_step(model, solver=solver)
    assert found.q == pytest.approx(projected(model, 0.0, model.bodies.q0), abs=1e-8)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_lattices_have_more_contacts_than_unknowns(kind):
    """Equal discs in a lattice pressed to a wall: the reactions are not unique, positions are."""
    n = 9
    k = np.arange(n * n)
    q0 = np.column_stack([k // n, k % n]).astype(float)
    if kind == "hexagonal":
        q0 = np.column_stack([np.sqrt(3) / 2 * q0[:, 0], q0[:, 1] + 0.5 * (k // n % 2)])
    r = np.full(n * n, 0.5 - 1e-14)
    wall = [((-1.0, 0.0), -(q0[:, 0].max() + 0.5))]
    model = discs(q0, r, lambda i: [1, -0.3 * (i.q[1] - n / 2)], walls=wall, t_end=0.2)
    run = simulate(model)
    assert run.residual[1:].max() <= 1e-9
    assert min(all_gaps(x.reshape(-1, 2), r).min() for x in run.x) >= -1e-10
    assert misfit(model, 0.0, q0, one_step(model)) <= 1e-12


def test_bodies_pressed_by_closing_walls_are_named():
    bodies = Bodies([[0.0, 0.0], [2.0, 0.0]], r=[0.5, 0.5])
    i, j, w = bodies.member("i"), bodies.member("j"), Items(s=[1.0, -1.0]).member("w")
    t = ca.SX.sym("t")
    families = {
        "pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j),
        "wall": Family(w.s * (i.q[0] - 1) + 2.02 - t - i.r, i, w),
    }
    model = ManyBodies(t=t, bodies=bodies, constraints=families, t_end=2, step=0.1)
    with pytest.raises(StepError, match=r"step 10: .* leave no point: .*'pair 0-1'.*'wall ") as failed:
        simulate(model)
    assert failed.value.step == 10
    assert len(failed.value.trajectory) == 10
    assert failed.value.component.split()[0] in ("pair", "wall")


# ---------------------------------------------------------------------------------------------- families


def test_a_chain_of_neighbours_is_a_string_with_a_stop():
    """Links |q_i - q_j| <= 1 along a chain, one end pulled: g = 1 - distance is not convex but in one dimension."""
    n = 6
    beads = Bodies(np.arange(n) * 0.5)
    i, j = beads.member("i"), beads.member("j")
    constraints = {
        "link": Family(1 - (j.q - i.q), i, j, over=neighbours(n)),
        "order": Family(j.q - i.q - 0.25, i, j, over=neighbours(n)),
    }
    model = ManyBodies(
        bodies=beads,
        f=lambda t, q: np.where(np.arange(n)[:, None] == n - 1, 1.0, 0.0),
        constraints=constraints,
        t_end=4,
        step=0.01,
    )
    run = simulate(model)
    # beads are taken along one after the other, at the mean velocity of those that move
    x, position = run.x[-1], np.arange(n) * 0.5
    for _ in range(400):
        velocity = np.where(np.arange(n) == n - 1, 1.0, 0.0)
        position = _string(position, position + 0.01 * velocity)
    assert x == pytest.approx(position, abs=1e-10)
    assert run.metadata["families"] == ["link", "order"]
    assert np.diff(x).max() <= 1 + 1e-12


def _string(start, wanted):
    """The nearest positions with 0.25 <= x_{i+1} - x_i <= 1, by Dykstra's alternating projections."""
    x, n = wanted.copy(), len(wanted)
    moves = np.zeros((n - 1, 2))
    for _ in range(3000):
        before = x.copy()
        for i in range(n - 1):
            x[i : i + 2] -= moves[i]
            gap = x[i + 1] - x[i]
            shift = (np.clip(gap, 0.25, 1) - gap) / 2
            moves[i] = -shift, shift
            x[i : i + 2] += moves[i]
        if np.abs(x - before).max() < 1e-15:
            break
    return x


def test_each_body_alone_and_parameters_and_time():
    """Beads above a floor that rises: q = max(q0, floor), whatever the numbers."""
    beads = Bodies([[0.0], [1.0], [2.0]], low=[0.0, 0.1, -3.0])
    i = beads.member("i")
    t, a = ca.SX.sym("t"), ca.SX.sym("a")
    model = ManyBodies(
        t=t, bodies=beads, constraints={"floor": Family(i.q - i.low - a * t, i)}, parameters={a: 1.0}, t_end=2, step=0.125
    )
    run = simulate(model, parameters={"a": 2.0})
    assert run.x[-1] == pytest.approx([4.0, 4.1, 2.0], abs=1e-14)
    assert run.contacts(-1).second.tolist() == [-1, -1]
    assert run.contacts(-1).reaction == pytest.approx([2.0, 2.0], abs=1e-12)
    assert run.pressure[-1] == pytest.approx([2.0, 2.0, 0.0], abs=1e-12)
    assert run.gap_min[-1] == pytest.approx(0, abs=1e-14)


def test_no_constraint_is_eulers_method():
    model = discs([[1.0, 0.0]], [0.1], lambda i: -i.q, t_end=1, step=0.1)
    run = simulate(model)
    assert run.x[-1] == pytest.approx([0.9**10, 0], abs=1e-14)
    assert run.metadata["solver_counts"] == {"none needed": 10}
    assert (run.gap_min == np.inf).all()
    assert "least gap" not in run.summary_text()


def test_f_may_be_a_function_and_is_checked():
    model = scattered(9, 1, t_end=0.5, step=0.05)
    bound = model.bind()
    given = BodiesProblem(bound)
    called = discs(
        model.bodies.q0, model.bodies.numbers["r"].ravel(), lambda t, q: given.f(t, q, np.ones(9, bool)),
        walls=[(sign * axis, -(9 / 0.4) ** 0.5) for axis in np.eye(2) for sign in (1, -1)], t_end=0.5, step=0.05,
    )  # fmt: skip
    assert (simulate(model).x == simulate(called).x).all()
    q0, r = model.bodies.q0, np.full(9, 0.1)
    wrong = {
        r"f gave an array of shape \(2,\) .* expected \(9, 2\)": lambda t, q: np.zeros(2),
        r"f of body 3 is \[nan  ?0\.\].*finite": lambda t, q: np.where(np.arange(18).reshape(9, 2) == 6, np.nan, 0),
        "f raised KeyError": lambda t, q: {}["nobody"],
    }
    for message, f in wrong.items():
        with pytest.raises((StepError, UsageError), match=message):
            simulate(discs(q0, r, f))


# ---------------------------------------------------------------------------------------------- leaving and entering


def test_bodies_leave_after_the_step_that_takes_them_out():
    model = discs([[0.0], [2.0]], [0.5, 0.5], [1.0], t_end=4, step=0.25, leave=None)
    i = model.me
    model = ManyBodies(bodies=model.bodies, f=[1.0], constraints=dict(model.constraints), leave=i.q[0] - 3, t_end=4, step=0.25)
    run = simulate(model)
    there = np.isfinite(run.x)
    assert run.x[there[:, 1], 1].max() == 3.25  # the row that is out is kept, then it is gone
    assert there[:, 0].sum() == 14
    assert there[:, 1].sum() == 6
    bodies = {"count": 2, "d": 1, "there": 0, "waiting": 0, "left": 2}
    assert run.metadata["bodies"] == bodies | {"empty_at": run.t[-1], "standstill": None}
    assert run.gap_min[-1] == np.inf


def test_bodies_enter_when_their_start_is_free():
    """Three start at one place, one after the other is let in; each as soon as the one before has moved its diameter."""
    q0, r = np.zeros((4, 1)), np.full(4, 0.5)
    model = discs(q0, r, [1.0], t_end=5, step=0.25, enter=[0, 0.5, 0.5, 4.25])
    run = simulate(model)
    first = [int(np.flatnonzero(np.isfinite(x))[0]) for x in run.x.T]
    assert run.t[first].tolist() == [0, 1, 2, 4.25]
    assert [run.x[k, i] for i, k in enumerate(first)] == [0, 0, 0, 0]
    assert np.nanmin(run.gap_min) >= 0
    assert run.metadata["totals"]["entered"] == 3
    waits = simulate(discs(q0[:2], r[:2], 0, t_end=1, step=0.25, enter=[0, 0.5]))
    assert waits.metadata["bodies"]["waiting"] == 1
    assert "1 waiting" in waits.summary_text()
    assert np.isnan(waits.x[:, 1]).all()


def test_everyone_may_leave(load_case):
    run = simulate(load_case("crowd", n=5), t_end=6)
    assert np.isnan(run.x[-1]).all()
    assert run.metadata["bodies"]["left"] == 5
    assert run.residual[1:].max() <= 1e-9


# ---------------------------------------------------------------------------------------------- runs


def resumable():
    """Entering, leaving, and a parameter."""
    model = scattered(12, 3, t_end=1.5, step=0.01)
    i = model.me
    return ManyBodies(
        bodies=model.bodies, f=model.f + ca.DM([0.3, 0.0]), constraints=dict(model.constraints), leave=i.q[0] - 1.2, t_end=1.5,
        step=0.01, enter=np.where(np.arange(12) % 3, 0.0, 0.7),
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    simulate(resumable(), out=folder)
    return (folder / "trajectory.npz").read_bytes()


def test_a_run_in_chunks_and_a_resumed_run_have_the_same_bytes(tmp_path, whole, monkeypatch):
    memory = simulate(resumable())
    memory.save(tmp_path / "memory.npz")
    assert (tmp_path / "memory.npz").read_bytes() == whole
    monkeypatch.setattr(walk, "CHUNK_BYTES", 1)  # 64 rows
    simulate(resumable(), out=tmp_path / "chunks")
    assert (tmp_path / "chunks" / "trajectory.npz").read_bytes() == whole
    simulate(resumable(), out=tmp_path / "parts", t_end=0.5)
    simulate(resumable(), out=tmp_path / "parts", t_end=1.17, resume=True)
    simulate(resumable(), out=tmp_path / "parts", resume=True)
    assert (tmp_path / "parts" / "trajectory.npz").read_bytes() == whole
    with pytest.raises(StorageError, match="another tolerance"):
        simulate(resumable(), out=tmp_path / "parts", resume=True, tolerance=1e-8)
    sparse = simulate(resumable(), save_every=7)
    assert sparse.x == pytest.approx(np.vstack([memory.x[::7], memory.x[-1:]]), nan_ok=True, abs=0)
    for row in (0, 5, -1):
        at = 7 * row if row >= 0 else -1
        assert all((a == b).all() for a, b in zip(sparse.contacts(row), memory.contacts(at), strict=True))


@pytest.mark.long
def test_a_killed_run_is_resumed_to_the_same_bytes(tmp_path, whole):
    code = (
        "import time, tests.models.test_many_bodies as t; t.walk.CHUNK_BYTES = 1\n"
        "call = t.BodiesStepper.__call__\n"
        "def slow(*args): time.sleep(1e-3); return call(*args)\n"
        "t.BodiesStepper.__call__ = slow; t.simulate(t.resumable(), out='run')"
    )
    kill_when_there(start(code, tmp_path), tmp_path / "run" / "chunk-000002.npz")
    simulate(resumable(), out=tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "trajectory.npz").read_bytes() == whole


def test_ctrl_c_keeps_what_was_computed(tmp_path, whole, monkeypatch):
    call = BodiesStepper.__call__

    def interrupting(self, *args):
        if args[-1] == 100:
            os.kill(os.getpid(), signal.SIGINT)
        return call(self, *args)

    monkeypatch.setattr(BodiesStepper, "__call__", interrupting)
    with pytest.raises(nsmodel.RunInterrupted, match=r"interrupted at t = 1\.01") as stopped:
        simulate(resumable(), out=tmp_path)
    assert len(stopped.value.trajectory) == 101
    monkeypatch.undo()
    simulate(resumable(), out=tmp_path, resume=True)
    assert (tmp_path / "trajectory.npz").read_bytes() == whole


def test_a_trajectory_is_told_written_and_read(tmp_path, load_case):
    run = simulate(load_case("crowd", n=20), t_end=0.6)
    run.save(tmp_path / "run.npz")
    again = Trajectory.load(tmp_path / "run.npz")
    assert all((a == b).all() for a, b in zip(again.contacts(-1), run.contacts(-1), strict=True))
    assert isinstance(run.contacts(3), Contacts)
    assert (np.diff(run.arrays["contact_row"]) >= 0).all()
    pressure = np.zeros(20)
    family, first, second, reaction = run.contacts(-1)
    np.add.at(pressure, first, reaction)
    np.add.at(pressure, second[family == 0], reaction[family == 0])
    assert run.pressure[-1] == pytest.approx(pressure, abs=1e-12)
    run.to_csv(tmp_path / "run.csv")
    table = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    assert table["q_39"] == pytest.approx(run.x[:, 39])
    assert not any(name.startswith("contact") for name in table.dtype.names)
    assert run.to_xarray()["contact_first"].dims == ("contact",)
    text = run.summary_text()
    assert "20: 20 there at the end, 0 left" in text
    assert "final state" not in text
    assert len(text.splitlines()) < 20
    with pytest.raises(UsageError, match="row 31: the run has the rows 0 to 30"):
        run.contacts(31)
    with pytest.raises(UsageError, match="belong to a model of many bodies"):
        nsmodel.simulate(load_case("moving_disc")).contacts(0)


def test_what_is_used_is_explained(load_case):
    text = nsmodel.explain(load_case("crowd"), compiled=False)
    for words in ("'pair': 4,950 pairs", "search tree", "cut-off", "'wall': 500 constraints, all evaluated", "clarabel", "apart"):
        assert words in text
    assert "solver daqp alone" in nsmodel.explain(load_case("crowd"), solver="daqp", compiled=False)


def test_a_compiled_step_that_fails_is_taken_interpreted(monkeypatch):
    model = scattered(9, 2, t_end=0.1).bind()

    class Failing:
        def __init__(self, *args):
            self.seconds, self.way = {}, "compiled by nobody"

        def __call__(self, *args):
            raise StepError("not certified")

    monkeypatch.setitem(sys.modules, "nsmodel.models.many_bodies.step_library", type(sys)("bodies"))
    sys.modules["nsmodel.models.many_bodies.step_library"].CompiledBodiesStep = Failing
    run = prepared_loop(model, compiled=True)
    assert run.propagator.settings["way of stepping"].startswith("compiled by")
    assert run.go().x == pytest.approx(simulate(model).x, abs=0)


# ---------------------------------------------------------------------------------------------- errors


def test_wrong_use_is_refused(load_case, tmp_path):
    crowd = load_case("crowd", n=10)
    with pytest.raises(
        UsageError, match=r"constraint 'pair 0-2' = -0\.4 < 0 at the start, body 0 at \(0, 0\) and body 2 at \(0\.6, 0\)"
    ):
        simulate(discs([[0, 0], [2, 0], [0.6, 0]], [0.5, 0.5, 0.5]))
    with pytest.raises(UsageError, match=r"'wall 1-0' = -0\.2 < 0 at the start, body 1 at"):
        simulate(_above([[0, 3.0], [2.0, 0.3]]))
    with pytest.raises(UsageError, match="rtol and atol do not apply to many bodies"):
        simulate(crowd, rtol=1e-3)
    with pytest.raises(UsageError, match="solver 'ipopt' is unknown for many bodies"):
        simulate(crowd, solver="ipopt")
    with pytest.raises(UsageError, match="steps do not fit in memory"):
        simulate(crowd, step=1e-9)
    simulate(crowd, t_end=0.1, out=tmp_path)
    with pytest.raises(StorageError, match="another model"):
        simulate(load_case("crowd", n=11), t_end=0.2, out=tmp_path, resume=True)
    bodies = Bodies(np.arange(10_000.0)[:, None])
    i, j = bodies.member("i"), bodies.member("j")
    huge = ManyBodies(bodies=bodies, constraints={"far": Family((i.q - j.q) ** 2 - 1, i, j)}, t_end=1, step=0.1)
    with pytest.raises(UsageError, match=r"'far' runs over 49,995,000 members"):
        simulate(huge)
    with pytest.raises(ModelError):
        discs([[0.0, np.nan]], [1.0])


def _above(q0):
    return discs(q0, [0.5, 0.5], walls=[((0.0, 1.0), 0.0)])


def test_a_constraint_that_is_overrun_is_told():
    """1 - |q| is not convex: the linearised set lets a body out."""
    bodies = Bodies([[0.8, 0.0]])
    i = bodies.member("i")
    model = ManyBodies(bodies=bodies, f=[1, 1], constraints={"round": Family(1 - ca.norm_2(i.q), i)}, t_end=0.5, step=0.1)
    run = simulate(model)
    assert any("'round 0' was overrun" in warning for warning in run.metadata["warnings"])


def test_the_identity_of_a_model_is_its_numbers_and_expressions(load_case):
    def mark(model):
        bound = model.bind()
        return fingerprint(bound, make_grid(bound, None, None, None))

    crowd = load_case("crowd", n=10)
    assert mark(crowd) == mark(load_case("crowd", n=10))
    others = [
        load_case("crowd", n=11),
        load_case("crowd", n=10, seed=2),
        _above([[0, 3.0], [2.0, 1.0]]),
        _above([[0, 3.0], [2.0, 2.0]]),
    ]
    assert len({mark(model) for model in (crowd, *others)}) == 5
    one, two = (discs([[0.0], [5.0]], [1, 1], lambda t, q, v=v: np.full((2, 1), v)) for v in (1.0, 2.0))
    assert mark(one) != mark(two)


def test_a_cold_step_and_a_warm_one_agree():
    model = scattered(16, 5, step=0.1)
    stepper = BodiesStepper(BodiesProblem(model.bind()), "auto", 1e-9)
    one = stepper(0.0, 0.1, model.bodies.q0)
    again = stepper(0.1, 0.1, one.q, one.warm)
    cold = stepper(0.1, 0.1, one.q, COLD_BODIES_START)
    assert again.q == pytest.approx(cold.q, abs=1e-12)
