"""Hypotheses 4.1, 5.1, 5.2 of Lur'e systems: against planted P, a semidefinite program from the definition, brute force, runs."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
from fuzz_models import COUNT, FULL, share

import nsmodel
from nsmodel import LureSystem, complementarity, relay
from nsmodel.hypotheses.region import region_of
from nsmodel.models.lure_system import check as lure
from nsmodel.models.lure_system.passivity import decide_input_output, decide_storage
from nsmodel.models.lure_system.symbolic import symbolic_findings as symbolic_findings
from nsmodel.proof import exact
from nsmodel.proof.dissipation import least_rate

# -- independent of the package ------------------------------------------------------------------------------------------


def definition(B, C):
    """max t <= 1 with P >= t I, P B = C', trace P <= 1e6, by a semidefinite program; -inf where P B = C' has no solution."""
    import clarabel
    from scipy import sparse
    from scipy.linalg import null_space

    n = len(B)
    unit = [np.eye(n)[[i]].T @ np.eye(n)[[j]] for j in range(n) for i in range(j + 1)]
    basis = np.array([part + part.T for part in unit])
    equations = np.array([(part @ B).ravel() for part in basis]).T
    first = np.linalg.lstsq(equations, C.T.ravel(), rcond=None)[0]
    if np.abs(equations @ first - C.T.ravel()).max() > 1e-8:
        return -np.inf
    parts = [np.tensordot(first, basis, 1), *np.tensordot(null_space(equations).T, basis, 1)]
    j, i = np.tril_indices(n)
    weight = np.where(i == j, 1, np.sqrt(2))
    stacked = np.array([part[i, j] * weight for part in [*parts, np.eye(n)]]).T
    trace = [np.trace(part) for part in parts]
    rows = np.vstack([
        np.column_stack([-stacked[:, 1:-1], stacked[:, -1]]), [*trace[1:], 0], [*np.zeros(len(parts) - 1), 1]
    ])  # fmt: skip
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    cost = np.zeros(len(parts))
    cost[-1] = -1
    offsets = np.concatenate([stacked[:, 0], [1e6 - trace[0], 1]])
    cones = [clarabel.PSDTriangleConeT(n), clarabel.NonnegativeConeT(2)]
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix((len(cost),) * 2), cost, sparse.csc_matrix(rows), offsets, cones, settings
    ).solve()
    return solution.x[-1]


def growth(P, J):
    """Largest eigenvalue of sym(R J R^{-1}), R^2 = P."""
    size, vectors = np.linalg.eigh(P)
    R = vectors * np.sqrt(size) @ vectors.T
    M = R @ J @ np.linalg.inv(R)
    return np.linalg.eigvalsh((M + M.T) / 2)[-1]


def planted(rng, n, m, rank):
    """P, B, C of whole numbers with P B = C', rank B <= rank, eigenvalues of P from about 1 on."""
    L = rng.integers(-2, 3, (n, n))
    P = L @ L.T + np.eye(n)
    B = rng.integers(-3, 4, (n, rank)) @ rng.integers(-2, 3, (rank, m)) if rank < m else rng.integers(-3, 4, (n, m))
    return P, B.astype(float), (B.T @ P).astype(float)


def sizes(rng):
    m = int(rng.integers(1, 5))
    return int(rng.integers(m, 13)), m


def spoilt(rng, B, C):
    """C with something changed that may or may not destroy P B = C'."""
    C = C.copy()
    kind = rng.integers(4)
    if kind == 0:
        C[rng.integers(len(C))] += rng.integers(-2, 3, C.shape[1])
    elif kind == 1:
        C *= -1
    elif kind == 2:
        C = rng.integers(-3, 4, C.shape).astype(float)
    else:
        C[rng.integers(len(C))] = 0
    return C


# -- 5.1 -----------------------------------------------------------------------------------------------------------------


