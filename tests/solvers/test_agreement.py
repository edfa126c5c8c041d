"""Solvers forced alone give the run that the chain gives, or stop; runs repeat bit for bit, whatever ran in between."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ManyBodies,
    MechanicalSystem,
    MonotoneInclusion,
    StepError,
    SweepingProcess,
    UsageError,
    complementarity,
    relay,
    second_order_cone,
    simulate,
)
from nsmodel.solvers.mlcp import QP_SOLVERS as QP_SOLVERS
from nsmodel.solvers.one_step_problem import initial_rows, one_step_problem
from nsmodel.solvers.plan import STEP_SOLVERS
from nsmodel.solvers.step import WarmStart
from nsmodel.solvers.time_stepper import Stepper

FORCED = ("qpoases", "qrqp", "daqp", "ipopt", "lemke")


class Stretch(NamedTuple):
    """The part of a case that is run: the step, the number of steps, arguments of the case's function."""

    step: float
    steps: int
    arguments: Mapping = MappingProxyType({})


MONOTONE = {
    "anti_windup": Stretch(0.05, 150),
    "bang_bang": Stretch(0.02, 90),
    "belt": Stretch(0.1, 60),
    "buck": Stretch(2e-6, 150),
    "buck_light_load": Stretch(1e-6, 30),
    "cabot_4_1": Stretch(1, 40),
    "cabot_4_2": Stretch(1, 25),
    "cabot_4_3": Stretch(1, 20),
    "crowd_room": Stretch(0.02, 14, {"n": 12}),
    "diode_bridge": Stretch(1e-5, 60),
    "drive_cycle": Stretch(0.1, 70),
    "elastoplastic": Stretch(0.05, 60),
    "friction_chain": Stretch(1e-2, 60, {"n": 10}),
    "friction_fit": Stretch(0.05, 70),
    "friction_oscillator": Stretch(0.05, 70),
    "friction_oscillator_relay": Stretch(1e-2, 50),
    "full_wave_rectifier": Stretch(2e-4, 60),
    "half_wave_rectifier": Stretch(2e-4, 80),
    "inclusion_8_1": Stretch(0.02, 50),
    "inclusion_8_2": Stretch(0.02, 90),
    "inclusion_8_2_full": Stretch(0.02, 70),
    "leash": Stretch(0.05, 80),
    "moving_disc": Stretch(0.02, 40),
    "moving_half_line": Stretch(0.02, 130),
    "observer": Stretch(0.05, 60),
    "obstacle": Stretch(5e-3, 40),
    "point_past_disc": Stretch(0.02, 40),
    "relay_oscillator": Stretch(0.02, 130),
    "rlc_diode": Stretch(1e-5, 50),
    "sampled_pi": Stretch(0.05, 100),
    "sandpile": Stretch(0.35, 40),
    "sliding_relay": Stretch(1e-2, 60),
    "three_pulse_rectifier": Stretch(2e-4, 60),
    "thyristor": Stretch(2e-4, 80),
    "total_variation": Stretch(0.02, 30),
    "tumbler": Stretch(0.02, 60),
    "two_discs": Stretch(0.02, 60),
    "two_masses": Stretch(1e-2, 80),
    "two_surfaces": Stretch(0.05, 40),
    "voltage_doubler": Stretch(2e-5, 60),
    "zener_limiter": Stretch(2e-4, 80),
}
NOT_MONOTONE = {
    "boost": Stretch(1e-6, 40),
    "gene_network": Stretch(1e-2, 40),
    "repressilator": Stretch(1e-2, 70),
    "toggle_switch": Stretch(1e-2, 180),
    "twisting": Stretch(1e-2, 200),
    "zhuravlev_ivanov": Stretch(1e-2, 60),
}
NO_LAW = {"integrate_and_fire", "schmitt_trigger", "sliding_mode", "thermostat"}

