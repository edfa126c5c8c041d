"""Models with nothing in them, models that are wrong, functions that jump or have kinks: said, never hidden."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ModelError,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    UsageError,
    box,
    check,
    complementarity,
    relay,
    simulate,
)
from nsmodel.modeling.laws import Law

T, Q, X, S = (ca.SX.sym(name) for name in ("t", "q", "x", "s"))
Q2 = ca.SX.sym("q", 2)


def failing(model, **options):
    """The error of a run that must stop, and what it has computed."""
    with pytest.raises(StepError) as caught:
        simulate(model, **options)
    return caught.value


def soft(u, a):
    """The prox of a|.|."""
    return np.sign(u) * np.maximum(np.abs(u) - a, 0)


# ---------------------------------------------------------------------------------------------- 11. emptiness


def empty():
    """Scenes with nothing to solve: (name, model, exact state (n,) at the end)."""
    yield "no constraints", SweepingProcess(q=Q2, f=[1, -2], q0=[0, 1], t_end=1, step=0.1), [1, -1]
    yield "empty dictionary", SweepingProcess(q=Q2, f=[1, -2], constraints={}, q0=[0, 1], t_end=1, step=0.1), [1, -1]
    yield "empty column", SweepingProcess(q=Q2, f=[1, -2], constraints={"none": []}, q0=[0, 1], t_end=1, step=0.1), [1, -1]
    yield "nothing at all", SweepingProcess(q=Q, q0=3, t_end=1, step=0.1), [3]
    yield "no friction, no force", FrictionOscillator(x=X, x0=1, v0=2, t_end=1, step=0.1), [3]
    yield "no law", FirstOrderSystem(x=X, f=0.5, x0=1, t_end=1, step=0.1), [1.5]
    yield (
        "law of size 0",
        FirstOrderSystem(x=X, lam=ca.SX(0, 1), f=0.5, h=[], g=0, law=complementarity(0), x0=1, t_end=1, step=0.1),
        [1.5],
    )
    for law in (complementarity(0), box([], []), Law(())):
        yield (
            "Lur'e, law of size 0",
            LureSystem(
                A=np.zeros((2, 2)), B=np.zeros((2, 0)), C=np.zeros((0, 2)), f=[1, -2], law=law, x0=[0, 1], t_end=1, step=0.1
            ),
            [1, -1],
        )
    yield "no operator, no set", MonotoneInclusion(x=X, field=0.5, x0=1, t_end=1, step=0.1), [1.5]


@pytest.mark.parametrize("at", range(len(list(empty()))))
def test_nothing_to_solve_leaves_the_solver_out(at):
    name, model, end = list(empty())[at]
    run = simulate(model)
    assert run.status == "done", name
    np.testing.assert_allclose(run.x[-1], end, atol=1e-14)
    assert run.multipliers.shape == (11, 0)
    assert not set(run.metadata["solver_counts"]) & {"qpoases", "lemke", "enumeration", "ipopt", "index set"}
    assert any("solver" in line for line in run.metadata["left_out"])
    with pytest.raises(UsageError, match="does not apply"):
        simulate(model, solver="qpoases")


def test_a_constraint_that_never_acts_calls_no_solver():
    far = {"far": 100 - Q2[0], "disc": ca.norm_2(Q2 - 50) - 1}
    run = simulate(SweepingProcess(q=Q2, f=[1, 0], constraints=far, q0=[0, 0], t_end=1, step=0.1))
    np.testing.assert_allclose(run.x[:, 0], run.t, atol=1e-14)
    np.testing.assert_array_equal(run.multipliers[1:], 0)
    assert np.all(run.index_set[1:] == -1)


def test_a_wall_that_is_never_reached_changes_nothing_in_the_other_classes():
    grid = {"t_end": 4, "step": 0.1}
    swinging = {"x": X, "potential": X**2 / 2, "friction": 0.3 * S, "s": S, "x0": 2, "v0": 1} | grid
    drifting = {"x": Q2, "field": [1, -0.3], "x0": [0, 0]} | grid
    for free, walled in (
        (FrictionOscillator(**swinging), FrictionOscillator(constraints={"far": 100 - X}, **swinging)),
        (MonotoneInclusion(**drifting), MonotoneInclusion(constraints={"far": 100 - Q2[0]}, **drifting)),
    ):
        one, other = simulate(free), simulate(walled)
        np.testing.assert_allclose(other.x, one.x, rtol=1e-12)
        np.testing.assert_array_equal(other.multipliers[1:, other.metadata["multiplier_names"].index("far")], 0)


def test_a_law_that_is_a_point_is_a_known_force():
    """box(c, c): the multiplier is c whatever y is."""
    run = simulate(LureSystem(A=-1, B=1, C=1, law=box(0.25, 0.25), x0=1, t_end=1, step=0.1))
    np.testing.assert_array_equal(run.multipliers[1:], 0.25)
    np.testing.assert_allclose(run.x[1:, 0], (run.x[:-1, 0] + 0.025) / 1.1, atol=1e-15)


def test_zero_columns_and_rows_are_no_obstacle():
    """A multiplier that acts on nothing, and an output that nothing moves."""
    model = LureSystem(A=-1, B=[[1, 0]], C=[[1], [0]], D=np.zeros((2, 2)), law=relay(2), x0=0.5, t_end=1, step=0.1)
    run = simulate(model)
    x = 0.5
    for k in range(10):
        x = soft(x, 0.1) / 1.1
        assert run.x[k + 1, 0] == pytest.approx(x, abs=1e-15)


# ---------------------------------------------------------------------------------------------- 12. bad models


def test_starts_outside_the_set_are_refused_by_a_run_and_reported_by_the_check():
    for model in (
        SweepingProcess(q=Q2, constraints={"disc": ca.norm_2(Q2) - 1}, q0=[0.5, 0], t_end=1, step=0.1),
        MonotoneInclusion(x=X, field=1, lower=0, x0=-1, t_end=1, step=0.1),
        MonotoneInclusion(x=Q2, field=[1, 1], constraints={"disc": 1 - ca.dot(Q2, Q2)}, x0=[2, 0], t_end=1, step=0.1),
        FrictionOscillator(x=X, constraints={"floor": X}, x0=-0.1, t_end=1, step=0.1),
    ):
        with pytest.raises(UsageError, match="outside the set"):
            simulate(model)
        report = check(model)
        assert any("outside the set" in note for note in report.notes)
        if isinstance(model, SweepingProcess):
            assert report["S-start"].verdict == "violated"
            assert report["S-start"].witness["constraint"] == "disc"


def test_models_that_break_a_hypothesis_load_and_warn():
    decreasing = FrictionOscillator(x=X, potential=X**2, friction=S - S**2, s=S, x0=0.1, t_end=0.2, step=0.1)
    saddle = FrictionOscillator(x=X, potential=-(X**2), friction=S, s=S, x0=0.1, t_end=0.2, step=0.1)
    lifted = LureSystem(A=-1, B=1, C=1, D=-0.01, law=relay(1), x0=1, t_end=0.2, step=0.1)
    said = (
        (decreasing, ["theta", "decreases"], "O-theta"),
        (saddle, ["not convex"], "O-g"),
        (lifted, ["D is not positive semidefinite"], "4.1"),
    )
    for model, words, id in said:
        assert check(model, quick=True)[id].verdict == "violated"
        try:
            run = simulate(model)
        except StepError as error:
            run = error.trajectory
        assert any(all(word in text for word in words) for text in run.metadata["warnings"])


# ---------------------------------------------------------------------------------------------- 13. kinks and gradients


@pytest.mark.parametrize(
    ("constraint", "q0"),
    [(ca.dot(Q2, Q2), [0, 0]), (Q2[0] ** 3, [0, 0]), (ca.fabs(Q2[0]), [0, 0]), (ca.SX(1), [0, 0]), (Q2[0] * Q2[1], [0, 0])],
    ids=str,
)
def test_a_constraint_without_gradient_at_the_start_is_said(constraint, q0):
    """Its linearised set is everything or nothing, whatever the set is."""
    model = SweepingProcess(q=Q2, f=[1, 0], constraints={"flat": constraint, "wall": 5 - Q2[0]}, q0=q0, t_end=0.3, step=0.1)
    try:
        said = " ".join(simulate(model).metadata["warnings"])
    except (UsageError, ModelError) as error:
        said = str(error)
    assert "'flat'" in said
    assert "gradient" in said
    assert "'wall'" not in said


@pytest.mark.parametrize("constraint", [ca.norm_2(Q2), ca.sqrt(Q2[0]), Q2[1] / Q2[0], ca.log(Q2[0])], ids=str)
def test_a_constraint_that_is_not_a_number_at_the_start_is_refused(constraint):
    with pytest.raises(UsageError, match=r"constraint 'bad': its (value|gradient) at the start .* is not a finite number"):
        simulate(SweepingProcess(q=Q2, f=[1, 0], constraints={"bad": constraint}, q0=[0, 0], t_end=1, step=0.1))


def test_a_constraint_that_becomes_not_a_number_is_named():
    """A root whose argument becomes negative at t = 0.35."""
    walls = {"root": ca.sqrt(0.35 - T) + 1 - Q, "wall": 9 - Q}
    error = failing(SweepingProcess(t=T, q=Q, f=1, constraints=walls, q0=0, t_end=1, step=0.1))
    assert "'root'" in str(error)
    assert "not a finite number" in str(error)
    assert error.trajectory.t[-1] == pytest.approx(0.3)


def test_the_check_says_where_a_gradient_vanishes_and_where_functions_jump():
    flat = SweepingProcess(q=Q2, f=[1, 0], constraints={"flat": ca.dot(Q2, Q2)}, q0=[0, 0], t_end=0.3, step=0.1)
    assert check(flat, quick=True)["A1"].verdict == "violated"
    assert check(flat, quick=True)["A1"].witness["constraint"] == "flat"
    jumping = SweepingProcess(q=Q, f=ca.sign(0.25 - Q), constraints={"w": 0.35 - Q}, q0=0, t_end=1, step=0.1)
    finding = check(jumping)["S-f"]
    assert (finding.verdict, finding.value["K_f"]) == ("violated", np.inf)
    assert finding.witness["q"] == pytest.approx(0.25)
    kinked = SweepingProcess(
        q=Q2, f=[1, 0.5], constraints={"square": ca.fmax(ca.fabs(Q2[0]), ca.fabs(Q2[1])) - 1}, q0=[-2, 0.3], t_end=4, step=0.1
    )
    finding = check(kinked)["A4"]
    assert finding.verdict == "violated"
    assert abs(finding.witness["q_0"]) == pytest.approx(abs(finding.witness["q_1"]), abs=1e-9)


def test_what_a_concave_kink_costs_is_said_by_the_run_and_its_check():
    """fmin(q_0, q_1) >= 0 by the scheme: one of the two is linearised, and the other is overrun."""
    corner = SweepingProcess(q=Q2, f=[-1, -1.5], constraints={"corner": ca.fmin(Q2[0], Q2[1])}, q0=[1, 1], t_end=2, step=0.1)
    run = simulate(corner)
    assert "constraint 'corner' was overrun, at worst by 0.15 at t = 1.2" in run.metadata["warnings"][0]
    report = check(corner, [run], quick=True)
    assert report["S-convex"].verdict == "violated"
    assert report["run-feasible"].verdict == "violated"
    assert report["run-feasible"].value["least value"] == run.gap.min() < -0.1
    assert report["run-feasible"].witness["constraint"] == "corner"


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("edge", [-ca.log(X), -ca.log1p(X - 1), -ca.log(X) + X**2], ids=str)
def test_a_potential_is_not_left_through_the_edge_of_its_domain(edge, compiled):
    """-1/x is a number also where log(x) is none: a root of the step's equation there is no minimum."""
    slow = simulate(FrictionOscillator(x=X, potential=edge, x0=1, v0=-1, t_end=1, step=0.1), compiled=compiled)
    assert slow.x.min() > 0
    assert np.isfinite(slow.energy).all()
    with pytest.raises(StepError, match="not finite"):
        simulate(FrictionOscillator(x=X, potential=edge, x0=1, v0=-20, t_end=1, step=0.1), compiled=compiled)


