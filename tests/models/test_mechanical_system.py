"""Mechanical systems: files of another program, helpers against their formulas, C, sweeps and checkpoints, what is refused."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import sympy

import nsmodel
from nsmodel import Contact, MechanicalSystem, ModelError, UsageError, check, mechanics, simulate, sweep
from tests.models.test_mechanical_scenes import G, S, ball, incline, pendulum, pile, rod
from tests.simulation.test_compiled_runs import stop_after

FILES = Path(__file__).resolve().parents[3] / "shared" / "data" / "mechanics"
AS_SICONOS = {"restitution": "newton", "project": False, "tol_g": 0.0}


def reference(name):
    if not (FILES / name).exists():
        pytest.skip("the reference files are not here")
    return np.loadtxt(FILES / name, skiprows=1)


# -- files of Siconos, first row: t, then columns ----------------------------------------------------------------------


def test_a_ball_of_siconos():
    ref, q, v = reference("BouncingBallTS.ref"), S("height"), S("speed")
    model = MechanicalSystem(q=q, v=v, M=1, F=-G, contacts={"floor": Contact(q, e=0.9)}, q0=1, t_end=10, step=5e-3,
                             activation=0.5, **AS_SICONOS)  # fmt: skip
    run = simulate(model)
    n = min(len(ref), len(run.t))
    np.testing.assert_allclose(run.x[:n], ref[:n, 1:3], atol=1e-12)


def test_a_disc_of_siconos():
    ref, q, v, R = reference("Ball2D_kernel_only_with_friction.ref"), S("p", 3), S("w", 3), 0.5
    floor = Contact(q[0] - R, slip=v[1] - R * v[2], mu=0.1, e=0.9)
    model = MechanicalSystem(q=q, v=v, M=[1, 1, 0.4 * R**2], F=[-G, 0, 0], contacts={"floor": floor}, q0=[1, 0, 0], v0=[0, 0, 2],
                             t_end=10, step=5e-3, activation=1, **AS_SICONOS)  # fmt: skip
    run = simulate(model)
    n = min(len(ref), len(run.t))
    np.testing.assert_allclose(run.q[:n, 0], ref[:n, 1], atol=1e-12)
    np.testing.assert_allclose(np.abs(run.v[:n]), np.abs(ref[:n, [2, 8, 3]]), atol=1e-12)


def test_a_column_of_beads_of_siconos():
    ref, n = reference("ColumnOfBeadsTS.ref"), 10
    q, v = S("p", n), S("w", n)
    contacts = {"floor": Contact(q[0] - 0.1, e=0.9)} | {f"pair {i}": Contact(q[i + 1] - q[i] - 0.2, e=0.9) for i in range(n - 1)}
    model = MechanicalSystem(q=q, v=v, M=1, F=[-G] * n, contacts=contacts, q0=1 + 0.25 * np.arange(n), t_end=2, step=5e-4,
                             activation=0.5, **AS_SICONOS)  # fmt: skip
    run = simulate(model, compiled=True)
    k = min(len(ref), len(run.t))
    np.testing.assert_allclose(run.q[:k], ref[:k, 1:21:2], atol=1e-12)
    np.testing.assert_allclose(run.v[:k], ref[:k, 2:22:2], atol=1e-12)


def test_two_balls_of_siconos():
    ref, q, v, R = reference("TwoBouncingBallTS-MoreauJeanGOSI.ref"), S("p", 6), S("w", 6), 0.1
    contacts = {
        "floor": Contact(q[0], slip=v[1:3], mu=0.6, e=0.95, e_t=0.95),
        "pair": Contact(q[3] - q[0] - 2 * R, slip=v[4:6] - v[1:3], mu=0.6, e=0.95, e_t=0.95),
    }
    M, F = [1, 1, 0.4 * R**2, 2, 2, 0.8 * R**2], [-G, 0, 0, -2 * G, 0, 0]
    model = MechanicalSystem(q=q, v=v, M=M, F=F, contacts=contacts, q0=[0.1, 0, 0, 0.301, 0, 0], t_end=3, step=1e-3,
                             activation=1.5, **AS_SICONOS)  # fmt: skip
    run = simulate(model, compiled=True)
    n = min(len(ref), len(run.t))
    np.testing.assert_allclose(run.x[:n][:, [0, 6, 3]], ref[:n][:, [1, 2, 5]], atol=1e-12)


def test_a_stick_of_siconos():
    ref, q, v, a = reference("ImpactingStick.ref"), S("p", 3), S("w", 3), np.pi / 4
    tip = Contact(q[1] - 0.5 * ca.cos(q[2]), slip=-v[0] - 0.5 * ca.cos(q[2]) * v[2], mu=0.01, e=1)
    model = MechanicalSystem(q=q, v=v, M=[1, 1, 1 / 12], F=[0, -10, 0], contacts={"tip": tip},
                             q0=[0.5 * np.sin(a), 0.5 * np.cos(a) + 0.01, a], v0=[-0.5, 0.1, 0.1], t_end=0.2, step=1e-4,
                             activation=0.5, geometry="begin", **AS_SICONOS)  # fmt: skip
    run = simulate(model, compiled=True)
    n = min(len(ref), len(run.t))
    np.testing.assert_allclose(run.x[:n], ref[:n, 1:7], atol=1e-12)


def woodpecker(t_end):
    """Glocker's woodpecker toy: sleeve, spring and bird on a pole."""
    rO, rM, hM, lM, lG, hS, lS = 0.0025, 0.0031, 0.0058, 0.010, 0.015, 0.02, 0.0201
    mM, mS, JM, JS, c = 0.0003, 0.0045, 5e-9, 7e-7, 0.0056
    q, v, (a, b, d) = S("p", 3), S("w", 3), (mS * lM, mS * lG, mS * lM * lG)
    M = [[mS + mM, a, b], [a, JM + mS * lM**2, d], [b, d, JS + mS * lG**2]]
    F = -G * ca.vertcat(mS + mM, a, b) - c * ca.vertcat(0, q[1] - q[2], q[2] - q[1])
    contacts = {
        "beak": Contact(-hS * q[2] + lM + lG - lS - rO, slip=v[0] + lM * v[1] + (lG - lS) * v[2], mu=0.3, e=0.5),
        "upper": Contact(hM * q[1] + rM - rO, slip=v[0] + rM * v[1], mu=0.3),
        "lower": Contact(-hM * q[1] + rM - rO, slip=v[0] + rM * v[1], mu=0.3),
    }
    return MechanicalSystem(q=q, v=v, M=M, F=F, contacts=contacts, q0=[0, -0.1036, -0.2788], v0=[-0.3411, 4.8572e-15, -7.4583],
                            t_end=t_end, step=2e-5, activation=0.5, **AS_SICONOS)  # fmt: skip