# At rest on the kink of |x| both rows are active and only the sum of their multipliers is determined: IPOPT may end between.
MAY_STOP = {("cabot_4_2", "ipopt")}


@pytest.fixture(scope="module")
def by_auto(load_case):
    """The run of each stretch by the chain."""
    done = {}

    def run(stem):
        if stem not in done:
            stretch = (MONOTONE | NOT_MONOTONE)[stem]
            model = load_case(stem, **stretch.arguments)
            done[stem] = model, simulate(model, step=stretch.step, t_end=stretch.step * stretch.steps)
        return done[stem]

    return run


def forced(model, stretch, solver):
    """(run, whether it stopped)."""
    try:
        return simulate(model, step=stretch.step, t_end=stretch.step * stretch.steps, solver=solver), False
    except StepError as error:
        return error.trajectory, True


def assert_same_states(run, reference, tolerance):
    """The states of a run, as far as it came, beside the largest state."""
    known = reference.x[: len(run.t)]
    np.testing.assert_array_equal(run.t, reference.t[: len(run.t)])
    size = np.abs(reference.x).max(axis=0)
    assert np.nanmax(np.abs(run.x - known) / np.where(size > 0, size, np.abs(reference.x).max())) <= tolerance


def test_every_case_file_is_in_a_list(case_file, load_case):
    if not isinstance(load_case(case_file.stem), ManyBodies | MechanicalSystem):  # which no solver alone is asked for
        assert case_file.stem in MONOTONE.keys() | NOT_MONOTONE.keys() | NO_LAW


@pytest.mark.parametrize("solver", FORCED)
@pytest.mark.parametrize("stem", MONOTONE)
def test_a_solver_alone_agrees_with_the_chain(stem, solver, by_auto):
    model, reference = by_auto(stem)
    assert len(np.unique(reference.index_set[1:], axis=0)) > 1
    run, stopped = forced(model, MONOTONE[stem], solver)
    assert not stopped or (stem, solver) in MAY_STOP
    assert_same_states(run, reference, 1e-9)
    assert set(run.metadata["solver_counts"]) <= {solver, "none needed"}


@pytest.mark.parametrize("solver", [name for name in STEP_SOLVERS if name not in (*FORCED, "auto")])
@pytest.mark.parametrize("stem", ["diode_bridge", "crowd_room", "friction_chain", "inclusion_8_2", "moving_disc", "cabot_4_1"])
def test_the_other_solvers_agree_or_stop(stem, solver, by_auto):
    """OSQP and its like end at 1e-3 to 1e-8: the polish makes them exact, or the step is refused."""
    model, reference = by_auto(stem)
    run, _ = forced(model, MONOTONE[stem], solver)
    assert_same_states(run, reference, 1e-9)


@pytest.mark.parametrize("solver", QP_SOLVERS)
@pytest.mark.parametrize("stem", NOT_MONOTONE)
def test_quadratic_programmes_are_refused_where_the_step_is_not_monotone(stem, solver, load_case):
    with pytest.raises(UsageError, match=rf"'{solver}' does not apply: .*not a convex QP .*least eigenvalue"):
        simulate(load_case(stem), solver=solver)


@pytest.mark.parametrize("solver", ["lemke", "active-set", "enumeration", "ipopt"])
@pytest.mark.parametrize("stem", NOT_MONOTONE)
def test_solvers_that_apply_to_any_step_are_right_or_stop(stem, solver, by_auto):
    """Solutions need not be unique: a step that differs must be a solution, which its residual says."""
    model, reference = by_auto(stem)
    run, _ = forced(model, NOT_MONOTONE[stem], solver)
    assert run.metadata["warnings"]
    if len(run.t) > 1:
        assert run.residual[1:].max() <= 1e-9
    if stem == "gene_network":
        assert_same_states(run, reference, 1e-9)


