"""Sweeping processes whose parameters lie in a box: closed forms, and dense values."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL

from nsmodel import SweepingProcess, check

p, t = ca.SX.sym("p"), ca.SX.sym("t")
q = ca.SX.sym("q", 2)


def sweeping(constraints, f=(0, 0), q0=(3.0, 0.0), **more):
    given = {"t": t, "q": q, "f": ca.vertcat(*f), "constraints": constraints, "q0": q0, "t_end": 1, "step": 0.01}
    return SweepingProcess(**given, parameters={p: 1.0}, **more)


def decided(model, box, region=None):
    report = check(model, parameters={"p": box}, quick=True, region=region)
    return report, {finding.id: finding for finding in report.findings}


def test_a_disc_of_unknown_radius_that_moves_at_unknown_speed():
    centre = ca.vertcat(p * t, 0)
    model = sweeping({"disc": ca.norm_2(q - centre) - p, "floor": q[1] + 2 - ca.sin(p)}, f=(-p, ca.sin(q[0])), q0=(4.0, 0.0))
    report, found = decided(model, (0.5, 2))
    assert {found[id].verdict for id in ("S-convex", "A0", "A1", "A2", "A3", "A4", "S-f", "S-start")} == {"holds"}
    assert found["A1"].value["a"] == found["A1"].value["b"] == 1
    assert found["A2"].value["b"] == pytest.approx(2, rel=1e-9)  # the fastest disc
    assert found["A4"].value["M_contact"] == pytest.approx(2, rel=1e-9)  # 1 / the least radius
    assert found["A0"].value["c"] == pytest.approx(0.25)
    assert found["S-f"].value["K_f"] == pytest.approx(1, rel=1e-9)
    assert dict(found["A4"].scope.parameters) == {"p": (0.5, 2)}
    assert all(item.scope.parameters for item in report.consequences)


def test_what_the_parameter_does_not_touch_has_no_scope_of_it():
    _, found = decided(sweeping({"disc": ca.norm_2(q) - 1}, f=(p, -q[1])), (0.5, 2))
    assert found["A5"].verdict == found["A4"].verdict == "holds"
    assert found["A4"].scope is None
    assert found["S-f"].verdict == "holds"
    assert found["S-f"].value["K_f"] == pytest.approx(1)
    assert found["S-f"].value["L_f"] >= 2


def test_gamma_of_two_discs_at_an_unknown_distance():
    discs = {"left": ca.norm_2(q + ca.vertcat(p, 0)) - 1, "right": ca.norm_2(q - ca.vertcat(p, 0)) - 1}
    _, apart = decided(sweeping(discs, q0=(0.0, 3.0)), (1.5, 2))
    assert apart["A5"].verdict == "holds"
    _, near = decided(sweeping(discs, q0=(0.0, 3.0)), (0.5, 0.75))
    worst = 1 / np.sqrt(1 - 0.75**2)  # in the corner the normals are (+-p, sqrt(1 - p^2))
    assert near["A5'"].verdict == "holds"
    assert worst * (1 - 1e-9) <= near["A5'"].value["gamma"]
    for at in np.linspace(0.5, 0.75, 11):
        single = check(sweeping(discs, q0=(0.0, 3.0)), parameters={"p": at}, quick=True)["A5'"]
        assert single.value["attained"] <= near["A5'"].value["gamma"] * (1 + 1e-9)
    _, touching = decided(sweeping(discs, q0=(0.0, 3.0)), (0.75, 1.5))  # they touch at p = 1
    assert touching["A5'"].verdict != "holds"


def test_a_start_that_is_inside_for_some_values_only():
    _, found = decided(sweeping({"wall": q[0] - p}, q0=(1.5, 0.0)), (0, 2))
    assert found["S-start"].verdict == "violated"
    assert found["S-start"].witness["p"] > 1.5
    _, found = decided(sweeping({"wall": q[0] - p}, q0=(p, 0.0)), (0, 2))
    assert found["S-start"].verdict == "holds"


def test_other_shapes_are_looked_at_at_values():
    _, found = decided(sweeping({"bowl": q[1] - p * q[0] ** 2}, q0=(0.0, 1.0)), (-1, 1))
    assert found["S-convex"].verdict == "violated"
    _, found = decided(sweeping({"bowl": q[1] + p * q[0] ** 2 + 1}, q0=(0.0, 1.0)), (0.5, 1))
    assert found["S-convex"].verdict in ("sampled", "holds")


@pytest.mark.long
def test_random_scenes_are_bounded_at_dense_values():
    rng = np.random.default_rng(2)
    proved = tried = 0
    for _ in range(max(2, 12 * COUNT // FULL)):
        g = {}
        for k in range(2):
            centre = ca.vertcat(*rng.uniform(-3, 3, 2)) + ca.vertcat(*rng.normal(size=2)) * p * t
            g[f"disc_{k}"] = ca.norm_2(q - centre) - rng.uniform(0.3, 0.6) * (1 + p * p)
        g["plane"] = ca.dot(ca.DM(rng.normal(size=2)), q) + 5 + ca.sin(p * t)
        model = sweeping(g, f=(ca.tanh(p * q[0]), -q[1]), q0=(0.1, 5.0))
        _, found = decided(model, (0.25, 1))
        for at in np.linspace(0.25, 1, 4):
            single = {item.id: item for item in check(model, parameters={"p": at}, quick=True).findings}
            for id, name, sign in (
                ("A1", "a", -1),
                ("A1", "b", 1),
                ("A2", "b", 1),
                ("A3", "M", 1),
                ("A4", "M", 1),
                ("A0", "c", -1),
            ):
                tried += 1
                if found[id].verdict == "holds" and single[id].verdict == "holds":
                    proved += 1
                    assert sign * single[id].value[name] <= sign * found[id].value[name] + 1e-9
            assert found["S-f"].verdict == "holds"
            assert found["S-f"].value["K_f"] >= max(1, at) * (1 - 1e-9)
            if found["S-start"].verdict == "holds":
                assert single["S-start"].verdict == "holds"
    assert proved > 0.4 * tried