def test_a_woodpecker_of_siconos():
    """Impacts with friction, stick, slip and self-locking; the file has rates of size 32, to 1e-8 by its own tolerance."""
    ref, run = reference("Woodpecker.ref"), simulate(woodpecker(0.3), compiled=True)
    n = min(len(ref), len(run.t))
    np.testing.assert_allclose(run.q[:n], ref[:n, 1::2][:, :3], atol=1e-10)
    np.testing.assert_allclose(run.v[:n], ref[:n, 2::2][:, :3], atol=1e-7)


def test_a_bar_of_siconos():
    ref, n, E, area, density = reference("ImpactingBar.ref"), 100, 210e9, 3.14e-4, 7800.0
    line = np.eye(n, k=1) + np.eye(n, k=-1)
    ends = np.eye(n)[0] + np.eye(n)[-1]
    M = (np.diag(2 / 3 - ends / 3) + line / 6) * density * area / n
    K = (np.diag(2 - ends) - line) * E * area * n
    q, v = S("p", n), S("w", n)
    model = MechanicalSystem(q=q, v=v, M=M, F=-ca.DM(K) @ q, contacts={"wall": Contact(q[0])}, q0=[5e-5] * n, v0=[-0.1] * n,
                             t_end=2e-6 * (len(ref) - 1), step=2e-6, activation=0, **AS_SICONOS)  # fmt: skip
    run = simulate(model, compiled=True)
    np.testing.assert_allclose(run.q[:, 0], ref[:, 1], atol=1e-12)
    np.testing.assert_allclose(run.v[:, 0], ref[:, 2], atol=1e-12)


# -- helpers -----------------------------------------------------------------------------------------------------------


def values(contact, q, v, at_q, at_v):
    f = ca.Function("contact", [q, v], [contact.gap, ca.SX(0, 1) if contact.slip is None else contact.slip])
    gap, slip = f(at_q, at_v)
    return float(gap), np.array(slip).ravel()


