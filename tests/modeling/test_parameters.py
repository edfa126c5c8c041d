"""Parameters that are vectors and matrices: declared and given by symbol or name, through every door."""

import json
import re
import sys
import textwrap

import casadi as ca
import numpy as np
import pytest
import sympy

from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    LureSystem,
    ManyBodies,
    ModelError,
    Trajectory,
    UsageError,
    check,
    codegen,
    explain,
    relay,
    simulate,
    stress,
    study,
)  # fmt: skip
from nsmodel.cli import main

VALUES = [0.0, 1.0, -4.0, -1.0, 12.0, 6.0]
MATRIX = [[0.0, 1.0], [-4.0, -1.0]]
VECTORS = {
    "SX": ca.SX.sym("th", 6),
    "MX": ca.MX.sym("th", 6),
    "SymPy matrix": sympy.ImmutableMatrix(sympy.symbols("th_0:6")),
    "SymPy matrix symbol": sympy.MatrixSymbol("th", 6, 1),
    "SymPy symbols": sympy.symbols("th_0:6"),
}
MATRICES = {
    "SX": ca.SX.sym("W", 2, 2),
    "MX": ca.MX.sym("W", 2, 2),
    "SymPy matrix": sympy.ImmutableMatrix([["W_0", "W_2"], ["W_1", "W_3"]]),
    "SymPy matrix symbol": sympy.MatrixSymbol("W", 2, 2),
}
FILE = """
import casadi as ca
from nsmodel import LureSystem, relay
th, W = ca.SX.sym("th", 2), ca.SX.sym("W", 2, 2)
def model(start=(12, 6)):
    return LureSystem(
        A=W, B=[0, 1], C=[0, 1], D=0, f=th, law=relay(1), x0=list(start), t_end=1, step=0.1,
        parameters={th: [0, 0], W: [[0, 1], [-4, -1]]},
    )
"""


def oscillator(th, parameters):
    """x'' = th_2 x + th_3 x' and friction; th_0, th_1 the first row, th_4, th_5 the start."""
    rows = [[th[0], th[1]], [th[2], th[3]]]
    A = rows if isinstance(th, sympy.Basic | tuple) else ca.vertcat(*(ca.horzcat(*row) for row in rows))
    return LureSystem(
        A=A, B=[0, 1], C=[0, 1], law=relay(1), x0=[th[4], th[5]], t_end=1, step=0.1, parameters=parameters
    )  # fmt: skip


def of_matrix(W, value):
    return LureSystem(A=W, B=[0, 1], C=[0, 1], law=relay(1), x0=[12, 6], t_end=1, step=0.1, parameters={W: value})


@pytest.fixture(scope="module", name="known")
def known_run():
    """The same model with its numbers written in."""
    return simulate(LureSystem(A=MATRIX, B=[0, 1], C=[0, 1], law=relay(1), x0=[12, 6], t_end=1, step=0.1)).x


@pytest.mark.parametrize("th", VECTORS.values(), ids=VECTORS)
def test_a_vector_is_declared_and_given_by_symbol_or_name(th, known):
    model = oscillator(th, {th: [*VALUES[:5], None]})
    assert list(model.parameters) == [f"th_{i}" for i in range(6)]
    np.testing.assert_array_equal(simulate(model, parameters={"th_5": 6}).x, known)
    numbers = model.bind({"th": VALUES}).bound_parameters
    for declared in ({th: VALUES}, {"th": VALUES}, {th: None}, {"th": [9.0] * 6}):
        for given in ({}, {th: VALUES}, {"th": VALUES}, {ca.SX.sym("th", 6): VALUES}):
            if given or VALUES in declared.values():
                assert oscillator(th, declared).bind(given).bound_parameters == numbers


@pytest.mark.parametrize("value", [tuple(VALUES), np.array(VALUES), np.array([VALUES]), ca.DM(VALUES), sympy.Matrix(VALUES)])
def test_values_are_lists_and_arrays(value):
    th = VECTORS["SX"]
    numbers = dict(zip((f"th_{i}" for i in range(6)), VALUES, strict=True))
    assert oscillator(th, {th: value}).parameters == numbers
    assert oscillator(th, {"th": value}).parameters == numbers
    assert oscillator(th, {th: None}).bind({th: value}).bound_parameters == numbers


