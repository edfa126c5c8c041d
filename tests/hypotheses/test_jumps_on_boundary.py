"""Steps inside C, on its boundary and at single points: what is maximal, continuous, one-sided Lipschitz, in fractions."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import casadi as ca
import numpy as np
import pytest
from fuzz_models import share

from nsmodel import MonotoneInclusion, check

x = ca.SX.sym("x")
REGION = {"x": (-3.0, 3.0)}


class Step(NamedTuple):
    """``weight`` times a step of ``kind`` at ``at``."""

    weight: int
    kind: str
    at: Fraction

    def expression(self) -> ca.SX:
        return float(self.weight) * KINDS[self.kind][0](x, float(self.at))

    def values(self, z: Fraction) -> tuple[Fraction, Fraction, Fraction]:
        """The limit from the left, the value and the limit from the right at z."""
        near = Fraction(1, 10**6)
        left, here, right = (self.weight * Fraction(KINDS[self.kind][1](z - self.at + d)) for d in (-near, Fraction(0), near))
        return left, here, right


KINDS: dict[str, tuple[Callable[[ca.SX, float], ca.SX], Callable[[Fraction], int]]] = {
    ">": (lambda s, p: ca.if_else(s > p, 1, 0), lambda d: int(d > 0)),
    ">=": (lambda s, p: ca.if_else(s >= p, 1, 0), lambda d: int(d >= 0)),
    "<": (lambda s, p: ca.if_else(s < p, 1, 0), lambda d: int(d < 0)),
    "<=": (lambda s, p: ca.if_else(s <= p, 1, 0), lambda d: int(d <= 0)),
    "sign": (lambda s, p: ca.sign(s - p), lambda d: (d > 0) - (d < 0)),
    "floor": (lambda s, p: ca.floor(s - p), math.floor),
    "ceil": (lambda s, p: ca.ceil(s - p), math.ceil),
}
SETS = {"[0, inf)": (0, None), "(-inf, 0]": (None, 0), "[0, 1]": (0, 1), "[-1, 1]": (-1, 1), "the line": (None, None)}


class Truth(NamedTuple):
    """Of a sum of steps on an interval: S + N_C maximal monotone, F continuous, F one-sided Lipschitz."""

    maximal: bool
    continuous: bool
    lipschitz: bool


def truth(steps: list[Step], low: int | None, high: int | None) -> Truth:
    """By the values at each point where one of the steps is, and beside it, of those of C alone; a sign is [-1, 1] in S."""
    places = {step.at + k for step in steps for k in (range(-5, 6) if step.kind in ("floor", "ceil") else (0,))}
    maximal = continuous = lipschitz = True
    for z in places:
        if (low is not None and z < low) or (high is not None and z > high):
            continue
        left, here, right = (sum(parts) for parts in zip(*(step.values(z) for step in steps), strict=True))
        spread = abs(sum(step.weight for step in steps if step.kind == "sign" and step.at == z))
        if z != low:  # N_C is 0, or points to the right: S fills what lies between the limit and its value
            maximal &= here - spread == left
            continuous &= here == left
            lipschitz &= here <= left
        if z != high:
            maximal &= here + spread == right
            continuous &= here == right
            lipschitz &= right <= here
    return Truth(maximal, continuous, lipschitz)


def models(count: int, seed: int) -> list[tuple[list[Step], int, str]]:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        kinds = rng.choice(list(KINDS), int(rng.integers(1, 4)), p=[0.2, 0.2, 0.14, 0.14, 0.2, 0.06, 0.06])
        places = [Fraction(str(at)) for at in rng.choice(["0", "0", "0", "1", "0.5", "-1"], len(kinds))]
        steps = [Step(int(rng.choice([1, 1, 2, -1])), str(kind), at) for kind, at in zip(kinds, places, strict=True)]
        found.append((steps, int(rng.integers(0, 2)), str(rng.choice(list(SETS)))))
    return found


def inclusion(field: ca.SX, operator: ca.SX, low: int | None, high: int | None) -> MonotoneInclusion:
    ends = {name: float(end) for name, end in (("lower", low), ("upper", high)) if end is not None}
    start = 0.25 if high is None or high > 0 else -0.25
    return MonotoneInclusion(x=x, field=field, operator=operator, x0=start, t_end=1, step=0.1, **ends)


@pytest.mark.long
def test_sums_of_steps_on_intervals_are_what_they_are():
    """What holds is true and what is violated is false, of all; of those without floor and ceil most are decided."""
    decided = asked = 0
    for steps, slope, name in models(share(400), 3):
        low, high = SETS[name]
        total, true = ca.SX(sum(step.expression() for step in steps)) + slope * x, truth(steps, low, high)
        if not ca.depends_on(total, x):
            continue  # they cancel each other
        as_operator = check(inclusion(-x, total, low, high), quick=True, region=REGION)
        as_field = check(inclusion(total, 0 * x, low, high), quick=True, region=REGION)
        known = as_operator["M-T"].verdict, as_field["M-A1"].verdict, as_field["M-24"].verdict
        for id, verdict, holds in zip(("M-T", "M-A1", "M-24"), known, true, strict=True):
            assert verdict not in (("violated",) if holds else ("holds",)), (id, name, slope, steps)
        if not any(step.kind in ("floor", "ceil") for step in steps):
            asked, decided = asked + 1, decided + (known[0] in ("holds", "violated"))
    assert decided >= 0.9 * asked > 0


@pytest.mark.parametrize(
    ("operator", "verdict"),
    [
        (ca.if_else(x > 0, 1, 0), "violated"),  # T(0) is what is <= 0, and up to 1 is missing
        (ca.if_else(x >= 0, 1, 0), "holds"),  # 1 on all of C
        (ca.sign(x), "holds"),
        (x + 2 * ca.if_else(x > 0, 1, 0), "violated"),
        (ca.if_else(x > 0, 0, 1), "violated"),  # not even monotone
        (ca.if_else(x > -1, 1, 0), "holds"),  # outside of C
        (ca.if_else(x > 0.5, 1, 0), "violated"),
    ],
)
def test_a_step_at_the_end_of_a_half_line(operator, verdict):
    report = check(inclusion(-x, operator, 0, None), quick=True, region=REGION)
    assert report["M-T"].verdict == verdict


def test_a_sign_whose_weight_an_if_else_makes_up_for():
    """2 if_else(x > 0, 1, 0) - sign(x) is 1 beside 0, and [-1, 1] there: not monotone, which is not claimed."""
    operator = 2 * ca.if_else(x > 0, 1, 0) - ca.sign(x)
    assert check(inclusion(-x, operator, None, None), quick=True, region=REGION)["M-T"].verdict != "holds"


def test_a_step_in_a_corner_of_a_quadrant():
    """(1, 1) if_else(x_0 + x_1 > 0, 1, 0) jumps at one point of C alone, of [1, inf) x [0, inf) at none."""
    z = ca.SX.sym("z", 2)
    step = ca.if_else(z[0] + z[1] > 0, 1, 0)
    for low, verdict in (([0, 0], "violated"), ([1, 0], "holds")):
        model = MonotoneInclusion(x=z, field=-z, operator=ca.vertcat(step, step), lower=low, x0=[2, 2], t_end=1, step=0.1)
        report = check(model, quick=True, region={"z_0": (-3.0, 3.0), "z_1": (-3.0, 3.0)})
        assert report["M-T"].verdict == verdict
        if verdict == "violated":
            assert report["M-T"].witness["x"] == [0, 0]
            assert report["M-T"].witness["above"] == [1, 1]


def test_a_step_that_the_box_around_a_disc_holds_and_the_disc_does_not():
    """x_0 + x_1 <= sqrt(2) < 1.8 on the unit disc: no jump in C, of which the box around it does not tell."""
    z = ca.SX.sym("z", 2)
    step = ca.if_else(z[0] + z[1] > 1.8, 1, 0)
    model = MonotoneInclusion(
        x=z, field=-z, operator=ca.vertcat(step, step), constraints={"disc": 1 - ca.sumsqr(z)}, x0=[0, 0], t_end=1, step=0.1
    )
    assert check(model, quick=True)["M-T"].verdict != "violated"


def test_a_field_that_jumps_on_the_boundary():
    """F(0) = 0 and 1 beside it: not continuous on C, and no L; from above the jump is no harm to (24)."""
    report = check(inclusion(ca.if_else(x > 0, 1, 0), 0 * x, 0, None), quick=True, region=REGION)
    assert report["M-A1"].verdict == "violated"
    assert report["M-A1"].witness["x"] == [0]
    assert report["M-A1"].value["jump"] == pytest.approx(1)
    assert report["M-24"].verdict != "holds"
    falling = check(inclusion(ca.if_else(x > 0, 0, 1), 0 * x, 0, None), quick=True, region=REGION)
    assert falling["M-A1"].verdict == "violated"
    assert falling["M-24"].verdict == "holds"