def test_helpers_say_what_their_geometry_is():
    """Gaps by distances; slips and normal velocities by differences of the point that touches."""
    q, v, h = S("p", 3), S("w", 3), 1e-6
    place, speed = np.array([0.3, 1.2, 0.7]), np.array([0.4, -0.2, 1.5])
    wall = ((1.0, 0.0), (-3.0, 4.0))
    normal = np.array([-0.6, 0.8])
    gap, slip = values(mechanics.disc(q, v, 0.25, wall, mu=0.1), q, v, place, speed)
    assert gap == pytest.approx(normal @ (place[:2] - [1, 0]) - 0.25)
    rim = speed[:2] + speed[2] * np.array([normal[1], -normal[0]]) * 0.25
    assert slip == pytest.approx([np.array([0.8, 0.6]) @ rim])
    c, s = np.cos(0.7), np.sin(0.7)
    gap, slip = values(mechanics.corner(q, v, (0.5, -0.2), mu=0.1), q, v, place, speed)
    assert gap == pytest.approx(1.2 + s * 0.5 + c * -0.2)
    ahead = place + h * speed
    moved = [part[0] + np.cos(part[2]) * 0.5 + np.sin(part[2]) * 0.2 for part in (place, ahead)]
    assert slip == pytest.approx([(moved[1] - moved[0]) / h], abs=1e-5)
    gap, _ = values(mechanics.segment(q, v, 0.1, (-1, 0), (0, 0.5)), q, v, place, speed)
    assert gap == pytest.approx(np.hypot(0.3, 0.7) - 0.1)  # the end (0, 1/2) is nearest
    gap, slip = values(mechanics.point(q[:2], v[:2], speed=(2.0, 0.0), mu=0.5), q, v, place, speed)
    assert (gap, slip[0]) == pytest.approx((1.2, -1.6))


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 2, -2), (-2, 1, 0.5)])
def test_spheres_slip_across_their_normal(normal):
    q, v = S("p", 3), S("w", 6)
    n = np.array(normal) / np.linalg.norm(normal)
    contact = mechanics.sphere(q, v, 0.5, ((0, 0, 0), normal), mu=0.3)
    rng = np.random.default_rng(0)
    speed = rng.normal(size=6)
    gap, slip = values(contact, q, v, [1.0, 2.0, 3.0], speed)
    assert gap == pytest.approx(n @ [1, 2, 3] - 0.5)
    rim = speed[:3] + np.cross(speed[3:], -0.5 * n)
    assert np.linalg.norm(slip) == pytest.approx(np.linalg.norm(rim - n * (n @ rim)))


@pytest.mark.parametrize("away", [(0, 0, -1), (0.3, 0.4, -0.9), (0.6, -0.8, 0.0), (1e-9, 0, -1)])
def test_a_pair_of_spheres_slips_across_its_normal_wherever_it_points(away):
    q, v = S("p", 6), S("w", 6)
    contact = mechanics.sphere(q[:3], v[:3], 0.4, (q[3:], v[3:], 0.5), mu=0.3)
    n, rng = np.array(away) / np.linalg.norm(away), np.random.default_rng(1)
    speed = rng.normal(size=6)
    gap, slip = values(contact, q, v, [*(2 * n), 0, 0, 0], speed)
    across = speed[:3] - speed[3:] - n * (n @ (speed[:3] - speed[3:]))
    assert gap == pytest.approx(1.1)
    assert np.linalg.norm(slip) == pytest.approx(np.linalg.norm(across))


def test_a_sphere_goes_around_another_one():
    """Through all directions of the normal, also straight below: held to the other by a joint, it keeps its speed."""
    q, v, fixed = S("p", 3), S("w", 3), (ca.SX([0, 0, 0]), ca.SX([0, 0, 0]), 0.5)
    contact = {"pair": mechanics.sphere(q, v, 0.5, fixed, mu=0.1)}
    start = {"q0": [0, 0, 1], "v0": [1, 0, 0], "t_end": 2 * np.pi, "step": 2 * np.pi / 500}
    run = simulate(MechanicalSystem(q=q, v=v, M=1, joints={"string": (ca.sumsqr(q) - 1) / 2}, contacts=contact, **start))
    assert run.status == "done"
    assert np.isfinite(run.x).all()
    np.testing.assert_allclose((run.q**2).sum(axis=1), 1, atol=1e-12)


def test_gravity_pulls_the_last_direction():
    np.testing.assert_allclose(mechanics.gravity([(2, 0.1), 1], g=10), [0, -20, 0, 0, -10])
    np.testing.assert_allclose(mechanics.gravity([3], size=3), [0, 0, -3 * 9.81])


def test_a_sphere_rolls_as_a_bowling_ball():
    """In space, with its spin and q' = T v; the lane along x: v = 5/7 of its speed, and a wall of another sphere stops it."""
    R, q, v = 0.11, S("p", 3), S("w", 6)
    contacts, M = {"lane": mechanics.sphere(q, v, R, mu=0.2)}, [1, 1, 1, *[0.4 * R**2] * 3]
    start = {"q0": [0, 0, R], "v0": [3, 0, 0, 0, 0, 0], "t_end": 1, "step": 5e-3}
    model = MechanicalSystem(q=q, v=v, M=M, F=[0, 0, -G, 0, 0, 0], kinematics=np.eye(3, 6), contacts=contacts, **start)
    run = simulate(model)
    assert run.v[-1, 0] == pytest.approx(5 / 7 * 3, abs=1e-11)
    assert run.v[-1, 4] == pytest.approx(5 / 7 * 3 / R, abs=1e-9)
    assert run.q[-1, 0] == pytest.approx(2.330088, abs=2e-4)


