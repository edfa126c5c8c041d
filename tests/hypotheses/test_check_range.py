"""Assumptions 3.1, 5.4 and 7.1 against enumeration of complementary cones, closed forms and hand-made potentials."""

from __future__ import annotations

from itertools import combinations, product

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

import nsmodel
from nsmodel import LureSystem, ball, box, complementarity, equality, polyhedron, relay, second_order_cone
from nsmodel.models.lure_system.range_condition import RANGE_HYPOTHESES, range_findings
from nsmodel.proof import conic, exact
from nsmodel.proof.conic import ConicSystem

INF = np.inf


def decided(C, D, law=None, x0=None, *, A=None, f=None, phi=None):
    """{id: finding} of a system with these matrices; ``phi`` is a function of the symbols y."""
    C, D = np.atleast_2d(np.asarray(C, float)), np.atleast_2d(np.asarray(D, float))
    m, n = C.shape
    y = ca.SX.sym("y", m)
    given = {"law": law} if phi is None else {"phi": phi(y), "y": y}
    model = LureSystem(
        A=np.zeros((n, n)) if A is None else A, B=np.zeros((n, m)), C=C, D=D, f=f, x0=np.zeros(n) if x0 is None else x0,
        t_end=1, step=0.1, t=TIME, **given,
    )  # fmt: skip
    found = range_findings(model.bind(), quick=False)
    assert [finding.id for finding in found] == [hypothesis.id for hypothesis in RANGE_HYPOTHESES]
    return {finding.id: finding for finding in found}


TIME = ca.SX.sym("t")


def verdicts(*args, **named):
    return {id: finding.verdict for id, finding in decided(*args, **named).items()}


# -- brute force: q in R(D + N_K) by enumeration of the pieces of the law -------------------------------------------------


def in_range_of_boxes(q, D, low, up):
    """Which columns of q (m, k) lie in a full-dimensional piece {q = D l + n : l_i at an end, or n_i = 0}."""
    m, inside = len(D), np.zeros(q.shape[1], bool)
    for code in product((-1, 0, 1), repeat=m):
        code = np.array(code)
        end = np.where(code < 0, low, up)
        fixed, free = code != 0, code == 0
        if not np.isfinite(end[fixed]).all() or abs(np.linalg.det(D[np.ix_(free, free)])) < 1e-9:
            continue
        l = np.where(fixed, np.where(fixed, end, 0), 0.0)[:, None] * np.ones(q.shape[1])
        l[free] = np.linalg.solve(D[np.ix_(free, free)], (q - D[:, fixed] @ l[fixed])[free])
        n = q - D @ l
        good = (l[free] >= low[free, None]).all(axis=0) & (l[free] <= up[free, None]).all(axis=0)
        inside |= good & (n[code < 0] <= 0).all(axis=0) & (n[code > 0] >= 0).all(axis=0)
    return inside


def in_range_of_polyhedron(q, D, H, K):
    """The same for {l : H l >= K}, by sets of active rows."""
    (r, m), inside = H.shape, np.zeros(q.shape[1], bool)
    for size in range(min(r, m) + 1):
        for active in map(list, combinations(range(r), size)):
            A = np.block([[D, -H[active].T], [H[active], np.zeros((size, size))]])
            if abs(np.linalg.det(A)) < 1e-9:
                continue
            found = np.linalg.solve(A, np.vstack([q, np.outer(K[active], np.ones(q.shape[1]))]))
            l, mu = found[:m], found[m:]
            inside |= (H @ l >= K[:, None] - 1e-9).all(axis=0) & (mu >= 0).all(axis=0)
    return inside


def surrounds(q, member, rng, size):
    """Whether a small turned cross around q lies in the (convex) set: then q is in its interior."""
    turn = np.linalg.qr(rng.normal(size=(len(q), len(q))))[0]
    return bool(member(q[:, None] + size * np.hstack([turn, -turn])).all())