def test_a_planted_P_is_found_and_solves_the_equation():
    rng = np.random.default_rng(0)
    for _ in range(500 * COUNT // FULL):
        n, m = sizes(rng)
        _, B, C = planted(rng, n, m, int(rng.integers(1, m + 1)))
        state, multiplier = 2.0 ** rng.integers(-20, 21, n), 2.0 ** rng.integers(-20, 21, m)
        finding = decide_storage(B * state[:, None] * multiplier, C / state * multiplier[:, None]).finding
        assert finding.verdict == "holds"
        found = np.array(finding.witness["P"]) * np.outer(state, state)  # in the units of the planted one
        assert np.abs(found @ B - C.T).max() <= 1e-9 * np.abs(found).max()
        d = 1 / np.sqrt(np.diagonal(found))
        assert np.linalg.eigvalsh(found * np.outer(d, d))[0] > 0


def test_the_decision_is_that_of_the_semidefinite_program():
    rng = np.random.default_rng(1)
    seen, clear = {True: 0, False: 0}, 0
    for _ in range(520 * COUNT // FULL):
        n, m = sizes(rng)
        n = min(n, 7)
        _, B, C = planted(rng, n, m, int(rng.integers(1, m + 1)))
        if rng.random() < 0.7:
            C = spoilt(rng, B, C)
        t = definition(B, C)
        exists = t > 1e-4
        assert exists or t < 1e-6, "the program does not tell: choose other numbers"
        units = 10.0 ** rng.integers(-6, 7, n), 10.0 ** rng.integers(-6, 7, m)
        finding = decide_storage(B, C).finding
        scaled = decide_storage(B * units[0][:, None] * units[1], C / units[0] * units[1][:, None]).finding
        assert finding.verdict == ("holds" if exists else "violated")
        assert scaled.verdict in (("holds", "sampled") if exists else ("violated", "sampled", "unknown"))
        clear += scaled.verdict == "violated"
        seen[exists] += 1
    assert min(seen.values()) > 100 * COUNT / FULL
    assert clear >= 0.98 * seen[False]


def test_the_witness_shows_what_is_wrong():
    rng = np.random.default_rng(2)
    seen = set()
    for _ in range(300):
        n, m = sizes(rng)
        _, B, C = planted(rng, n, m, int(rng.integers(1, m + 1)))
        C = spoilt(rng, B, C)
        finding = decide_storage(B, C).finding
        if finding.verdict != "violated":
            continue
        witness = {name: np.array(item) for name, item in finding.witness.items()}
        if "skew part" in witness:
            assert np.allclose(witness["skew part"], (C @ B - (C @ B).T) / 2)
            assert np.abs(witness["skew part"]).max() > 0
        if "v'CBv" in witness:
            v = witness["v"]
            assert v @ C @ B @ v < 0
        if "v with B v = 0" in witness:
            v = witness["v with B v = 0"]
            assert np.abs(B @ v).max() <= 1e-12
            assert np.abs(C.T @ v).max() > 1e-9
        if "v with C B v = 0" in witness:
            v = witness["v with C B v = 0"]
            assert np.abs(C @ B @ v).max() <= 1e-11
            assert np.abs(B @ v).max() > 1e-9
        seen |= set(witness)
    assert {"skew part", "v'CBv", "v with B v = 0", "v with C B v = 0"} <= seen


@pytest.mark.parametrize(
    ("B", "C", "reason"),
    [
        ([[1], [0]], [[0, 1]], "rank C B < rank B"),
        ([[0, 0], [10, 3]], [[1, 0], [0, 1]], "not symmetric"),
        ([[2]], [[-1]], "not psd"),
        ([[1, 1], [0, 0]], [[1, 0], [1, 1]], "ker B does not lie in ker C'"),
    ],
)
def test_systems_without_P(B, C, reason):
    finding = decide_storage(np.array(B, float), np.array(C, float)).finding
    assert finding.verdict == "violated"
    assert reason in finding.how


def test_the_twisting_controller_has_the_skew_part_as_its_witness():
    finding = decide_storage(np.array([[0.0, 0.0], [10.0, 3.0]]), np.eye(2)).finding
    assert finding.witness["skew part"] == [[0, -5], [5, 0]]


def test_rounded_numbers_are_accepted_with_their_margin_only():
    rng = np.random.default_rng(3)
    verdicts = []
    for _ in range(60):
        n, m = int(rng.integers(3, 9)), int(rng.integers(2, 4))
        L = rng.normal(size=(n, n))
        P, B = L @ L.T + np.eye(n), rng.normal(size=(n, m))
        finding = decide_storage(B, (P @ B).T).finding
        verdicts.append(finding.verdict)
        assert finding.value["|PB - C'|/|C|"] < 1e-12
        off = (P @ B).T * (1 + 1e-9 * rng.normal(size=(m, n)))
        assert decide_storage(B, off).finding.verdict == "violated"
    assert set(verdicts) == {"sampled"}


def test_a_stiff_rectifier_is_accepted():
    B, C = np.array([[-1e9], [0.0]]), np.array([[-1.0, 0.0]])
    finding = decide_storage(B, C).finding
    assert finding.verdict == "holds"
    assert np.array(finding.witness["P"])[0, 0] == pytest.approx(1e-9, rel=1e-15)
    stiff = np.array([[1.0, 0.0], [0.0, 1e9]])
    result = decide_storage(np.eye(2), stiff).finding
    assert result.verdict == "holds"
    assert result.value["cond P"] == pytest.approx(1e9)


def test_P_is_about_as_well_conditioned_as_possible():
    rng = np.random.default_rng(4)
    for _ in range(share(40, 10)):
        b, c = rng.normal(size=2), rng.normal(size=2)
        c *= np.sign(c @ b)
        B, C = b[:, None], c[None, :]
        normal = np.array([-b[1], b[0]])
        conditions = []
        for x in np.logspace(-6, 6, 1500):
            P = np.outer(c, c) / (c @ b) + x * np.outer(normal, normal)
            conditions.append(np.linalg.cond(P))
        assert decide_storage(B, C).finding.value["cond P"] <= 1.1 * min(conditions)


# -- 4.1 -----------------------------------------------------------------------------------------------------------------


def test_D_is_decided_exactly():
    skew = np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert decide_input_output(skew).verdict == "holds"
    rank_one = np.outer([0.5, 0.25, 0.125], [0.5, 0.25, 0.125])
    assert decide_input_output(rank_one).verdict == "holds"
    rounded = np.outer([0.1, 0.3, 0.7], [0.1, 0.3, 0.7])
    assert decide_input_output(rounded).verdict in ("holds", "sampled")
    rough = np.diag([1e12, 1e-12]) + 1e-3 * skew
    assert decide_input_output(rough).verdict == "holds"
    bad = np.diag([1e12, -1e-12])
    finding = decide_input_output(bad)
    v = np.array(finding.witness["v"])
    assert finding.verdict == "violated"
    assert v @ bad @ v < 0


def test_D_with_a_clear_sign_is_never_sampled():
    rng = np.random.default_rng(5)
    for _ in range(300):
        m = int(rng.integers(1, 7))
        L, K = rng.normal(size=(m, m)), rng.normal(size=(m, m))
        S = L @ L.T
        S += (rng.choice([-0.1, 0.1]) - np.linalg.eigvalsh(S)[0]) * np.eye(m)
        D = S + K - K.T
        finding = decide_input_output(D)
        least = np.linalg.eigvalsh(S)[0]
        assert finding.verdict == ("holds" if least > 0 else "violated")
        assert finding.value["least eigenvalue"] == pytest.approx(least, abs=1e-9)
        if least > 0:  # a bound, not an eigenvalue in doubles
            below = exact.rational(D) - Fraction(finding.value["least eigenvalue"]) * exact.eye(len(D))
            assert exact.is_psd(below)


# -- 5.2, A linear -------------------------------------------------------------------------------------------------------


def test_omega_is_a_bound_and_no_search_over_P_beats_it():
    rng = np.random.default_rng(6)
    for trial in range(share(30, 8)):
        n = 2 + trial % 2
        b = rng.normal(size=(n, 1))
        L = rng.normal(size=(n, n))
        C = b.T @ (L @ L.T + np.eye(n))
        J = rng.normal(size=(n, n))
        passivity = decide_storage(b, C)
        rate = least_rate(passivity.pairing, [J])
        P = exact.doubles(passivity.pairing.storage_matrix(rate.Y))
        assert np.abs(P @ b - C.T).max() <= 1e-9 * np.abs(P).max()
        assert growth(P, J) <= rate.omega + 1e-9 * np.abs(J).max()
        N = np.linalg.svd(b.T)[2][1:].T
        base = C.T @ C / (C @ b).item()
        best = np.inf
        for _ in range(600):
            G = rng.normal(size=(n - 1, n - 1)) * 10 ** rng.uniform(-1, 1)
            best = min(best, growth(base + N @ (G @ G.T + 1e-4 * np.eye(n - 1)) @ N.T, J))
        assert rate.omega <= best + 1e-6 * np.abs(J).max()


def test_omega_over_a_scalar_Y_is_the_minimum_of_a_fine_scan():
    rng = np.random.default_rng(7)
    for _ in range(share(25, 6)):
        J = rng.normal(size=(2, 2))
        passivity = decide_storage(np.array([[0.0], [1.0]]), np.array([[0.0, 1.0]]))
        rate = least_rate(passivity.pairing, [J])
        scan = min(growth(np.diag([y, 1.0]), J) for y in np.logspace(-3, 3, 1500) * abs(J[1, 0] / J[0, 1]))
        assert rate.omega == pytest.approx(scan, abs=4e-3 * np.abs(J).max())
        assert rate.omega <= scan + 1e-6


def mechanical(rng, masses, friction, damped):
    """M x'' + D x' + K x = -H l, y = H'x', masses and stiffnesses powers of two, so that nothing is rounded."""
    n = masses
    M = np.diag(2.0 ** rng.integers(-1, 3, n))
    spring = 2.0 ** rng.integers(-1, 3, n + 1)
    K = np.diag(spring[:-1] + spring[1:]) - np.diag(spring[1:-1], 1) - np.diag(spring[1:-1], -1)
    D = np.zeros((n, n))
    D[damped, damped] = 0.5
    H, zero, inverse = np.eye(n)[:, friction], np.zeros((n, n)), np.linalg.inv(M)
    J = np.block([[zero, np.eye(n)], [-inverse @ K, -inverse @ D]])
    none = np.zeros((n, len(friction)))
    return J, np.vstack([none, inverse @ H]), np.vstack([none, H]).T, M, K


@pytest.mark.parametrize(
    ("masses", "friction", "damped"),
    [
        (1, [0], []),
        (2, [0, 1], []),
        (2, [0], []),
        (3, [1], [0]),
        (3, [0, 2], [1]),
        (4, [0], []),
        (5, [0, 1, 2, 3, 4], [2]),
    ],
)
def test_energy_is_found_and_its_decay_proved(masses, friction, damped):
    rng = np.random.default_rng(8)
    for _ in range(3):
        J, B, C, _, _ = mechanical(rng, masses, friction, damped)
        passivity = decide_storage(B, C)
        rate = least_rate(passivity.pairing, [J])
        P = exact.doubles(passivity.pairing.storage_matrix(rate.Y))
        assert rate.omega == 0.0
        assert np.linalg.eigvalsh(P)[0] > 0
        assert np.linalg.eigvalsh(P @ J + J.T @ P)[-1] <= 1e-12 * np.abs(P @ J).max()


def test_energy_that_is_not_found_exactly_is_found_up_to_the_accuracy_of_the_search():
    J, B, C, _, _ = mechanical(np.random.default_rng(8), 6, [3], [0])
    rate = least_rate(decide_storage(B, C).pairing, [J])
    assert 0 <= rate.omega <= rate.accuracy


def test_strict_contraction_is_found():
    rng = np.random.default_rng(9)
    for _ in range(10):
        n = int(rng.integers(2, 7))
        L = rng.normal(size=(n, n))
        P = L @ L.T + np.eye(n)
        S, K = rng.normal(size=(n, n)), rng.normal(size=(n, n))
        J = np.linalg.solve(P, K - K.T - S @ S.T) - 0.3 * np.eye(n)
        B = rng.normal(size=(n, 1))
        passivity = decide_storage(B, (P @ B).T)
        rate = least_rate(passivity.pairing, [J])
        assert rate.least - 1e-9 <= rate.omega <= growth(P, J) + 1e-6
        assert rate.omega <= -0.3 + 1e-6


# -- 5.2, A nonlinear ----------------------------------------------------------------------------------------------------

X = ca.SX.sym("x", 2)


def checked(A, x0=(1, 1), **arguments):
    given = {"B": [0, 1], "C": [0, 1], "law": relay(1), **arguments}
    model = LureSystem(x=X, A=A, x0=list(x0), t_end=1, step=0.01, **given)
    region = region_of(model, [], {"x_0": (-2, 2), "x_1": (-2, 2)})
    findings, consequences = lure.check(model, region, [], False)
    return {f.id: f for f in findings}, {c.name: c for c in consequences}, region


NONLINEAR = {
    "cubic damping": ([X[1], -X[0] - X[1] ** 3], True, 0.0),
    "quadratic drag": ([X[1], -X[0] - ca.fabs(X[1]) * X[1]], True, 0.0),
    "saturation": ([-X[0] + ca.fmax(X[1], 0), -X[1]], True, -0.5),
    "arctangent": ([-X[0] + ca.atan(X[1]), -X[1] - ca.atan(X[0])], True, -0.4),
    "pendulum": ([X[1], -ca.sin(X[0]) - X[1] / 2], True, 1.0),
    "hardening spring": ([X[1], -X[0] - X[0] ** 3], False, 3.0),
    "van der Pol": ([X[1], (1 - X[0] ** 2) * X[1] - X[0]], False, 6.0),
}


@pytest.mark.parametrize("name", NONLINEAR)
def test_nonlinear_operators_obey_their_omega_between_random_points(name):
    A, everywhere, at_most = NONLINEAR[name]
    findings, _, region = checked(A)
    finding = findings["5.2"]
    omega, P = finding.value["omega"], np.array(finding.witness["P_omega"])
    assert finding.verdict == "holds"
    assert (finding.scope is None) == everywhere
    assert omega <= at_most
    rng = np.random.default_rng(10)
    span = 100 * np.ones(2) if everywhere else region.upper
    a, b = rng.uniform(-span, span, (2, 20000, 2))
    function = ca.Function("A", [X], [ca.vertcat(*A)])
    change = (np.array(function(a.T)) - np.array(function(b.T))).T
    product, size = np.einsum("ki,ij,kj->k", a - b, P, change), np.einsum("ki,ij,kj->k", a - b, P, a - b)
    assert (product <= omega * size + 1e-9 * np.abs(change).max() ** 2).all()


def test_an_operator_that_jumps_is_refused_with_the_jump():
    findings, _, _ = checked([X[1], -X[0] - ca.sign(X[1] - 0.5)])
    finding = findings["5.2"]
    assert finding.verdict == "violated"
    assert finding.witness["x"][1] == pytest.approx(0.5)
    assert finding.value["jump"] == pytest.approx(2)
    floor, _, _ = checked([X[1], -ca.floor(X[0])])  # its derivative is 0 everywhere
    assert floor["5.2"].verdict == "violated"


def test_without_P_there_is_nothing_to_be_monotone_in():
    findings, consequences, _ = checked([X[1], -X[0]], C=[1, 0])
    assert findings["5.1"].verdict == "violated"
    assert findings["5.2"].verdict == "unknown"
    assert "no P" in findings["5.2"].how
    assert consequences["well posed"].verdict == "unknown"


# -- cases and consequences ----------------------------------------------------------------------------------------------

CASES = {
    "diode_bridge": ("holds", "holds", 0.0),
    "friction_chain": ("holds", "holds", 0.0),
    "friction_oscillator_relay": ("holds", "holds", 0.0),
    "relay_oscillator": ("violated", "unknown", None),
    "rlc_diode": ("holds", "holds", 0.0),
    "sliding_relay": ("holds", "holds", 1.0),
    "two_masses": ("holds", "holds", None),
}


@pytest.mark.parametrize("stem", CASES)
def test_cases(load_case, stem):
    model = load_case(stem).bind()
    findings, consequences = lure.check(model, region_of(model, []), [], False)
    assert [finding.id for finding in findings] == [hypothesis.id for hypothesis in lure.HYPOTHESES]
    verdicts = {finding.id: finding.verdict for finding in findings}
    P, monotone, omega = CASES[stem]
    assert (verdicts["4.1"], verdicts["5.1"], verdicts["5.2"]) == ("holds", P, monotone)
    if omega is not None:
        assert findings[3].value["omega"] == omega
    assert {c.name: c.verdict for c in consequences}["well posed"] == ("unknown" if P == "violated" else "holds")


def test_the_rectifier_has_the_energy_of_its_capacitor_and_coil(load_case):
    model = load_case("rlc_diode").bind()
    findings, _ = lure.check(model, region_of(model, []), [], False)
    assert np.array(findings[3].witness["P_omega"]) == pytest.approx(np.diag([1e-6, 1e-2]), rel=1e-12)


def test_two_free_masses_drift_apart_so_that_omega_is_small_and_not_zero(load_case):
    model = load_case("two_masses").bind()
    findings, consequences = lure.check(model, region_of(model, []), [], False)
    assert 0 < findings[3].value["omega"] < 0.1
    stable = next(c for c in consequences if c.name == "Lyapunov stable")
    assert stable.verdict == "unknown"
    assert "omega <= 0" in stable.statement


def test_a_chain_of_fifty_masses_is_proved_in_little_time(load_case):
    model = load_case("friction_chain", n=50).bind()
    findings, _ = lure.check(model, region_of(model, []), [], False)
    assert findings[2].verdict == findings[3].verdict == "holds"
    assert findings[3].value["omega"] == 0.0


def test_stability_needs_the_sign_of_omega_and_no_force():
    damped = [X[1], -X[0] - X[1]]
    _, consequences, _ = checked(damped)
    assert consequences["Lyapunov stable"].verdict == "holds"
    _, contracting, _ = checked([-X[0] + X[1], -X[0] - X[1]])
    assert contracting["globally asymptotically stable"].verdict == "holds"
    assert contracting["contraction"].value["omega"] == pytest.approx(-1.0)
    _, growing, _ = checked([X[1], X[0]])
    assert growing["Lyapunov stable"].verdict == "unknown"
    assert "omega <= 0" in growing["Lyapunov stable"].statement
    _, forced, _ = checked(damped, f=[0, 1])
    assert forced["Lyapunov stable"].verdict == "unknown"
    assert "f is not 0" in forced["Lyapunov stable"].statement


def test_a_box_gives_stability_but_no_global_one():
    softening = [-X[0] + X[0] ** 3 / 8, -X[1]]  # contracts for |x_0| < 1.63 only
    model = LureSystem(x=X, A=softening, B=[0, 1], C=[0, 1], law=relay(1), x0=[1, 1], t_end=1, step=0.01)
    region = region_of(model, [], {"x_0": (-1, 1), "x_1": (-1, 1)})
    findings, consequences = lure.check(model, region, [], False)
    assert findings[3].value["omega"] == pytest.approx(-0.625, abs=1e-6)
    verdicts = {c.name: c.verdict for c in consequences}
    assert verdicts["Lyapunov stable"] == "holds"
    assert verdicts["globally asymptotically stable"] == "unknown"


def test_a_force_that_jumps_takes_the_theorem_away():
    t = ca.SX.sym("t")
    _, consequences, _ = checked([X[1], -X[0]], t=t, f=[0, ca.sign(t - 0.5)])
    assert consequences["well posed"].verdict == "unknown"
    assert "continuous" in consequences["well posed"].statement
    _, smooth, _ = checked([X[1], -X[0]], t=t, f=[0, ca.sin(t)])
    assert smooth["well posed"].verdict == "holds"


# -- two runs ------------------------------------------------------------------------------------------------------------


def pair_of_runs(theta, A, omega_law=None):
    runs = []
    for x0 in ([2.0, -1.0], [-1.0, 0.5]):
        model = LureSystem(
            x=X, A=A, B=[0, 1], C=[0, 1], law=omega_law or relay(1), x0=x0, t_end=4, step=0.01, theta=theta
        )  # fmt: skip
        runs.append(nsmodel.simulate(model))
    return model, *runs


@pytest.mark.parametrize("theta", [1.0, 0.5])
@pytest.mark.parametrize("name", ["cubic damping", "arctangent", "pendulum"])
def test_two_runs_contract_as_promised(theta, name):
    model, a, b = pair_of_runs(theta, NONLINEAR[name][0])
    finding = checked(NONLINEAR[name][0])[0]["5.2"]
    P = np.array(finding.witness["P_omega"])
    result = lure.compare_contraction(model, P, finding.value["omega"], a, b)
    assert result.verdict == "holds"
    size = np.sqrt(np.einsum("ki,ij,kj->k", a.x - b.x, P, a.x - b.x))
    ratio = size / (size[0] * np.exp(finding.value["omega"] * a.t))
    assert result.value["largest ratio to the bound"] == pytest.approx(ratio.max())
    too_small = lure.compare_contraction(model, P, finding.value["omega"] - 5, a, b)
    assert too_small.verdict == "violated"


def test_runs_that_cannot_be_compared():
    model, a, _ = pair_of_runs(1.0, NONLINEAR["pendulum"][0])
    assert "same start" in lure.compare_contraction(model, np.eye(2), 1.0, a, a).how
    other = nsmodel.simulate(model, step=0.02)
    assert "different times" in lure.compare_contraction(model, np.eye(2), 1.0, a, other).how


# -- parameters without value --------------------------------------------------------------------------------------------


def symbolic(**arguments):
    model = LureSystem(t_end=1, step=0.1, **arguments)
    return {finding.id: finding for finding in symbolic_findings(model)}


def test_two_masses_need_only_positive_masses_and_friction_forces():
    m1, m2, mu1, mu2, k = (ca.SX.sym(name) for name in ("m1", "m2", "mu1", "mu2", "k"))
    findings = symbolic(
        A=[[0, 1, 0, 0], [-k / m1, 0, k / m1, 0], [0, 0, 0, 1], [k / m2, 0, -k / m2, 0]],
        B=[[0, 0], [mu1 / m1, 0], [0, 0], [0, mu2 / m2]], C=[[0, 1, 0, 0], [0, 0, 0, 1]], law=relay(2), x0=[1, 0, -1, 0],
        parameters={m1: None, m2: None, mu1: None, mu2: None, k: 10},
    )  # fmt: skip
    assert findings["4.1"].verdict == "holds"
    assert findings["5.1"].verdict == "unknown"
    assert findings["5.1"].witness["conditions"] == ["mu1/m1 > 0", "mu2/m2 > 0"]
    assert findings["5.1"].how.endswith("so for all values > 0 of m1, m2, mu1, mu2")


def test_a_sliding_rod_loses_monotonicity_at_four_thirds():
    mu, angle = ca.SX.sym("mu"), ca.SX.sym("angle")
    c, s = ca.cos(angle), ca.sin(angle)
    arguments = {"A": [[0]], "B": [1], "C": [1], "D": 1 + 3 * c**2 - 3 * mu * s * c, "law": complementarity(1), "x0": [1]}
    free = symbolic(parameters={mu: None, angle: None}, **arguments)["4.1"]
    assert free.verdict == "unknown"
    assert free.value["least |mu| on the boundary"] == pytest.approx(4 / 3, abs=1e-6)
    tilted = symbolic(parameters={mu: None, angle: np.arctan(2)}, **arguments)["4.1"]
    assert "mu <=" in tilted.how
    assert symbolic(parameters={mu: 1.0, angle: 0.3}, **arguments)["4.1"].verdict == "holds"


def test_conditions_of_symbols_agree_with_numbers():
    names = ("a", "b", "c")
    a, b, c = (ca.SX.sym(name) for name in names)
    B, C = [[a, 1], [b, 2]], [[1, c], [0, 3]]
    arguments = {"A": np.zeros((2, 2)), "law": relay(2), "x0": [1, 0], "D": [[a, b], [c, 1]]}
    findings = symbolic(B=B, C=C, parameters=dict.fromkeys((a, b, c)), **arguments)
    assert findings["5.1"].verdict == findings["4.1"].verdict == "unknown"
    rng = np.random.default_rng(11)
    seen = set()
    for _ in range(share(90, 30)):
        values = dict(zip(names, (float(v) for v in rng.integers(-4, 5, 3)), strict=True))
        if rng.random() < 0.6:
            values["c"] = (3 * values["b"] - 1) / 2  # where C B is symmetric
        number = LureSystem(t_end=1, step=0.1, B=B, C=C, parameters=dict.fromkeys((a, b, c)), **arguments).bind(values)
        Bn, Cn, Dn = (np.array(ca.DM(M)) for M in (number.B, number.C, number.D))
        if np.linalg.matrix_rank(Bn) < 2:
            continue
        for id, decided in (("5.1", decide_storage(Bn, Cn).finding), ("4.1", decide_input_output(Dn))):
            text = " and ".join(f"({condition})" for condition in findings[id].witness["conditions"]).replace(" = 0", " == 0")
            assert eval(text, {}, values) == (decided.verdict == "holds")
            seen.add((id, decided.verdict))
    assert len(seen) == 4


def test_units_in_which_the_energy_is_found_exactly():
    for unit in (1e9, 1e-9, 1e5):
        model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, unit], C=[0, 1 / unit], law=relay(1), x0=[1, 0], t_end=1, step=0.1)
        report = nsmodel.check(model, quick=True)
        assert report["5.2"].value["omega"] == 0
        assert {c.name: c.verdict for c in report.consequences}["Lyapunov stable"] == "holds"


