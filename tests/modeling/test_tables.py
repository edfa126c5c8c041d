"""Lookup tables: linear interpolants are written out exactly, and what follows for runs, C and checks."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from nsmodel import FrictionOscillator, MonotoneInclusion, SweepingProcess, check, simulate
from nsmodel.modeling.expressions import expand_tables, read_table, table_expression

POINTS, VALUES = [-2.0, -1.0, 0.0, 1.0, 2.0], [4.0, 1.0, 0.0, 1.0, 4.0]
LUT = ca.interpolant("lut", "linear", [POINTS], VALUES)


@pytest.mark.parametrize("n", [2, 3, 40, 300])
def test_a_table_is_read_and_written_out(n):
    rng = np.random.default_rng(n)
    points, values = np.sort(rng.normal(size=n)) * 3, rng.normal(size=n)
    lut = ca.interpolant("lut", "linear", [points.tolist()], values.tolist())
    table = read_table(lut)
    np.testing.assert_array_equal(table.points, points)
    np.testing.assert_array_equal(table.values, values)
    x = ca.SX.sym("x")
    f = ca.Function("f", [x], [table_expression(table, x)])
    at = rng.uniform(points[0], points[-1], 500)
    steep = np.abs(np.diff(values) / np.diff(points)).max()
    np.testing.assert_allclose(np.array(f.map(500)(at[None])).ravel(), np.interp(at, points, values), atol=1e-14 * n * steep)


def test_tables_inside_expressions_are_opened_and_others_stay():
    x = ca.SX.sym("x", 2)
    spline = ca.interpolant("spline", "bspline", [[0.0, 1, 2, 3, 4]], [1.0, 2, 4, 8, 16])
    plane = ca.interpolant("plane", "linear", [[0.0, 1], [0.0, 1]], [1.0, 2, 3, 5])
    mixed = ca.vertcat(ca.sin(LUT(LUT(x[0]) + x[1])), x[1], spline(LUT(x[0])), plane(x))
    found = expand_tables(mixed)
    assert "lut" not in str(found)
    assert "spline" in str(found)
    f, g = (ca.Function("f", [x], [e]) for e in (mixed, found))
    for point in np.random.default_rng(1).uniform(0, 1.5, (20, 2)):
        np.testing.assert_allclose(np.array(f(point)), np.array(g(point)), atol=1e-13)
    assert read_table(spline) is None
    assert read_table(plane) is None


def test_what_the_check_says_of_tables():
    x, s = ca.MX.sym("x"), ca.MX.sym("s")
    inclusion = MonotoneInclusion(x=x, field=-LUT(x), lower=[-2], upper=[2], x0=[1.0], t_end=1, step=0.1)
    report = check(inclusion, quick=True)
    assert [report[id].verdict for id in ("M-T", "M-A1", "M-A2", "M-A3", "M-24")] == ["holds"] * 5
    oscillator = FrictionOscillator(x=x, potential=LUT(x), friction=0.1 * s, s=s, x0=[1.5], v0=[0.0], t_end=1, step=0.01)
    report = check(oscillator, quick=True)
    assert report["O-g"].verdict == "holds"
    assert report["O-g"].value["inf g"] == 0
    sweeping = SweepingProcess(q=x, f=-LUT(x), constraints={"wall": x + 1}, q0=[1.0], t_end=1, step=0.1)
    velocity = check(sweeping, region={"x": (-2, 2)})["S-f"]
    assert velocity.verdict == "holds"
    assert 3 <= velocity.value["K_f"] <= 3 * (1 + 1e-9)


def test_a_run_through_a_table():
    x = ca.MX.sym("x")
    table = SweepingProcess(q=x, f=-LUT(x), constraints={"wall": x + 1}, q0=[1.5], t_end=1, step=0.01)
    y = ca.SX.sym("x")
    plain = SweepingProcess(q=y, f=-ca.fabs(y) - 2 * ca.fmax(ca.fabs(y) - 1, 0), constraints={"wall": y + 1}, q0=[1.5], t_end=1,
                            step=0.01)  # fmt: skip
    for compiled in (False, True):
        np.testing.assert_allclose(simulate(table, compiled=compiled).x, simulate(plain).x, atol=1e-12)
