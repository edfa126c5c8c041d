"""certify="interval": bounds above 50 digits and near them, mutated pieces found, errors of closed forms below their bounds."""

import operator

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from fuzz_models import share, some

import nsmodel
from nsmodel import FirstOrderSystem, LureSystem, SweepingProcess, Trajectory, UsageError, complementarity, relay, simulate
from nsmodel.cli import main
from nsmodel.event_driven.interval_proof import AllowedErrors, StoredPieces, certify_pieces, jump_bounds, prove_piece_bounds
from nsmodel.modeling.model_files import case_files
from nsmodel.proof.expression_graph import fold_graph
from nsmodel.simulation.error_bounds import NoErrorBound, global_error
from nsmodel.simulation.event_driven import event_driven_problem
from tests import event_scenes as scenes

OPERATIONS = {
    ca.OP_ASSIGN: lambda a: a, ca.OP_ADD: operator.add, ca.OP_SUB: operator.sub, ca.OP_MUL: operator.mul,
    ca.OP_DIV: operator.truediv, ca.OP_LOG1P: mp.log1p,
    ca.OP_NEG: operator.neg, ca.OP_SQ: lambda a: a * a, ca.OP_TWICE: lambda a: 2 * a, ca.OP_INV: lambda a: 1 / a,
    ca.OP_SQRT: mp.sqrt, ca.OP_EXP: mp.exp, ca.OP_LOG: mp.log, ca.OP_SIN: mp.sin, ca.OP_COS: mp.cos, ca.OP_TAN: mp.tan,
    ca.OP_ATAN: mp.atan, ca.OP_TANH: mp.tanh, ca.OP_SINH: mp.sinh, ca.OP_COSH: mp.cosh, ca.OP_ERF: mp.erf, ca.OP_ASINH: mp.asinh,
    ca.OP_FABS: abs, ca.OP_FMAX: max, ca.OP_FMIN: min, ca.OP_POW: operator.pow, ca.OP_CONSTPOW: operator.pow,
    ca.OP_EXPM1: mp.expm1, ca.OP_ASIN: mp.asin, ca.OP_ACOS: mp.acos,
}  # fmt: skip


def stored(run):
    arrays, start = run.arrays, run.arrays["piece_start"]
    end = np.append(start[1:], run.t[-1])
    x, l, y = (arrays[f"piece_{name}"] for name in ("x", "multipliers", "y"))
    return StoredPieces(start, end, arrays["piece_unit"], x, l, y, arrays["piece_codes"].astype(int))


def sampled(problem, pieces, shares):
    """The largest |x' - f - g| and |y - h| at shares of each piece, in 50 digits."""
    defect, rows = np.zeros(pieces.x.shape[:2]), np.zeros(pieces.y.shape[:2])
    symbols = [s.element_hash() for s in ca.vertsplit(ca.vertcat(problem.t, problem.x, problem.l))]
    with mp.workdps(50):
        for k in range(len(pieces.start)):
            start, end, unit = (mp.mpf(float(array[k])) for array in (pieces.start, pieces.end, pieces.unit))
            x, l, y = ([[mp.mpf(float(v)) for v in c[::-1]] for c in array[k]] for array in (pieces.x, pieces.l, pieces.y))
            for share in shares:
                s = (end - start) / unit * mp.mpf(share)
                at = [start + unit * s, *(mp.polyval(c, s) for c in x), *(mp.polyval(c, s) for c in l)]
                where = dict(zip(symbols, at, strict=True))
                out = ca.vertcat(problem.f + problem.g, problem.h)
                values = fold_graph(out, lambda e, w=where: w[e.element_hash()], mp.mpf, lambda op, args: OPERATIONS[op](*args))
                for i, c in enumerate(x):
                    rate = mp.polyval([a * (len(c) - 1 - j) for j, a in enumerate(c[:-1])], s) / unit
                    defect[k, i] = max(defect[k, i], float(abs(rate - values[i])))
                for i, c in enumerate(y):
                    rows[k, i] = max(rows[k, i], float(abs(mp.polyval(c, s) - values[len(x) + i])))
    return defect, rows


