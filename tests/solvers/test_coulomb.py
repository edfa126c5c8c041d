"""Coulomb friction as a law: its cone, its problems with one contact and many, and steps with it."""

from __future__ import annotations

import contextlib

import casadi as ca
import numpy as np
import pytest
from conftest import optimised
from search.contacts import KINDS, TOLERANCE, ContactProblem, answer, draw_problem, judge, natural_map, planted_point

import nsmodel
from nsmodel import ModelError, complementarity, coulomb, equality, product
from nsmodel.modeling.laws import CoulombSet
from nsmodel.solvers import friction_contacts, mlcp
from nsmodel.solvers.diagnosis import contacts_without_answer
from nsmodel.solvers.residuals import NumericLaw, numeric_law
from nsmodel.study.reference_steps import CoulombAtRows, block_residual
from tests.codegen.test_codegen_affine import COMPILER, Library, compiled, hostile, source

MUS = (0.0, 0.3, 1.0, 2.5)
G = 9.81


# -- the cone ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mu", MUS)
@pytest.mark.parametrize("d", [2, 3])
def test_the_projection_is_the_nearest_point(mu, d):
    """By its definition: <u - P(u), v - P(u)> <= 0 for points v of the cone, and P(u) is one."""
    rng, K = np.random.default_rng(1), CoulombSet(mu)
    e = rng.normal(size=(200, d - 1))
    inside = np.c_[np.ones(200), mu * rng.random((200, 1)) * e / np.linalg.norm(e, axis=1, keepdims=True)] * rng.exponential(
        2, (200, 1)
    )
    for u in rng.normal(size=(100, d)) * 10.0 ** rng.uniform(-3, 3, (100, 1)):
        p = K.project(u)
        size = np.linalg.norm(u)
        assert np.linalg.norm(p[1:]) <= mu * p[0] + 1e-14 * size
        assert ((inside - p) @ (u - p)).max() <= 1e-12 * size * np.abs(inside).max() + 1e-12 * size**2


@pytest.mark.parametrize("mu", [0.0, 5e-324, 0.3])
def test_nothing_pulls(mu):
    """Without friction the cone is a half line: -1 is not in it, though |P_T| = 0 <= mu P_N = 0."""
    K, u = CoulombSet(mu), np.array([-1.0, 0.0])
    np.testing.assert_array_equal(K.project(u), 0)
    np.testing.assert_array_equal(K.jacobian(u), 0)
    assert K.code(u) == -1
    assert float(coulomb(mu).blocks[0].excess(u[None])[0, 0]) == 1
    problem = ContactProblem(np.eye(2), np.array([1.0, 0.0]), np.array([mu]), 2, None)
    assert mlcp.affine_law_residual(problem.W, problem.b, problem.law, u).max() > 0.1
    assert natural_map(problem, u) > 0.1


@pytest.mark.parametrize("mu", [1.0, 1e3, 1e9, 1e300])
def test_much_friction_hides_nothing(mu):
    """y_N = -1 with P = 0, and friction where y_N = 1, are judged as what they are, however large mu |y_T| is beside them."""
    for b, l in (([-1.0, 0.3], [0.0, 0.0]), ([1.0, -0.3], [0.0, 0.2])):
        problem = ContactProblem(np.eye(2), np.array(b), np.array([mu]), 2, None)
        assert mlcp.affine_law_residual(problem.W, problem.b, problem.law, np.array(l)).max() > 0.1


@pytest.mark.parametrize("mu", [0.0, 1.0, 1e3, 1e9])
@pytest.mark.parametrize("read", [lambda mu: coulomb(mu).blocks[0], lambda mu: CoulombAtRows(np.full((1, 1), mu))])
def test_the_judge_of_studies_sees_both_too(mu, read):
    """An approach without an impulse, friction in the air, a pull; and no objection to open, stick and slip."""
    s_y = np.full((1, 2), 1e-8)
    wrong = (([0.0, 0.0], [-1.0, 0.3]), ([0.0, 0.2], [1.0, -0.3]), ([-1.0, 0.0], [0.0, 0.0]))
    right = (([0.0, 0.0], [1.0, 0.2]), ([1.0, 0.5 * mu], [0.0, 0.0]), ([1.0, -mu], [0.0, 0.3]))
    for pairs, is_right in ((wrong, False), (right, True)):
        for l, y in pairs:
            with np.errstate(all="ignore"):
                assert (block_residual(read(mu), np.array([l]), np.array([y]), s_y) <= 1) == is_right


