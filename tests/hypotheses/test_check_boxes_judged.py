"""What is said over boxes of parameters, put to the oracle at values: random models, and forged numbers that it must see."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL
from search.boxes import Varied
from search.judged_boxes import at_value, judged

from nsmodel import SweepingProcess, check

FEW = [("lure", 21), ("first_order", 0)]  # Of the first, P B = C' holds to rounding alone.
MANY = [(name, seed) for name in ("sweeping", "first_order", "lure", "inclusion", "oscillator", "bodies") for seed in range(10)]


@pytest.mark.parametrize(("name", "seed"), MANY if COUNT == FULL else FEW)
def test_nothing_said_over_a_box_contradicts_a_value_in_it(name, seed):
    row = judged(name, seed)
    assert not row["contradictions"]
    assert not {"crash", "fault"} & set(row)


@pytest.mark.parametrize(("id", "name", "factor"), [("A1", "b", 0.5), ("A4", "M", 0.4), ("S-f", "K_f", 0.5)])
def test_the_judge_sees_a_number_that_is_worse_at_a_value(id, name, factor):
    """p (|q| - 1), p in [1/2, 2], f = -p q: |grad g| = p, |D^2 g| <= p / |q|, K_f = p."""
    p, q = ca.SX.sym("p"), ca.SX.sym("q", 2)
    model = SweepingProcess(
        q=q, f=-p * q, constraints={"disc": p * (ca.norm_2(q) - 1)}, q0=[3, 0], t_end=1, step=0.01, parameters={p: 1.0}
    )
    one = Varied("g", model, "p", 0.5, 2.0)
    over = check(model, [], parameters={"p": (0.5, 2.0)}, quick=True)
    forged = tuple(
        replace(item, value={**item.value, name: factor * item.value[name]}) if item.id == id else item for item in over.findings
    )
    found = [
        item["id"]
        for value in (0.5, 2.0)
        for item in at_value("sweeping", 0, one, replace(over, findings=forged, consequences=()), value, np.random.default_rng(1))
    ]
    assert set(found) == {id}