def test_curved_laws_refuse_solvers_for_boxes():
    model = LureSystem(A=-np.eye(3), B=np.eye(3), C=np.eye(3), law=second_order_cone(3), x0=[1, 0, 0], t_end=1, step=0.1)
    for solver in set(STEP_SOLVERS) - {"auto", "ipopt", "semismooth"}:
        with pytest.raises(UsageError, match=r"the law has (balls|cones|ellipsoids|contacts)"):
            simulate(model, solver=solver)


def isotropic():
    x, s = ca.SX.sym("x", 2), ca.SX.sym("s")
    return FrictionOscillator(x=x, potential=ca.dot(x, x), friction=2 * s, s=s, x0=[1, 0.3], v0=[0, 1], t_end=2, step=0.05)


def cone_system():
    t = ca.SX.sym("t")
    f = ca.vertcat(ca.cos(3 * t), 2 * ca.sin(2 * t), 0.5)
    one = np.eye(3)
    return LureSystem(t=t, A=-one, B=one, C=one, f=f, law=second_order_cone(3), x0=[1, 0, 0], t_end=2, step=0.05)


@pytest.mark.parametrize("make", [isotropic, cone_system])
def test_ipopt_on_curved_laws_agrees_or_stops(make):
    model = make()
    reference = simulate(model)
    assert len(np.unique(reference.index_set[1:], axis=0)) > 1
    run, _ = forced(model, Stretch(0.05, 40), "ipopt")
    assert_same_states(run, reference, 1e-9)


# ---------------------------------------------------------------------------------------------- the same bits


def raw(run):
    return {name: array.tobytes() for name, array in run.arrays.items()}


def assert_same_bits(one, two):
    assert raw(one) == raw(two)
    assert one.metadata == two.metadata


SOME = (
    "diode_bridge", "friction_chain", "crowd_room", "cabot_4_2", "gene_network", "inclusion_8_2_full", "moving_disc",
    "two_masses",
)  # fmt: skip


@pytest.mark.parametrize("stem", SOME)
def test_a_run_repeats_bit_for_bit_with_another_run_in_between(stem, by_auto, load_case):
    model, first = by_auto(stem)
    stretch = (MONOTONE | NOT_MONOTONE)[stem]
    run = simulate(model, step=stretch.step, t_end=stretch.step * stretch.steps)
    assert_same_bits(run, first)
    simulate(load_case("rlc_diode"), t_end=1e-3)
    simulate(model, step=stretch.step * 1.5, t_end=stretch.step * 6)
    again = simulate(load_case(stem, **stretch.arguments), step=stretch.step, t_end=stretch.step * stretch.steps)
    assert_same_bits(again, first)


@pytest.mark.parametrize("solver", ["qpoases", "qrqp", "daqp", "osqp", "piqp", "ipopt"])
def test_a_forced_solver_repeats_bit_for_bit(solver, load_case):
    """Hot starts are hidden memory: a run of another length of steps in between must not show."""
    model = load_case("diode_bridge")
    one = simulate(model, step=1e-5, t_end=4e-4, solver=solver)
    simulate(model, step=2e-5, t_end=4e-4, solver=solver)
    assert_same_bits(simulate(model, step=1e-5, t_end=4e-4, solver=solver), one)


def stepper_models():
    """One model for each path: constant matrices, one linearisation, Newton, curved law."""
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("l", 2)
    yield (
        "kernel",
        LureSystem(t=t, A=[[0, 1], [-4, 0]], B=[0, 1], C=[0, 1], f=[0, ca.sin(t)], law=relay(1), x0=[1, 0], t_end=1, step=0.1),
    )
    yield (
        "linearised",
        SweepingProcess(
            q=x, f=[1, 0.1], constraints={"disc": ca.norm_2(x) - 1, "wall": 1.5 - x[0]}, q0=[-1.2, 0.1], t_end=1, step=0.1
        ),
    )
    yield "newton", FirstOrderSystem(
        x=x, lam=l, f=[-x[0] ** 3, -x[1]], h=[0.2 - x[0], 0.3 - x[1] + l[0] / 9], g=[2 * l[0] * (1 - l[1] / 2), l[1]],
        law=relay(2, 0, 1), x0=[0.5, 0.1], t_end=1, step=0.1,
    )  # fmt: skip
    yield "curved", isotropic()


