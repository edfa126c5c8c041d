"""Large sparse scenes: against dense matrices, against splitting methods written here, in C, and where they must fail."""

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
from fuzz_models import COUNT, FULL

from nsmodel import FirstOrderSystem, LureSystem, box, check, codegen, complementarity, equality, explain, relay, simulate
from nsmodel.codegen.library import compiler
from nsmodel.errors import CodegenError, ModelError, StepError, UsageError
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.solvers import time_stepper
from nsmodel.solvers.newton import NewtonSolver
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.residuals import numeric_law
from nsmodel.solvers.sparse import SparseStepSolver, band_ordering
from nsmodel.solvers.structure import read_step_structure

pytestmark = pytest.mark.usefixtures("own_cache")
in_c = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def springs(n, stiffness=100.0):
    return stiffness * (2 * sp.eye(n) - sp.eye(n, k=1) - sp.eye(n, k=-1))


def chain(n, theta=0.5, gamma=1.0, force=3.0, unit=1.0, **options):
    """The chain of cases/mechanics/friction_chain.py; ``unit``: how many of the states' units a metre has."""
    t, i, zero, one = ca.SX.sym("t"), np.arange(1, n + 1), sp.csc_matrix((n, n)), sp.eye(n)
    return LureSystem(
        t=t, A=sp.bmat([[zero, one], [-springs(n), zero]]), B=sp.vstack([zero, unit * one]), C=sp.hstack([zero, one]),
        f=unit * ca.vertcat(np.zeros(n), force * ca.sin(2 * t + 0.3 * (i - 1))), law=relay(n),
        x0=unit * np.concatenate([np.sin(2 * np.pi * i / (n + 1)), np.zeros(n)]), theta=theta, gamma=gamma,
        **{"t_end": 1, "step": 0.01, **options},
    )  # fmt: skip


def string(n, law=None, **options):
    """x' = -K x - 1 + l, y = x - obstacle: a string that falls onto an obstacle of two humps."""
    i = np.arange(1, n + 1) / (n + 1)
    obstacle = 0.3 * np.sin(2 * np.pi * i) ** 2 - 0.4
    x, l = ca.SX.sym("x", n), ca.SX.sym("l", n)
    f = -ca.DM(springs(n, 1e3).tocsc()) @ x - 40
    return FirstOrderSystem(
        x=x, lam=l, f=f, h=x - obstacle, g=l, law=law or complementarity(n), x0=np.zeros(n), t_end=0.2, step=0.01, **options
    )


def by_dense_matrices(monkeypatch, model, **options):
    with monkeypatch.context() as patch:
        patch.setattr(time_stepper, "is_sparse_step_faster", lambda *_: False)
        return simulate(model, compiled=False, **options)


@pytest.mark.parametrize(("theta", "gamma"), [(0.5, 1.0), (1.0, 1.0), (0.6, 0.7)])
def test_chain_is_that_of_dense_matrices(theta, gamma, monkeypatch):
    model = chain(41, theta, gamma)
    run, dense = simulate(model, compiled=False), by_dense_matrices(monkeypatch, model)
    assert any("a band of" in line for line in run.metadata["used"])
    assert not any("a band of" in line for line in dense.metadata["used"])
    assert np.abs(run.x - dense.x).max() < 1e-10
    assert np.abs(run.multipliers - dense.multipliers)[1:].max() < 1e-8
    assert (run.index_set == dense.index_set).all()


def stick_slip(n, steps, h=0.01):
    """The chain by coordinate descent: M v' - c + h Sgn(v') contains 0, M tridiagonal, even and odd masses in turn."""
    i = np.arange(n)
    K = springs(n).tocsr()
    M = sp.eye(n) + h**2 / 4 * K
    diagonal, rest = M.diagonal(), (M - sp.diags(M.diagonal())).tocsr()
    x, v = np.sin(2 * np.pi * (i + 1) / (n + 1)), np.zeros(n)
    rows = [np.concatenate([x, v])]
    for k in range(steps):
        force = sum(3 * np.sin(2 * h * (k + j) + 0.3 * i) for j in (0, 1))
        c, new = v + h / 2 * force - h * (K @ x) - h**2 / 4 * (K @ v), v.copy()
        for _ in range(60):
            before = new.copy()
            for part in (slice(0, None, 2), slice(1, None, 2)):
                pull = (c - rest @ new)[part]
                new[part] = np.sign(pull) * np.maximum(np.abs(pull) - h, 0) / diagonal[part]
            if np.abs(new - before).max() <= 1e-16:
                break
        x, v = x + h / 2 * (v + new), new
        rows.append(np.concatenate([x, v]))
    return np.array(rows)


