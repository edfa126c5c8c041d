"""Cases of rectifiers, limiters and gene switches against hand-made orbits, SciPy and times by logarithms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from nsmodel import simulate, table

RTOL = 1e-8


@pytest.fixture(scope="module")
def by_pieces(load_case):
    """Return by_pieces(stem, **fields) -> (model, its event-driven run)."""

    def run(stem, **fields):
        model = replace(load_case(stem), **fields)
        return model, simulate(model, rtol=RTOL, method="event-driven", compiled=False)

    return run


def times(run):
    return np.array([event.t for event in run.events])


# -- circuits ----------------------------------------------------------------------------------------------------------


def test_the_zener_lets_go_when_the_source_passes_its_voltage(by_pieces):
    model, run = by_pieces("zener_limiter", t_end=0.02)
    top, release, bottom, last = times(run)
    assert np.abs(run.x - model.exact(run.t)).max() <= 10 * RTOL
    assert [release, last] == pytest.approx(
        [0.5 / 50 - np.arcsin(5.1 / 12) / 100 / np.pi, 0.02 - np.arcsin(0.7 / 12) / 100 / np.pi]
    )
    assert release == pytest.approx(8.60e-3, abs=5e-6)
    assert run.at([0.5 * (top + release), 0.5 * (bottom + last)]).x[:, 0] == pytest.approx([5.1, -0.7], abs=1e-14)
    lag = np.arctan(100 * np.pi * 2e-3)  # cut off afterwards
    assert (lag + np.pi - np.arcsin(5.1 / 12 / np.cos(lag))) / 100 / np.pi == pytest.approx(10.1e-3, abs=5e-5)


def test_the_doubler_hands_each_charge_on(by_pieces):
    """Beside currents cut off at 0, which is the law where Rs > 0 and never both diodes conduct."""
    _, run = by_pieces("voltage_doubler", t_end=5e-3)
    source = lambda t: 10 * np.sin(2000 * np.pi * t)  # noqa: E731

    def slope(t, v):
        clamp, peak = max(v[0] - source(t), 0), max(source(t) - v[0] - v[1], 0)
        return [(peak - clamp) / 1e-5, (peak - v[1] / 1e4) / 1e-5]

    right = solve_ivp(slope, (0, 5e-3), [0, 0], method="LSODA", rtol=1e-9, atol=1e-9, max_step=2e-5, dense_output=True)
    t = np.linspace(0, 5e-3, 400)
    assert np.abs(run.at(t).x - right.sol(t).T).max() <= 2e-6
    assert (run.index_set[1:] != 0).any(axis=1).all()  # 0: the diode conducts


def test_the_doubler_settles_below_twice_the_voltage(run_case):
    run = run_case("voltage_doubler")
    assert run.t[-501:][[0, -1]] == pytest.approx([14e-3, 15e-3])
    mean = np.trapezoid(run.v2[-501:], run.t[-501:]) / 1e-3
    current, charges = mean / 1e4, run.multipliers[-500:].sum(axis=0) * 2e-6
    assert charges == pytest.approx(current * 1e-3, rel=1e-2)  # what flows in a period: all capacitors give back what they take
    formula = 20 - 1.5 * current / (1e3 * 1e-5)
    assert formula == pytest.approx(19.70, abs=6e-3)
    assert 0 < formula - mean < 0.03
    assert abs(20 - mean) > 0.3


def orbit(Vm=325.0, w=100 * np.pi, Ls=3e-3, Ld=0.1, R=10.0):
    """(I, begin, end) of the periodic three-phase rectifier: the load's current at tau, and where two diodes conduct.

    tau = 0 where the voltages e_0 and e_1 of the phases are equal, e_0 on the way down.
    """
    third = 2 * np.pi / 3 / w

    def linear(L, r, angle):
        """(tau, begin, I) -> the solution of L I' = Vm cos(w tau + angle) - r I that is I at the begin."""
        swing = Vm * np.exp(1j * angle) / (r + 1j * w * L)
        wave = lambda tau: (swing * np.exp(1j * w * tau)).real  # noqa: E731
        return lambda tau, begin, I: wave(tau) + (I - wave(begin)) * np.exp(-r * (tau - begin) / L)

    both, alone = linear(Ls + 2 * Ld, 2 * R, 0), linear(Ls + Ld, R, -np.pi / 3)

    def begins(I):
        """The second diode stops blocking: e_1 is e_0 less what the first coil takes."""
        rate = lambda tau: (Vm * np.cos(w * tau + np.pi / 3) - R * I) / (Ls + Ld)  # noqa: E731
        return brentq(lambda tau: np.sqrt(3) * Vm * np.sin(w * tau) + Ls * rate(tau), -third / 4, third / 4, xtol=1e-18)

    def ends(begin, I):
        """The first current is 0: i_1 - i_0 is all of it."""
        rise = lambda tau: np.sqrt(3) * Vm / (w * Ls) * (np.cos(w * begin) - np.cos(w * tau)) - I  # noqa: E731
        return brentq(lambda tau: rise(tau) - both(tau, begin, I), begin, third / 2, xtol=1e-18)

    def again(I):
        begin = begins(I)
        end = ends(begin, I)
        return alone(begin + third, end, both(end, begin, I)) - I

    I = brentq(again, 1, 100, xtol=1e-13)
    begin = begins(I)
    end = ends(begin, I)
    return lambda tau: both(tau, begin, I) if tau < end else alone(tau, end, both(end, begin, I)), begin, end