def random_psd(rng, m):
    kind = rng.integers(6)
    V, a = rng.integers(-2, 3, (m, 1)), rng.integers(-2, 3, (m, m))
    skew = a - a.T
    return [np.zeros((m, m)), skew, V @ V.T, V @ V.T + skew, a @ a.T + np.eye(m), np.diag(rng.integers(0, 2, m)) + skew][
        kind
    ] * 1.0


@pytest.mark.parametrize("seed", range(share(12, 3)))
def test_boxes_against_complementary_cones(seed):
    rng, seen = np.random.default_rng(seed), set()
    for _ in range(40):
        m, n = rng.integers(1, 4), rng.integers(1, 3)
        D, C, x0 = random_psd(rng, m), rng.integers(-2, 3, (m, n)), rng.integers(-2, 3, n)
        ends = [[(0, INF), (-1, INF), (-INF, 1), (-1, 1), (0, 2), (-INF, INF)][k] for k in rng.integers(0, 6, m)]
        low, up = np.array(ends, float).T
        member = lambda q: in_range_of_boxes(q, D, low, up)  # noqa: B023, E731
        found = decided(C, D, box(low, up), x0)
        seen.add(found["5.x0"].verdict)
        if "v" in found["5.4a"].witness:
            # v and -v recede in K, S v = 0, and D v is 0 but on bounded rows: Upsilon is linear, its conjugate's domain flat.
            v, bounded = np.array(found["5.4a"].witness["v"]), np.isfinite(low) & np.isfinite(up)
            assert v.any()
            assert not ((D + D.T) @ v).any()
            assert not v[np.isfinite(low) | np.isfinite(up)].any()
            assert not (D @ v)[~bounded].any()
            assert ("Yet -C x0" in found["5.x0"].how) >= surrounds(-C @ x0, member, rng, 1e-4)
        else:
            compare(found, C, x0, member, rng)
    assert seen == {"holds", "violated"}


@pytest.mark.parametrize("seed", range(share(6, 2)))
def test_polyhedra_against_active_sets(seed):
    rng = np.random.default_rng(100 + seed)
    for _ in range(25):
        m, n, r = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 5)
        D, C, x0 = random_psd(rng, m), rng.integers(-2, 3, (m, n)), rng.integers(-2, 3, n)
        H = rng.integers(-2, 3, (r, m)) * 1.0
        K = H @ rng.integers(-1, 2, m) - rng.integers(0, 3, r)  # not empty, but perhaps flat
        member = lambda q: in_range_of_polyhedron(q, D, H, K)  # noqa: B023, E731
        found = decided(C, D, polyhedron(H, K), x0)
        if "v" in found["5.4a"].witness:
            v = np.array(found["5.4a"].witness["v"])
            assert v.any()
            assert not (H @ v).any()
            assert not ((D + D.T) @ v).any()
        else:
            compare(found, C, x0, member, rng)


def compare(found, C, x0, member, rng):
    """5.x0 and 5.4a against the set: -C x must have a neighbourhood in it."""
    inside = surrounds(-C @ x0, member, rng, 1e-4)
    assert found["5.x0"].verdict == ("holds" if inside else "violated")
    assert found["5.4b"].verdict == "holds"
    states = np.array(list(product((-3, -1, 0, 1, 3), repeat=C.shape[1])))
    some = any(surrounds(-C @ x, member, rng, 1e-4) for x in states)
    if found["5.4a"].verdict == "violated":
        assert not some
    elif "x" in found["5.4a"].witness:
        x = np.array(found["5.4a"].witness["x"])
        assert surrounds(-C @ x, member, rng, 1e-4 * min(1.0, np.abs(x).max() or 1.0))
    if some:
        assert found["5.4a"].verdict == found["5.4c"].verdict == "holds"


def test_verdicts_do_not_depend_on_units():
    rng = np.random.default_rng(5)
    for _ in range(40):
        m = rng.integers(2, 4)
        D, C, x0 = random_psd(rng, m), rng.integers(-2, 3, (m, 2)), rng.integers(-2, 3, 2)
        units = 2.0 ** rng.integers(-30, 31, m)
        law = complementarity(int(m))
        scaled = verdicts(units[:, None] * C, units[:, None] * D * units, law, x0)
        assert scaled == verdicts(C, D, law, x0)