@pytest.mark.parametrize("value", [1e154, 1e300])
def test_no_coefficient_overflows(value):
    """mu^2 is infinite: an infinity, and no OverflowError, in each of the cone's expressions."""
    K, l, y = CoulombSet(value), ca.SX.sym("l", 2), ca.SX.sym("y", 2)
    K.complementarity(l, y, 1e-12)
    K.quadric(2)
    for u in ([-1.0, 0.3], [1.0, 0.3], [-1.0, 1e-3]):
        assert np.isfinite(K.project(np.array(u))).all()
        assert np.isfinite(K.jacobian(np.array(u))).all()


@pytest.mark.parametrize("mu", MUS)
@pytest.mark.parametrize("d", [2, 3])
def test_the_derivatives_are_those_of_differences(mu, d):
    rng, K, h = np.random.default_rng(2), CoulombSet(mu), 1e-6
    for u in rng.normal(size=(50, d)):
        for function, jacobian in ((K.project, K.jacobian(u)), (K.shifted, K.shift_jacobian(u))):
            columns = [(function(u + h * e) - function(u - h * e)) / (2 * h) for e in np.eye(d)]
            np.testing.assert_allclose(jacobian, np.array(columns).T, atol=1e-7)


@pytest.mark.parametrize("d", [2, 3])
def test_the_law_is_contact_and_friction(d):
    """The residual is 0 at points that meet both laws as they are usually written, and is not where one of them is off."""
    rng = np.random.default_rng(3)
    for seed in range(60):
        mus = rng.uniform(0, 2, 3)
        l, y = planted_point(np.random.default_rng(seed), mus, d)
        W = np.eye(3 * d)
        problem = ContactProblem(W, y - W @ l, mus, d, l)
        assert mlcp.affine_law_residual(W, problem.b, problem.law, l).max() <= 1e-14
        off = np.array([1.0, *[0.3] * (d - 1)] * 3) * rng.choice([-1, 1], 3 * d)
        assert mlcp.affine_law_residual(W, problem.b, problem.law, l + 1e-3 * off).max() > 1e-6


# -- problems ----------------------------------------------------------------------------------------------------------


def one_contact(W, b, mu):
    return ContactProblem(np.array(W), np.array(b), np.array([mu]), len(b), None)


@pytest.mark.parametrize(
    ("b", "l", "code"),
    [
        ([0.5, 1.0], [0, 0], -1),  # opens
        ([-1.0, 0.2], [1, -0.2], 0),  # sticks
        ([-1.0, 3.0], [1, -0.5], 1),  # slips forward
        ([-1.0, -3.0], [1, 0.5], 1),
        ([0.0, 1.0], [0, 0], -1),  # touches without pushing
        ([0.5, 0.3, 0.4], [0, 0, 0], -1),
        ([-1.0, 0.03, -0.04], [1, -0.03, 0.04], 0),
        ([-1.0, 3.0, -4.0], [1, -0.3, 0.4], 1),
    ],
)
def test_one_contact(b, l, code):
    found = answer(one_contact(np.eye(len(b)), b, 0.5))
    np.testing.assert_allclose(found.l, l, atol=1e-15)
    assert set(found.index) == {code}
    assert found.residual <= 1e-15


def test_contact_without_friction_lets_slip():
    found = answer(one_contact(np.eye(3), [-2.0, 1.0, -1.0], 0.0))
    np.testing.assert_array_equal(found.l, [2, 0, 0])


ROD, ROD_B = [[2.5, -1.5], [-1.5, 2.5]], [0.1605, -1.363]  # Of Painlevé at 45 degrees, mu = 2: three answers.
ROD_ANSWERS = ([0, 0], [0.4108, 0.7917], [0.3210, 0.6420])


def test_of_three_answers_the_last_modes_decide():
    problem = one_contact(ROD, ROD_B, 2.0)
    for rough, code in zip(ROD_ANSWERS, (-1, 0, 1), strict=True):
        warm, index = np.array(rough, float), np.full(2, code, np.int8)
        found = mlcp.solve_mlcp(problem.W, problem.b, problem.law, warm, index, (mlcp.SEMISMOOTH,), True, 1e-12)
        np.testing.assert_allclose(found.l, rough, atol=1e-4)
        assert natural_map(problem, found.l) <= 1e-14