def test_the_three_phase_rectifier_changes_over_slowly(by_pieces, run_case):
    current, begin, end = orbit()
    crossing = (1 / 6 + np.arange(3) / 3) / 50
    _, run = by_pieces("three_pulse_rectifier", x0=[current(1 / 300), 0, 0], t_end=0.02)
    assert times(run) == pytest.approx(np.sort([*(crossing + begin), *(crossing + end)]), abs=1e-9)
    tau = np.linspace(begin, begin + 0.0066, 50)
    assert run.at(crossing[0] + tau).x.sum(axis=1) == pytest.approx([current(s) for s in tau], rel=10 * RTOL)
    mean = 150 * sum(quad(current, *part, epsabs=1e-10)[0] for part in ((begin, end), (end, begin + 1 / 150)))
    assert run.mean("u_d") == pytest.approx(10 * mean, rel=1e-6)
    assert 360 * 50 * (end - begin) == pytest.approx(23, abs=0.5)
    without = 3 * np.sqrt(3) / (2 * np.pi) * 325
    assert (without, 10 * mean) == pytest.approx((268.8, 257.1), abs=0.05)
    assert without - 150 * 3e-3 * mean == pytest.approx(10 * mean, abs=0.15)  # the textbook, without ripple
    from_rest = run_case("three_pulse_rectifier")
    assert np.trapezoid(from_rest.u_d[-401:], from_rest.t[-401:]) / 0.02 == pytest.approx(10 * mean, rel=1e-3)


# -- genes -------------------------------------------------------------------------------------------------------------

PHI = (1 + np.sqrt(5)) / 2


def ring(x, t_end):
    """The times at which genes of the ring cross 1, by logarithms."""
    t, found, x = 0.0, [], np.array(x, float)
    on = x > 1
    while True:
        rest = np.where(np.roll(on, 1), 0.0, 2.0)
        with np.errstate(invalid="ignore"):
            wait = np.log((rest - x) / (rest - 1))  # to come from x to 1 on the way to the rest
        wait = np.where((rest > 1) != on, wait, np.inf)
        k = int(wait.argmin())
        t += wait[k]
        if t > t_end:
            return np.array(found)
        x = rest + (x - rest) * np.exp(-wait[k])
        x[k], on[k] = 1.0, not on[k]
        found.append(t)


def test_the_repressilator_turns_in_six_logarithms_of_the_golden_ratio(by_pieces):
    _, run = by_pieces("repressilator")
    assert times(run) == pytest.approx(ring([0.2, 0.3, 0.1], 12), abs=1e-7)
    period = times(run)[6:] - times(run)[:-6]
    assert (np.diff(period) > 0).all()
    assert period[-1] == pytest.approx(6 * np.log(PHI), abs=3e-4)
    assert period[0] < 1.2  # the first turn is far from it
    late = run.x[run.t > 9]
    assert [late.min(), late.max()] == pytest.approx([1 - 1 / PHI, 1 + 1 / PHI], abs=1e-3)


@pytest.mark.parametrize(("n", "rests"), [(3, True), (6, False)])
def test_a_ring_of_soft_switches_may_come_to_rest(n, rests):
    """What the docstring calls a wrong answer."""
    run = solve_ivp(
        lambda t, x: 2 / (1 + np.roll(x, 1) ** n) - x, (0, 200), [0.2, 0.3, 0.1], rtol=1e-8, t_eval=np.linspace(190, 200, 50)
    )
    assert (np.abs(run.y - 1).max() < 1e-4) == rests


def test_the_toggle_switch_remembers_the_longer_pulse(by_pieces):
    _, run = by_pieces("toggle_switch")
    back = 2.05 + np.log(2 * (1 - np.exp(-1.05)))  # b is at the threshold again
    assert times(run)[:4] == pytest.approx([1, 1 + np.log(2), 2.05, back], abs=1e-8)
    assert 2 * np.exp(-(back - 1 - np.log(2))) > 1  # a is not yet
    a, b = run.at([5.99, 12.0]).x.T
    assert (a > 1).tolist() == [True, False]
    assert (b > 1).tolist() == [False, True]


@pytest.mark.parametrize("part", [1 - 1e-6, 1 + 1e-6])
def test_the_shortest_pulse_that_flips_the_toggle_switch(load_case, part):
    model = load_case("toggle_switch")
    pulse = table([0, 1, 1 + part * np.log(3)], [0, 1, 0])
    run = simulate(model, inputs={"u": pulse}, t_end=20, rtol=1e-9, method="event-driven", compiled=False)
    assert (run.a[-1] < run.b[-1]) == (part > 1)


@pytest.mark.parametrize(
    ("step", "at_six", "flips"), [(5e-3, (1.977, 0.023), True), (0.2, (0.022, 1.99), True), (0.05, (1, 1), True)]
)
def test_coarse_steps_flip_the_toggle_switch_wrongly(load_case, step, at_six, flips):
    run = simulate(load_case("toggle_switch"), step=step, compiled=False)
    assert run.x[np.searchsorted(run.t, 5.99)] == pytest.approx(at_six, abs=0.02)
    assert (run.a[-1] < 1) == flips