# -- with the rest of the package --------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [ball(0.5, 1e-2), incline(25, -2.0), pendulum(5e-3), rod(5e-2), woodpecker(0.01)])
def test_c_is_the_interpreted_run(model):
    here, there = simulate(model, compiled=False), simulate(model, compiled=True)
    for name in {"x", "multipliers", "u_N", "u_T", "gap", "acting", "energy"} & set(here.arrays):
        size = max(1.0, np.nanmax(np.abs(here.arrays[name]), initial=0.0))
        np.testing.assert_allclose(there.arrays[name][1:], here.arrays[name][1:], atol=1e-11 * size)
    rows = here.multipliers.shape[1]  # of positions that touch without push, the code is a matter of rounding
    np.testing.assert_array_equal(there.index_set[1:, :rows], here.index_set[1:, :rows])


def test_a_run_goes_on_as_it_would_have(tmp_path, monkeypatch):
    model = woodpecker(0.01)
    whole = simulate(model, compiled=True)
    with monkeypatch.context() as patch:
        stop_after(patch, 150)
        with pytest.raises(nsmodel.RunInterrupted):
            simulate(model, compiled=True, out=tmp_path)
    resumed = simulate(model, out=tmp_path, resume=True, compiled=True)
    np.testing.assert_array_equal(resumed.x, whole.x)
    np.testing.assert_array_equal(resumed.index_set, whole.index_set)


def test_columns_are_what_they_say():
    run = simulate(incline(25, 2.0))
    np.testing.assert_allclose(run.reactions[1:, 0], G * np.cos(np.deg2rad(25)), rtol=1e-12)
    np.testing.assert_allclose(run.reactions[1:, 1], -0.5 * run.reactions[1:, 0], rtol=1e-12)
    np.testing.assert_array_equal(run.q, run.x[:, :2])
    np.testing.assert_allclose(run.u_T[1:], run.v[1:, 0], rtol=1e-14)
    assert (run.acting[1:] == 1).all()
    work = np.diff(run.energy) - run.step[1:] * G * np.sin(np.deg2rad(25)) * (run.v[1:, 0] + run.v[:-1, 0]) / 2
    np.testing.assert_allclose(run.impulse_work[1:], work, atol=1e-13)


@pytest.mark.parametrize("name", ["bowling_ball", "ball_on_ramp"])
def test_each_contact_has_its_columns_and_its_line_by_name(name, tmp_path):
    run = simulate(nsmodel.load(name))
    names, text = list(nsmodel.load(name).contacts), run.summary_text()
    found = {one["name"]: one for one in run.summary()["by_contact"]}
    assert list(found) == names
    run.to_csv(tmp_path / "run.csv")
    header = (tmp_path / "run.csv").read_text().splitlines()[0].split(",")
    for k, contact in enumerate(names):
        assert {f"{part}:{contact}" for part in ("u_N", "gap", "acting", "missed", "penetration", "impulse_work")} <= set(header)
        assert f"u_T:{contact} slip" in header
        assert found[contact]["acting"] == np.nansum(run.acting.reshape(len(run.t), -1)[:, k])
        assert re.search(rf"{contact} +acts in {found[contact]['acting']} steps, missed in 0, penetration at most", text)


def with_axes(axes: object, path: Path) -> nsmodel.Trajectory:
    """A run of two contacts, saved with other axes (None: without) and read again."""
    run = simulate(nsmodel.load("ball_on_ramp"), t_end=0.01)
    kept = {name: value for name, value in run.metadata.items() if name != "axes"}
    nsmodel.Trajectory(run.arrays, kept | ({} if axes is None else {"axes": axes})).save(path)
    return nsmodel.Trajectory.load(path)


@pytest.mark.parametrize("axes", [
    {"contact": []}, {"contact": ["a"]}, {"contact": ["a", "b", "c"], "slip": ["x"]}, {"time": ["x"]}, {"state": ["a"] * 6},
    {"contact": [1, 2]}, [], {"contact": "ab"},
])  # fmt: skip
def test_forged_axes_are_refused(axes, tmp_path):
    with pytest.raises(nsmodel.errors.StorageError, match="axes"):
        with_axes(axes, tmp_path / "run.npz")


@pytest.mark.parametrize("axes", [None, {}, {"contact": ["a", "a"], "slip": ["a", "a"]}])
def test_axes_that_name_no_contact_or_one_twice_are_shown(axes, tmp_path):
    forged = with_axes(axes, tmp_path / "run.npz")
    forged.summary_text()
    forged.to_csv(tmp_path / "run.csv")
    forged.to_xarray()


def test_contacts_that_others_close_are_missed():
    """Two balls fly apart from a wall; an impulse drives the first one into a wall whose gap the free step does not close."""
    q, v = S("p", 2), S("w", 2)
    contacts = {"wall": Contact(q[0]), "pair": Contact(q[1] - q[0] - 1, e=1)}
    start = {"q0": [0.004, 1.005], "v0": [0.0, -1.0], "t_end": 0.05, "step": 0.01}
    for project in (False, True):
        run = simulate(MechanicalSystem(q=q, v=v, M=1, contacts=contacts, project=project, **start))
        assert run.missed[1:, 0].sum() >= 1
        assert run.summary()["by_contact"][0]["missed"] == run.missed[1:, 0].sum()
        assert (run.penetration.max() <= 1e-15) == project