def random_model(seed):
    """Three states, two relays, smooth and kinked terms."""
    random = np.random.default_rng(seed)
    t, x, l = ca.SX.sym("t"), ca.SX.sym("x", 3), ca.SX.sym("l", 2)
    u = lambda: ca.dot(random.normal(size=3), x) + random.normal() * ca.sin(t)  # noqa: E731
    one = [
        ca.sin, ca.cos, ca.tanh, ca.atan, ca.erf, ca.asinh, ca.fabs, lambda a: ca.exp(-(a**2)), lambda a: a / (1 + a**2),
        lambda a: ca.sqrt(1 + a**2), lambda a: ca.fmax(a, 0.3), lambda a: ca.log(2 + a**2), lambda a: (1.5 + ca.sin(a)) ** 1.3,
        lambda a: ca.asin(0.9 * ca.sin(a)), lambda a: ca.sinh(ca.tanh(a)), lambda a: ca.sin(a) * ca.cos(2 * a),
    ]  # fmt: skip
    pick = lambda: one[random.integers(len(one))](u())  # noqa: E731
    f = ca.vertcat(*(pick() + pick() * pick() - x[i] for i in range(3)))
    C = random.normal(size=(2, 3))
    return FirstOrderSystem(
        t=t, x=x, lam=l, f=f, g=ca.DM(C.T) @ l, h=ca.DM(C) @ x, law=relay(2), x0=random.normal(size=3), t_end=2.0
    )


@pytest.mark.parametrize("seed", range(share(12, 2)))
@pytest.mark.parametrize("rtol", [1e-4, 1e-9])
@pytest.mark.long
def test_bounds_are_above_50_digits_and_near(seed, rtol):
    model = random_model(seed)
    run = simulate(model, rtol=rtol, method="event-driven")
    problem, pieces = event_driven_problem(model.bind(None)), stored(run)
    found = prove_piece_bounds(problem, pieces)
    assert np.isfinite(found.defect).all()
    defect, rows = sampled(problem, pieces, np.linspace(0, 1, 9))
    assert (defect <= found.defect).all()
    assert (rows <= found.rows).all()
    rounding = 1e-12 * np.abs(pieces.x).max()
    assert (found.defect <= 3 * defect.max(axis=0) + rounding).all()


@pytest.mark.parametrize("name", ["friction_oscillator", "sliding_relay", "diode_bridge", "point_past_disc"])
@pytest.mark.parametrize("rtol", [1e-3, 1e-8])
def test_scenes_are_proved(name, rtol, tmp_path):
    run = simulate(nsmodel.load(name), rtol=rtol, certify="interval")
    about = run.summary()["certificate"]
    assert about["proved"] == about["pieces"] == len(run.piece_start) == len(run.piece_defect)
    assert "proved by intervals" in run.summary_text()
    assert (run.defect_bound[1:] >= 0).all()
    run.save(tmp_path / "run.npz")
    again = Trajectory.load(tmp_path / "run.npz")
    assert again.summary()["certificate"] == about
    assert (again.piece_depth == run.piece_depth).all()


def scene():
    model = nsmodel.load("friction_oscillator").bind(None)
    run = simulate(model, rtol=1e-10, method="event-driven")
    x0 = run.arrays["piece_x"][0, :, 0]
    allowed = AllowedErrors.of(1e-10, np.zeros(2), np.abs(run.x).max() * np.ones(2), np.abs(run.v).max() * np.ones(1))
    return event_driven_problem(model), stored(run), x0, allowed


def mutations(pieces, random):
    """(what, mutated) of one piece each."""

    def changed(name, index, value):
        array = getattr(pieces, name).copy()
        array[index] = value
        return pieces._replace(**{name: array})

    k = int(random.integers(1, len(pieces.start) - 2))
    for i in range(2):
        for order in range(4):
            yield f"x_{i} of order {order}", changed("x", (k, i, order), pieces.x[k, i, order] + 1e-6)
    yield "l", changed("l", (k, 0, 0), pieces.l[k, 0, 0] * (1 + 1e-6) + 1e-6)
    yield "y", changed("y", (k, 0, 1), pieces.y[k, 0, 1] + 1e-6)
    for code in {-1, 0, 1} - {pieces.codes[k, 0]}:
        yield f"code {code}", changed("codes", (k, 0), code)
    events = np.flatnonzero((np.diff(pieces.codes, axis=0) != 0).any(axis=1)) + 1
    e = int(random.choice(events))
    for by in (1e-6, -1e-6, 0.05):
        start, end = pieces.start.copy(), pieces.end.copy()
        start[e] += by
        end[e - 1] += by
        yield f"switch moved by {by}", pieces._replace(start=start, end=end)
    end = pieces.end.copy()
    end[e - 1] += 0.05
    yield "a piece past its event", pieces._replace(end=end)


