"""Where a verdict speaks, and where it does not: boxes, times, clauses, and what is known to fail outside."""

from __future__ import annotations

import json

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

import nsmodel
from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, ManyBodies, MonotoneInclusion, SweepingProcess, check, relay
from nsmodel.hypotheses.findings import Scope, intersect_scopes
from nsmodel.proof.domain import check_defined_in_time

t, q, S = ca.SX.sym("t"), ca.SX.sym("q", 2), ca.SX.sym("s")
x, y = q[0], q[1]


def swept(g, q0, f=(0, 0), t_end=1.0, step=0.05, **more):
    constraints = g if isinstance(g, dict) else {"wall": g}
    return SweepingProcess(t=t, q=q, constraints=constraints, f=ca.vertcat(*f), q0=q0, t_end=t_end, step=step, **more)


def consequences(report):
    return {item.name: item for item in report.consequences}


# -- time --------------------------------------------------------------------------------------------------------------

TIMES = {
    "pole": (1 / (t - 0.5123), 0.5123),
    "double pole": (1 / (t - 0.5123) ** 2, 0.5123),
    "tangent": (ca.tan(np.pi * t), 0.5),
    "logarithm": (ca.log(ca.fabs(t - 0.5123)), 0.5123),
    "integrable": (1 / ca.sqrt(ca.fabs(t - 0.5123)), 0.5123),
    "root": (ca.sqrt(0.5123 - t), 0.5123),
    "on the grid": (1 / (0.5 - t), 0.5),
}


@pytest.mark.parametrize("name", TIMES)
def test_a_velocity_that_is_not_finite_at_some_time_is_no_velocity(name):
    f, at = TIMES[name]
    report = check(swept(ca.norm_2(q) - 1, [2, 0], (f, 0)), [])
    assert report["S-f"].verdict == "violated"
    assert report["S-f"].witness["t"] == pytest.approx(at, abs=1e-9)
    assert consequences(report)["well posed"].verdict == "unknown"


@pytest.mark.parametrize(
    ("f", "verdict"),
    [
        (ca.sqrt(t), "holds"), (ca.if_else(t < 0.5, ca.sqrt(0.5 - t), 0), "holds"), (1 / (2 + ca.sin(30 * t)), "holds"),
        (1 / (1 + (t - 0.3) ** 2), "holds"), (ca.sqrt(ca.fmax(t - 0.5, 0)), "holds"), (ca.sin(t) / t, "unknown"),
        (t * ca.log(t), "unknown"), (1 / (ca.exp(t) - 2), "violated"), (ca.acos(2 * t), "violated"), (ca.log1p(-t), "violated"),
        (1 / ca.sin(3 * t - 1), "violated"), (ca.sqrt(1 + ca.cos(20 * t)), "holds"),
    ],
)  # fmt: skip
def test_operations_with_a_domain_are_decided_on_the_interval(f, verdict):
    assert check_defined_in_time(f, t, 0.0, 1.0).verdict == verdict