# -- worked answers -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("C", "x0", "meets", "start"), [
    ([[1], [1]], [1], "holds", "holds"), ([[1], [-1]], [1], "violated", "violated"), ([[1], [0]], [1], "violated", "violated"),
    ([[1], [2]], [0], "holds", "violated"),
])  # fmt: skip
def test_cone_without_feedthrough_asks_that_the_outputs_can_be_positive(C, x0, meets, start):
    found = verdicts(C, np.zeros((2, 2)), complementarity(2), x0)
    assert (found["5.4a"], found["5.x0"], found["5.4b"], found["5.4c"]) == (meets, start, "holds", "holds")


def test_definite_feedthrough_and_bounded_laws_ask_nothing():
    for law, D in ((complementarity(2), [[1, 5], [-5, 1e-9]]), (relay(2), np.zeros((2, 2))), (ball(2), np.zeros((2, 2)))):
        found = verdicts([[0], [0]], D, law, [1])
        assert {found[id] for id in ("3.1", "5.4a", "5.4b", "5.4c", "5.x0")} == {"holds"}


def test_skew_feedthrough_is_a_real_condition():
    # Delta = {z_1 = 0, z_2 >= 0}: l_2 makes up for any y_1, nothing for y_2 <= 0.
    skew = [[0, 1], [-1, 0]]
    assert verdicts([[0], [1]], skew, complementarity(2), [1])["5.x0"] == "holds"
    found = decided([[-1], [0]], skew, complementarity(2), [1])
    assert found["5.x0"].verdict == found["5.4a"].verdict == "violated"
    assert found["5.4a"].witness["w"] == [0, 1]


def test_equality_without_feedthrough_empties_the_interior():
    found = decided([[1]], [[0]], equality(1), [0])
    assert found["5.4a"].verdict == found["5.4c"].verdict == found["5.x0"].verdict == "violated"
    assert found["5.4a"].witness["v"] == [1]
    assert verdicts([[1]], [[1]], equality(1), [3])["5.x0"] == "holds"


def test_margin_is_the_distance_to_the_boundary():
    assert decided([[3], [5]], np.zeros((2, 2)), complementarity(2), [1])["5.x0"].value["margin"] == pytest.approx(3)


def test_round_off_in_the_data_is_taken_as_it_is():
    found = decided([[1, 1, -1]], [[0]], complementarity(1), [0.1, 0.2, 0.3])["5.x0"]
    assert found.verdict == "holds"  # The doubles 0.1 + 0.2 - 0.3 sum to 2^-55 + ... > 0, and the margin says how little.
    assert 0 < found.value["margin"] < 1e-16


@pytest.mark.parametrize(("x0", "start"), [([2, 1, 1], "holds"), ([5, 3, 4], "violated"), ([1, 3, 4], "violated")])
def test_second_order_cone(x0, start):
    found = decided(np.eye(3), np.zeros((3, 3)), second_order_cone(3), x0)
    assert (found["5.4a"].verdict, found["5.4b"].verdict, found["5.x0"].verdict) == ("holds", "holds", start)


def test_second_order_cone_that_the_range_misses():
    found = decided([[1], [2], [0]], np.zeros((3, 3)), second_order_cone(3), [1])["5.4a"]
    w = np.array(found.witness["w"])
    assert found.verdict == "violated"
    assert w @ [1, 2, 0] == 0
    assert w[0] >= np.linalg.norm(w[1:])


def test_second_order_cone_with_feedthrough_in_one_direction():
    # D acts on l_0 only; ker(D + D') = {z_0 = 0} holds no point of the cone but 0.
    found = verdicts(np.zeros((3, 1)), np.diag([1, 0, 0]), second_order_cone(3), [0])
    assert {found[id] for id in ("5.4a", "5.4b", "5.4c", "5.x0")} == {"holds"}
    assert verdicts(np.zeros((3, 1)), np.diag([0, 1, 0]), second_order_cone(3), [0])["5.4b"] == "unknown"