def test_numbers_whose_products_leave_the_range_of_doubles():
    for unit in (1e150, 1e-150, 1e200, 1e-200, 1e300):
        for B, C in ((unit, 1 / unit), (unit, unit), (unit, 1.0), (1.0, unit)):
            passivity = decide_storage(np.array([[0.0], [B]]), np.array([[0.0, C]]))
            assert passivity.finding.verdict in ("holds", "unknown")


def test_a_forcing_is_looked_at_up_to_the_end_though_the_run_stopped_before():
    t = ca.SX.sym("t")
    model = LureSystem(A=[[-1]], B=[1], C=[1], f=[1 / (t - 0.5)], t=t, law=relay(1), x0=[1], t_end=1, step=0.1)
    well_posed = nsmodel.check(model).consequences[0]
    assert (well_posed.name, well_posed.verdict) == ("well posed", "unknown")
    assert "fails at t = 0.5" in well_posed.statement


def test_a_coefficient_that_is_not_finite_proves_nothing():
    x = ca.SX.sym("x")
    model = LureSystem(x=x, A=[x * 1e308 * 1e308], B=[1], C=[1], law=relay(1), x0=[1], t_end=1, step=0.1)
    assert nsmodel.check(model, quick=True)["5.2"].verdict == "unknown"


def wide(A, n=300):
    """A system with too many states for dense proofs: C = B' = I, a relay on each."""
    x, unit = ca.SX.sym("x", n), sp.identity(n, format="csc")
    return nsmodel.check(LureSystem(x=x, A=A(x), B=unit, C=unit, law=relay(n), x0=np.zeros(n), t_end=1, step=0.1), (), quick=True)