def test_models_are_swept_pickled_saved_and_checked(tmp_path):
    e, q, v = S("e"), S("height"), S("speed")
    model = MechanicalSystem(
        q=q, v=v, M=1, F=-G, contacts={"floor": Contact(q, e=e)}, q0=1, t_end=1, step=1e-2, parameters={"e": 0.5}
    )
    found = sweep(model, grid={"e": [0.2, 0.8]}, outputs={"end": "height[-1]"})
    for value, end in zip((0.2, 0.8), found["end"].values, strict=True):
        assert end == pytest.approx(simulate(model, parameters={"e": value}).height[-1], abs=1e-12)
    other = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(simulate(other).x, simulate(model).x)
    simulate(model).save(tmp_path / "run.npz")
    np.testing.assert_array_equal(nsmodel.Trajectory.load(tmp_path / "run.npz").gap, simulate(model).gap)
    verdicts = {f.id: f.verdict for f in check(model).findings}
    assert {verdicts[id] for id in ("C-M", "C-lin", "C-start", "C-e", "C-theta")} == {"holds"}
    assert {verdicts[id] for id in ("C-ind", "C-mfcq", "C-W", "C-P", "C-F")} == {"unknown"}
    with pytest.raises(UsageError, match="not located; give step="):
        simulate(model, rtol=1e-4)


def dropped():
    """A point dropped on a floor; all that it depends on is a parameter."""
    q, v = ca.SX.sym("q", 2), ca.SX.sym("v", 2)
    e, height, mu, m = (ca.SX.sym(name) for name in ("e", "height", "mu", "m"))
    return MechanicalSystem(
        q=q, v=v, M=m * np.eye(2), F=ca.vertcat(0, -G * m), contacts={"floor": Contact(q[1], slip=v[0], mu=mu, e=e)},
        q0=[0, height], v0=[1, 0], t_end=0.5, step=0.01, parameters={e: 0.5, height: 0.5, mu: 0.3, m: 1.0},
    )  # fmt: skip


@pytest.mark.parametrize("is_compiled", [False, True])
def test_a_contact_without_friction_does_not_pull(is_compiled):
    """mu = 0 as a parameter: free flight until it lands, and never an impulse < 0."""
    run = simulate(dropped(), parameters={"mu": 0.0}, compiled=is_compiled)
    above = run.t < np.sqrt(2 * 0.5 / G) - 0.02
    np.testing.assert_allclose(run.v[above, 1], -G * run.t[above], atol=1e-12)
    assert (run.multipliers[1:, 0] >= 0).all()


def ladder(mu, t_end):
    """A uniform ladder of 2 m against a wall, its start at 1.2 rad to the floor; rotation by its angle."""
    q, v = ca.SX.sym("q", 3), ca.SX.sym("v", 3)
    sine, cosine = ca.sin(q[2]), ca.cos(q[2])
    contacts = {
        "floor": Contact(q[1] - sine, slip=v[0] - sine * v[2], mu=mu),
        "wall": Contact(q[0] - cosine, slip=v[1] + cosine * v[2], mu=mu),
    }
    return MechanicalSystem(
        q=q, v=v, M=np.diag([1, 1, 1 / 3]), F=ca.vertcat(0, -G, 0), contacts=contacts,
        q0=[np.cos(1.2), np.sin(1.2), 1.2], v0=[0, 0, 0], t_end=t_end, step=1e-3,
    )  # fmt: skip


def test_a_smooth_ladder_leaves_the_wall_at_two_thirds_of_its_height():
    """By energy the wall's force is 0 where sin(angle) is 2/3 of its start."""
    run = simulate(ladder(0.0, 1.2))
    last = np.flatnonzero(run.multipliers[:, 1] > 1e-12)[-1]
    assert np.sin(run.q[last, 2]) / np.sin(1.2) == pytest.approx(2 / 3, abs=0.03)


@pytest.mark.parametrize("mu", [0.3, 1e6])
def test_a_ladder_is_held_by_friction(mu):
    run = simulate(ladder(mu, 0.05), compiled=True)
    np.testing.assert_allclose(run.q, run.q[[0] * len(run.t)], atol=1e-14)


@pytest.mark.parametrize(
    ("name", "bad", "message"),
    [
        ("e", 2.0, "e = 2 with .*expected a number in \\[0, 1\\]"),
        ("e", -0.1, "e = -0.1 with .*expected a number in \\[0, 1\\]"),
        ("height", -0.5, "contact 'floor' overlaps at the start: its gap is -0.5"),
        ("mu", -0.5, "mu = -0.5"),
        ("m", -1.0, "M: its least eigenvalue at the start is -1"),
        ("m", 0.0, "M: its least eigenvalue at the start is 0"),
    ],
)
def test_a_compiled_sweep_refuses_what_a_run_refuses(name, bad, message):
    found = sweep(dropped(), grid={name: [0.6, bad, 0.7]}, outputs={"end": "q_1[-1]"}, compiled=True)
    assert (found.status != 0).tolist() == [False, True, False]
    assert re.search(message, found.messages[1])


