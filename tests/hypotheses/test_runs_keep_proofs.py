"""Runs take part in a check as points, steps and boxes; what is decided without them stays decided."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import partial
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
import pytest
from search.checked import draw

import nsmodel
from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    ManyBodies,
    StepError,
    UsageError,
    check,
    complementarity,
    pwm,
    simulate,
)
from nsmodel.hypotheses.region import region_of
from nsmodel.models.first_order_system.step_matrix import MlcpOfStep
from nsmodel.proof import exact

DECIDED = {"holds", "violated"}


def buck(duty: float, parts: int = 20, **changes: Any) -> FirstOrderSystem:
    """A buck converter whose duty is a parameter: steps end at its edges."""
    x, l, u, d = ca.SX.sym("x", 2), ca.SX.sym("l"), ca.SX.sym("u"), ca.SX.sym("d")
    L, C, R, E, T = 1e-3, 1e-4, 10.0, 12.0, 1e-4
    given = {
        "x": x, "lam": l, "f": [(E * u - x[1] - 0.1 * x[0]) / L, (x[0] - x[1] / R) / C], "g": [l / L, 0], "h": [x[0]],
        "law": complementarity(1), "inputs": {u: pwm(T, d)}, "parameters": {d: duty}, "x0": [1.0, 0.0], "t_end": 10 * T,
        "step": T / parts,
    }  # fmt: skip
    return FirstOrderSystem(**(given | changes))


def leaving() -> ManyBodies:
    """Two discs above a curved floor, of which the first leaves."""
    people = Bodies(q0=[(0.0, 0.0), (1.5, 0.0)], r=[0.5, 0.5])
    i, j = people.member("i"), people.member("j")
    families = {"apart": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j), "floor": Family(i.q[1] + 2 + 0.1 * i.q[0] ** 2 - i.r, i)}
    return ManyBodies(bodies=people, f=[1.0, 0.0], constraints=families, leave=i.q[0] - 2, t_end=1.0, step=0.05)


def runs_of(model: Any) -> list[Any]:
    """Runs of a model: its own, a short one, one with other steps, one under error control."""
    own = {"t_end": model.t_end, "step": model.step}
    found = []
    for changes in ({}, {"t_end": 0.731 * own["t_end"]}, {"step": own["step"] and own["step"] * np.pi / 3}, {"rtol": 1e-3}):
        try:
            found.append(simulate(model, **changes))
        except (StepError, UsageError) as error:
            found += [error.trajectory] if getattr(error, "trajectory", None) is not None else []
    return [run for run in found if len(run.t) > 1]


SCENES: dict[str, Callable[[], Any]] = {
    **{f"buck, duty {duty}": partial(buck, duty) for duty in (0.37, 0.4, 0.43)},
    "buck, unknown from g": partial(buck, 0.4, theta=0.5, gamma=0.5),
    "leaving bodies": leaving,
    **{stem: partial(nsmodel.load, stem) for stem in ("boost", "cabot_4_1", "gene_network", "inclusion_8_2", "two_discs")},
    **{f"first order {seed}": partial(draw, "first_order", seed) for seed in (1, 2, 5, 24)},
    **{f"{name} {seed}": partial(draw, name, seed) for name in ("oscillator", "lure", "inclusion", "bodies") for seed in (1, 3)},
    "sweeping 4": partial(draw, "sweeping", 4),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_a_run_lowers_no_proof(name):
    """One question, of one box, with and without runs: what holds, holds, and what is violated is not said to be open."""
    model = SCENES[name]()
    for run in runs_of(model):
        box = region_of(model, [run])
        region = dict(zip(box.names, zip(box.lower, box.upper, strict=True), strict=True))
        before, after = (check(model, own, region=region, quick=True) for own in ([], [run]))
        for finding in before.findings:
            if finding.verdict in DECIDED:
                assert after[finding.id].verdict in DECIDED, (finding.id, finding.how, after[finding.id].how)
                assert "holds" in {finding.verdict, after[finding.id].verdict} or finding.verdict == after[finding.id].verdict
            if finding.verdict == "holds" and after[finding.id].verdict == "violated":
                assert after[finding.id].witness
        stated = {(item.name, item.verdict) for item in after.consequences}
        for item in before.consequences:
            if item.verdict == "holds" and not any(after[id].verdict == "violated" for id in item.rests_on):
                assert (item.name, "holds") in stated, item.statement


def test_many_step_lengths_are_decided_at_once():
    """A run under error control has a length for each step: W_mlcp is h C W^-1 B > 0 for all of them."""
    model = buck(0.37, parts=23)
    run = simulate(model, t_end=3e-3, rtol=1e-3, method="time-stepping")
    assert len(np.unique(run.step[1:])) > 6
    report = check(model, [run])
    assert {finding.verdict for finding in report.findings} == {"holds"}
    assert f"from {run.step[1:].min():.4g} to {run.step[1:].max():.4g}" in report["F-unique"].how


# -- W_mlcp as a function of the step ----------------------------------------------------------------------------------


def chain(coefficients: list[Fraction]) -> MlcpOfStep:
    """A scalar W_mlcp(s) = c_0 + c_1 s + ...: (I - s N)^-1 of a nilpotent N is a sum of powers."""
    n = len(coefficients) - 1
    N, B = exact.zeros(n, n), exact.zeros(n, 1)
    for k in range(n - 1):
        N[k + 1, k] = Fraction(1)
    B[0, 0] = Fraction(1)
    C = exact.rational([coefficients[1:]])
    return MlcpOfStep(exact.eye(n), N, B, C, exact.rational([[coefficients[0]]]))


@pytest.mark.parametrize(
    ("coefficients", "low", "high", "kind"),
    [
        (["1/4", "-1", "1"], "1/10", "2/5", "positive definite"),  # (s - 1/2)^2 before its root
        (["1/4", "-1", "1"], "2/5", "3/5", ""),  # touches 0 inside
        (["1/4", "-1", "1"], "1/2", "3/5", ""),  # touches 0 at an end
        (["1/4", "0", "-1", "0", "1"], "7/10", "71/100", ""),  # (s^2 - 1/2)^2: an irrational root
        (["1/4", "0", "-1", "0", "1"], "708/1000", "71/100", "positive definite"),
        (["-1/4", "1"], "1/10", "1", ""),  # changes sign
        (["0", "1"], "1/1000000000", "1", "positive definite"),
        (["0", "0"], "1/10", "1", "positive semidefinite"),
    ],
)
def test_a_scalar_of_the_step(coefficients, low, high, kind):
    made = chain([Fraction(one) for one in coefficients])
    assert made.mlcp(Fraction(1, 3))[0, 0] == sum(Fraction(c) / 3**k for k, c in enumerate(coefficients))
    assert made.kind_for_all(Fraction(low), Fraction(high)) == kind


def test_a_step_matrix_that_is_singular_between_is_none():
    """1 - s = 0 at s = 1, beside which W_mlcp is > 0 on either side."""
    one, none = exact.eye(1), exact.zeros(1, 1)
    made = MlcpOfStep(one, one, one, none, one)
    assert made.kind_for_all(Fraction(1, 2), Fraction(3, 4)) == "positive definite"
    assert made.kind_for_all(Fraction(1, 2), Fraction(2)) == ""


def principal_minors(W: np.ndarray) -> list[float]:
    """All of them, in doubles."""
    rows = range(len(W))
    return [float(np.linalg.det(W[np.ix_(own, own)])) for k in range(1, len(W) + 1) for own in combinations(rows, k)]


def test_random_matrices_of_the_step_are_what_they_are_at_points():
    """In doubles, at 400 points: what is said holds at each, and what is clear at each is said."""
    rng, told = np.random.default_rng(1), {"positive definite": 0, "a P-matrix": 0, "": 0, "positive semidefinite": 0}
    for _ in range(120):
        n, m = rng.integers(1, 4, 2)
        draws = (rng.integers(-3, 4, shape) / 2 for shape in ((n, n), (n, m), (m, n), (m, m)))
        G, B, C, D = draws
        C = B.T if rng.random() < 0.5 else C
        D = D + rng.integers(0, 4) * np.eye(m) if rng.random() < 0.7 else 0 * D
        low, high = sorted(rng.choice(np.arange(1, 9) / 8, 2, replace=False))
        made = MlcpOfStep(*map(exact.rational, (np.eye(n), G, B, C, D)))
        kind = made.kind_for_all(Fraction(low), Fraction(high))
        told[kind] += 1
        steps = np.linspace(low, high, 400)
        systems = [np.eye(n) - s * G for s in steps]
        dets = np.array([np.linalg.det(W) for W in systems])
        if kind:
            assert (dets * dets[0] > 0).all()
        elif not (dets * dets[0] > 1e-3).all():
            continue
        at = [D + s * C @ np.linalg.solve(W, B) for s, W in zip(steps, systems, strict=True)]
        least = min(np.linalg.eigvalsh(W + W.T)[0] for W in at)
        minor = min(min(principal_minors(W)) for W in at)
        if kind.startswith("positive"):
            assert least > (-1e-9 if kind.endswith("semidefinite") else 0)
        elif kind:
            assert minor > 0
        else:
            assert least < 1e-2
            assert minor < 1e-2
    assert min(told.values()) > 2, told
