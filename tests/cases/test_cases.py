"""Every case file runs and is verified; its numbers against reference trajectories, the scene's geometry and theorems."""

from __future__ import annotations

import ast
from fractions import Fraction
from itertools import product as all_pairs

import casadi as ca
import closed_forms as exact
import numpy as np
import pytest

import nsmodel
from nsmodel import FrictionOscillator, ManyBodies, SweepingProcess, simulate
from nsmodel.modeling.base import Model
from nsmodel.modeling.parts import MODEL_CLASSES

LONGEST = 12_000  # Steps that the test of every case file takes at most.

# ---------------------------------------------------------------------------------------------- all case files


def test_every_class_has_a_scheme_and_a_case(cases_of):
    public = {kind for kind in vars(nsmodel).values() if isinstance(kind, type) and issubclass(kind, Model)}
    assert public == {getattr(nsmodel, name) for name in MODEL_CLASSES}
    assert [name for name in MODEL_CLASSES if not cases_of(getattr(nsmodel, name))] == []


def test_case_file_is_described_runs_and_is_verified(case_file, load_case, run_case):
    description = ast.get_docstring(ast.parse(case_file.read_text()))
    assert description
    assert "What to see:" in description
    model = load_case(case_file.stem)
    assert model.title
    if model.t_end / model.step <= LONGEST:
        run = run_case(case_file.stem)
    else:
        run = simulate(model, t_end=LONGEST * model.step)
    assert run.status == "done"
    assert run.title == model.title
    first = 2 if getattr(model, "x1", None) is not None else 1  # rows before it are the start
    assert run.residual[first:].max() <= 1e-9
    if isinstance(model, ManyBodies):  # who is not there is NaN
        assert (np.isfinite(run.x).sum(axis=1) > 0).any()
        return
    assert np.isfinite(run.x).all()
    for name, array in run.arrays.items():
        assert np.isfinite(array[first:]).all(), name


EXACT = {
    "bang_bang": exact.bang_bang,
    "belt": exact.belt,
    "elastoplastic": lambda t: exact.stop_operators(t, [0, 1, 0.2, 1, 2.5, -2.5, 2.5], [4, 2, 2, 1], [1, 1, 2, 2]),
    "friction_fit": lambda t: exact.friction_free(t, 5.3)[:, :1],
    "friction_oscillator": lambda t: exact.friction_free(t, 5.3)[:, :1],
    "half_wave_rectifier": exact.rectified,
    "inclusion_8_1": exact.inclusion_8_1,
    "inclusion_8_2": lambda t: exact.inclusion_8_2_diagonal(t, [1, 2, 4], [3, 0.5, -4], [1, 1, 1], -2, 1.5, [-1, 1.5, 1]),
    "leash": lambda t: exact.leash(t, [(0, 0), (1.5, 0), (-2, 0), (1, 0)], (-0.3, 0.8)),
    "moving_disc": exact.moving_disc,
    "moving_half_line": exact.half_line,
    "point_past_disc": exact.point_past_disc,
    "sandpile": exact.sandpile,
    "schmitt_trigger": lambda t: exact.to_and_fro(t, 0, -2.5, 2.5, -5, 5, 1e-2),
    "sliding_relay": exact.sliding_relay,
    "thermostat": lambda t: exact.to_and_fro(t, 15, 19, 21, 5, 35, 2),
    "thyristor": lambda t: exact.rectified(t, np.pi / 3),
    "tumbler": exact.tumbler,
    "twisting": exact.twisting,
    "two_discs": exact.two_discs,
    "two_surfaces": exact.two_surfaces,
    "zener_limiter": exact.zener_limited,
    "zhuravlev_ivanov": exact.zhuravlev_ivanov,
}


def test_exact_solutions_of_the_case_files_are_the_closed_forms(cases_of):
    models = {
        stem: model
        for name in MODEL_CLASSES
        for stem, model in cases_of(getattr(nsmodel, name)).items()
        if model.exact is not None
    }
    assert set(models) == set(EXACT)
    for stem, model in models.items():
        t = np.linspace(0, model.t_end, 997)
        assert model.exact(t) == pytest.approx(EXACT[stem](t), abs=1e-12), stem


# ---------------------------------------------------------------------------------------------- Siconos