@pytest.mark.parametrize("W", MATRICES.values(), ids=MATRICES)
def test_a_matrix_keeps_its_rows_and_columns(W, known):
    np.testing.assert_array_equal(simulate(of_matrix(W, MATRIX)).x, known)
    np.testing.assert_array_equal(simulate(of_matrix(W, None), parameters={"W": MATRIX}).x, known)
    numbers = {"W_0": 0, "W_1": -4, "W_2": 1, "W_3": -1}
    for value in (MATRIX, np.array(MATRIX), ca.DM(MATRIX), sympy.Matrix(MATRIX)):
        for key in (W, "W", ca.SX.sym("W", 2, 2)):
            assert of_matrix(W, None).bind({key: value}).bound_parameters == numbers


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ({"th": 1}, "x0 uses the symbol 'th_4', which is not declared: 'th' is declared as one number; give parameters={'th'"),
        ({"th": [1, 2]}, "x0 uses the symbol 'th_4', which is not declared: add it to parameters={...}"),
        ({ca.SX.sym("th", 6): [1, 2]}, "parameter 'th': 2 values; expected 6, one for each of th_0, th_1, ..., th_5"),
        ({ca.MX.sym("th", 6): 1}, "parameter 'th': 1 value; expected 6, one for each of"),
        ({sympy.MatrixSymbol("th", 6, 1): [[1, 2, 3], [4, 5, 6]]}, "parameter 'th': shape (2, 3); expected 6, one for each"),
        ({"th": VALUES, "th_3": 1}, "parameters: 'th_3' is declared twice; keep one"),
        ({"th": [*VALUES[:5], "a"]}, "parameter 'th_5' = 'a' is not a number"),
        ({"th": [*VALUES[:5], [1]]}, "parameter 'th_5' = [1] is not a number"),
        ({ca.SX.sym("k"): ca.SX.sym("m", 2)}, "parameter 'k' = SX([m_0, m_1]) is not a number"),
    ],
)  # fmt: skip
def test_wrong_vectors_are_refused_when_declared(declared, message):
    with pytest.raises(ModelError, match=re.escape(message)):
        oscillator(VECTORS["SX"], declared)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"th": VALUES[:5]}, "parameter 'th': 5 values; expected 6, one for each of th_0, th_1, ..., th_5"),
        ({ca.SX.sym("th", 5): VALUES[:5]}, "parameter 'th': 5 values; expected 6"),
        ({"th": VALUES, "th_0": 1}, "parameter 'th_0' is given twice; keep one"),
        ({"W": [0, 1, -4, -1]}, "parameter 'W': 4 values; expected a matrix of shape (2, 2), a list of its rows (W_0, ..., W_3"),
        ({"W": np.ones((2, 3))}, "parameter 'W': shape (2, 3); expected a matrix of shape (2, 2)"),
        ({"tth": VALUES}, "parameter 'tth' is not declared; the model has th, W. Did you mean 'th'?"),
    ],
)
def test_wrong_vectors_are_refused_when_given(given, message):
    th, W = ca.SX.sym("th", 6), ca.SX.sym("W", 2, 2)
    model = LureSystem(
        A=W, B=[0, 1], C=[0, 1], f=th[:2], law=relay(1), x0=[1, 0], t_end=1, step=0.1, parameters={th: None, W: None}
    )
    for door in (simulate, explain, check, study, stress):
        with pytest.raises(UsageError, match=re.escape(message)):
            door(model, parameters=given)


def test_every_door_takes_a_vector(tmp_path, known, monkeypatch):
    monkeypatch.setattr(sys.modules["nsmodel.study.stress"], "STEP_FACTORS", (1.0, 10.0))
    th = VECTORS["SX"]
    model, given = oscillator(th, {th: None}), {th: VALUES}
    assert explain(model, parameters=given).startswith("scheme")
    report = check(model, parameters=given, quick=True)
    assert dict(report.parameters) == {f"th_{i}": value for i, value in enumerate(VALUES)}
    found = study(model, parameters=given, steps=[0.1, 0.05], solvers=[], budget=2)
    assert found.lines
    pushed = stress(oscillator(th, {th: None, "k": 1}), parameters=given, vary={"k": [1, 2]}, steps=3)
    assert not pushed.wrong
    fixed = codegen.write(model, tmp_path / "fixed", parameters=given)
    assert fixed.about["parameters"] == {}
    free = codegen.write(oscillator(th, {th: VALUES}), tmp_path / "free", parameters={"th_4": 12})
    assert free.about["parameters"] == {f"th_{i}": VALUES[i] for i in (0, 1, 2, 3, 5)}
    np.testing.assert_array_equal(simulate(model.bind({"th": VALUES})).x, known)


def test_the_conditions_on_an_open_matrix_are_found():
    report = check(of_matrix(ca.SX.sym("W", 2, 2), None))
    assert list(report.parameters) == ["W_0", "W_1", "W_2", "W_3"]