@pytest.mark.parametrize(
    "kind", KINDS, ids=[f"{d} rows {'planted' * p or 'drawn'} {'definite' * f or 'singular'}" for d, p, f in KINDS]
)
def test_random_problems_get_a_right_answer(kind):
    assert [judge(draw_problem(seed, *kind)) for seed in range(25)] == [""] * 25


def test_units_do_not_matter():
    """Masses times 1e7 and lengths times 1e-3: the same answer to rounding."""
    for seed in range(20):
        problem = draw_problem(seed, 3, False, True)
        other = problem._replace(W=problem.W / 1e7, b=problem.b * 1e-3)
        one, two = answer(problem), answer(other)
        np.testing.assert_allclose(two.l, one.l * 1e4, rtol=1e-9, atol=1e-9 * 1e4 * np.abs(one.l).max())
        assert two.residual <= TOLERANCE


def test_lemke_is_asked_where_modes_are_too_many():
    """Eight contacts in the plane: of all modes there are 65 536."""
    rng = np.random.default_rng(0)
    mus = rng.uniform(0.1, 1, 8)
    l, y = planted_point(rng, mus, 2)
    A = rng.normal(size=(16, 9))
    problem = ContactProblem(A @ A.T, y - A @ (A.T @ l), mus, 2, l)
    assert not list(friction_contacts.solutions_on_all_modes(problem.W, problem.b, problem.law))
    assert natural_map(problem, friction_contacts.solve_by_lemke(problem.W, problem.b, problem.law)) <= 1e-9


@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
@pytest.mark.parametrize(("d", "count"), [(2, 1), (2, 3), (3, 1), (3, 3)])
def test_the_chain_in_c_is_that_of_python(d, count, tmp_path):
    rng = np.random.default_rng(d * count)
    mus = rng.uniform(0, 1.5, count)
    law = product(*(coulomb(mu, slip=d - 1) for mu in mus))
    library = Library(compiled(tmp_path, source(law, rows=2 * d * count), optimised("-O2"), "-shared", "-fPIC", name="friction"))
    for seed in range(40):
        m = d * count
        A = rng.normal(size=(m, m + 2 - 3 * (seed % 2)))
        l, y = planted_point(rng, mus, d)
        problem = ContactProblem(A @ A.T, y - A @ (A.T @ l) if seed % 4 < 2 else rng.normal(size=m), mus, d, None)
        python = mlcp.solve_mlcp(
            problem.W, problem.b, numeric_law(law), np.zeros(m), np.full(m, -1, np.int8), (mlcp.SEMISMOOTH,), True, 1e-10
        )
        c = library.solve(problem.W, problem.b, numeric_law(law), np.zeros(m), np.full(m, -1, np.int8))
        assert (c.solver == "none") == (python.residual > 1e-10)
        if c.solver != "none":
            assert natural_map(problem, c.l) <= TOLERANCE
        if c.solver != "none" and seed % 2 == 0:  # W definite
            np.testing.assert_allclose(problem.W @ c.l, problem.W @ python.l, atol=1e-11 * np.abs(problem.b).max())


MIXED = product(coulomb(0.4), coulomb(0.3, slip=2), complementarity(1), coulomb(0.0), equality(1))


@pytest.mark.skipif(COMPILER is None, reason="no C compiler")
@pytest.mark.long
def test_hostile_numbers_end_and_nothing_false_passes(tmp_path):
    """NaN, infinities, sizes to 1e300, in C under a sanitizer and, a few of them, in Python."""
    law, checked = numeric_law(MIXED), ("-fsanitize=undefined", "-fno-sanitize-recover=all")
    text = source(MIXED, rows=2 * law.size)
    library = Library(compiled(tmp_path, text, optimised("-O1"), "-shared", "-fPIC", *checked, name="hostile"))
    for seed in range(200):
        rng = np.random.default_rng(seed)
        W, b = hostile(rng, law.size)
        warm, index = rng.choice([np.nan, np.inf, 1e300, 0.0, 1.0], law.size), rng.integers(-1, 2, law.size).astype(np.int8)
        with np.errstate(all="ignore"):
            c = library.solve(W, b, law, warm, index)
            found = [c.l] * (c.solver != "none")
            if seed < 8:
                with contextlib.suppress(np.linalg.LinAlgError):  # which a run takes for a step that fails
                    python = mlcp.solve_mlcp(W, b, law, warm, index, (mlcp.SEMISMOOTH,), False, 1e-10)
                    found += [python.l] * (python.residual <= 1e-10)
            for l in found:
                assert np.isfinite(l).all()
                rounding = 8 * 2.0**-53 / 1e-10 * (np.abs(W) @ np.abs(l) + np.abs(b))
                assert mlcp.affine_law_residual(W, b, law, l, rounding).max() <= 2e-10