def test_random_poles_and_roots_of_time_are_found_where_they_are():
    """Polynomials and sines with planted roots, inside and outside of the interval."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        c, inside = rng.uniform(-2, 3), None
        inside = 0 <= c <= 1
        u = {0: t - c, 1: (t - c) * (t**2 + rng.uniform(0.1, 1)), 2: ca.sin(t - c), 3: ca.exp(t) - np.exp(c)}[
            int(rng.integers(4))
        ]
        found = check_defined_in_time({0: 1 / u, 1: ca.log(ca.fabs(u)), 2: u**-3}[int(rng.integers(3))], t, 0.0, 1.0)
        assert found.verdict == ("violated" if inside else "holds"), (u, c, found)
        if inside:
            assert found.at == pytest.approx(c, abs=1e-9)


def test_a_constraint_that_is_not_finite_at_some_time_does_not_move_at_bounded_speed():
    report = check(swept(x + 3 + 0.1 / (t - 0.7), [2, 0]), [])
    assert report["A2"].verdict == "violated"
    assert report["A2"].witness["t"] == pytest.approx(0.7)


def test_no_proof_has_an_infinite_constant():
    with pytest.raises(ValueError, match="holds' with K infinite"):
        nsmodel.hypotheses.findings.make_finding(
            nsmodel.hypotheses.findings.Hypothesis("A", "s", "p"), "holds", "how", {"K": np.inf}
        )


def test_a_first_order_system_with_a_pole_in_time():
    z, l = ca.SX.sym("z"), ca.SX.sym("l")
    model = FirstOrderSystem(
        t=t, x=z, lam=l, f=-z + 1 / (t - 0.5), h=z, g=l, law=relay(1), x0=[1], t_end=1, step=0.1
    )  # fmt: skip
    report = check(model, [])
    assert report["F-jacobians"].verdict == "violated"
    assert report["F-unique"].verdict == "unknown"
    assert {item.verdict for item in report.consequences if item.name in ("one trajectory", "order")} == {"unknown"}


def test_what_was_seen_to_the_end_of_a_short_run_is_not_said_of_the_whole_time():
    """Two walls that close at t = 1."""
    model = swept({"left": x + 1 - t, "right": 1 - t - x}, [0, 0], t_end=2.0)
    short = nsmodel.simulate(model, t_end=0.5)
    report = check(model, [short])
    assert report["A5"].verdict != "holds"
    assert consequences(report)["well posed"].verdict == "unknown"
    early = check(swept({"left": x + 1 - t, "right": 1 - t - x}, [0, 0], t_end=0.5), [])
    assert early["A5"].verdict == "holds"
    assert early["A5"].scope.time == consequences(early)["well posed"].scope.time == (0, 0.5)


# -- boxes -------------------------------------------------------------------------------------------------------------


def test_prox_regularity_found_on_a_box_is_told_of_the_box():
    """The origin is at 0.1418 from Q, with two nearest points."""
    report = check(
        swept({"left": ca.norm_2(q + ca.vertcat(1, 0)) - 1.01, "right": ca.norm_2(q - ca.vertcat(1, 0)) - 1.01}, [0, 2]), []
    )
    found = consequences(report)["prox-regular"]
    if found.scope is None:
        assert found.value["eta"] <= 0.1418
    else:
        assert "inside the box" in found.statement
        assert "as a whole need not be prox-regular" in found.statement


def test_the_speed_of_a_set_found_on_a_box_is_told_of_the_box():
    left, right = (ca.norm_2(q + sign * ca.vertcat(1 + t, 0)) - 1.01 for sign in (1, -1))
    found = consequences(check(swept({"left": left, "right": right}, [0, 5], t_end=0.02, step=0.005), []))["K_L"]
    assert found.verdict != "holds" or (found.scope.states and "Nothing is said of Q(t) beyond" in found.statement)


def test_a_maximum_of_two_planes_is_not_called_convex_beyond_the_box():
    found = consequences(check(swept(ca.fmax(x, y), [3, 0.1]), [], region={"q_0": (2, 4), "q_1": (-1, 1)}))["prox-regular"]
    assert found.scope.states
    assert found.statement != "Q(t) is convex"
    assert "eta" not in found.value


def test_a_root_of_the_state_outside_the_box():
    """f = (0, sqrt y) from 0: two solutions, 0 and t^2/4."""
    model = swept({}, [0, 0], (0, ca.sqrt(ca.fmax(y, 0))))
    found = check(model, [], region={"q_0": (-1, 1), "q_1": (1, 2)})
    assert found["S-f"].verdict == "holds"
    assert found["S-f"].scope.states == {"q_0": (-1, 1), "q_1": (1, 2)}
    well = consequences(found)["well posed"]
    assert "stay inside the box" in well.clause
    assert well.until is None
    assert well.verdict == "unknown"
    assert "the start is not inside the box" in well.statement


def test_what_follows_for_solutions_in_a_box_asks_for_a_start_in_it():
    """x' = x^2 - p is looked at on a box; that two solutions in it part slowly does not depend on x0."""
    p, z = ca.SX.sym("p"), ca.SX.sym("z")
    for boxes, x0 in (({}, z * 0 + 0.5), ({p: (0.5, 3)}, p)):
        model = nsmodel.MonotoneInclusion(
            x=z, field=[z**2 - p], x0=[0.5 if not boxes else p], t_end=1, step=0.1, parameters={p: 1}
        )
        for region, inside in (((-1, 4), True), ((1, 4), False)):
            made = consequences(check(model, [], region={"z": region}, parameters=boxes or None))
            assert ("the start is not inside the box" in made["well posed"].statement) == (not inside), x0
            assert inside or made["well posed"].verdict == "unknown"
            assert boxes or made["stability"].verdict == "holds"


