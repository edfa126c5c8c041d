"""Everything a user may write becomes SX in the declared symbols, or an error in the user's own words."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
import scipy.sparse

from nsmodel.errors import ModelError
from nsmodel.modeling.conversion import Converter, declare, expand_mx, to_sx

sympy = pytest.importorskip("sympy")

Q = ca.SX.sym("q", 2)
K = ca.SX.sym("k")
POINT = ca.DM([0.3, -0.7, 1.9])


@pytest.fixture
def converter():
    return Converter([declare(Q, "q"), declare(K, "parameters")])


def value(expr, point=POINT):
    """Numbers of an SX in exactly the symbols Q and K: another object of the same name makes the Function fail."""
    return np.array(ca.Function("f", [ca.vertcat(Q, K)], [ca.densify(ca.SX(expr))])(point))


# -- declarations ------------------------------------------------------------------------------------------------------

a, b = sympy.symbols("a b")


@pytest.mark.parametrize(
    ("given", "names", "stem"),
    [
        (ca.SX.sym("q", 2), ("q_0", "q_1"), "q"),
        (ca.MX.sym("q", 2), ("q_0", "q_1"), "q"),
        (ca.SX.sym("q", 2).T, ("q_0", "q_1"), "q"),
        (ca.SX.sym("t"), ("t",), "t"),
        (ca.MX.sym("t"), ("t",), "t"),
        ("k", ("k",), "k"),
        ([ca.SX.sym("q_0"), ca.SX.sym("q_1")], ("q_0", "q_1"), "q"),
        ([ca.SX.sym("x"), ca.SX.sym("v")], ("x", "v"), None),
        ([ca.MX.sym("x"), ca.MX.sym("v")], ("x", "v"), None),
        (ca.vertcat(ca.SX.sym("x"), ca.SX.sym("v")), ("x", "v"), None),
        (ca.vertcat(ca.MX.sym("v"), ca.MX.sym("q", 2)), ("v", "q_0", "q_1"), None),
        (ca.MX.sym("K", 2, 2), ("K_0", "K_1", "K_2", "K_3"), "K"),
        (np.array([ca.SX.sym("x"), ca.SX.sym("v")]), ("x", "v"), None),
        (a, ("a",), "a"),
        ((a, b), ("a", "b"), None),
        (sympy.Matrix([a, b]), ("a", "b"), None),
        (sympy.symbols("q_0:3"), ("q_0", "q_1", "q_2"), "q"),
        ([], (), None),
    ],
)
def test_declare_reads_names_and_the_common_stem(given, names, stem):
    declared = declare(given, "x")
    assert (declared.names, declared.stem) == (names, stem)
    assert declared.sx.shape == (len(names), 1)
    assert tuple(s.name() for s in ca.vertsplit(declared.sx)) == names


def test_declare_keeps_the_users_own_sx_symbols_and_the_source():
    assert ca.is_equal(declare(Q, "q").sx, Q)
    mx = ca.MX.sym("q", 2)
    assert declare(mx, "q").source[0].name() == "q"
    assert len(declare(mx, "q").source) == 1
    assert declare([a, b], "x").source == (a, b)


@pytest.mark.parametrize("given", [2 * Q, 3.0, ca.vertcat(Q, 1), ca.SX(2, 1), 2 * ca.MX.sym("m"), a + 1, None, {"q": 1}])
def test_declare_refuses_what_is_not_a_symbol(given):
    with pytest.raises(ModelError, match=r"state: .* is not a symbol; expected symbols only, such as ca.SX.sym\('state', 2\)"):
        declare(given, "state")


def test_a_name_declared_twice_is_refused():
    with pytest.raises(ModelError, match="x: the symbol 'q_0' is declared twice"):
        declare([ca.SX.sym("q", 2), ca.MX.sym("q", 1, 2)], "x")
    with pytest.raises(ModelError, match="the declared symbols: the symbol 'k' is declared twice"):
        Converter([declare(K, "x"), declare("k", "parameters")])


# -- values ------------------------------------------------------------------------------------------------------------

MQ, MK = ca.MX.sym("q", 2), ca.MX.sym("k")
SQ0, SQ1, SK = sympy.symbols("q_0 q_1 k", real=True)
q0, q1, k = 0.3, -0.7, 1.9


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (2, [[2]]),
        (True, [[1]]),
        (Fraction(1, 4), [[0.25]]),
        (np.float32(0.5), [[0.5]]),
        (np.inf, [[np.inf]]),
        ([1, 2], [[1], [2]]),
        ((1, [2])[0], [[1]]),
        ([[1, 2]], [[1, 2]]),
        ([[1, 2], [3, K]], [[1, 2], [3, k]]),
        ([Q[0], 1.5, SK, MK], [[q0], [1.5], [k], [k]]),
        ([Q, K], [[q0], [q1], [k]]),
        ([np.array([1, 2]), np.array([3, 4])], [[1, 2], [3, 4]]),
        ([[Q[0]], [Q[1]]], [[q0], [q1]]),
        (np.array([1, 2]), [[1], [2]]),
        (np.array([[1, 2]]), [[1, 2]]),
        (np.array(3), [[3]]),
        (np.array([Q[0], 2.0], dtype=object), [[q0], [2]]),
        (np.array([[SK, 2.0]], dtype=object), [[k, 2]]),
        (np.zeros((0, 3)), np.zeros((0, 3))),
        (np.zeros(0), np.zeros((0, 1))),
        ([], np.zeros((0, 1))),
        ([[], []], np.zeros((2, 0))),
        (scipy.sparse.csc_matrix([[0, 2.0], [1, 0]]), [[0, 2], [1, 0]]),
        (ca.DM([[1, 2], [3, 4]]), [[1, 2], [3, 4]]),
        (K * Q.T, [[k * q0, k * q1]]),
        (ca.vertcat(MK * MQ[1], ca.norm_2(MQ)), [[k * q1], [np.hypot(q0, q1)]]),
        (ca.if_else(MK > 1, MQ[0], ca.inf), [[q0]]),
        (SK * SQ1 + 1, [[k * q1 + 1]]),
        (sympy.Matrix([[SK, 0], [1, SQ0]]), [[k, 0], [1, q0]]),
        (sympy.ImmutableMatrix([SK, SQ0]), [[k], [q0]]),
    ],
)
def test_convert(converter, given, expected):
    result = converter.convert(given, "f")
    assert result.shape == np.shape(expected)
    np.testing.assert_allclose(value(result), expected)


def test_symbols_of_another_object_are_matched_by_name():
    converter = Converter([declare("k", "parameters"), declare(ca.MX.sym("q", 2), "q")])
    own = converter.symbols
    result = converter.convert(ca.vertcat(ca.SX.sym("k") * ca.SX.sym("q", 2), ca.SX.sym("q_1")), "f")
    f = ca.Function("f", [own["k"], own["q_0"], own["q_1"]], [result])
    np.testing.assert_allclose(np.array(f(2, 3, 5)).ravel(), [6, 10, 5])


def test_a_matrix_of_mx_symbols_keeps_its_order():
    mx = ca.MX.sym("K", 2, 2)
    converter = Converter([declare(mx, "parameters")])
    f = ca.Function("f", list(converter.symbols.values()), [converter.convert(mx, "A")])
    np.testing.assert_allclose(np.array(f(1, 2, 3, 4)), [[1, 3], [2, 4]])


x = sympy.Symbol("x", real=True)


@pytest.mark.parametrize(
    "expr",
    [
        x**2 - x / 3 + sympy.Rational(1, 7),
        x**3 * sympy.pi + sympy.E,
        1 / (2 + x) + sympy.sqrt(2 + x) + (2 + x) ** sympy.Rational(-3, 2),
        sympy.exp(x) + sympy.log(3 + x) + 2**x,
        sympy.sin(x) + sympy.cos(x) + sympy.tan(x),
        sympy.asin(x / 3) + sympy.acos(x / 3) + sympy.atan(x) + sympy.atan2(x, 2),
        sympy.sinh(x) + sympy.cosh(x) + sympy.tanh(x),
        sympy.Abs(x) + sympy.sign(x) + sympy.sqrt(x**2),
        sympy.Max(x, 0, 1 - x) + sympy.Min(x, sympy.Rational(1, 2)),
        sympy.Heaviside(x - 1) + sympy.Heaviside(x, 1) + sympy.Heaviside(x, 0),
        sympy.Piecewise((x**2, x < 0), (x, x <= 1), (3, True)),
        sympy.Piecewise((1, (x > -1) & (x < 1)), (2, sympy.Or(x > 2, sympy.Eq(x, 1))), (3, True)),
        sympy.Piecewise((1, sympy.Not((x > -1) & (x < 1.5))), (2, sympy.Ne(x, 0)), (3, True)),
        sympy.Float("0.1") + x,
        sympy.floor(x) + sympy.ceiling(x),
    ],
)
def test_sympy_gives_the_same_numbers(expr):
    symbol = ca.SX.sym("x")
    f = ca.Function("f", [symbol], [to_sx(expr, {"x": symbol}, "f")])
    for number in (-1.75, -1.0, 0.0, 0.5, 1.0, 2.25):
        expected = float(expr.subs(x, sympy.Rational(number)).evalf())
        assert float(f(number)) == pytest.approx(expected, rel=1e-13)


def test_sympy_infinity_and_heaviside_keep_the_form_that_the_split_reads():
    symbol = ca.SX.sym("x")
    domain = to_sx(sympy.Piecewise((x**2, x >= 0), (sympy.oo, True)), {"x": symbol}, "phi")
    assert str(domain) == str(ca.if_else(symbol >= 0, symbol**2, ca.inf))
    assert "sign" in str(to_sx(sympy.Heaviside(x), {"x": symbol}, "S"))


def test_importing_does_not_import_sympy():
    code = "import sys, nsmodel.modeling.conversion; sys.exit('sympy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# -- errors ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given",
    [
        2 * ca.SX.sym("m"),
        ca.MX.sym("m") + MK,
        sympy.Symbol("m") * SK,
        [1, [ca.SX.sym("m")]],
        sympy.Matrix([sympy.Symbol("m")]),
    ],
)
def test_an_undeclared_symbol_is_named(converter, given):
    message = r"f uses the symbol 'm', which is not declared: .* or declare it as x=, t=; .*, k"
    with pytest.raises(ModelError, match=message):
        converter.convert(given, "f")


def test_an_mx_vector_longer_than_the_declared_one_is_undeclared(converter):
    with pytest.raises(ModelError, match="f uses the symbol 'q_2'"):
        converter.convert(ca.sumsqr(ca.MX.sym("q", 3)), "f")


@pytest.mark.parametrize(
    ("given", "index"),
    [
        (np.nan, "f holds"),
        ([1, np.nan], r"f\[1\] holds"),
        (np.array([[1, 2], [np.nan, 3]]), r"f\[1, 0\] holds"),
        (ca.vertcat(Q[0], Q[1] + np.nan), r"f\[1\] holds"),
        (MK * np.nan, "f holds"),
        (sympy.nan, "f holds"),
    ],
)
def test_a_nan_is_refused_with_its_index(converter, given, index):
    with pytest.raises(ModelError, match=f"{index} a NaN"):
        converter.convert(given, "f")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("sin(q)", r"f: sin\(q\) \(a str\) is not an expression; expected a number"),
        (None, r"f: None \(a NoneType\) is not an expression"),
        (1j, "f: 1j .* is not an expression"),
        (lambda q: q, "f: .* is not an expression; call it with your symbols"),
        (np.zeros((2, 2, 2)), r"f: shape \(2, 2, 2\); expected a scalar, a vector or a matrix"),
        ([Q.T, 1], r"f\[0\]: shape \(1, 2\); expected a scalar or a column"),
        ([[1, 2], [3]], "f: the rows have 2, 1 entries; expected rows of one length"),
        ([[1, Q]], r"f\[0\]\[1\]: shape \(2, 1\); a nested list holds scalars"),
        (sympy.gamma(SK), r"f: 'gamma' in gamma\(k\) has no CasADi counterpart"),
        (sympy.Function("u")(SK), r"f: 'u' in u\(k\) has no CasADi counterpart"),
        (sympy.I * SK, "f: 'ImaginaryUnit' in I has no CasADi counterpart"),
        (sympy.Piecewise((1, SK > 0)), "f: Piecewise.* has no value where none of its conditions holds"),
    ],
)
def test_other_values_are_refused(converter, given, message):
    with pytest.raises(ModelError, match=message):
        converter.convert(given, "f")


def test_an_mx_operation_without_a_scalar_form_is_refused(converter):
    matrix = ca.vertcat(ca.horzcat(MK, 0), ca.horzcat(0, MQ[0]))
    with pytest.raises(ModelError, match=r"f cannot be written with scalar operations \(.*LinsolQr.*\); build it from SX"):
        converter.convert(ca.solve(matrix, MQ), "f")


def test_expand_mx_puts_the_sx_symbols():
    (result,) = expand_mx([MK * MQ], [MQ, MK], [Q, K], "f")
    np.testing.assert_allclose(value(result), [[k * q0], [k * q1]])