def test_discontinuous_f():
    run = simulate(SweepingProcess(t=T, q=Q, f=ca.if_else(T < 0.45, 1, -1), constraints={"w": 0.3 - Q}, q0=0, t_end=1, step=0.1))
    np.testing.assert_allclose(run.x[:, 0], [0, 0.1, 0.2, 0.3, 0.3, 0.3, 0.2, 0.1, 0, -0.1, -0.2], atol=1e-15)
    run = simulate(SweepingProcess(q=Q, f=ca.sign(0.25 - Q), constraints={"w": 0.35 - Q}, q0=0, t_end=1, step=0.1))
    np.testing.assert_allclose(run.x[3:, 0], [0.3, 0.2] * 4, atol=1e-15)


def test_kinks_in_a_constraint():
    """A square obstacle |q|_inf >= 1: its face x = -1 stops the point, which glides up along it and goes over the corner."""
    square = ca.fmax(ca.fabs(Q2[0]), ca.fabs(Q2[1])) - 1
    run = simulate(SweepingProcess(q=Q2, f=[1, 0.5], constraints={"square": square}, q0=[-2, 0.3], t_end=4, step=0.01))
    assert run.gap.min() >= -1e-14
    x = run.x
    held = (run.t > 1.05) & (run.t < 1.35)
    np.testing.assert_allclose(x[held, 0], -1, atol=1e-14)
    np.testing.assert_allclose(x[:, 1], 0.3 + 0.5 * run.t, atol=0.02)
    assert x[-1, 0] == pytest.approx(-1 + (4 - 1.4), abs=0.02)


def test_a_root_of_a_square_is_a_distance():
    """Two intervals head-on, by the root of a square: they meet and stay together."""
    q = ca.SX.sym("q", 2)
    pair = {"pair": ca.sqrt((q[1] - q[0]) ** 2) - 0.2}
    run = simulate(SweepingProcess(q=q, f=[1, -1], constraints=pair, q0=[-1, 1], t_end=2, step=0.05))
    np.testing.assert_allclose(run.x[-1], [-0.1, 0.1], atol=1e-14)