# -- steps -------------------------------------------------------------------------------------------------------------


def block(degrees, v0, mu=0.5, **given):
    """A point on an incline: velocities along and across, and the way."""
    x = ca.SX.sym("vx"), ca.SX.sym("vy"), ca.SX.sym("way")
    P, phi = ca.SX.sym("P", 2), np.deg2rad(degrees)
    return nsmodel.FirstOrderSystem(
        x=ca.vertcat(*x), lam=P, f=ca.vertcat(G * np.sin(phi), -G * np.cos(phi), x[0]), g=ca.vertcat(P[1], P[0], 0),
        h=ca.vertcat(x[1], x[0]), law=coulomb(mu), x0=[v0, 0, 0], **{"t_end": 1.5, "step": 5e-3} | given,
    )  # fmt: skip


@pytest.mark.parametrize("is_compiled", [False, True])
def test_a_block_on_an_incline(is_compiled):
    """tan 25 < mu = 0.5 < tan 27: it stays, slides on, comes to rest, slides off. Velocities are exact while it slides so."""
    phi = np.deg2rad(25)
    rest = nsmodel.simulate(block(25, 0.0), compiled=is_compiled)
    assert (rest.x == 0).all()
    on = nsmodel.simulate(block(25, 2.0), compiled=is_compiled)
    np.testing.assert_allclose(on.x[:, 0], 2 + G * (np.sin(phi) - 0.5 * np.cos(phi)) * on.t, rtol=1e-12)
    up = nsmodel.simulate(block(25, -2.0), compiled=is_compiled)
    stopped = 2 / (G * (np.sin(phi) + 0.5 * np.cos(phi)))
    assert (up.x[up.t > stopped + 0.005, 0] == 0.0).all()
    assert up.x[-1, 2] == pytest.approx(-2 * stopped / 2, abs=1e-2)
    off = nsmodel.simulate(block(27, 0.0), compiled=is_compiled)
    phi = np.deg2rad(27)
    np.testing.assert_allclose(off.x[1:, 0], G * (np.sin(phi) - 0.5 * np.cos(phi)) * off.t[1:], rtol=1e-9)
    for run in (rest, on, up, off):
        assert run.residual[1:].max() <= 1e-9
        assert (np.abs(run.multipliers[1:, 1]) <= 0.5 * run.multipliers[1:, 0] * (1 + 1e-14)).all()


def slope(h):
    """Launched across the fall line of a plane of 20 degrees with mu = tan 20."""
    a = np.deg2rad(20)
    v, q, P = ca.SX.sym("v", 3), ca.SX.sym("q", 2), ca.SX.sym("P", 3)
    return nsmodel.FirstOrderSystem(
        x=ca.vertcat(v, q), lam=P, f=ca.vertcat(G * np.sin(a), 0, -G * np.cos(a), v[:2]), g=ca.vertcat(P[1], P[2], P[0], 0, 0),
        h=ca.vertcat(v[2], v[0], v[1]), law=coulomb(np.tan(a), slip=2), x0=[0, 2, 0, 0, 0], t_end=0.622742891, step=h,
    )  # fmt: skip


@pytest.mark.parametrize("is_compiled", [False, True])
def test_a_slip_that_turns_in_space(is_compiled):
    """v (1 + cos psi) is constant: at tau = tan(psi/2) = 0.2 the closed form has v = (0.96, 0.4). Order 1."""
    ends = [nsmodel.simulate(slope(h), compiled=is_compiled).x[-1] for h in (2e-2, 1e-2)]
    errors = [np.abs(x[:2] - [0.96, 0.4]).max() for x in ends]
    assert errors[1] <= 1e-2
    assert 1.8 <= errors[0] / errors[1] <= 2.2


