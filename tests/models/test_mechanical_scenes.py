"""Scenes of mechanics with contact whose answers are known in closed form, or from an event-driven reference."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from nsmodel import Contact, MechanicalSystem, ModelError, simulate
from nsmodel.models.mechanical_system.several_answers import contact_matrix, has_positive_modes, uniqueness_doubt

G = 9.81
S = ca.SX.sym


def ball(e, step, t_end=3.0, **given):
    q, v = S("height"), S("speed")
    return MechanicalSystem(
        q=q, v=v, M=1, potential=G * q, contacts={"floor": Contact(q, e=e)}, q0=1, t_end=t_end, step=step, **given
    )


def bouncing(t, e):
    """The height of a ball that falls from 1; 0 after the last impact."""
    first = np.sqrt(2 / G)
    height = np.where(t <= first, 1 - G * t**2 / 2, 0.0)
    begin, speed = first, e * np.sqrt(2 * G)
    while speed > 1e-12:
        end = begin + 2 * speed / G
        s = t - begin
        height = np.where((t > begin) & (t <= end), speed * s - G * s**2 / 2, height)
        begin, speed = end, e * speed
        if begin > t[-1]:
            break
    return height


STEPS = (2e-2, 1.3e-2, 8e-3, 5.3e-3, 3.4e-3, 2.2e-3)


def fitted_order(errors, steps):
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


@pytest.mark.parametrize("project", [True, False])
@pytest.mark.parametrize("e", [0.5, 0.8])
def test_a_ball_that_bounces_comes_to_rest(e, project):
    """Infinitely many impacts until t_0 (1 + e)/(1 - e); then v is exactly 0. Put back, nothing is penetrated."""
    limit, errors = np.sqrt(2 / G) * (1 + e) / (1 - e), []
    for step in STEPS:
        run = simulate(ball(e, step, t_end=step * round(4.5 / step), project=project))
        errors.append(np.abs(run.height - bouncing(run.t, e)).max())
        assert (run.speed[run.t > limit + 40 * step] == 0.0).all()
        assert run.residual[1:].max() <= 1e-9
        if project:
            assert run.penetration.max() <= 1e-14
    assert errors[-1] <= 1.5e-2
    assert errors[-1] <= errors[0] / 4


def test_random_steps_come_to_rest_too():
    for step in np.exp(np.random.default_rng(0).uniform(np.log(2e-5), np.log(2e-2), 6)):
        run = simulate(ball(0.5, float(step), t_end=float(step) * round(1.5 / step + 60)), compiled=True)
        assert (run.speed[run.t > 1.354571 + 40 * step] == 0.0).all()


def test_a_ball_without_restitution_stays_where_it_falls():
    run = simulate(ball(0.0, 1e-3, t_end=1.0, activation=0.5))
    after = run.t > np.sqrt(2 / G) + 2e-3
    assert (run.speed[after] == 0.0).all()
    np.testing.assert_allclose(run.multipliers[after, 0], G * 1e-3, rtol=1e-12)
    total = run.multipliers[1:, 0].sum()
    assert total == pytest.approx(G * 1.0, rel=1e-9)  # all that falls in 1 s is caught


def test_a_ball_with_e_1_keeps_its_energy():
    run = simulate(ball(1.0, 1e-2, t_end=5.0))
    np.testing.assert_allclose(run.energy, G, rtol=1e-12)


def test_an_impact_in_a_corner_acts_on_both_walls():
    q, v = S("p", 2), S("w", 2)
    walls = {"left": Contact(q[0], e=0.7), "bottom": Contact(q[1], e=0.7)}
    run = simulate(MechanicalSystem(q=q, v=v, M=1, contacts=walls, q0=[0.5, 0.5], v0=[-1, -1], t_end=1, step=1e-2))
    np.testing.assert_allclose(run.v[-1], [0.7, 0.7], rtol=1e-14)


@pytest.mark.parametrize(("n", "e"), [(3, 1.0), (3, 0.5), (5, 1.0), (4, 0.0)])
def test_newtons_cradle(n, e):
    """Touching balls share one impact, spaced ones have one after the other: both as they are known."""
    q, v = S("p", n), S("w", n)
    pairs = {f"pair {i}": Contact(q[i + 1] - q[i] - 1, e=e) for i in range(n - 1)}
    start = np.eye(n)[0]
    touching = MechanicalSystem(q=q, v=v, M=1, contacts=pairs, q0=np.arange(n), v0=start, t_end=0.01, step=1e-3)
    expected = np.full(n, (1 + e) / n)
    expected[0] -= e
    np.testing.assert_allclose(simulate(touching).v[-1], expected, atol=1e-14)
    if e == 1:
        spaced = MechanicalSystem(q=q, v=v, M=1, contacts=pairs, q0=1.05 * np.arange(n), v0=start, t_end=0.5, step=1e-3)
        np.testing.assert_allclose(simulate(spaced).v[-1], np.eye(n)[-1], atol=1e-13)


def incline(degrees, v0, step=1e-2, **given):
    q, v, phi = S("p", 2), S("w", 2), np.deg2rad(degrees)
    floor = Contact(q[1], slip=v[0], mu=0.5)
    return MechanicalSystem(
        q=q,
        v=v,
        M=1,
        F=[G * np.sin(phi), -G * np.cos(phi)],
        contacts={"floor": floor},
        q0=[0, 0],
        v0=[v0, 0],
        t_end=1.5,
        step=step,
        **given,
    )


@pytest.mark.parametrize("project", [True, False])
def test_a_block_on_an_incline(project):
    """It sticks iff tan phi <= mu; sliding one way its speed is exact, and its way of order 2."""
    rest = simulate(incline(25, 0.0, project=project))
    assert (rest.x == 0).all()
    assert simulate(incline(np.rad2deg(np.arctan(0.5)), 0.0, project=project)).v.max() <= 1e-15
    for degrees, v0, way, speed in ((25, 2.0, 2.663001, 1.550668), (27, 0.0, 0.093667, 0.124890)):
        run = simulate(incline(degrees, v0, project=project))
        assert run.v[-1, 0] == pytest.approx(speed, abs=1e-6)
        assert run.q[-1, 0] == pytest.approx(way, abs=2e-4)
    up = simulate(incline(25, -2.0, step=2e-3, project=project))
    assert up.q[-1, 0] == pytest.approx(-0.232793, abs=2e-4)
    assert (up.v[up.t > 0.2341, 0] == 0.0).all()


def test_a_block_on_a_belt_takes_its_speed():
    q, v = S("p", 2), S("w", 2)
    belt = Contact(q[1], slip=v[0] - 1.2, mu=0.3)
    run = simulate(MechanicalSystem(q=q, v=v, M=1, F=[0, -G], contacts={"belt": belt}, q0=[0, 0], t_end=1, step=1e-3))
    assert run.q[-1, 0] == pytest.approx(0.955352, abs=3e-4)
    np.testing.assert_allclose(run.v[run.t > 0.41, 0], 1.2, rtol=1e-15)


@pytest.mark.parametrize(("k", "speed", "way"), [(0.4, 2.142857142857, 2.330088), (0.5, 2.0, 2.254842), (1.0, 1.5, 2.073394)])
def test_a_bowling_ball_rolls(k, speed, way):
    R, mu = 0.11, 0.2
    q, v = S("p", 3), S("w", 3)
    lane = Contact(q[1] - R, slip=v[0] + R * v[2], mu=mu)
    model = MechanicalSystem(
        q=q, v=v, M=[1, 1, k * R**2], F=[0, -G, 0], contacts={"lane": lane}, q0=[0, R, 0], v0=[3, 0, 0], t_end=1, step=2e-3
    )
    run = simulate(model)
    assert run.v[-1, 0] == pytest.approx(speed, abs=1e-12)
    assert run.q[-1, 0] == pytest.approx(way, abs=1e-4)


def test_a_slip_that_turns_in_space():
    """v (1 + cos psi) is constant on a plane of 20 degrees with mu = tan 20; order 1."""
    a, errors = np.deg2rad(20), []
    q, v = S("p", 3), S("w", 3)
    floor = Contact(q[2], slip=v[:2], mu=np.tan(a))
    for step in (1e-2, 5e-3):
        run = simulate(MechanicalSystem(
            q=q, v=v, M=1, F=[G * np.sin(a), 0, -G * np.cos(a)], contacts={"floor": floor}, q0=[0, 0, 0], v0=[0, 2, 0],
            t_end=0.622742891, step=step,
        ))  # fmt: skip
        errors.append(np.abs(run.q[-1, :2] - [0.405290527, 0.673975163]).max())
    assert errors[0] <= 8e-3
    assert 1.7 <= errors[0] / errors[1] <= 2.3


@pytest.mark.parametrize("e", [1.0, 0.8])
def test_an_oscillator_against_a_wall(e):
    w = 2 * np.pi
    q, v = S("p"), S("w")
    errors, steps = [], (1.7e-2, 1.1e-2, 7e-3, 4.1e-3, 2.7e-3, 1.7e-3)
    for step in steps:
        model = MechanicalSystem(
            q=q, v=v, M=1, F=-(w**2) * q, contacts={"wall": Contact(q, e=e)}, q0=0, v0=1, t_end=3.3, step=step,
            activation=0.5, project=False,
        )  # fmt: skip
        run = simulate(model)
        exact = e ** np.floor(w * run.t / np.pi) * np.abs(np.sin(w * run.t)) / w
        errors.append(np.abs(run.p - exact).max())
    assert errors[-1] <= 1.2e-2
    assert 0.7 <= fitted_order(errors, steps) <= 1.4


def test_a_block_on_a_spring_is_the_oscillator_with_friction():
    q, v = S("p", 2), S("w", 2)
    floor = Contact(q[1], slip=v[0], mu=1)
    run = simulate(
        MechanicalSystem(q=q, v=v, M=1, F=[-q[0], -1], contacts={"floor": floor}, q0=[5.3, 0], t_end=12, step=np.pi / 600)
    )
    t = run.t
    exact = np.where(t < np.pi, 1 + 4.3 * np.cos(t), np.where(t < 2 * np.pi, -1 + 2.3 * np.cos(t), 1 + 0.3 * np.cos(t)))
    exact = np.where(t >= 3 * np.pi, 0.7, exact)
    assert np.abs(run.q[:, 0] - exact).max() <= 1e-4
    assert (run.v[t > 3 * np.pi + 0.02, 0] == 0.0).all()


def pendulum(step, **given):
    """Two points of mass 1 on rods of length 1 in the plane, absolute angles, and a wall below."""
    q, v = S("p", 2), S("w", 2)
    c, s = ca.cos(q[0] - q[1]), ca.sin(q[0] - q[1])
    M = ca.vertcat(ca.horzcat(2, c), ca.horzcat(c, 1))
    weight = ca.vertcat(-20 * ca.sin(q[0]), -10 * ca.sin(q[1]))
    wall = Contact(ca.sin(q[0]) + ca.sin(q[1]) + 0.2, e=0.8)
    forces = {"F": weight} if given.get("inertia") != "given" else {"F": weight + ca.vertcat(-s * v[1] ** 2, s * v[0] ** 2)}
    return MechanicalSystem(q=q, v=v, M=M, contacts={"wall": wall}, q0=[0.6, 0.9], t_end=2, step=step, **forces, **given)


@pytest.mark.parametrize("inertia", ["derived", "given"])
def test_a_double_pendulum_hits_a_wall(inertia):
    """Gyroscopic terms derived from M are those written by hand; against an event-driven reference."""
    run = simulate(pendulum(2e-3, inertia=inertia, activation=0.5, project=False))
    assert np.abs(run.q[-1] - [0.083533180, 0.150613940]).max() <= 6e-3
    assert np.abs(run.v[-1] - [-2.893873590, 1.705288340]).max() <= 4e-2


def test_forces_quadratic_in_velocities_ask_whether_gyroscopic_terms_are_in_them():
    q, v = S("p", 2), S("w", 2)
    with pytest.raises(ModelError, match="say inertia='given'"):
        MechanicalSystem(q=q, v=v, M=[[2 + ca.cos(q[0]), 0], [0, 1]], F=[v[1] ** 2, 0], q0=[0, 0], t_end=1, step=0.1)


def rod(step, **given):
    q, v = S("p", 2), S("w", 2)
    return MechanicalSystem(q=q, v=v, M=1, potential=q[1], joints={"rod": (ca.sumsqr(q) - 1) / 2}, q0=[1, 0],
                            t_end=7.416298709205487, step=step, **given)  # fmt: skip


def test_a_point_on_a_rod_swings_with_order_two():
    """One period; the joint is kept to rounding where positions are put back, and to O(h^2) where not."""
    for project, drift in ((True, 0.0), (False, 3.6e-4)):
        energies = []
        for count in (200, 400):
            run = simulate(rod(7.416298709205487 / count, project=project))
            assert np.abs((run.q**2).sum(axis=1) - 1).max() / 2 <= drift * (200 / count) ** 2 + 1e-14
            energies.append(np.abs(run.energy - run.energy[0]).max())
        assert energies[0] <= 2e-3
        assert 3 <= energies[0] / energies[1] <= 5


def rocking(step):
    """A block of half width 0.1 and half height 0.4, two corners, started on its left one."""
    b, a, m, alpha = 0.1, 0.4, 1.0, np.arctan(0.25)
    R = np.hypot(a, b)
    q, v = S("p", 3), S("w", 3)
    corners = {}
    for name, s in (("left", -1), ("right", 1)):
        gap = q[1] + s * b * ca.sin(q[2]) - a * ca.cos(q[2])
        along = q[0] + s * b * ca.cos(q[2]) + a * ca.sin(q[2])
        corners[name] = Contact(gap, slip=ca.jtimes(along, q, v), mu=5)
    th = alpha / 2
    start = [0, b * np.sin(th) + a * np.cos(th), th]
    return MechanicalSystem(q=q, v=v, M=[m, m, m * R**2 / 3], F=[0, -G * m, 0], contacts=corners, q0=start, t_end=0.6, step=step)


def test_a_block_rocks_as_housner_says():
    """The corner changes at t = 0.312309 with the speed -0.893414, of which 1 - (3/2) sin^2 alpha = 0.911765 is left."""
    run = simulate(rocking(5e-4))
    k = int(np.argmin(run.w_2))
    assert run.t[k] == pytest.approx(0.312309, abs=2e-3)
    assert run.w_2[k] == pytest.approx(-0.893414, abs=3e-3)
    assert run.w_2[k + 3] / run.w_2[k] == pytest.approx(0.911765, abs=5e-3)


def pile(mu, step=4e-3, **given):
    """Six discs in a triangle on a floor, neighbours touching."""
    R, rows, centres = 0.1, 3, []
    for row in range(rows):
        centres += [(0.2 * (i + row / 2), R + row * R * np.sqrt(3)) for i in range(rows - row)]
    n = len(centres)
    q, v, contacts = S("p", 3 * n), S("w", 3 * n), {}
    for i, (x, y) in enumerate(centres):
        if y < 0.11:
            contacts[f"floor {i}"] = Contact(q[3 * i + 1] - R, slip=v[3 * i] + R * v[3 * i + 2], mu=mu)
        for j in range(i):
            if np.hypot(x - centres[j][0], y - centres[j][1]) < 0.201:
                d = q[3 * i : 3 * i + 2] - q[3 * j : 3 * j + 2]
                normal = d / ca.norm_2(d)
                w = v[3 * i : 3 * i + 2] - v[3 * j : 3 * j + 2]
                slip = -normal[1] * w[0] + normal[0] * w[1] - R * (v[3 * i + 2] + v[3 * j + 2])
                contacts[f"pair {j}-{i}"] = Contact(ca.norm_2(d) - 2 * R, slip=slip, mu=mu)
    M, F = np.tile([1, 1, R**2 / 2], n), np.tile([0, -G, 0], n)
    q0 = np.array([[x, y, 0] for x, y in centres]).ravel()
    return MechanicalSystem(q=q, v=v, M=M, F=F, contacts=contacts, q0=q0, t_end=0.2, step=step, tol_g=1e-9, **given)


@pytest.mark.parametrize(
    ("tangent", "W", "critical"), [(2.0, [[1.6, 1.2], [1.2, 3.4]], 4 / 3), (1.0, [[2.5, 1.5], [1.5, 2.5]], 5 / 3)]
)
def test_painleves_rod(tangent, W, critical):
    """W_NN = 1 + 3 cos^2, W_NT = 3 sin cos, W_TT = 1 + 3 sin^2; below mu_c = W_NN/|W_NT| a step has one answer."""
    q, v, angle = S("p", 3), S("w", 3), np.arctan(tangent)

    def sliding(mu):
        tip = Contact(q[1] - ca.sin(q[2]), slip=v[0] + ca.sin(q[2]) * v[2], mu=mu)
        start = {"q0": [0, np.sin(angle), angle], "v0": [1, 0, 0], "t_end": 0.01, "step": 1e-3}
        return MechanicalSystem(q=q, v=v, M=[1, 1, 1 / 3], F=[0, -G, 0], contacts={"tip": tip}, **start)

    model = sliding(0.9 * critical)
    matrix, _ = contact_matrix(model)
    np.testing.assert_allclose(np.abs(matrix), W, rtol=1e-12)
    assert f"mu_c = {critical:.4g}" in uniqueness_doubt(model)
    assert has_positive_modes(sliding(0.999 * critical), matrix)
    assert not has_positive_modes(sliding(1.001 * critical), matrix)


@pytest.mark.long
def test_a_pile_falls_or_rests_by_its_friction():
    """Equilibrium forces exist from mu = 0.433987 on; W is singular, and a step may have several answers."""
    falls, rests = simulate(pile(0.42, activation=0.5, project=False)), simulate(pile(0.8))
    assert 1.1e-2 <= falls.q[0, 16] - falls.q[-1, 16] <= 1.6e-2
    assert np.abs(rests.v).max() <= 1e-12
    assert any("W singular: rank 18 of 24" in text for text in simulate(pile(0.5, 0.1)).metadata["warnings"])


def test_units_do_not_matter():
    """Masses times 1e7, lengths times 1e-3: the same digits."""

    def bouncing_disc(mass, length):
        q, v, R = S("p", 3), S("w", 3), 0.5 * length
        floor, M = Contact(q[1] - R, slip=v[0] + R * v[2], mu=0.1, e=0.9), np.array([1, 1, 0.4 * R**2]) * mass
        start = {"q0": [0, length, 0], "v0": [0, 0, 2], "t_end": 2, "step": 5e-3}
        return simulate(MechanicalSystem(q=q, v=v, M=M, F=[0, -G * length * mass, 0], contacts={"floor": floor}, **start))

    one, other = bouncing_disc(1, 1), bouncing_disc(1e7, 1e-3)
    np.testing.assert_allclose(other.q[:, :2] * 1e3, one.q[:, :2], atol=1e-11)
    np.testing.assert_allclose(other.v[:, 2], one.v[:, 2], atol=1e-11)