def test_two_pegs_and_one_body():
    """The same corner between two pegs, as a family of one body."""
    bodies = nsmodel.Bodies([[0.0, 2.0]], r=[0.5])
    i, pegs = bodies.member("i"), nsmodel.Items(q=[[-1.0, 0.0], [1.0, 0.0]], r=[0.51, 0.51])
    k = pegs.member("k")
    model = ManyBodies(
        bodies=bodies, constraints={"peg": nsmodel.Family(ca.norm_2(i.q - k.q) - i.r - k.r, i, k)}, t_end=1, step=0.1
    )  # fmt: skip
    found = consequences(check(model, []))["prox-regular"]
    assert found.verdict != "holds" or found.scope is not None or found.value["eta"] <= 0.1418


def test_a_one_sided_constant_of_the_box_is_told_of_the_box():
    z = ca.SX.sym("z")
    model = MonotoneInclusion(x=z, field=-(z - 10) + ca.tanh(ca.sqrt(ca.fabs(z - 10))), x0=[12], t_end=0.1, step=0.01)
    report = check(model)
    well = consequences(report)["well posed"]
    assert report["M-24"].scope.states
    assert "for all t" not in well.statement
    assert "stay inside the box" in well.clause


def test_a_regular_step_matrix_of_the_box_is_told_of_the_box():
    """1 - 2 h x = 0 at x = 1/(2 h)."""
    z = ca.SX.sym("z")
    model = FirstOrderSystem(x=z, f=z**2, x0=[0.1], t_end=0.2, step=0.1)
    report = check(model, [])
    assert report["F-step"].scope.states
    assert consequences(report)["W for smaller steps"].scope.states