def test_law_without_interior():
    for law in (relay(1, 2, 2), ball(2, 0), polyhedron([[1, 0], [-1, 0]], [1, -1]), polyhedron([[1.0], [-1.0]], [1, 0])):
        m = law.size
        assert verdicts(np.ones((m, 1)), np.eye(m), law, [1])["3.1"] == "violated"
    assert decided([[1]], [[0]], polyhedron([[1], [-1], [0]], [0, -4, 0]))["3.1"].value["width"] == pytest.approx(4)


def test_feedthrough_that_is_psd_up_to_rounding_proves_nothing():
    v = np.array([[0.1], [0.2], [0.3]])
    D = v @ v.T
    D[0, 0] -= 1e-18
    assert not exact.definiteness(D).psd
    found = verdicts(np.ones((3, 1)), D, complementarity(3), [1])
    assert {found[id] for id in ("5.4a", "5.4b", "5.4c", "5.x0")} == {"sampled"}
    assert verdicts(np.ones((3, 1)), D, relay(3), [1])["5.4b"] == "holds"  # K is bounded: D does not matter


def test_indefinite_feedthrough_leaves_the_range_open():
    found = verdicts([[1]], [[-1]], complementarity(1), [1])
    assert (found["5.4b"], found["5.4c"]) == ("unknown", "unknown")
    assert verdicts([[1]], [[-1]], relay(1), [1])["5.4b"] == "holds"


# -- potentials -----------------------------------------------------------------------------------------------------------


def indicator(*rows):
    value = ca.SX(0)
    for row in rows:
        value = ca.if_else(row >= 0, value, ca.inf)
    return value


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_potentials_that_are_laws_agree_with_the_laws(seed):
    rng = np.random.default_rng(seed)
    pairs = [
        (lambda y: ca.fabs(y[0]) + ca.fabs(y[1]), relay(2)),
        (lambda y: indicator(y[0], y[1]), complementarity(2)),
        (lambda y: indicator(y[0]) + ca.fmax(-2 * y[1], 0), nsmodel.product(complementarity(1), relay(1, 0, 2))),
        (lambda y: indicator(y[0], -y[0]) + ca.fabs(y[1]), nsmodel.product(equality(1), relay(1))),
        (lambda y: indicator(2 * y[0] + y[1], y[1] - y[0]) , polyhedron([[1 / 4, 1 / 4], [-1 / 4, 1 / 2]], [0, 0])),
    ]  # fmt: skip
    for phi, law in pairs:
        for _ in range(share(12, 3)):
            D, C, x0 = random_psd(rng, 2), rng.integers(-2, 3, (2, 2)), rng.integers(-2, 3, 2)
            assert verdicts(C, D, x0=x0, phi=phi) == verdicts(C, D, law, x0)


@pytest.mark.parametrize("seed", range(3))
def test_quadratic_potentials_on_cones_against_complementary_cones(seed):
    """l = -(Q y + b) + J'n with 0 <= n _|_ J y + c >= 0, y = C x + D l, is an LCP in n: I + D Q is regular for psd D, Q."""
    rng, seen = np.random.default_rng(seed), set()
    while len(seen) < 30:
        D, C, x0 = random_psd(rng, 2), rng.integers(-2, 3, (2, 2)), rng.integers(-2, 3, 2)
        a = rng.integers(-1, 2, (1, 2))
        Q, J, b, c = a.T @ a * 1.0, rng.integers(-2, 3, (2, 2)) * 1.0, rng.integers(-1, 2, 2), rng.integers(-1, 2, 2)
        if abs(np.linalg.det(J)) < 0.5:
            continue
        inverse = np.linalg.inv(np.eye(2) + D @ Q)
        M = J @ inverse @ D @ J.T

        def member(p):
            q = J @ inverse @ (p - (D @ b)[:, None]) + c[:, None]  # noqa: B023
            return in_range_of_boxes(-q, M, np.zeros(2), np.full(2, INF))  # noqa: B023

        def phi(y):
            smooth = ca.dot(y, ca.DM(Q) @ y) / 2 + ca.dot(ca.DM(b), y)  # noqa: B023
            return smooth + indicator(*ca.vertsplit(ca.DM(J) @ y + ca.DM(c)))  # noqa: B023

        verdict = decided(C, D, x0=x0, phi=phi)["5.x0"].verdict
        assert verdict == ("holds" if surrounds(C @ x0, member, rng, 1e-4) else "violated")
        seen.add((verdict, len(seen)))
    assert {verdict for verdict, _ in seen} == {"holds", "violated"}