def test_a_long_chain_is_that_of_coordinate_descent():
    n = 300
    run = simulate(chain(n), compiled=False)
    assert np.abs(run.x - stick_slip(n, 100)).max() < 1e-10
    v, l, code = run.x[1:, n:], run.multipliers[1:], run.index_set[1:]
    assert 0.05 < (code == 0).mean() < 0.95
    assert (v[code == 0] == 0).all()
    assert (l[code < 0] == -1).all()
    assert (l[code > 0] == 1).all()
    assert np.abs(l).max() == 1
    assert (v[code < 0] > 0).all()
    assert run.residual[1:].max() <= 1e-9


def test_friction_takes_energy_from_a_chain_that_is_left_alone():
    n = 60
    run = simulate(chain(n, theta=1.0, force=0.0, t_end=3), compiled=False)
    x, v = run.x[:, :n], run.x[:, n:]
    energy = (v**2).sum(axis=1) / 2 + (x * (springs(n) @ x.T).T).sum(axis=1) / 2
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()
    assert energy[-1] < 0.995 * energy[0]


def test_string_on_an_obstacle_is_that_of_projected_relaxation():
    n, h = 130, 0.01
    model = string(n)
    run = simulate(model, compiled=False)
    assert any("a band of" in line for line in run.metadata["used"])
    i = np.arange(1, n + 1) / (n + 1)
    obstacle, K, x = 0.3 * np.sin(2 * np.pi * i) ** 2 - 0.4, springs(n, 1e3).tocsr(), np.zeros(n)
    M = (sp.eye(n) + h * K).tocsr()
    rest, diagonal = M - sp.diags(M.diagonal()), M.diagonal()
    for k in range(20):
        c, new = x - 40 * h, x.copy()
        for _ in range(4000):
            before = new.copy()
            for part in (slice(0, None, 2), slice(1, None, 2)):
                new[part] = np.maximum((c - rest @ new)[part] / diagonal[part], obstacle[part])
            if np.abs(new - before).max() <= 1e-15:
                break
        x = new
        assert np.abs(run.x[k + 1] - x).max() < 1e-10
    touching = run.index_set[-1] == 0
    assert touching.any()
    assert not touching.all()
    assert (run.x[-1] >= obstacle).all()
    assert np.abs(run.x[-1] - obstacle)[touching].max() < 1e-15
    assert (run.multipliers[-1][~touching] == 0).all()


def test_box_laws_rows_of_several_states_and_theta_are_those_of_dense_matrices(monkeypatch):
    n = 61
    x, l = ca.SX.sym("x", n), ca.SX.sym("l", n)
    D = ca.DM((sp.eye(n) - sp.eye(n, k=-1)).tocsc())
    t = ca.SX.sym("t")
    law = box(np.linspace(-4, -2, n), np.append(np.full(n - 1, 3.0), np.inf))
    layers = FirstOrderSystem(  # between neighbours dry friction, different in the two directions
        t=t, x=x, lam=l, f=-x + 30 * ca.sin(3 * t + 0.1 * np.arange(n)), h=D @ x, g=D.T @ l, law=law, x0=np.zeros(n), t_end=1,
        step=0.02, theta=0.8,
    )  # fmt: skip
    for model in (layers, string(60, box(np.zeros(60), np.full(60, 25.0)), gamma=0.7)):
        run, dense = simulate(model, compiled=False), by_dense_matrices(monkeypatch, model)
        assert any("a band of" in line for line in run.metadata["used"])
        assert len(np.unique(run.index_set[1:])) == 3
        assert np.abs(run.x - dense.x).max() < 1e-10 * max(1, np.abs(dense.x).max())
        assert np.abs(run.multipliers - dense.multipliers)[1:].max() < 1e-7


def test_units_change_no_verdict():
    run = simulate(chain(45), compiled=False)
    for unit in (1e9, 1e-9):
        other = simulate(chain(45, unit=unit), compiled=False)
        assert (other.index_set == run.index_set).all()
        assert np.abs(other.x / unit - run.x).max() < 1e-10
        assert other.residual[1:].max() <= 1e-9