@pytest.mark.parametrize("seed", range(share(5, 2)))
def test_mutated_pieces_are_found(seed):
    problem, pieces, x0, allowed = scene()
    assert not certify_pieces(problem, pieces, x0, allowed).failures
    for what, mutated in mutations(pieces, np.random.default_rng(seed)):
        assert certify_pieces(problem, mutated, x0, allowed).failures, what


def test_in_a_folder_and_on_the_command_line(tmp_path, capsys):
    file = str(case_files()["friction_oscillator"])
    run = simulate(nsmodel.load(file), rtol=1e-6, certify="interval", out=tmp_path / "one", save_every=2)
    again = Trajectory.load(tmp_path / "one" / "trajectory.npz")
    assert (again.error_bound == run.error_bound).all()
    assert len(run.error_bound) == len(run.t) == len(run.defect_bound) < len(run.piece_proved) + 1
    assert main(["run", file, "--rtol", "1e-6", "--certify", "interval", "--explain"]) == 0
    out = capsys.readouterr().out
    assert "proved by interval arithmetic" in out
    assert "of the solution until" in out


def test_failures_are_told_and_the_run_is_one():
    run = simulate(scenes.capacitor_filter(), rtol=1e-8, certify="interval")
    about = run.metadata["certificate"]
    assert run.status == "done"
    assert about["proved"] == about["pieces"] - 1
    assert "piece 0: 'x_0' jumps" in about["failures"][0]
    assert "not proved" in run.summary_text()


def test_signs_past_an_event_are_bounded_by_their_depth():
    """x' = 1, y = x - 1 held to be < 0 until t = 1 + d: the depth is d, whatever d is."""
    x, l = ca.SX.sym("x"), ca.SX.sym("l")
    model = FirstOrderSystem(x=x, lam=l, f=[1], g=[0 * l], h=[x - 1], law=relay(1), x0=[0], t_end=2)
    problem = event_driven_problem(model.bind(None))
    for d in (1e-3, 1e-9, 1e-14):
        c = np.zeros((1, 1, 9))
        x, l, y = c.copy(), c.copy(), c.copy()
        x[0, 0, 1], l[0, 0, 0], y[0, 0, :2] = 1, 1, (-1, 1)
        pieces = StoredPieces(np.zeros(1), np.array([1 + d]), np.ones(1), x, l, y, np.array([[1]]))
        found = prove_piece_bounds(problem, pieces)
        assert d * (1 - 1e-2) <= found.depth[0, 0] <= d * (1 + 1e-6) + 1e-15
        assert found.reach[0, 0] >= d * (1 - 1e-2)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rtol": 1e-4, "certify": "intervals"}, "certify = 'intervals'"),
        ({"rtol": 1e-4, "certify": True}, "expected one of estimate, interval"),
        ({"certify": "interval"}, "give rtol"),
        ({"rtol": 1e-4, "certify": "interval", "method": "time-stepping"}, "leave method out"),
        ({"rtol": 1e-4, "certify": "interval", "resume": True, "out": "."}, "leave one of them out"),
    ],
)
def test_refused_by_name(options, words):
    with pytest.raises(UsageError, match=words):
        simulate(nsmodel.load("friction_oscillator"), **options)


def test_what_is_not_event_driven_is_refused():
    with pytest.raises(UsageError, match="not event-driven"):
        simulate(nsmodel.load("evacuation"), rtol=1e-4, certify="interval", compiled=True)


# -- the global error


def forms():
    """(name, model, exact) of closed forms that the bound takes; the exact states of an oscillator are positions."""
    yield from ((f"release {s}", *scenes.release(s)[:2]) for s in (0.77, 1.3))
    yield ("play", *scenes.play()[:2])
    yield ("diode", *scenes.diode()[:2])
    for name in ("friction_oscillator", "sliding_relay"):
        model = nsmodel.load(name)
        yield name, model, model.exact


@pytest.mark.parametrize("rtol", some([1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10], 3))
def test_error_of_closed_forms_is_below_its_bound(rtol):
    for name, model, exact in forms():
        run = simulate(model, rtol=rtol, certify="interval")
        at = np.linspace(0, run.t[-1], 1001)
        number = np.clip(np.searchsorted(run.piece_start, at, side="right") - 1, 0, None)
        for x, bound in ((run.x - exact(run.t), run.error_bound), (run.at(at).x - exact(at), run.piece_error[number])):
            rounding = 1e-15 * np.abs(run.x).max()  # Of the closed form.
            assert (np.abs(x) <= bound[:, : x.shape[1]] + rounding).all(), name
        assert run.error_bound.max() <= 10 * rtol * np.abs(run.x).max(), name
        assert "of the solution until" in run.summary_text()