def test_finite_potentials_ask_nothing():
    for phi in (
        lambda y: ca.sumsqr(y) / 2 + ca.fabs(y[0]),
        lambda y: ca.sqrt(1 + y[0] ** 2) + ca.sqrt(1 + y[1] ** 2),
        lambda y: ca.norm_2(y) + y[0] ** 4 + y[1] ** 2,
    ):
        found = verdicts([[1], [0]], np.zeros((2, 2)), x0=[1], phi=phi)
        assert {found[id] for id in ("3.1", "5.4a", "5.4c", "5.x0", "7.1")} == {"holds"}


def test_quadratic_on_a_half_plane():
    # dom Phi = {y_0 >= 1}, D = 0: C x0 must be inside.
    phi = lambda y: indicator(y[0] - 1) + y[0] ** 2  # noqa: E731
    assert verdicts(np.eye(2), np.zeros((2, 2)), x0=[2, 0], phi=phi)["5.x0"] == "holds"
    found = decided(np.eye(2), np.zeros((2, 2)), x0=[1, 0], phi=phi)
    assert found["5.x0"].verdict == "violated"
    assert found["3.1"].verdict == "violated"  # Phi does not depend on y_1.
    assert found["3.1"].witness["direction"] == [0, 1]


def test_potential_that_is_nowhere_finite_proves_nothing():
    found = verdicts([[1]], [[1]], x0=[1], phi=lambda y: indicator(-1 - y[0] ** 2))
    assert set(found.values()) == {"unknown"}
    found = verdicts([[1]], [[1]], x0=[1], phi=lambda y: indicator(y[0] - 1, -y[0] - 1))
    assert found.pop("7.1") == "violated"  # y = 0 is outside the domain.
    assert set(found.values()) == {"unknown"}


def test_what_is_not_understood_is_said():
    found = decided([[1]], [[1]], x0=[1], phi=lambda y: -ca.log(y))
    assert {found[id].verdict for id in ("3.1", "5.4a", "5.4b", "5.4c", "5.x0", "7.1")} == {"unknown"}
    assert "not proved to be convex" in found["5.4a"].how
    curved = lambda y: indicator(1 - y[0] ** 2)  # noqa: E731
    assert "curved" in decided([[1]], [[0]], x0=[1], phi=curved)["5.4a"].how
    assert verdicts([[1]], [[1]], x0=[1], phi=curved)["5.4a"] == "holds"  # D > 0 asks nothing of the domain


# -- 7.1 ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("law", "D", "extra", "verdict", "failing"), [
    (relay(1), 0, {}, "holds", None),
    (relay(1), 0, {"A": lambda x: ca.sin(x) * ca.exp(x)}, "holds", None),
    (relay(1), 0, {"A": lambda x: x + 1}, "violated", "A(0) = 0"),
    (relay(1, 1, 2), 0, {}, "violated", "0 in (D + dXi)^-1(0)"),
    (complementarity(1), 0, {}, "violated", "0 in X_0"),
    (complementarity(1), 1, {}, "holds", None),
    (relay(1), 0, {"f": [ca.sin(TIME)]}, "violated", "f = 0"),
    (polyhedron([[1.0]], [1.0]), 1, {}, "violated", "0 in (D + dXi)^-1(0)"),
])  # fmt: skip
def test_rest_at_the_origin(law, D, extra, verdict, failing):
    x = ca.SX.sym("x")
    A = extra.get("A", lambda x: -x)(x)
    model = LureSystem(t=TIME, x=x, A=A, B=[1], C=[1], D=[[D]], law=law, x0=[1], f=extra.get("f"), t_end=1, step=0.1)
    found = range_findings(model.bind(), quick=True)[-1]
    assert found.verdict == verdict
    assert found.witness.get("part") == failing