# case file: reference, number of states, and the columns after them as a run gives them (unique multipliers, outputs)
SICONOS = {
    "diode_bridge": ("DiodeBridge", 2, lambda y, l: [y[0], -l[0], -l[1], l[2], y[0] + l[2]]),
    "rlc_diode": ("CircuitRLCD", 2, lambda y, l: [-y[0], l[0]]),
    "relay_oscillator": ("RelayOscillator", 3, lambda y, l: [l[0], y[0]]),
    "gene_network": ("StepSystem", 2, lambda y, l: [*l]),
    "friction_oscillator_relay": ("FrictionOscillator", 2, lambda y, l: [l[0], y[0]]),
}


@pytest.mark.parametrize("stem", SICONOS)
def test_run_agrees_with_siconos(stem, run_case, reference):
    name, n, others = SICONOS[stem]
    table, run = reference(name), run_case(stem)
    N = len(table)  # the reference has the rows 0 .. N-1
    assert len(run) == N
    assert run.t[:N] == pytest.approx(table[:, 0], abs=1e-12 * run.t[-1])
    states = table[:, 1 : n + 1]
    assert (np.abs(run.x[:N] - states).max(axis=0) <= 1e-8 * np.abs(states).max(axis=0)).all()
    columns = np.column_stack(others(run.y.T, run.multipliers.T))[1:N]  # the reference has no multiplier at the start
    laws = table[1:, n + 1 : n + 1 + columns.shape[1]]
    assert (np.abs(columns - laws).max(axis=0) <= 1e-8 * np.abs(laws).max(axis=0)).all()


@pytest.mark.parametrize(
    ("h", "final"),
    [
        (1e-2, (3.39548888077, 0, 3.40513760694, 0)),
        (1e-3, (3.44152917015, 0, 3.45116927886, 0)),
        (1e-4, (3.44459908528, 0, 3.45426508887, 0)),
    ],
)
def test_two_masses_end_where_siconos_ends(h, final, load_case):
    run = simulate(load_case("two_masses"), step=h, save_every=100)
    assert run.x[-1] == pytest.approx(final, abs=1e-8)
    assert run.v1[-1] == run.v2[-1] == 0.0  # both stick


@pytest.mark.parametrize(
    ("n", "final"),
    [
        (10, (0.228447684898, 0.6081791976, 0, -0.340449305742)),
        (50, (0.273264334566, 0.390996311905, -0.397678254199, -0.159286879513)),
    ],
)
def test_friction_chain_ends_where_siconos_ends(n, final, load_case):
    run = simulate(load_case("friction_chain", n=n), t_end=10, save_every=100)
    middle = n // 2 + 1
    ends = [run.x_1[-1], getattr(run, f"x_{middle}")[-1], run.v_1[-1], getattr(run, f"v_{middle}")[-1]]
    assert ends == pytest.approx(final, abs=1e-8)


# ---------------------------------------------------------------------------------------------- sweeping processes