@pytest.mark.parametrize(("name", "model"), list(stepper_models()), ids=[name for name, _ in stepper_models()])
def test_a_step_depends_on_its_arguments_alone(name, model):
    """Steps of many sizes in any order, on one stepper or on a fresh one for each: the same bits."""
    problem = one_step_problem(model)
    state = initial_rows(model, 0.1)[-1][0]

    def fresh():
        return Stepper(problem, "auto", 1e-9, h=0.1, state=state)

    used, rng, results = fresh(), np.random.default_rng(0), []
    sizes = 0.1 * 1.05 ** np.arange(-10, 10)
    at, warm, t = state, used.cold_start(), 0.0
    for h in rng.permutation(sizes):
        before = [a.tobytes() for a in (at, warm.l, warm.index)]
        result = used(t, h, at, warm)
        assert before == [a.tobytes() for a in (at, warm.l, warm.index)]
        results.append((t, h, at.copy(), WarmStart(warm.l.copy(), warm.index.copy()), result))
        at, warm, t = result.row[used.layout.state].copy(), result.warm, t + h
    for i in rng.permutation(len(results)):
        t, h, at, warm, expected = results[i]
        for stepper in (used, fresh()) if i % 4 == 0 else (used,):
            found = stepper(t, h, at, warm)
            assert found.row.tobytes() == expected.row.tobytes()
            assert found.warm.l.tobytes() == expected.warm.l.tobytes()
            assert found.warm.index.tobytes() == expected.warm.index.tobytes()


def test_results_do_not_change_when_the_next_step_is_taken(load_case):
    """Rows are copies: the buffers of the kernel are used again."""
    model = load_case("friction_oscillator_relay")
    problem = one_step_problem(model)
    stepper = Stepper(problem, "auto", 1e-9, h=0.1, state=np.array([12.0, 6.0]))
    first = stepper(0.0, 0.1, np.array([12.0, 6.0]), stepper.cold_start())
    before = first.row.tobytes(), first.warm.l.tobytes()
    stepper(0.1, 0.1, np.array([-3.0, 5.0]), first.warm)
    assert before == (first.row.tobytes(), first.warm.l.tobytes())


# ---------------------------------------------------------------------------------------------- nothing is printed


@pytest.mark.parametrize("solver", STEP_SOLVERS)
def test_solvers_print_nothing(solver, load_case, capfd):
    for stem, stretch in (("diode_bridge", Stretch(1e-5, 30)), ("moving_disc", Stretch(0.02, 30))):
        forced(load_case(stem), stretch, solver)
    assert capfd.readouterr() == ("", "")


def test_failing_steps_print_nothing(capfd):
    """A step that no solver can do passes through all of them, IPOPT at the end."""
    t, q, x, l = (ca.SX.sym(name) for name in "tqxl")
    models = [
        SweepingProcess(t=t, q=q, constraints={"left": q + 0.5 - t, "right": 0.5 - t - q}, q0=0.1, t_end=1, step=0.1),
        LureSystem(t=t, A=-1, B=1, C=1, f=ca.sqrt(0.5 - t), law=relay(1), x0=0.5, t_end=1, step=0.1),
        FirstOrderSystem(x=x, lam=l, f=-1, h=x, g=-l, law=complementarity(1), x0=0, t_end=1, step=0.1),
        MonotoneInclusion(x=x, field=1 + ca.sqrt(0.25 - x), operator=-x, lower=-1, upper=2, x0=0, t_end=9, step=0.1),
    ]
    for model in models:
        with pytest.raises(StepError):
            simulate(model)
    assert capfd.readouterr() == ("", "")
