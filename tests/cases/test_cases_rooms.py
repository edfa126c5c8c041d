"""Cases of crowds against geometry, projections by SciPy's least squares, balances, shortest ways, isotonic regression."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import isotonic_regression, nnls
from scipy.sparse.csgraph import dijkstra

from nsmodel import simulate
from nsmodel.crowd import People, crowd, measure

ROOMS = ("arch", "city_blocks", "counterflow", "crossing", "running_track", "stairs")


def places(run):
    return run.x.reshape(len(run.t), -1, 2)


def to_segments(q, segments):
    """The nearest points (N, S, 2) of segments (S, 2, 2) to q (N, 2)."""
    a, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    part = np.clip(((q[:, None] - a) * along).sum(axis=2) / (along**2).sum(axis=1), 0, 1)
    return a + part[..., None] * along


def field(q):
    """The nearest points of the middle line of the track."""
    return np.column_stack([np.clip(q[:, 0], -8, 8), 0 * q[:, 0]])[:, None]


def contacts(stem, q, radii, walls, near=np.inf):
    """Gaps (K,) and their gradients (K, N, 2) of pairs and of people with walls, of those that are less than ``near``."""
    (i, j), (feet, room) = (
        np.triu_indices(len(q), 1),
        (field(q), 6.0) if stem == "running_track" else (to_segments(q, walls), 0.0),
    )
    between, away = q[j] - q[i], q[:, None] - feet
    apart, size = np.linalg.norm(between, axis=1), np.linalg.norm(away, axis=2)
    pair, wall = apart - radii[i] - radii[j], size - room - radii[:, None]
    pairs, (who, which) = np.flatnonzero(pair < near), np.nonzero(wall < near)
    G, k = np.zeros((len(pairs) + len(who), len(q), 2)), np.arange(len(pairs))
    G[k, j[pairs]] = between[pairs] / apart[pairs, None]
    G[k, i[pairs]] = -G[k, j[pairs]]
    G[len(pairs) + np.arange(len(who)), who] = away[who, which] / size[who, which, None]
    return np.concatenate([pair[pairs], wall[who, which]]), G


def nearest_velocity(wish, gaps, G, h):
    """argmin |u - wish| with gaps + h G u >= 0: Lawson and Hanson's least distance, by `nnls`."""
    G, wish = G.reshape(len(G), -1), wish.ravel()
    E, last = np.vstack([G.T, -gaps / h - G @ wish]), np.append(np.zeros(len(wish)), 1.0)
    r = E @ nnls(E, last, maxiter=10_000)[0] - last
    return (wish - r[:-1] / r[-1]).reshape(-1, 2)


def wishes(model, t, q):
    """The velocities wanted (N, 2)."""
    if callable(model.f):
        return model.f(t, q)
    away = q - field(q)[:, 0]
    out = away / np.linalg.norm(away, axis=1)[:, None]
    speed = np.random.default_rng(2).uniform(2.5, 4.0, 12)[:, None]
    return speed * (np.cos(0.2) * np.column_stack([-out[:, 1], out[:, 0]]) - np.sin(0.2) * out)


@pytest.mark.parametrize("stem", ROOMS)
def test_nobody_overlaps_and_each_step_is_the_nearest_admissible_one(stem, load_case, run_case):
    model, run = load_case(stem), run_case(stem)
    assert run.metadata["warnings"] == []
    q, radii, walls = places(run), model.scene["radii"], model.scene["walls"]
    pressure = np.nansum(run.pressure, axis=1)
    gaps, pressed = [], int(pressure.argmax())
    for row in {*range(1, len(q) - 1, 10), pressed}:
        here = np.isfinite(q[row, :, 0])
        gaps += contacts(stem, q[row, here], radii[here], walls, 0.1)[0].tolist()
    assert min(gaps) == pytest.approx(0, abs=1e-9)
    for row in (pressed, int(np.flatnonzero(pressure > 1)[0]) + 5):
        before, after, h = q[row - 1], q[row], run.t[row] - run.t[row - 1]
        here = np.isfinite(before[:, 0])
        wish = wishes(model, run.t[row - 1], before)[here]
        u = nearest_velocity(wish, *contacts(stem, before[here], radii[here], walls, 5 * h), h)
        assert np.abs(u - wish).max() > 0.1  # somebody is pushed
        stays = np.isfinite(after[here, 0])
        assert u[stays] == pytest.approx(((after - before) / h)[here][stays], abs=1e-6)