def _segment_distances(places, start, end):
    along = np.subtract(end, start)
    part = np.clip((places - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(places - start - part[..., None] * along, axis=-1)


def _crowd(run):
    """Gaps of all pairs and walls (N+1, ...) from the scene's geometry."""
    places = run.x.reshape(len(run.t), -1, 2)
    radii, walls = np.array(run.metadata["scene"]["radii"]), np.array(run.metadata["scene"]["walls"])
    i, j = np.triu_indices(radii.size, 1)
    pairs = np.linalg.norm(places[:, i] - places[:, j], axis=-1) - radii[i] - radii[j]
    return np.hstack([pairs, *(_segment_distances(places, *wall) - radii for wall in walls)])


def _drum(t):
    return [t + (2 * k + 1) * np.pi / 4 for k in range(4)]


GAPS = {
    "crowd_room": _crowd,
    "moving_disc": lambda run: np.linalg.norm(run.x - np.column_stack([run.t, 0 * run.t]), axis=1) - 1,
    "moving_half_line": lambda run: run.x[:, 0] - np.sin(run.t),
    "point_past_disc": lambda run: np.linalg.norm(run.x, axis=1) - 1,
    "sandpile": lambda run: np.hstack([1 - np.diff(run.x), 1 + np.diff(run.x)]),
    "tumbler": lambda run: 1 - np.column_stack([np.cos(b) * run.x[:, 0] + np.sin(b) * run.x[:, 1] for b in _drum(run.t)]),
    "two_discs": lambda run: np.linalg.norm(run.x[:, 2:] - run.x[:, :2], axis=1) - 0.6,
}


def test_no_overlap_in_any_sweeping_case(cases_of, run_case):
    stems = cases_of(SweepingProcess)
    assert set(stems) == set(GAPS)
    for stem in stems:
        run = run_case(stem)
        gaps = GAPS[stem](run)
        assert gaps.min() >= -1e-10, stem
        assert gaps.min() <= 1e-2, f"{stem}: nothing ever touches"
        assert np.sort(run.gap.ravel()) == pytest.approx(np.sort(gaps.ravel()), abs=1e-12), stem


def test_crowd_moves_with_the_closest_admissible_velocity(run_case):
    """u = (q_{k+1} - q_k)/h is the projection of the desired velocity: u - f = sum of reactions along the gaps' gradients."""
    run = run_case("crowd_room")
    radii, walls = np.array(run.metadata["scene"]["radii"]), np.array(run.metadata["scene"]["walls"])
    L, h = walls[0][1][1], run.step[1]
    low, high = L / 2 - 0.35, L / 2 + 0.35  # door of 1.2 m, kept 0.25 m away from its posts
    i, j = np.triu_indices(radii.size, 1)
    for k in (1, 20, 35):
        places = run.x[k - 1].reshape(-1, 2)
        target = np.column_stack([np.full(radii.size, L + 0.3), np.clip(places[:, 1], low, high)]) - places
        f = np.where(places[:, :1] < L, target / np.linalg.norm(target, axis=1, keepdims=True), [1, 0])
        force, reactions = np.zeros_like(f), run.reactions[k]
        e = places[j] - places[i]
        e *= reactions[: i.size, None] / np.linalg.norm(e, axis=1, keepdims=True)
        np.add.at(force, j, e)
        np.add.at(force, i, -e)
        for person, pushes in enumerate(reactions[i.size :].reshape(-1, len(walls))):
            for wall, push in zip(walls, pushes, strict=True):
                along = wall[1] - wall[0]
                part = np.clip((places[person] - wall[0]) @ along / (along @ along), 0, 1)
                away = places[person] - wall[0] - part * along
                force[person] += push * away / np.linalg.norm(away)
        u = (run.x[k] - run.x[k - 1]).reshape(-1, 2) / h
        assert u == pytest.approx(f + force, abs=1e-10)
        assert reactions.min() >= 0
    assert run.reactions[35].max() > 0.1  # people do push


def test_stagnation_point_keeps_its_symmetry(load_case):
    """A point carried head-on to the disc stays in front of it: (-1, 0) is an unstable equilibrium."""
    q = ca.SX.sym("q", 2)
    disc = {"disc": ca.norm_2(q) - 1}
    run = simulate(SweepingProcess(q=q, f=[1, 0], constraints=disc, q0=[-1.5, 0], t_end=4.5, step=1e-2))
    assert (run.q[:, 1] == 0).all()
    assert run.q[:, 0] == pytest.approx(np.minimum(-1.5 + run.t, -1), abs=1e-12)


# ---------------------------------------------------------------------------------------------- oscillators at rest


def _example_4_1(x, w, a, b):
    """v = argmin (v - w)^2/2 + a|v| + b (x + v)^2/2: a soft threshold."""
    u = w - b * x
    return (u - a if u > a else u + a if u < -a else u * 0) / (1 + b)


def _example_4_2(x, w, a, b):
    """v = argmin (v - w)^2/2 + a|v| + b|x + v|: one of the two kinks or of the four slopes' stationary points."""
    candidates = [0 * x, -x, *(w + i * a + j * b for i, j in all_pairs((-1, 1), repeat=2))]
    return min(candidates, key=lambda v: (v - w) ** 2 / 2 + a * abs(v) + b * abs(x + v))


def _rational_recursion(argmin, x0, x1, a, b, rows):
    """(x_n, v_n) of the scheme with step 1 in exact arithmetic; v_0 is unknown."""
    x, v, a, b = [Fraction(x0), Fraction(x1)], [None, Fraction(x1) - Fraction(x0)], Fraction(a), Fraction(b)
    for _ in range(rows - 2):
        v.append(argmin(x[-1], v[-1], a, b))
        x.append(x[-1] + v[-1])
    return x, v


def _oscillator(potential, a, b, x1):
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    g = {"square": b * x**2 / 2, "abs": b * ca.fabs(x)}[potential]
    return FrictionOscillator(x=x, potential=g, friction=a * s, s=s, x0=2, x1=x1, step=1, t_end=60)


# what stops, the model, the closed step, its a, b and second start, and the interval of possible limits
STOPS = {
    "4.1": ("cabot_4_1", _example_4_1, 0.02, 0.1, 2, 0.2),
    "4.2": ("cabot_4_2", _example_4_2, 0.03, 0.1, 2, 0.0),
    "4.1, moving start": (("square", 0.1, 0.5, 3), _example_4_1, 0.1, 0.5, 3, 0.2),
    "4.2, moving start": (("abs", 0.03, 0.1, 3), _example_4_2, 0.03, 0.1, 3, 0.0),
    "4.2, strong friction": (("abs", 0.1, 0.03, 3), _example_4_2, 0.1, 0.03, 3, np.inf),
}


@pytest.mark.parametrize("name", STOPS)
def test_oscillator_stops_exactly_where_and_when_it_must(name, load_case):
    source, argmin, a, b, x1, half_width = STOPS[name]
    run = simulate(load_case(source) if isinstance(source, str) else _oscillator(*source))
    found, v = run.metadata["convergence"], run.v[:, 0]
    x_exact, v_exact = _rational_recursion(argmin, 2, x1, a, b, len(run.t))
    rest = 1 + max(n for n, value in enumerate(v_exact) if n and value != 0)
    assert run.x[:, 0] == pytest.approx(np.array(x_exact, float), abs=1e-12)
    assert found["finite"]
    assert found["n_0"] == rest
    assert found["t_0"] == run.t[rest]
    assert (v[rest:] == 0.0).all()
    assert v[rest - 1] != 0
    assert (run.x[rest:] == run.x[-1]).all()
    assert abs(run.x[-1, 0]) <= half_width
    distance = abs(b * run.x[-1, 0]) if argmin is _example_4_1 else b if run.x[-1, 0] else 0.0
    assert found["distance"] == pytest.approx(distance, abs=1e-15)
    assert found["theta_prime_0"] == a
    assert found["margin"] == pytest.approx(a - distance, abs=1e-15)


def test_oscillator_with_growing_steps_stops_in_the_dead_zone(load_case):
    run = simulate(load_case("cabot_4_1"), steps=1 + 0.05 * np.arange(60))
    n_0 = run.metadata["convergence"]["n_0"]
    assert (run.v[n_0:] == 0.0).all()
    assert run.v[n_0 - 1, 0] != 0
    assert abs(run.x[-1, 0]) <= 0.02 / 0.1


def test_counterexample_converges_but_never_in_finite_time(load_case, run_case):
    n = np.arange(201)
    closed = 1 + (1 + n) / 2.0**n
    assert run_case("cabot_4_3").x[:, 0] == pytest.approx(closed[:51], abs=1e-10)
    run = simulate(load_case("cabot_4_3"), t_end=200)
    assert run.x[:, 0] == pytest.approx(closed, abs=1e-10)
    assert (np.diff(run.x[1:51, 0]) < 0).all()
    found = run.metadata["convergence"]
    assert not found["finite"]
    assert found["n_0"] is None
    assert found["margin"] == pytest.approx(0, abs=1e-12)  # 0 is on the boundary of A(0) + dg(1) = [0, 2]


# ---------------------------------------------------------------------------------------------- Newton's method


def test_gene_network_needs_about_one_newton_iteration(run_case):
    run = run_case("gene_network")
    assert run.newton[1:].min() >= 1
    assert run.newton[1:].mean() <= 1.2
    # The sliding equilibrium, from 0 = -4.5 xa + 40 (1 - l3), 0 = -1.5 xb + 40 (1 - l4) at (8, 8).
    assert run.x[-1] == pytest.approx([8, 8], abs=1e-9)
    assert run.multipliers[-1] == pytest.approx([1, 1, 1 - 4.5 * 8 / 40, 1 - 1.5 * 8 / 40], abs=1e-9)


def test_bouncing_ball_needs_few_newton_iterations(run_case):
    run = run_case("zhuravlev_ivanov")
    moving = run.t[1:] <= exact.ball_rest()[2]
    assert run.newton[1:].min() >= 1
    assert run.newton[1:].mean() <= 2.5
    assert run.newton[1:][moving].mean() <= 2.5  # not only because it rests from t = 1.87 on
    assert run.x[-1] == pytest.approx([0, 0], abs=1e-9)