OUTSIDE = {
    "1 - cos": lambda z: FrictionOscillator(x=z, potential=1 - ca.cos(z), s=S, friction=S, x0=[0.5], t_end=1, step=0.1),
    "double well": lambda z: FrictionOscillator(x=z, potential=(z**2 - 1) ** 2, s=S, friction=S, x0=[1.1], t_end=1, step=0.1),
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_potential_convex_on_the_box_alone_names_a_point_where_it_is_not(name):
    z = ca.SX.sym("z")
    model = OUTSIDE[name](z)
    finding = check(model, [])["O-g"]
    assert finding.verdict == "holds"
    assert finding.scope.states
    at = finding.outside["x"]
    H = ca.Function("H", [z], [ca.hessian(model.potential, z)[0]])
    assert float(H(at)) < 0
    assert not finding.scope.states["z"][0] <= at[0] <= finding.scope.states["z"][1]


def test_a_jump_outside_the_box_is_named():
    z = ca.SX.sym("z")
    model = MonotoneInclusion(x=z, field=-z + ca.if_else(z > 10, 1, 0), x0=[1], t_end=1, step=0.1)
    finding = check(model, [], region={"z": (-2, 2)})["M-A1"]
    assert finding.scope.states == {"z": (-2, 2)}
    assert finding.outside["x"] == pytest.approx([10])


def test_an_operator_that_jumps_down_outside_the_box_does_not_hold_everywhere():
    z = ca.SX.sym("z")
    model = MonotoneInclusion(x=z, field=-z, operator=ca.if_else(z > 0, -1, 1), x0=[0.3], t_end=0.1, step=0.01)
    finding = check(model, [])["M-T"]
    assert finding.verdict == "violated" or (finding.scope is not None and finding.scope.states)


def test_convexity_of_a_cubic_is_told_of_the_box():
    finding = check(swept(x**3 + y - 1, [2, 1]), [], region={"q_0": (1, 3), "q_1": (0, 2)})["S-convex"]
    assert finding.verdict == "holds"
    assert finding.scope.states == {"q_0": (1, 3), "q_1": (0, 2)}
    assert finding.outside["q_0"] < 0


# -- how long the solution stays inside --------------------------------------------------------------------------------


def test_a_solution_does_not_leave_the_box_before_the_time_that_is_proved():
    """Random fields in a box, a disc in the way: |q'| <= sup |f| while the disc stands, sqrt(sup|f|^2 + K_L^2) when it moves."""
    rng, told = np.random.default_rng(3), 0
    for k in range(share(12, 4)):
        A, b, speed = rng.normal(size=(2, 2)), rng.normal(size=2), (k % 2) * rng.uniform(0.1, 0.5)
        f = ca.sin(ca.DM(A) @ q) + ca.DM(b) + 0.1 * ca.vertcat(x**3, y**3)
        model = swept(ca.norm_2(q - ca.vertcat(speed * t - 2, 0)) - 1, [0, 0], (f[0], f[1]), t_end=0.4, step=0.004)
        report = check(model, [], region={"q_0": (-0.8, 0.8), "q_1": (-0.8, 0.8)})
        well = consequences(report)["well posed"]
        if well.verdict != "holds" or well.until is None:
            continue
        told += 1
        run = nsmodel.simulate(model)
        assert np.abs(run.x[run.t <= well.until]).max() < 0.8
        assert f"for t <= {well.until:.5g}" in well.clause
    assert told >= share(12, 4) / 3


def test_an_inclusion_stays_inside_as_long_as_its_speed_allows():
    z = ca.SX.sym("z")
    model = MonotoneInclusion(x=z, field=1 + 0.1 * z**2, phi=ca.fabs(z), x0=[0.0], t_end=2, step=0.01)
    well = consequences(check(model, [], region={"z": (-1, 1)}))["stability"]
    assert well.scope.states == {"z": (-1, 1)}
    assert well.until is None or well.until == pytest.approx(0.99 / 2.1, rel=0.1)


# -- the report --------------------------------------------------------------------------------------------------------


def test_the_intersection_of_scopes():
    a, b = Scope({"x": (0, 2)}, (0, 1)), Scope({"x": (1, 3), "y": (0, 1)}, (0.5, 2), {"k": (1, 2)})
    assert intersect_scopes(a, b) == Scope({"x": (1, 2), "y": (0, 1)}, (0.5, 1), {"k": (1, 2)})
    assert intersect_scopes(a, None) == a
    assert intersect_scopes(None, None) is None


def test_scope_is_data_in_every_form_of_the_report(tmp_path):
    model = swept({}, [0, 1.5], (0, ca.sqrt(ca.fmax(y, 0)) + 0 * t))
    report = check(model, [], region={"q_0": (-1, 1), "q_1": (1, 2)})
    plain = json.loads(nsmodel.files.storage.dumps(report.document()))
    assert all("scope" in item for item in [*plain["findings"], *plain["consequences"]])
    finding = next(item for item in plain["findings"] if item["id"] == "S-f")
    assert finding["scope"] == {"states": {"q_0": [-1, 1], "q_1": [1, 2]}, "time": None, "parameters": None}
    assert next(item for item in plain["findings"] if item["id"] == "A1")["scope"] is None
    assert "on the box: f is continuous" in report.text()
    assert "stay inside the box" in " ".join(report.text().split())
    assert "stay inside the box" in report.markdown()
    assert "on a box of states" in report.verdict


def test_a_lure_system_with_a_forcing_is_well_posed_for_its_times():
    model = LureSystem(A=[[-1]], B=[1], C=[1], f=[ca.sin(t)], t=t, law=relay(1), x0=[1], t_end=3, step=0.1)
    found = consequences(check(model, []))
    assert found["well posed"].scope.time == (0, 3)
    assert found["contraction"].scope.time == (0, 3)
    assert (
        consequences(check(LureSystem(A=[[-1]], B=[1], C=[1], law=relay(1), x0=[1], t_end=3, step=0.1), []))["well posed"].scope
        is None
    )