@pytest.mark.parametrize(("n", "unit"), [(20, 1.0), (20, 1e9), (20, 1e-9), (30, 1.0)])
def test_no_wrong_answer_passes_that_dense_matrices_refuse(n, unit):
    model = chain(n, unit=unit, t_end=0.3)
    run, problem = simulate(model, compiled=False), one_step_problem(model)
    structure, law = read_step_structure(problem), numeric_law(problem.law)
    sparse, newton = SparseStepSolver(problem, structure, law, 1e-9), NewtonSolver(problem, structure, law, 1e-9)
    rng, refused = np.random.default_rng(1), 0
    for k in (5, 17, 29):
        t, h, state, z, l, index = run.t[k - 1], 0.01, run.x[k - 1], run.x[k], run.multipliers[k], run.index_set[k]
        assert sparse.certify(t, h, state, z, l, index).residual <= 1e-9
        at = newton.linearise(t, h, state, 0 * z, 0 * l)
        known = newton.known(t, h, state)
        for size in (1e-3, 1e-6, 1e-8, 1e-10, 1e-12):
            for _ in range(6):
                wrong_z, wrong_l, code = z.copy(), l.copy(), index.copy()
                i = rng.integers(n)
                kind = rng.integers(3)
                if kind == 0:
                    wrong_z[rng.integers(2 * n)] += size * unit
                elif kind == 1:
                    wrong_l[i] += size
                else:  # another index set, and what follows from it
                    code[i] = 0 if code[i] else 1
                    wrong_l[i] = np.clip(l[i] + size, -1, 1)
                    wrong_z = np.linalg.solve(at.J.E_z, -(at.E + at.J.E_l @ wrong_l))
                here = newton.linearise(t, h, state, wrong_z, wrong_l)
                dense = newton.evaluate_residual(known, here, wrong_l, code, "", 1).residual
                if dense > 1e-9:
                    refused += 1
                    assert sparse.certify(t, h, state, wrong_z, wrong_l, code).residual > 1e-9
    assert refused > 30