def test_a_model_of_many_bodies_takes_vectors_and_writes_them_out():
    bodies, wind = Bodies([[0.0, 0.0], [3.0, 0.0]], r=[1.0, 1.0]), ca.SX.sym("wind", 2)
    i, j = bodies.member("i"), bodies.member("j")
    pair = Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)
    model = ManyBodies(bodies=bodies, f=wind, constraints={"pair": pair}, t_end=0.2, step=0.1, parameters={wind: None})
    run = simulate(model, parameters={"wind": [1, 2]})
    np.testing.assert_allclose(run.x[-1], [0.2, 0.4, 3.2, 0.4])
    np.testing.assert_allclose(simulate(model.written_out(), parameters={wind: [1, 2]}).x[-1], run.x[-1])


@pytest.mark.parametrize(
    ("settings", "parameters"),
    [
        (["th=1,2"], {"th_0": 1, "th_1": 2}),
        (["W=0,1;-9,-1"], {"W_0": 0, "W_1": -9, "W_2": 1, "W_3": -1}),
        (["th_1=5", "start=1,2"], {"th_1": 5}),
    ],
)
def test_vectors_and_matrices_are_set_on_the_command_line(tmp_path, capsys, settings, parameters):
    (tmp_path / "m.py").write_text(textwrap.dedent(FILE))
    options = [word for setting in settings for word in ("--set", setting)]
    assert main(["run", str(tmp_path / "m.py"), *options, "--json", "--out", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    run = Trajectory.load(tmp_path / "out" / "trajectory.npz")
    assert run.metadata["parameters"].items() >= parameters.items()
    assert run.x[0].tolist() == ([1, 2] if "start=1,2" in settings else [12, 6])


@pytest.mark.parametrize(
    ("command", "options", "message"),
    [
        ("run", ["--set", "th=1,2,3"], "parameter 'th': 3 values; expected 2, one for each of th_0, th_1"),
        ("run", ["--set", "W=1,2"], "parameter 'W': 2 values; expected a matrix of shape (2, 2)"),
        ("run", ["--set", "th=1,,2"], "--set th=1,,2: '1,,2' is not a number, nor numbers with commas between"),
        ("run", ["--set", "th_0=1", "--set", "th_0=2"], "--set gives 'th_0' twice; keep one"),
        ("run", ["--set", "th=1,2", "--set", "th_0=2"], "parameter 'th_0' is given twice; keep one"),
        ("check", ["--set", "th_0=1", "--set", " th_0 =2"], "--set gives 'th_0' twice; keep one"),
        ("check", ["--region", "x_0=1:2", "--region", "x_0=1:3"], "--region gives 'x_0' twice; keep one"),
        ("study", ["--set", "th_0=1", "--set", "th_0=1"], "--set gives 'th_0' twice; keep one"),
        ("codegen", ["--set", "th_0=1", "--set", "th_0=1"], "--set gives 'th_0' twice; keep one"),
        ("stress", ["--vary", "th_0=1", "--vary", "th_0=2"], "--vary gives 'th_0' twice; keep one"),
        ("stress", ["--vary", "th_0=1", "--set", "th_0=2"], "'th_0' is given with --set and with --vary; keep one"),
        ("stress", ["--vary", "th=1,2"], "parameter 'th': 1 value; expected 2, one for each of th_0, th_1"),
    ],
)
def test_wrong_settings_are_refused(tmp_path, capsys, command, options, message):
    (tmp_path / "m.py").write_text(textwrap.dedent(FILE))
    assert main([command, str(tmp_path / "m.py"), *options]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err


def test_json_names_each_entry(tmp_path, capsys):
    (tmp_path / "m.py").write_text(textwrap.dedent(FILE))
    assert main(["check", str(tmp_path / "m.py"), "--quick", "--json", "--set", "th=1,2"]) == 0
    assert json.loads(capsys.readouterr().out)["parameters"]["th_1"] == 2


def test_parameters_bound_one_after_the_other_are_all_told():
    x, k, c = ca.SX.sym("x"), ca.SX.sym("k"), ca.SX.sym("c")
    model = FirstOrderSystem(x=x, f=-k * x + c, x0=1, t_end=1, step=0.1, parameters={k: 2.0, c: None})
    both = model.bind({"c": 0.5}, partly=True).bind()
    assert dict(both.bound_parameters) == {"k": 2.0, "c": 0.5}
    later = model.bind({"k": 2.0}, partly=True)
    assert dict(later.bound_parameters) == {"k": 2.0}
    assert dict(later.bind({"c": 0.5}).bound_parameters) == {"k": 2.0, "c": 0.5}