# -- one by one --------------------------------------------------------------------------------------------------------


def last_out(run):
    assert run.metadata["bodies"]["empty_at"] is not None
    return measure.evacuation_times(run).max()


def through_each_other(model):
    """The run in which nobody is in anybody's way."""
    return simulate(replace(model, constraints={"wall": model.constraints["wall"]}), compiled=False)


def test_two_groups_in_a_corridor_keep_their_sum_of_velocities(load_case, run_case):
    model, run = load_case("counterflow"), run_case("counterflow")
    q, way = places(run), np.where(np.arange(40) < 20, 1, -1)
    for row in range(1, np.searchsorted(run.t, 10.0), 20):
        u, wish = (q[row] - q[row - 1]) / model.step, model.f(run.t[row - 1], q[row - 1])
        assert u[:, 0].sum() == pytest.approx(wish[:, 0].sum(), abs=1e-9)
    slow, free = (np.searchsorted(run.t, t) for t in (5.0, 2.0))
    progress = [(way * (q[row] - q[row - 20])[:, 0]).mean() for row in (free, slow)]
    assert progress == pytest.approx([1.14, 0.43], abs=0.05)
    assert (last_out(run), last_out(through_each_other(model))) == pytest.approx((21, 14.4), abs=0.5)
    assert (way * (q[-2] - q[0])[:, 0])[np.isfinite(q[-2, :, 0])].min() > 0


def test_everybody_crosses_to_the_street_wanted(load_case, run_case):
    model, run = load_case("crossing"), run_case("crossing")
    q = places(run)
    last = np.array([own[np.isfinite(own[:, 0])][-1] for own in q.transpose(1, 0, 2)])
    by_street = [last[:12, 0] > 14.4, last[12:24, 0] < -0.4, last[24:36, 1] > 14.3, last[36:, 1] < -0.4]
    assert np.all(by_street)
    assert (last_out(run), last_out(through_each_other(model))) == pytest.approx((16, 11), abs=0.5)


def along_the_track(q):
    """How far along the inner edge (N+1, n), laps added up, m."""
    x, y = q[..., 0], q[..., 1]
    turn = 6.3 * np.arctan2(np.where(np.abs(x) > 8, y, np.sign(y)), np.where(np.abs(x) > 8, np.abs(x) - 8, 0.0))
    right, left = np.clip(x, -8, 8) + turn + 6.3 * np.pi / 2, 16 - np.clip(x, -8, 8) + 6.3 * np.pi * 1.5 - turn
    ahead = np.where((x > 8) | ((np.abs(x) <= 8) & (y < 0)), right, np.where(x < -8, left, 8 - x + 8 + 6.3 * np.pi))
    return np.unwrap(ahead, axis=0, period=32 + 12.6 * np.pi)


def test_runners_in_single_file_are_at_the_isotonic_regression_of_where_they_would_be_alone(run_case):
    run, k = run_case("running_track"), np.arange(12)
    s, speed = along_the_track(places(run)), np.cos(0.2) * np.random.default_rng(2).uniform(2.5, 4.0, 12)
    for row in (40, 100, 200, 480):
        alone = s[0] + speed * run.t[row]
        together = isotonic_regression(alone + 0.6 * k, increasing=False).x - 0.6 * k
        assert s[row] == pytest.approx(together, abs=0.01)
    assert np.abs(alone - together).max() == pytest.approx(13, abs=0.1)
    driven = np.minimum.accumulate(alone + 0.6 * k) - 0.6 * k  # a train at the speed of its slowest
    assert np.abs(driven - together).max() > 5


def shortest(start, blocks):
    """The length of the string pulled tight from a place around the corners of blocks to the gate, and the straight line's."""
    nodes = np.concatenate([start[None], *blocks])
    block = np.concatenate([[-1], *(np.full(len(b), k) for k, b in enumerate(blocks))])
    sides = np.concatenate([np.stack([b, np.roll(b, -1, axis=0)], axis=1) for b in blocks])

    def side_of(a, b, c):
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    def seen(a, b):
        crossings = (
            side_of(a, b, c) * side_of(a, b, d) < -1e-9 and side_of(c, d, a) * side_of(c, d, b) < -1e-9 for c, d in sides
        )
        return not any(crossings)

    n = len(nodes)
    D = np.full((n + 1, n + 1), np.inf)
    for i, j in itertools.combinations(range(n), 2):
        diagonal = block[i] == block[j] and abs(i - j) == 2
        if not diagonal and seen(nodes[i], nodes[j]):
            D[i, j] = np.linalg.norm(nodes[i] - nodes[j])
    for i in range(n):
        gate = np.array([20.0, np.clip(nodes[i, 1], 11.25, 12.75)])
        if seen(nodes[i], gate):
            D[i, n] = np.linalg.norm(nodes[i] - gate)
    straight = np.linalg.norm(start - (20.0, np.clip(start[1], 11.25, 12.75)))
    return dijkstra(D, directed=False, indices=0)[n], straight