@pytest.mark.parametrize(("phi", "verdict"), [
    (lambda y: ca.fabs(y[0]) + y[0] / 2, "holds"), (lambda y: ca.fabs(y[0]) + 2 * y[0], "violated"),
    (lambda y: ca.fabs(y[0] - 1) + y[0] ** 2, "violated"), (lambda y: ca.fabs(y[0] - 1) + y[0], "holds"),
    (lambda y: indicator(y[0]) + y[0] + y[0] ** 2, "violated"),
])  # fmt: skip
def test_rest_at_the_origin_of_a_potential(phi, verdict):
    assert verdicts([[1]], [[0]], phi=phi, A=[[-1]])["7.1"] == verdict


# -- strict feasibility ---------------------------------------------------------------------------------------------------


def test_every_answer_is_a_proof():
    rng = np.random.default_rng(0)
    for _ in range(300):
        r, n = rng.integers(1, 5), rng.integers(3, 9)
        A = rng.integers(-2, 3, (r, n)) * 1.0
        units = 10.0 ** rng.integers(-9, 10, (r, 1))
        for cones in ((), ((0, 1, 2),)):
            system = ConicSystem(exact.rational(A if cones else units * A), tuple(range(3 if cones else 1, n)), cones)
            answer = conic.decide_feasibility(system)
            assert (answer.point is None) != (answer.separator is None)
            if answer.point is not None:
                assert conic.is_strict_solution(system, answer.point)
            else:
                assert conic.is_separator(system, answer.separator)


def test_cases_are_proved(cases_of):
    on_the_boundary = "half_wave_rectifier"  # is where it starts
    for stem, model in cases_of(LureSystem).items():
        if model.inputs or model.blocks:
            continue
        found = {finding.id: finding for finding in range_findings(model.bind(), quick=False)}
        for id in ("3.1", "5.4a", "5.4b", "5.4c", *(["5.x0"] if stem != on_the_boundary else [])):
            assert found[id].verdict == "holds", (stem, id, found[id].how)


def test_what_rests_on_a_kernel_that_rounding_decides_is_not_proved():
    rng, seen = np.random.default_rng(3), 0
    for _ in range(40):
        v = rng.normal(size=2)
        D = np.outer(v, v)
        if not exact.definiteness(D).definite:
            continue
        seen += 1
        found = verdicts(np.eye(2), D, equality(2), [1.0, 1.0])  # by v v' itself: y = C x0 + v (v'l) is not 0
        assert found["5.4a"] == found["5.x0"] == "sampled"
        assert verdicts(np.eye(2), D + np.eye(2), equality(2), [1.0, 1.0])["5.x0"] == "holds"
    assert seen > 5


def test_psd_up_to_rounding_means_the_same_in_all_findings():
    skew = np.array([[0, 1], [np.nextafter(-1, 0), 0]])
    found = verdicts(np.eye(2), skew, complementarity(2), [1.0, 1.0])
    assert {found[id] for id in ("5.4a", "5.4b", "5.4c", "5.x0")} == {"sampled"}


def test_a_forcing_that_is_not_a_number_is_not_zero():
    assert verdicts([[1.0]], [[0.0]], relay(1), [0.0], f=[ca.sqrt(TIME - 2)])["7.1"] == "violated"


def test_a_potential_that_is_flat_to_second_order_at_0_only():
    assert verdicts([[1.0]], [[0.0]], x0=[0.0], phi=lambda y: y[0] ** 4)["3.1"] == "holds"  # Phi* is finite everywhere
    two = verdicts(np.eye(2), np.zeros((2, 2)), x0=[0.0, 0.0], phi=lambda y: (y[0] + y[1]) ** 4)
    assert two["3.1"] != "holds"  # affine along (1, -1)