def without_friction(q, v, e):
    return {"contacts": {"floor": Contact(q[1], e=e)}, "q0": [0, 1], "v0": [1, 0], "F": ca.vertcat(0, -G * e)}


def without_contacts(q, v, e):
    return {"joints": {"rod": ca.sumsqr(q) - 1}, "q0": [1, 0], "v0": [0, 0], "F": ca.vertcat(0, -G * e)}


@pytest.mark.parametrize("kind", [without_friction, without_contacts])
def test_compiled_sweeps_of_systems_without_slip_are_their_runs(kind):
    q, v, e = ca.SX.sym("q", 2), ca.SX.sym("v", 2), ca.SX.sym("e")
    model = MechanicalSystem(q=q, v=v, M=np.eye(2), t_end=1, step=0.01, parameters={e: 0.5}, **kind(q, v, e))
    found = sweep(model, grid={"e": [0.2, 0.5, 0.9]}, outputs={"end": "q_1[-1]"}, compiled=True)
    runs = [simulate(model, parameters={"e": value}).q[-1, 1] for value in (0.2, 0.5, 0.9)]
    np.testing.assert_allclose(found["end"].values, runs, atol=1e-12)


def test_the_code_of_a_system_carries_its_largest_gap_and_no_reaction(tmp_path):
    """A reaction in the state would have its own setter, of n numbers."""
    about = nsmodel.codegen.write(dropped(), tmp_path, name="scene").about
    header = (tmp_path / "scene.h").read_text()
    assert not about["force"]
    assert "set_force" not in header
    assert "the states, then the largest gap so far" in header


def test_a_model_that_is_replaced_is_the_same_model():
    """Twice, with a potential, kinematics, joints and derived inertia: the forces of a potential count once."""
    for model in (ball(0.5, 1e-2), pendulum(5e-3), rod(5e-2), nsmodel.load("hook_ball"), nsmodel.load("slider_crank")):
        again = replace(replace(model))
        one, two = (simulate(each, t_end=20 * model.step, compiled=False) for each in (model, again))
        for name, array in one.arrays.items():
            np.testing.assert_array_equal(two.arrays[name], array, err_msg=name)
        assert two.metadata["multiplier_names"] == one.metadata["multiplier_names"]


def test_a_crank_of_siconos():
    """Impacts of four corners for 0.03 s; there positions are put back after the step, here in one problem with it."""
    ref, start = reference("SliderCrankMoreauJeanCombinedProjectionOSI.ref"), {"q0": [0, 0, 0], "t_end": 0.03, "step": 1e-4}
    as_there = {"geometry": "end", "activation": 0.5, "restitution": "newton", "tol_g": 0.0}
    run = simulate(replace(nsmodel.load("slider_crank"), **start, **as_there), compiled=True)
    found = np.abs(run.q - np.column_stack([2 * np.pi * ref[:301, 1], ref[:301, 2:4]]))
    assert found[:101].max() <= 3e-4
    assert found.max() <= 5e-4


def test_sympy_writes_the_same_model():
    q, v = sympy.symbols("p_0 p_1"), sympy.symbols("w_0 w_1")
    floor = Contact(q[1], slip=v[0], mu=0.5)
    run = simulate(
        MechanicalSystem(q=q, v=v, M=1, F=[0, -G], contacts={"floor": floor}, q0=[0, 0], v0=[1, 0], t_end=1, step=1e-2)
    )
    assert run.v[-1, 0] == 0
    assert run.q[-1, 0] == pytest.approx(1 / (2 * 0.5 * G), rel=2e-2)


def test_several_answers_are_said_unless_one_is_proved():
    def warned(model):
        return [text for text in simulate(model).metadata["warnings"] if text.startswith("unique")]

    assert not warned(ball(0.5, 0.1))
    assert not warned(incline(25, 0.0, step=0.1))  # one contact on a line, mu below mu_c
    assert warned(woodpecker(4e-5))
    assert "rank 18 of 24" in warned(pile(0.5, 0.1))[0]


def test_a_mass_matrix_of_angles_is_decided_at_all_angles():
    """Of a double pendulum det M = m_1 m_2 + m_2^2 sin^2 > 0; where a coupling is too large, M is not definite at 0."""
    for coupling, verdict, start in ((1.0, "holds", 1.5), (1.5, "violated", 0.0)):

        def masses(q, c=coupling):
            return [[2, c * ca.cos(q[0] - q[1])], [c * ca.cos(q[0] - q[1]), 1]]

        q, v = S("p", 2), S("w", 2)
        model = MechanicalSystem(q=q, v=v, M=masses(q), q0=[start, 0], t_end=1, step=0.1)
        found = next(one for one in nsmodel.check(model, runs=[]).findings if one.id == "C-M")
        assert found.verdict == verdict, found
        if verdict == "holds":
            assert 0 < found.value["least eigenvalue"] <= (3 - np.sqrt(5)) / 2 + 1e-9