@pytest.mark.parametrize(
    "A",
    [
        lambda x: -x + 5 * ca.sign(x),
        lambda x: -x + ca.floor(x),
        lambda x: ca.fmod(x, 2),
        lambda x: ca.if_else(x > 1, 1 - x, -x),
        lambda x: ca.atan2(0, x),
    ],
)
def test_a_large_system_that_jumps_is_not_linear(A):
    assert wide(A)["5.2"].verdict == "unknown"


def test_a_large_linear_system_keeps_its_negative_omega():
    report = wide(lambda x: -x)
    assert report["5.2"].value["omega"] == -1
    stable = {item.name: item.verdict for item in report.consequences}
    assert stable["globally asymptotically stable"] == "sampled"  # A(0) = 0 in floating point
    chain = wide(lambda x: -3 * x + ca.vertcat(x[1:], 0))["5.2"].value["omega"]
    assert -2.5 <= chain <= -2 + 1e-13
    assert wide(lambda x: 1e308 * (x + ca.vertcat(x[1:], 0)))["5.2"].verdict == "unknown"


# -- what is printed is what was proved -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("b", "c"), [(1e9, 1e-3), (1e3, 1e-12), (1e8, 1e-8), (1e-12, 1e12)])
@pytest.mark.parametrize("quick", [True, False])
def test_the_p_that_is_given_is_the_p_that_was_proved(b, c, quick):
    from fractions import Fraction

    A, B, C = np.array([[-2.0, 0], [-2, -4]]), b * np.array([[-1.0], [1]]), c * np.array([[1.0, 2]])
    given = LureSystem(A=A, B=B, C=C, law=complementarity(1), x0=[2, 2], t_end=0.2, step=0.1)
    report = nsmodel.check(given, quick=quick)
    for id, name in (("5.1", "P"), ("5.2", "P_omega")):
        found = report[id]
        assert found.verdict == "holds"
        near = exact.rational(np.array(found.witness[name]))
        fractions = found.witness.get(f"{name} exactly")
        P = near if fractions is None else np.array([[Fraction(entry) for entry in row] for row in fractions], dtype=object)
        assert exact.is_symmetric(P)
        assert exact.definiteness(P).definite
        assert not (exact.matrix_product(P, B) - exact.rational(C).T).any()
        assert all(abs(p - q) <= Fraction(1e-15) * abs(q) for p, q in zip(near.ravel(), P.ravel(), strict=True))
    assert exact.is_psd(Fraction(report["5.2"].value["omega"]) * P - exact.matrix_product(P, A))


def test_a_forcing_with_an_integrable_derivative_is_enough():
    t = ca.SX.sym("t")
    for f, verdict in ((ca.sqrt(t), "holds"), (ca.sqrt(ca.fabs(t - 0.5)), "holds"), (ca.sign(t - 0.5), "unknown")):
        given = LureSystem(t=t, A=[[-1]], B=[[1]], C=[[1]], law=relay(1), f=f, x0=[1], t_end=1, step=0.1)
        made = {item.name: item for item in nsmodel.check(given, quick=True).consequences}
        assert made["well posed"].verdict == verdict


def test_a_diagonal_pairing_of_many_rows():
    import scipy.sparse as sparse

    n = 400
    p = np.linspace(1, 3, n).round(2)
    B = sparse.diags(np.ones(n), format="csc")
    given = LureSystem(
        A=-sparse.eye(n, format="csc"), B=B, C=sparse.diags(p, format="csc"), law=relay(n), x0=np.ones(n), t_end=1, step=0.1
    )
    report = nsmodel.check(given, quick=True)
    assert report["5.1"].verdict == report["5.2"].verdict == "holds"
    assert -1 <= report["5.2"].value["omega"] <= -1 + 1e-12