def test_a_coefficient_that_moves_is_one_that_stays():
    """mu(t) constant gives the run of the number; mu(t) > tan phi stops the block, and mu < 0 is refused by its row."""
    t = ca.SX.sym("t")
    for mu, moved in ((0.5, 0.5 + 0 * ca.sin(t) * t**0), (0.5, ca.fmax(0.5, -t))):
        one, two = nsmodel.simulate(block(25, -2.0, mu)), nsmodel.simulate(block(25, -2.0, moved, t=t))
        np.testing.assert_allclose(two.x, one.x, atol=1e-12)
        np.testing.assert_allclose(two.multipliers[1:], one.multipliers[1:], atol=1e-12)
    with pytest.raises(nsmodel.NsmodelError, match="the law of 'P_0' at t = "):
        nsmodel.simulate(block(25, 1.0, 0.1 - t, t=t))


def test_mu_is_a_parameter():
    mu = ca.SX.sym("mu")
    model = block(25, -2.0, mu, parameters={mu: 0.5})
    same = nsmodel.simulate(block(25, -2.0, 0.9)).x
    np.testing.assert_allclose(nsmodel.simulate(model, parameters={"mu": 0.9}).x, same, atol=1e-13)
    with pytest.raises(nsmodel.UsageError, match="Coulomb friction has mu = -1"):
        nsmodel.simulate(model, parameters={"mu": -1.0})


def test_an_error_control_runs_by_steps():
    run = nsmodel.simulate(block(25, -2.0), rtol=1e-5)
    stopped = 2 / (G * (np.sin(np.deg2rad(25)) + 0.5 * np.cos(np.deg2rad(25))))
    assert run.x[-1, 0] == 0
    assert run.x[-1, 2] == pytest.approx(-stopped, rel=1e-4)


# -- what is refused, and what is not promised -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"mu": -0.1}, "mu = -0.1 must be finite and not negative"),
        ({"mu": np.inf}, "mu = inf"),
        ({"mu": [0.1, 0.2]}, "mu has 2 values; expected one, and a law for each contact"),
        ({"mu": "rough"}, "mu = 'rough'"),
        ({"mu": 0.1, "slip": 3}, "slip = 3; a contact has 1 row of slip in the plane and 2 in space"),
        ({"mu": 0.1, "slip": True}, "slip = True"),
    ],
)
def test_bad_numbers_are_named(given, text):
    with pytest.raises(ModelError, match=text):
        coulomb(**given)


def test_nothing_is_proved_by_a_law_that_is_no_normal_cone():
    """What holds of a first-order system holds whatever its law is; the other classes take no such law."""
    found = {f.id: f for f in nsmodel.check(block(25, 2.0)).findings}
    assert {id for id, f in found.items() if f.verdict == "holds"} <= {"F-jacobians", "F-W", "F-step", "run-residual"}
    for id in ("F-mlcp", "F-unique"):
        assert "no normal cone" in found[id].how
    with pytest.raises(ModelError, match="write a FirstOrderSystem"):
        nsmodel.LureSystem(A=np.zeros((2, 2)), B=np.eye(2), C=np.eye(2), law=coulomb(0.5), x0=[0, 0], t_end=1, step=0.1)


@pytest.mark.parametrize("rank", [4, 3, 2])
def test_that_no_modes_fit_is_never_said_of_a_problem_with_an_answer(rank):
    """Planted answers in all modes, W definite and singular; and where it is said nothing solves the problem."""
    rng, said = np.random.default_rng(rank), 0
    for _ in range(30):
        G, mu = rng.normal(size=(4, rank)), rng.uniform(0.1, 3, 2)
        W = G @ G.T
        law = NumericLaw(
            np.full(4, -np.inf), np.full(4, np.inf), tuple((slice(2 * k, 2 * k + 2), CoulombSet(mu[k])) for k in (0, 1))
        )
        l, y = np.zeros(4), np.zeros(4)
        for k, mode in enumerate(rng.integers(3, size=2)):
            n, t = 2 * k, 2 * k + 1
            if mode == 0:
                y[n], y[t] = rng.uniform(0, 1), rng.normal()
            else:
                l[n] = rng.uniform(0, 1)
                l[t] = mu[k] * l[n] * rng.uniform(-1, 1)
            if mode == 2:
                y[t] = rng.normal()
                l[t] = -np.sign(y[t]) * mu[k] * l[n]
        assert not contacts_without_answer(law, W, y - W @ l)
        b = rng.normal(size=4)
        if contacts_without_answer(law, W, b):
            said += 1
            found = mlcp.solve_mlcp(W, b, law, np.zeros(4), np.full(4, -1, np.int8), (mlcp.SEMISMOOTH,), True, 1e-10)
            assert not found.residual <= 1e-9
    assert said if rank < 4 else not said