def test_checks_find_what_the_theory_forbids():
    q, v = S("p", 2), S("w", 2)
    contacts = {"a": Contact(q[1], slip=v[0], mu=0.3, e=0.5), "b": Contact(q[0] + 1, e=0.2)}
    M = [[2 + ca.sin(q[0]), 0], [0, 1]]
    model = MechanicalSystem(q=q, v=v, M=M, F=[0, -1], contacts=contacts, q0=[0, 0], theta=0.8, t_end=0.1, step=0.01)
    found = {f.id: f for f in check(model).findings}
    assert found["C-M"].verdict == "holds"
    assert found["C-M"].value["least eigenvalue"] <= 1
    assert [found[id].verdict for id in ("C-e", "C-theta")] == ["violated", "violated"]


def test_the_energy_of_impacts_is_promised_where_it_is_kept():
    """Not where walls move, nor where e acts on approach alone and others push what separates."""
    t, (q, v) = S("t"), (S("p", 2), S("w", 2))

    def promised(contacts, **given):
        model = MechanicalSystem(t=t, q=q, v=v, M=1, contacts=contacts, q0=[1, 1], t_end=0.1, step=0.1, **given)
        return {one.name: one.verdict for one in check(model, quick=True).consequences}.get("impacts keep or lose energy")

    floor, wall = Contact(q[1], e=0.5), Contact(q[0], e=0.5)
    assert promised({"floor": floor}) == "holds"
    assert promised({"floor": floor, "wall": wall}) is None
    assert promised({"floor": floor, "wall": wall}, restitution="newton") == "holds"
    assert promised({"floor": Contact(q[1], slip=v[0], mu=0.3), "wall": Contact(q[0])}) == "holds"
    assert promised({"floor": Contact(q[1] - t)}) is None
    assert promised({"belt": Contact(q[1], slip=v[0] - 1, mu=0.3)}) is None
    assert promised({"floor": Contact(q[1], slip=v[0], mu=0.3, e=0.5)}) == "unknown"


# -- what is refused ---------------------------------------------------------------------------------------------------


def made(**given):
    q, v = S("p", 2), S("w", 2)
    standard = {"q": q, "v": v, "M": 1, "F": [0, -1], "q0": [0, 1], "t_end": 1, "step": 0.1}
    return MechanicalSystem(**standard | {name: part(q, v) if callable(part) else part for name, part in given.items()})


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"M": [[1, 0.5], [0, 1]]}, r"M: entry \(1, 0\) is 0, and \(0, 1\) is 0.5; a mass matrix is symmetric"),
        ({"M": np.eye(3)}, r"M: shape \(3, 3\); expected \(2, 2\)"),
        ({"contacts": lambda q, v: {"a": Contact(q[1], slip=v[0] ** 2, mu=0.1)}}, "contact 'a': slip = .* is not affine"),
        ({"contacts": lambda q, v: {"a": Contact(q[1], slip=v[0], mu=-0.1)}}, r"contact 'a': mu = -0.1; expected a number"),
        ({"contacts": lambda q, v: {"a": Contact(q[1], slip=v[0], mu=[0.1, 0.2])}}, "contact 'a': mu: 2 values; expected one"),
        ({"contacts": lambda q, v: {"a": Contact(q[1], e=1.5)}}, r"contact 'a': e = 1.5; expected a number in \[0, 1\]"),
        ({"contacts": lambda q, v: {"a": Contact(q[1] + v[0])}}, "contact 'a': gap depends on 'w_0'"),
        ({"contacts": lambda q, v: {"a": Contact(q[1], slip=[v[0], v[1], v[0]], mu=0.1)}}, "slip has 3 rows; a contact has 1"),
        ({"contacts": lambda q, v: {"a": Contact(q[1], mu=0.1)}}, "contact 'a': mu or e_t is given without slip"),
        ({"contacts": lambda q, v: {"a": q[1]}}, r"contact 'a': .*expected Contact\(gap"),
        ({"contacts": lambda q, v: [Contact(q[1])]}, "expected a dictionary {name: Contact"),
        ({"contacts": lambda q, v: {"a": Contact(q[1])}, "joints": lambda q, v: {"a": q[0]}}, "'a' names two of the states"),
        ({"v": S("w", 3)}, "v: 3 velocities for 2 positions; give kinematics"),
        ({"theta": 0.3}, r"theta = 0.3; expected a number in \[1/2, 1\]"),
        ({"activation": "soon"}, "activation = 'soon'; expected one of 'free', 0, 0.5, 1, 1.5"),
        ({"restitution": "poisson"}, "restitution = 'poisson'"),
        ({"geometry": "left"}, "geometry = 'left'"),
        ({"inertia": "both"}, "inertia = 'both'"),
        ({"tol_g": -1}, "tol_g = -1"),
        ({"project": 1}, "project = 1"),
    ],
)  # fmt: skip
def test_bad_models_are_named(given, text):
    with pytest.raises(ModelError, match=text):
        made(**given)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"M": np.diag([1.0, 0.0])}, "M: its least eigenvalue at the start is 0"),
        ({"contacts": lambda q, v: {"wall": Contact(q[0] - 0.5)}}, "contact 'wall' overlaps at the start: its gap is -0.5"),
        ({"joints": lambda q, v: {"rod": ca.sumsqr(q) - 4}}, "joint 'rod' is open at the start: c = -3"),
        ({"joints": lambda q, v: {"rod": ca.sumsqr(q) - 1}, "v0": [0, 1]}, "joint 'rod' moves apart at the start: dc/dt = 2"),
    ],
)  # fmt: skip
def test_bad_starts_are_named(given, text):
    with pytest.raises(UsageError, match=text):
        simulate(made(**given))


