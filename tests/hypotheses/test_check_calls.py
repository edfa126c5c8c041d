"""Functions that are not inlined: what they do inside is not seen, and nothing about them may be proved."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from nsmodel import FrictionOscillator, LureSystem, MonotoneInclusion, SweepingProcess, check, relay
from nsmodel.proof import polynomial
from nsmodel.proof.convex import rules
from nsmodel.proof.expression_graph import apply_operation, fold_graph, operation_codes

u, x, s, t = (ca.SX.sym(name) for name in ("u", "x", "s", "t"))
CONCAVE = ca.Function("concave", [u], [-(u**2)], {"never_inline": True})
LATE = ca.Function("late", [u], [1 + 3 * u], {"never_inline": True})
GRID = {"t_end": 1, "step": 0.1}


def test_a_walk_gives_the_values_of_the_graph():
    a = ca.SX.sym("a", 2)
    expr = ca.vertcat(ca.fmax(a[0], 2 * a[1]) ** 2, ca.if_else(a[0] < 1, ca.exp(a[1]), -a[0]), 3)
    at = {"a_0": 0.3, "a_1": -0.7}
    results = fold_graph(
        expr, lambda node: ca.SX(at[node.name()]), ca.SX, lambda op, args: apply_operation(op, args)
    )  # numbers: CasADi folds them
    assert np.array(ca.DM(ca.vertcat(*results))).ravel() == pytest.approx(
        np.array(ca.Function("f", [a], [expr])([0.3, -0.7])).ravel(), rel=1e-15
    )


def test_a_call_is_not_built_from_its_code():
    """CasADi itself would give 0, and a proof about it would be one about 0."""
    assert ca.OP_CALL in operation_codes(CONCAVE(x))
    with pytest.raises(ValueError, match="a call cannot be built from its code"):
        apply_operation(ca.OP_CALL, [x])


def test_nothing_is_read_off_a_call():
    expr = CONCAVE(x) + x
    assert polynomial.read_polynomials(expr, x) == [None]
    assert rules.find_ridges(expr, x) is None
    (shape,) = rules.global_curvatures(expr, x)
    assert not shape.convex
    assert not shape.concave


@pytest.mark.parametrize("quick", [True, False])
def test_a_concave_potential_in_a_call_is_not_called_convex(quick):
    oscillator = FrictionOscillator(x=x, potential=CONCAVE(x), friction=s, s=s, x0=1, **GRID)
    assert check(oscillator, [], quick=quick)["O-g"].verdict == "violated"
    inclusion = check(MonotoneInclusion(x=x, field=-x, phi=CONCAVE(x), lower=0, x0=1, **GRID), [], quick=quick)
    assert inclusion["M-T"].verdict == "violated"
    assert inclusion["M-24"].verdict != "holds"  # L = -1 + 2: the operator pushes outwards


def test_a_radius_that_grows_in_a_call_moves_the_constraint():
    """|d_t g| = 3."""
    q = ca.SX.sym("q", 2)
    model = SweepingProcess(t=t, q=q, constraints={"disc": ca.norm_2(q) - LATE(t)}, q0=[8, 0], **GRID)
    finding = check(model, [], quick=True)["A2"]
    assert finding.verdict != "violated"
    assert finding.value["b"] == pytest.approx(3, rel=1e-6)


def test_a_rate_in_a_call_is_checked_as_far_as_it_can_be_seen():
    report = check(LureSystem(x=x, A=[CONCAVE(x)], B=[1], C=[1], law=relay(1), x0=[1], **GRID), [], quick=True)
    assert report["7.1"].verdict != "holds"
    assert report["5.2"].verdict != "holds"