def test_rows_given_twice_have_a_solution():
    """The rows coded 0 are dependent: the matrix of their index set is singular."""
    n = 80
    x = ca.SX.sym("x", n)
    l = ca.SX.sym("l", n)
    twice = np.repeat(np.arange(n // 2), 2)
    C = sp.csr_matrix((np.ones(n), (np.arange(n), twice)), shape=(n, n))
    model = FirstOrderSystem(
        x=x, lam=l, f=-ca.DM(springs(n, 10.0).tocsc()) @ x - 1, h=ca.DM(C.tocsc()) @ x, g=ca.DM(C.T.tocsc()) @ l,
        law=equality(n), x0=np.concatenate([np.zeros(n // 2), np.ones(n // 2)]), t_end=0.2, step=0.02,
    )  # fmt: skip
    run = simulate(model, compiled=False)
    assert np.abs(run.x[:, : n // 2]).max() < 1e-12
    free, x = springs(n, 10.0).tocsr()[n // 2 :, n // 2 :].toarray(), np.ones(n // 2)
    for _ in range(10):
        x = np.linalg.solve(np.eye(n // 2) + 0.02 * free, x - 0.02)
    assert np.abs(run.x[-1, n // 2 :] - x).max() < 1e-10


def test_steps_without_a_solution_fail():
    """y = x_0 >= 0 and y = -x_0 - 1 >= 0, among many rows that are fine."""
    n = 800 if COUNT == FULL else 520  # With more than 500 no dense matrices are written.
    x, l = ca.SX.sym("x", n), ca.SX.sym("l", n + 1)
    model = FirstOrderSystem(
        x=x, lam=l, f=-x, h=ca.vertcat(x, -x[0] - 1), g=ca.vertcat(l[0] - l[n], l[1:n]), law=complementarity(n + 1),
        x0=np.ones(n), t_end=0.1, step=0.05,
    )  # fmt: skip
    with pytest.raises(StepError, match="no verified step"):
        simulate(model, compiled=False)
    singular = FirstOrderSystem(x=x, f=20 * x, x0=np.ones(n), t_end=0.1, step=0.05)
    with pytest.raises(StepError, match=r"singular at h = 0\.05"):
        simulate(singular, compiled=False)


@in_c
@pytest.mark.parametrize(("theta", "gamma"), [(0.5, 1.0), (0.6, 0.7)])
def test_compiled_chain_is_the_interpreted_one(theta, gamma):
    model = chain(60, theta, gamma)
    run, compiled = simulate(model, compiled=False), simulate(model, compiled=True)
    assert compiled.metadata["used"][-1].startswith("steps in C")
    assert compiled.metadata["solver_counts"] == run.metadata["solver_counts"]
    assert (compiled.index_set == run.index_set).all()
    assert np.abs(compiled.x - run.x).max() < 1e-12
    assert np.abs(compiled.multipliers - run.multipliers)[1:].max() < 1e-9
    assert compiled.residual[1:].max() <= 1e-9


@in_c
def test_compiled_obstacle_and_dependent_rows_are_those_interpreted():
    n = 60
    x, l = ca.SX.sym("x", n), ca.SX.sym("l", n)
    C = ca.DM(sp.csr_matrix((np.ones(n), (np.arange(n), np.repeat(np.arange(n // 2), 2))), shape=(n, n)).tocsc())
    K = ca.DM(springs(n, 10.0).tocsc())
    twice = FirstOrderSystem(
        x=x, lam=l, f=-K @ x - 1, h=C @ x, g=C.T @ l, law=complementarity(n), x0=np.ones(n), t_end=1, step=0.02
    )
    for model in (string(70), twice):
        run, compiled = simulate(model, compiled=False), simulate(model, compiled=True)
        assert compiled.metadata["used"][-1].startswith("steps in C")
        assert np.abs(compiled.x - run.x).max() < 1e-11
        assert (run.index_set[-1] == 0).any()


def test_a_resumed_run_repeats_bit_for_bit(tmp_path):
    whole = simulate(chain(50), compiled=False)
    simulate(chain(50), compiled=False, t_end=0.37, out=tmp_path / "run")
    resumed = simulate(chain(50), compiled=False, out=tmp_path / "run", resume=True)
    for name in ("x", "multipliers", "index_set"):
        assert np.array_equal(resumed.arrays[name], whole.arrays[name], equal_nan=name != "index_set")


def test_a_step_depends_on_its_arguments_alone():
    run, other = prepared_loop(chain(50), compiled=False), prepared_loop(chain(50), compiled=False)
    first = run.propagator.stepper(0.0, 0.01, run.propagator.state, run.propagator.warm)
    again = other.propagator.stepper
    for h in (0.02, 0.013, 0.01, 0.004, *np.linspace(0.005, 0.006, 20)):
        again(0.3, h, other.propagator.state * 1.1, other.propagator.warm)
    repeated = again(0.0, 0.01, run.propagator.state, run.propagator.warm)
    assert np.array_equal(first.row, repeated.row)


def test_what_is_used_is_said():
    text = explain(chain(50))
    assert "a band of" in text
    assert "block principal pivoting" in text
    assert "W, which is dense" in text
    assert "sparse" not in explain(chain(10))
    assert "a band of" not in explain(chain(50), solver="lemke")


def test_wide_bands_have_a_sparse_factorisation_and_are_not_compiled(monkeypatch):
    n = 400
    links = sp.random(n, n, 0.008, random_state=np.random.default_rng(3))
    graph = links + links.T
    L = sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
    model = LureSystem(A=-L - sp.eye(n), B=sp.eye(n), C=sp.eye(n), law=relay(n), x0=np.linspace(-3, 3, n), t_end=0.2, step=0.02)
    run = simulate(model, compiled=True)
    assert any("sparse LU, the band being wide" in line for line in run.metadata["used"])
    assert any("sparse LU has no counterpart in C" in line for line in run.metadata["warnings"])
    M, x = (1.02 * np.eye(n) + 0.02 * L.toarray()), model.x0
    x = np.linspace(-3, 3, n)
    for _ in range(10):
        new = x.copy()
        for _ in range(300):
            before = new.copy()
            pull = new + 0.5 * (x - M @ new)  # proximal gradient: |I - 0.5 M| < 1
            new = np.sign(pull) * np.maximum(np.abs(pull) - 0.5 * 0.02, 0)
            if np.abs(new - before).max() <= 1e-16:
                break
        x = new
    assert np.abs(run.x[-1] - x).max() < 1e-12


@in_c
def test_large_systems_without_a_law():
    n, h = 150, 0.01
    x = ca.SX.sym("x", n)
    K = springs(n)
    model = FirstOrderSystem(x=x, f=1 - ca.DM(K.tocsc()) @ x, x0=np.zeros(n), t_end=0.2, step=h, theta=0.5)
    expected, left, right = np.zeros(n), np.eye(n) + h / 2 * K.toarray(), np.eye(n) - h / 2 * K.toarray()
    for _ in range(20):
        expected = np.linalg.solve(left, right @ expected + h)
    for compiled in (False, True):
        run = simulate(model, compiled=compiled)
        assert any("a band of" in line for line in run.metadata["used"])
        assert run.metadata["solver_counts"] == {"none needed": 20}
        assert np.abs(run.x[-1] - expected).max() < 1e-13


def test_a_step_that_is_not_monotone_is_warned_of():
    """W = 1/(1 + h) C C' - 0.1 in one row of many: also where Lanczos' method looks for it."""
    for n in (130, 400):
        D = sp.diags(np.where(np.arange(n) == n // 3, -0.1, 0.0))
        model = LureSystem(
            A=-sp.eye(n), B=sp.eye(n), C=sp.eye(n), D=D, law=relay(n), x0=np.zeros(n), t_end=0.02, step=0.01
        )  # fmt: skip
        warnings = " ".join(simulate(model, compiled=False).metadata["warnings"])
        assert "D is not positive semidefinite" in warnings
        assert "not monotone" in warnings


def test_order_of_a_shuffled_chain_is_narrow():
    n = 500
    shuffle = np.random.default_rng(0).permutation(n)
    found = band_ordering((springs(n).tocsr()[shuffle][:, shuffle]).tocsr())
    assert found.below == found.above == 1
    assert sorted(found.place) == list(range(n))


def test_sparse_input_is_refused_by_name():
    n = 5
    good = {"A": sp.eye(n), "B": sp.eye(n), "C": sp.eye(n), "law": relay(n), "x0": np.zeros(n), "t_end": 1, "step": 0.1}
    assert LureSystem(**good).B.nnz() == n
    broken = sp.eye(n).tolil()
    broken[1, 3] = np.nan
    endless = sp.eye(n).tolil()
    endless[2, 0] = np.inf
    for name, value, message in (
        ("A", sp.eye(4), r"A: shape \(4, 4\); expected \(5, 5\)"),
        ("B", sp.csr_matrix((3, n)), r"B: shape \(3, 5\); expected \(5, 5\)"),
        ("C", 1j * sp.eye(n), "C: a sparse array of shape .* complex"),
        ("B", broken, r"B\[1, 3\] holds a NaN"),
        ("D", endless, r"D\[2, 0\] = inf; expected a finite number"),
    ):
        with pytest.raises(ModelError, match=message):
            LureSystem(**{**good, name: value})


@pytest.mark.long
def test_a_start_that_is_not_finite_is_refused_and_a_thousand_masses_are_declared_at_once():
    model = chain(1000, t_end=0.03)
    run = simulate(model, compiled=False)
    assert run.x.shape == (4, 2000)
    assert not run.metadata["warnings"]
    with pytest.raises((UsageError, StepError)):
        time_stepper.Stepper(one_step_problem(model), "auto", 1e-9, h=0.01, state=np.zeros(2000))(
            0.0, 0.01, np.full(2000, np.nan), time_stepper.WarmStart(np.zeros(1000), np.zeros(1000, np.int8))
        )


def test_of_a_large_system_structure_alone_is_checked():
    n = 120
    report = check(chain(n), quick=True)
    verdicts = {finding.id: finding.verdict for finding in report.findings}
    assert verdicts == dict.fromkeys(("3.1", "4.1", "5.1", "5.2", "5.4a", "5.4b", "5.4c", "5.x0"), "holds") | {"7.1": "violated"}
    zero, one = sp.csc_matrix((n, n)), sp.eye(n)
    A = sp.bmat([[zero, one], [-springs(n), zero]]).toarray()
    assert np.linalg.eigvalsh((A + A.T) / 2)[-1] <= report["5.2"].value["omega"] <= 200
    for C, verdict in ((lambda C: 2 * C, "holds"), (lambda C: C + C[:, [*range(1, 2 * n), 0]], "unknown")):  # P = 2 I; none known
        other = chain(n)
        object.__setattr__(other, "C", C(other.C))
        assert {check(other, quick=True)[id].verdict for id in ("5.1", "5.2")} == {verdict}
    quiet = check(chain(n, force=0.0), quick=True)
    assert quiet["7.1"].verdict == "sampled"


@in_c
@pytest.mark.long
def test_rows_of_one_form_are_one_loop_in_c(tmp_path):
    """The code grows by tables, not by statements; a parameter left to set, or any step, needs dense matrices and is refused."""
    n = 1000 if COUNT == FULL else 520  # With more than 500 no dense matrices are written.
    folder = codegen.write(chain(n), tmp_path / "a", name="chain").folder
    longer = codegen.write(chain(n + 400), tmp_path / "b", name="chain").folder
    counts = [(path / "chain.c").read_text().count(";") for path in (folder, longer)]
    assert counts[1] - counts[0] < 100
    solver = codegen.load(folder).solver()
    run = simulate(chain(n), compiled=False, t_end=0.05)
    for row in run.x[1:]:
        assert solver.step() == 0
        assert np.abs(solver.x - row).max() < 1e-12
    with pytest.raises(CodegenError, match="1800 unknowns and multipliers are more than 1500"):
        codegen.write(chain(600), tmp_path / "c", any_step=True)