def widened(block):
    """A rectangle whose sides are 0.25 m further out: what a person of that radius can walk around."""
    sides = np.roll(block, -1, axis=0) - block
    sides *= 0.25 / np.linalg.norm(sides, axis=1)[:, None]
    return block - sides + np.roll(sides, 1, axis=0)


def test_everybody_takes_the_shortest_streets(load_case):
    model = load_case("city_blocks")
    blocks = [np.array(wall) for wall in np.split(model.scene["walls"][4:, 0], len(model.scene["walls"][4:]) // 4)]
    ways, q = model.f.distance(model.bodies.q0, model.f.group), model.bodies.q0
    farthest = int(ways.argmax())
    for k in (0, 12, farthest):
        tight, straight = shortest(q[k], blocks)
        assert tight <= ways[k] <= shortest(q[k], [widened(block) for block in blocks])[0] + 0.01
    assert (ways[farthest], straight) == pytest.approx((23.3, 21.9), abs=0.05)
    free = measure.evacuation_times(through_each_other(model))
    assert 1.4 * free == pytest.approx(ways + 0.5, abs=0.3)


def test_the_last_one_leaves_the_town_behind_the_others(run_case):
    assert last_out(run_case("city_blocks")) == pytest.approx(17.35, abs=0.5)


def when(run, x):
    """The time (n,) at which each person passes x, on the way to the right."""
    flow = measure.flow(run, [(x, 8.0), (x, 0.0)])
    assert len(flow.time) == 40
    return flow.time[np.argsort(flow.person)]


def test_who_is_pushed_is_down_the_stairs_sooner_and_downstairs_all_walk_freely(load_case, run_case):
    run = run_case("stairs")
    begin, end, later = (when(run, x) for x in (7.0, 11.0, 15.0))
    assert (end - begin).min() < 5.5
    assert (end - begin).max() < 7
    assert later - end == pytest.approx(np.full(40, 4 / 1.2), abs=0.05)
    assert np.diff(np.sort(later)) == pytest.approx(np.diff(np.sort(end)), abs=0.05)  # as many a second, at twice the speed
    assert (last_out(run), last_out(simulate(load_case("stairs", pace=1.0), compiled=False))) == pytest.approx(
        (20.6, 15.3), abs=0.5
    )


def test_one_alone_takes_the_stairs_at_half_speed(load_case):
    model = load_case("stairs", n=1, seed=6)
    x, y = model.bodies.q0[0]
    assert 3.5 < y < 4.5  # straight on
    assert last_out(simulate(model, compiled=False)) == pytest.approx((7 - x) / 1.2 + 4 / 0.6 + 6.5 / 1.2, abs=0.15)


def test_an_arch_is_an_equilibrium_and_little_slack_undoes_it(load_case, run_case):
    model, run = load_case("arch"), run_case("arch")
    q, radii, walls = places(run), model.scene["radii"], model.scene["walls"]

    def left_of(row):
        """How much of the wishes the contacts at a row cannot hold."""
        here = np.isfinite(q[row, :, 0])
        _, G = contacts("arch", q[row, here], radii[here], walls, 1e-7)
        return nnls(G.reshape(len(G), -1).T, -model.f(run.t[row], q[row])[here].ravel())[1]

    assert left_of(-1) < 1e-5
    assert left_of(40) > 0.1
    still = run.metadata["bodies"]["standstill"]
    here = np.isfinite(q[-1, :, 0])
    assert (here.sum(), still["bodies"], run.metadata["bodies"]["empty_at"]) == (22, 22, None)
    assert last_out(simulate(load_case("arch", angle=1.0), compiled=False)) < 20
    room = measure.room_of(run)
    slack = crowd(room, People(q[-1, here], radii[here] - 0.02), t_end=10, step=0.05)
    assert last_out(simulate(slack, compiled=False)) == pytest.approx(6, abs=1)