def random_monotone(seed):
    """A Lur'e system with P B = C' and D diagonal, or a moving set, with numbers of few digits."""
    random = np.random.default_rng(seed)
    t, n = ca.SX.sym("t"), int(random.integers(1, 5))
    m, wave = int(random.integers(1, min(n, 3) + 1)), lambda: random.normal() * ca.sin(random.uniform(1, 4) * t)
    if seed % 3 == 0:
        q, N = ca.SX.sym("q", n), np.round(random.normal(size=(m, n)) * 4) / 4
        constraints = {f"c{i}": ca.dot(ca.DM(N[i]), q) + 0.5 + wave() for i in range(m)}
        f = [random.normal() - 0.2 * q[i] + ca.sin(q[(i + 1) % n]) for i in range(n)]
        return SweepingProcess(t=t, q=q, f=f, constraints=constraints, q0=np.zeros(n), t_end=3)
    P, B = np.diag(2.0 ** random.integers(-3, 4, n)), np.round(random.normal(size=(n, m)) * 8) / 8
    C, D, A = B.T @ P, np.diag(random.choice([0, 0.5, 1.0], m)), random.normal(size=(n, n)) - 0.3 * np.eye(n)
    law = complementarity(m) if random.random() < 0.6 else relay(m)
    x0 = np.linalg.lstsq(C, np.abs(random.normal(size=m)), rcond=None)[0]
    return LureSystem(t=t, A=A, B=B, C=C, D=D, f=[wave() for _ in range(n)], law=law, x0=x0, t_end=3)


@pytest.mark.long
@pytest.mark.parametrize("model", [*map(random_model, range(share(6))), *map(random_monotone, range(share(15, 5)))])
def test_errors_of_random_models_are_below_their_bounds(model):
    """Against a run at 1e-13 whose own bound is added; no bound where the error has left the tube."""
    fine, at = simulate(model, rtol=1e-13, certify="interval", method="event-driven"), np.linspace(0, model.t_end, 300)

    def bound(run):
        return run.piece_error[np.clip(np.searchsorted(run.piece_start, at, side="right") - 1, 0, None)]

    for rtol in (1e-3, 1e-6, 1e-9):
        run = simulate(model, rtol=rtol, certify="interval", method="event-driven")
        assert run.metadata["certificate"]["failures"] == []
        assert np.isfinite(run.piece_error).all(axis=1).sum() > 1
        error = np.abs(run.at(at).x - fine.at(at).x)
        assert (error <= bound(run) + bound(fine) + 1e-14 * (1 + np.abs(run.x).max())).all()


def test_mutated_runs_have_bounds_above_their_errors():
    """A run that is wrong all along has a bound that is as large."""
    model = nsmodel.load("friction_oscillator").bind(None)
    run = simulate(model, rtol=1e-8, method="event-driven")
    problem, pieces = event_driven_problem(model), stored(run)
    x0 = pieces.x[0, :, 0].copy()
    for k, order, by in ((1, 0, 1e-3), (2, 1, 1e-4), (0, 3, 1e-2)):
        x = pieces.x.copy()
        x[k, :, order] += by
        mutated = pieces._replace(x=x)
        try:
            bound = global_error(problem, mutated, prove_piece_bounds(problem, mutated), jump_bounds(mutated, x0))
        except NoErrorBound:
            continue
        at = np.linspace(mutated.start[k], mutated.end[k], 50)
        s = (at - mutated.start[k]) / mutated.unit[k]
        error = np.abs(np.polynomial.polynomial.polyval(s, x[k, 0]) - model.exact(at)[:, 0])
        assert error.max() >= by / 10
        assert error.max() <= bound.states[k, 0]


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (nsmodel.load("diode_bridge"), "h_x g_l is singular on the rows"),
        (scenes.mains_bridge(), "h_l is not diagonal"),
        (nsmodel.load("point_past_disc"), "g_l is not constant"),
        (nsmodel.load("relay_oscillator"), "no P = P' > 0 with P g_l = h_x'"),
        (scenes.capacitor_filter(), "an impulse"),
    ],
)  # fmt: skip
def test_no_bound_is_named(model, words):
    run = simulate(model, rtol=1e-6, certify="interval")
    assert words in run.metadata["certificate"]["no_error_bound"]
    assert "error_bound" not in run.arrays
    assert "no bound of the global error" in run.summary_text()