def test_a_coefficient_that_a_parameter_takes_out_of_its_range_is_named():
    e, part = S("e"), {"contacts": lambda q, v: {"floor": Contact(q[1], e=S("e"))}}
    assert simulate(made(parameters={e: 0.5}, **part)).status == "done"
    with pytest.raises(UsageError, match="contact 'floor': e = 2 with e = 2; expected a number in"):
        simulate(made(parameters={e: 0.5}, **part), parameters={"e": 2.0})


def test_friction_may_move_with_time():
    """mu(t) constant gives the run of the number, and mu < 0 is refused by its row."""
    t = S("t")

    def slid(mu):
        part = {"contacts": lambda q, v: {"floor": Contact(q[1], slip=v[0], mu=mu)}, "q0": [0, 0], "v0": [1, 0]}
        return simulate(made(t=t, **part))

    np.testing.assert_allclose(slid(0.05 + 0 * ca.fmax(t, 0) * t).x, slid(0.05).x, atol=1e-13)
    np.testing.assert_allclose(slid(ca.fmax(0.05, -t)).x, slid(0.05).x, atol=1e-13)
    with pytest.raises(nsmodel.StepError, match="the law of 'floor' at t = "):
        slid(0.05 - t)


@pytest.mark.long
def test_a_step_without_an_answer_names_its_contacts():
    """Two walls that close on a body, with and without friction; and impulses that rounding hides behind a huge mu."""
    t = S("t")
    for project in (True, False):
        for rough in (False, True):
            more = (lambda v: {"slip": v[1], "mu": 0.3}) if rough else (lambda v: {})
            walls = {"contacts": lambda q, v, m=more: {"left": Contact(q[0] + 0.1 - t, **m(v)),
                                                       "right": Contact(0.1 - t - q[0], **m(v))}}  # fmt: skip
            with pytest.raises(nsmodel.StepError, match=r"no point: 'left' \(weight 0.5\) and 'right' \(weight 0.5\) oppose"):
                simulate(made(t=t, project=project, **walls))
    with pytest.raises(nsmodel.StepError, match=r"did not converge, with the contacts 'floor' closing\."):
        simulate(ladder(1e9, 0.05))


def test_a_corner_whose_friction_leaves_no_answer_says_so():
    """A disc that hits floor and wall in one step, mu = 1.5 and e = 1/2: W has rank 3 of 4, and no modes fit."""
    q, v, rough = S("p", 3), S("w", 3), {"mu": 1.5, "e": 0.5}
    walls = {"floor": mechanics.disc(q, v, 0.1, **rough), "wall": mechanics.disc(q, v, 0.1, ((0, 0), (1, 0)), **rough)}
    start = {"q0": [0.1003, 0.1096, 0], "v0": [-0.3114, -2.537, 0.1877], "t_end": 0.004, "step": 0.004}
    model = MechanicalSystem(q=q, v=v, M=[1, 1, 0.005], F=[0, -G, 0], contacts=walls, **start)
    none = r"none of the 16 choices of modes \(.*\) of the contacts that act, 'floor', 'wall', has an answer\."
    with pytest.raises(nsmodel.StepError, match=none):
        simulate(model)


def test_bad_walls_are_named():
    q, v = S("p", 2), S("w", 2)
    with pytest.raises(ModelError, match=r"wall: .*the normal not 0"):
        mechanics.disc(q, v, 1.0, ((0, 0), (0, 0)))
    for other in (3.0, (1,), [], ((0, 0), (0, 1), 1.0, 4)):
        with pytest.raises(ModelError, match=r"wall: .*expected \(a point on it, its normal\), 2 numbers each"):
            mechanics.disc(q, v, 1.0, other)
    with pytest.raises(ModelError, match="segment: both ends are"):
        mechanics.segment(q, v, 1.0, (0, 0), (0, 0))
