"""Laws whose force has an infinite slope where they switch, such as super-twisting: sqrt|s| times a relay on s."""

import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, StepError, relay, simulate
from nsmodel.solvers import diagnosis

S, V, L, T = (ca.SX.sym(name) for name in "svlt")


def super_twisting(k1=1.5, k2=1.1, d=0.5, x0=(1.0, 0.0), root=lambda s: ca.sqrt(ca.fabs(s)), **options):
    """s' = v + k1 sqrt|s| l, v' = d cos t + k2 l, l in -Sgn(s): s and v are 0 from a finite time on where k2 > d."""
    given = {"t_end": 3.0, "step": 1e-2, "theta": 1.0} | options
    return FirstOrderSystem(
        t=T, x=[S, V], lam=L, f=[V, d * ca.cos(T)], g=[k1 * root(S) * L, k2 * L], h=S, law=relay(1), x0=list(x0), **given
    )


def steps_by_hand(k1, k2, d, x0, h, count):
    """The implicit steps: s_1 + h k1 sqrt|s_1| S + h^2 k2 S = b with S in Sgn(s_1) has one solution, in closed form."""
    (s, v), rows = x0, [x0]
    for k in range(1, count + 1):
        b = s + h * v + h * h * d * np.cos(k * h)
        side = np.clip(b / (h * h * k2), -1, 1)
        left = max(abs(b) - h * h * k2, 0.0)
        root = 2 * left / (h * k1 + np.sqrt((h * k1) ** 2 + 4 * left))
        s, v = side * root**2, v + h * d * np.cos(k * h) - h * k2 * side
        rows.append((s, v))
    return np.array(rows)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_steps_of_super_twisting_are_those_of_the_closed_form(seed, compiled):
    rng = np.random.default_rng(seed)
    k1, d = 10 ** rng.uniform(-1.5, 1), 10 ** rng.uniform(-1, 0.5)
    k2, h = d * 10 ** rng.uniform(-0.8, 1), 10 ** rng.uniform(-3, -1)
    x0 = tuple(rng.normal(size=2) * 10.0 ** rng.integers(-3, 2) * (seed != 3, 1))  # the last one starts on s = 0
    run = simulate(super_twisting(k1, k2, d, x0, t_end=200 * h, step=h), compiled=compiled)
    by_hand = steps_by_hand(k1, k2, d, x0, h, 200)
    assert np.abs(run.x - by_hand).max() <= 1e-7 * np.abs(by_hand).max()


ROOTS = {
    "2/3": lambda s: ca.fabs(s) ** (2 / 3),
    "1/3": lambda s: ca.fabs(s) ** (1 / 3),
    "of a square": lambda s: (s * s) ** 0.25,
    "plus 0": lambda s: ca.sqrt(ca.fabs(s) + 0),
}


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("name", ROOTS)
def test_other_powers_keep_the_formulas_of_their_steps(name, compiled):
    h, force = 0.05, ca.Function("force", [S], [ROOTS[name](S)])
    run = simulate(super_twisting(root=ROOTS[name], step=h), compiled=compiled)
    l, (s, v) = run.multipliers[1:, 0], run.x.T
    grown = np.array(force(s[1:].reshape(1, -1))).ravel()
    assert np.abs(s[1:] - s[:-1] - h * (v[1:] + 1.5 * grown * l)).max() <= 1e-9
    assert np.abs(v[1:] - v[:-1] - h * (0.5 * np.cos(run.t[1:]) + 1.1 * l)).max() <= 1e-9
    assert (np.abs(l) <= 1).all()
    assert (np.where(s[1:] == 0, 0, l + np.sign(s[1:])) == 0).all()
    assert not run.x[-1].any()


@pytest.mark.parametrize("theta", [1.0, 0.5])
def test_a_sliding_variable_of_two_states(theta):
    """Where s = x_2 + 2 x_1 is no state of its own, x_1 goes to 0 as exp(-2 t) once s = 0."""
    x = ca.SX.sym("x", 2)
    s = x[1] + 2 * x[0]
    model = FirstOrderSystem(
        t=T, x=ca.vertcat(x, V), lam=L, f=[x[1], -2 * x[0] + V - 2 * x[1], 0.5 * ca.cos(T)],
        g=[0, 1.5 * ca.sqrt(ca.fabs(s)) * L, 1.1 * L], h=s, law=relay(1), x0=[1, 0.3, 0], t_end=6, step=1e-2, theta=theta,
    )  # fmt: skip
    run = simulate(model, compiled=False)
    later = run.t > 5
    assert np.abs(run.x[later] @ [2, 1, 0]).max() < 1e-9
    rate = np.log(run.x[-1, 0] / run.x[later, 0][0]) / (run.t[-1] - run.t[later][0])
    assert rate == pytest.approx(-2, abs=0.05)


def test_steps_converge_to_the_piece_with_order_one():
    """Up to the first crossing, at 0.8376."""
    exact = simulate(super_twisting(t_end=0.8), rtol=1e-10, method="event-driven").x[-1]
    errors = [np.abs(simulate(super_twisting(t_end=0.8, step=h)).x[-1] - exact).max() for h in (1e-2, 5e-3, 2.5e-3)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert ((orders > 0.9) & (orders < 1.1)).all()


@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_pieces_go_over_the_crossings_by_steps_and_stay_at_zero(rtol):
    """Crossings of s = 0 accumulate; then v = 0 needs l = -d cos(t)/k2."""
    run = simulate(super_twisting(), rtol=rtol, compiled=False)
    slides = run.t > 1.6
    assert np.abs(run.x[slides]).max() <= 10 * rtol
    assert np.abs(run.multipliers[slides, 0] + 0.5 / 1.1 * np.cos(run.t[slides])).max() <= 0.02
    assert all("is at 0 in g" in stretch["why"] for stretch in run.summary()["stretches"])


def test_pieces_alone_stop_at_the_root_and_name_it():
    with pytest.raises(
        StepError, match="a root, or another power without a Taylor series at 0, is at 0 in g; time steps go over"
    ):
        simulate(super_twisting(), rtol=1e-6, method="event-driven", compiled=False)


def test_a_sign_that_makes_no_jump_is_not_called_one():
    """s_1 = s + h 50 (1 + s_1^2) has no solution for s = 1, h = 0.1; s^2 is written with a sign."""
    growing = FirstOrderSystem(
        t=T, x=S, lam=L, f=50 * (1 + ca.sign(S) * S * ca.fabs(S)), g=0.1 * L, h=S, law=relay(1), x0=1.0, t_end=1, step=0.1
    )
    with pytest.raises(StepError) as failed:
        simulate(growing, compiled=False)
    assert "jump" not in str(failed.value)


def with_a_jump(n, **options):
    """Signs that no law holds: steps that come to where they switch have no answer."""
    q = ca.SX.sym("q", n)
    f = [-ca.sign(q[i] - 0.1) * ca.exp(0.1 * q[(i + 1) % n]) + 0.3 * ca.cos((i + 1) * T) for i in range(n)]
    return FirstOrderSystem(t=T, x=q, lam=L, f=f, g=[(1 + q[i] ** 2) * L for i in range(n)], h=q[0], law=relay(1), **options)


@pytest.mark.parametrize("step", [1e-2, 1e-10])
def test_a_jump_is_named_however_short_the_step(step):
    with pytest.raises(StepError, match="a jump in the model"):
        simulate(with_a_jump(2, x0=[0.1 + step / 3, 0.1 + step / 3], t_end=20 * step, step=step), compiled=False)


def test_a_jump_is_looked_for_once(monkeypatch):
    looked = []
    monkeypatch.setattr(diagnosis, "_find_jump", lambda *_: looked.append(1) or True)
    model = with_a_jump(2, x0=[0.103, 0.103], t_end=0.2, step=1e-2)
    for _ in range(2):
        with pytest.raises(StepError, match="a jump in the model"):
            simulate(model, compiled=False)
    assert len(looked) == 1
