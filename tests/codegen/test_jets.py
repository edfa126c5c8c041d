"""Taylor coefficients of expressions against 50 digits: each operation, and random compositions of them."""

import ctypes
import shutil
import subprocess

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from conftest import optimised
from fuzz_models import share

from nsmodel.codegen.expressions import c_number
from nsmodel.codegen.recurrences import C_DIALECT, recurrence_kernels
from nsmodel.event_driven.recurrence_code import TaylorExpansion, higher_order_statements, order_0_statements
from nsmodel.event_driven.recurrences import BINARY_RECURRENCES, UNARY_RECURRENCES, taylor_decompose
from nsmodel.proof.expression_graph import OpaqueExpression, fold_graph

ORDERS = 12
NAMES = {getattr(ca, name): name[3:].lower() for name in dir(ca) if name.startswith("OP_")}


def truncated(a):
    return mp.floor(a) if a >= 0 else mp.ceil(a)


IN_MP = {
    "neg": lambda a: -a,
    "twice": lambda a: 2 * a,
    "sq": lambda a: a * a,
    "inv": lambda a: 1 / a,
    "sqrt": mp.sqrt,
    "exp": mp.exp,
    "log": mp.log,
    "expm1": mp.expm1,
    "log1p": mp.log1p,
    "sin": mp.sin,
    "cos": mp.cos,
    "tan": mp.tan,
    "asin": mp.asin,
    "acos": mp.acos,
    "atan": mp.atan,
    "sinh": mp.sinh,
    "cosh": mp.cosh,
    "tanh": mp.tanh,
    "asinh": mp.asinh,
    "acosh": mp.acosh,
    "atanh": mp.atanh,
    "erf": mp.erf,
    "fabs": abs,
    "sign": mp.sign,
    "floor": mp.floor,
    "ceil": mp.ceil,
    "not": lambda a: mp.mpf(a == 0),
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "pow": lambda a, b: a**b,
    "constpow": lambda a, b: a**b,
    "hypot": mp.hypot,
    "atan2": mp.atan2,
    "fmax": max,
    "fmin": min,
    "copysign": lambda a, b: abs(a) if b >= 0 else -abs(a),
    "fmod": lambda a, b: a - b * truncated(a / b),
    "remainder": lambda a, b: a - b * mp.nint(a / b),
    "lt": lambda a, b: mp.mpf(a < b),
    "le": lambda a, b: mp.mpf(a <= b),
    "eq": lambda a, b: mp.mpf(a == b),
    "ne": lambda a, b: mp.mpf(a != b),
    "and": lambda a, b: mp.mpf(bool(a) and bool(b)),
    "or": lambda a, b: mp.mpf(bool(a) or bool(b)),
    "if_else_zero": lambda a, b: b if a else mp.mpf(0),
}


def in_digits(expr, u, polynomials):
    """Taylor coefficients of the expression along polynomials of time, by differences in 50 digits."""
    symbols = {symbol.element_hash(): i for i, symbol in enumerate(ca.vertsplit(u))}

    def at(t):
        values = [mp.polyval([mp.mpf(float(c)) for c in reversed(p)], t) for p in polynomials]
        return fold_graph(
            expr, lambda s: values[symbols[s.element_hash()]], lambda number: mp.mpf(number),
            lambda op, args: args[0] if op == ca.OP_ASSIGN else IN_MP[NAMES[op]](*args),
        )[0]  # fmt: skip

    with mp.workdps(50):
        return np.array([float(c) for c in mp.taylor(at, 0, ORDERS)])


def by_recurrence(expr, u, polynomials, label="f"):
    jets = taylor_decompose(expr, [u], label)
    expansion = TaylorExpansion(jets, ORDERS)
    for (_, entry), row in jets.inputs.items():
        expansion.rows[row][: len(polynomials[entry])] = list(map(float, polynomials[entry]))
    return np.array([expansion.order(k)[0] for k in range(ORDERS + 1)])


def misfit(expr, u, polynomials):
    found, exact = by_recurrence(expr, u, polynomials), in_digits(expr, u, polynomials)
    return np.max(np.abs(found - exact) / (np.abs(exact) + 1e-14 * np.abs(exact).max()))


U = ca.SX.sym("u", 2)
INSIDE = [np.array([0.4, -0.3, 0.2, 0.05]), np.array([0.7, 0.5, -0.1])]
ABOVE_ONE = [np.array([1.6, -0.3, 0.2]), np.array([2.3, 0.5, -0.1])]
EACH = {
    "neg": -U[0],
    "twice": 2 * U[0],
    "sq": U[0] ** 2,
    "inv": 1 / U[0],
    "sqrt": ca.sqrt(U[0]),
    "exp": ca.exp(U[0]),
    "log": ca.log(U[0]),
    "expm1": ca.expm1(U[0]),
    "log1p": ca.log1p(U[0]),
    "sin": ca.sin(U[0]),
    "cos": ca.cos(U[0]),
    "tan": ca.tan(U[0]),
    "asin": ca.asin(U[0]),
    "acos": ca.acos(U[0]),
    "atan": ca.atan(U[0]),
    "sinh": ca.sinh(U[0]),
    "cosh": ca.cosh(U[0]),
    "tanh": ca.tanh(U[0]),
    "asinh": ca.asinh(U[0]),
    "acosh": ca.acosh(U[0]),
    "atanh": ca.atanh(U[0]),
    "erf": ca.erf(U[0]),
    "fabs": ca.fabs(-U[0]),
    "sign": ca.sign(U[0]) * U[1],
    "floor": ca.floor(3 * U[1]) + U[0],
    "ceil": ca.ceil(3 * U[1]) + U[0],
    "not": ca.logic_not(U[0] < U[1]) + U[0],
    "add": U[0] + U[1],
    "sub": U[0] - U[1],
    "mul": U[0] * U[1],
    "div": U[0] / U[1],
    "pow": U[0] ** U[1],
    "constpow": U[0] ** 2.7,
    "hypot": ca.hypot(U[0], U[1]),
    "atan2": ca.atan2(U[0], U[1]),
    "fmax": ca.fmax(U[0], U[1]),
    "fmin": ca.fmin(U[0], U[1]),
    "copysign": ca.copysign(U[0], -U[1]),
    "fmod": ca.fmod(5 * U[1], U[0]),
    "remainder": ca.remainder(5 * U[1], U[0]),
    "lt": ca.if_else(U[0] < U[1], U[0], U[1] ** 2),
    "le": ca.if_else(U[1] <= U[0], U[0], 2),
    "eq": ca.if_else(U[0] == U[1], 1, U[0]),
    "ne": ca.if_else(U[0] != U[1], U[1], U[0]),
    "and": ca.if_else(ca.logic_and(U[0] > 0, U[1] > 0), U[0], U[1]),
    "or": ca.if_else(ca.logic_or(U[0] < 0, U[1] > 0), U[0], U[1]),
    "if_else_zero": ca.if_else(U[0] < 0, ca.sqrt(-U[0]), ca.cos(U[0])),
}


@pytest.mark.parametrize("name", EACH)
def test_each_operation(name):
    polynomials = ABOVE_ONE if name == "acosh" else INSIDE
    assert misfit(EACH[name], U, polynomials) <= 1e-12


def test_every_operation_that_the_package_writes_in_c_is_among_them():
    from nsmodel.codegen import expressions as expression

    written = {*expression._INFIX, *expression._COMPARISON_SIGNS, *expression._C_FUNCTIONS}
    written |= {ca.OP_AND, ca.OP_OR, ca.OP_NOT, ca.OP_IF_ELSE_ZERO, ca.OP_NEG, ca.OP_SQ, ca.OP_TWICE, ca.OP_INV}
    assert written <= UNARY_RECURRENCES.keys() | BINARY_RECURRENCES.keys()
    assert {NAMES[op] for op in written} <= EACH.keys() | {"constpow"}


@pytest.mark.parametrize("p", [0, 1, 2, 3, 7, 16, -1, -3, 0.5, 1.5, -2.5, 17])
def test_powers(p):
    assert misfit(ca.SX(U[0] ** p) + 0 * U[1] + U[1], U, INSIDE) <= 1e-12


@pytest.mark.parametrize("p", [2, 3, 5])
def test_whole_powers_of_what_vanishes(p):
    assert misfit(U[0] ** p + U[1], U, [np.array([0.0, 1.0, 0.3]), np.array([0.2])]) <= 1e-13


def test_numbers_apart_from_symbols_are_folded():
    jets = taylor_decompose(ca.sin(ca.SX(2)) * U[0], [U], "f")
    assert [line.kind for line in jets.lines] == ["scaled"]


def test_sine_and_cosine_of_one_argument_are_one_pair():
    assert len(taylor_decompose(ca.sin(U[0]) * ca.cos(U[0]) + ca.cosh(U[1]) - ca.sinh(U[1]), [U], "f").lines) == 7


def test_what_has_no_series_is_refused_by_name():
    hidden = ca.Function("hidden", [U], [ca.sin(U[0])], {"never_inline": True})
    with pytest.raises(OpaqueExpression, match="'f' holds call"):
        taylor_decompose(hidden(U), [U], "'f'")


COMPOSED = [
    lambda a, b: a + b,
    lambda a, b: a - 0.7 * b,
    lambda a, b: a * b,
    lambda a, b: a / (1.5 + b**2),
    lambda a, b: ca.sin(a),
    lambda a, b: ca.cos(a),
    lambda a, b: ca.exp(-(a**2)),
    lambda a, b: ca.tanh(a),
    lambda a, b: ca.atan(a),
    lambda a, b: ca.sqrt(1 + a**2),
    lambda a, b: ca.log(2 + ca.cos(a)),
    lambda a, b: ca.erf(a),
    lambda a, b: ca.atan2(a, 2 + b**2),
    lambda a, b: (1 + a**2) ** 1.3,
    lambda a, b: ca.asinh(a),
    lambda a, b: ca.hypot(a, 1 + b),
    lambda a, b: ca.fmax(a, b + 0.3),
    lambda a, b: ca.fabs(a - 5),
    lambda a, b: ca.if_else(a < b, a, ca.sin(b)),
    lambda a, b: ca.asin(ca.sin(a) / 2),
]


def composition(seed):
    """A random expression, and polynomials of degree 3; only what is far from the ends of its domain is composed."""
    rng = np.random.default_rng(seed)
    pool = list(ca.vertsplit(U))
    for _ in range(7):
        a, b = (pool[rng.integers(len(pool))] for _ in range(2))
        pool.append(COMPOSED[rng.integers(len(COMPOSED))](a, b))
    expr = pool[-1] + pool[-2] * pool[-3]
    return expr, [rng.normal(size=4) * [0.8, 0.5, 0.3, 0.2] for _ in range(2)]


@pytest.mark.parametrize("seed", range(share(60, 15)))
def test_random_compositions(seed):
    expr, polynomials = composition(seed)
    assert misfit(expr, U, polynomials) <= 1e-9


# ------------------------------------------------------------------------------------------------------------------- in C


def in_c_text(jets, name, width):
    """``static void name(double (*N)[width], double *choice, int k)``: order k of all rows but those of inputs."""
    numbers = [f"N[{row}][0] = {c_number(value).text};" for row, value in jets.numbers.items()]
    first = "\n".join([*numbers, *order_0_statements(jets, C_DIALECT)])
    later = "\n".join(higher_order_statements(jets, C_DIALECT))
    head = f"static void {name}(double (*N)[{width}], double *choice, int k)"
    return f"{head}\n{{\n(void)choice;\nif (k == 0) {{\n{first}\nreturn;\n}}\n{later}\n}}\n"


@pytest.fixture(scope="module")
def in_c(tmp_path_factory):
    """order(i, N, choice, k) of each of EACH and of random compositions, in one library; rows as `Expansion` has them."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    expressions = [*EACH.values(), *(composition(seed)[0] for seed in range(20))]
    all_jets = [taylor_decompose(expr, [U], "f") for expr in expressions]
    text = (
        "#include <math.h>\n"
        + recurrence_kernels()
        + "".join(in_c_text(jets, f"f{i}", ORDERS + 1) for i, jets in enumerate(all_jets))
    )
    cases = "".join(f"    case {i}: f{i}(N, choice, k); break;\n" for i in range(len(all_jets)))
    text += f"void order(int i, double (*N)[{ORDERS + 1}], double *choice, int k)\n{{\n    switch (i) {{\n{cases}    }}\n}}\n"
    folder = tmp_path_factory.mktemp("jets")
    (folder / "jets.c").write_text(text)
    strict = ["-std=c99", optimised("-O1"), "-Wall", "-Wextra", "-Werror", "-pedantic", "-ffp-contract=off", "-fPIC", "-shared"]
    subprocess.run([compiler, *strict, "-o", folder / "jets.so", folder / "jets.c", "-lm"], check=True)
    return ctypes.CDLL(str(folder / "jets.so")).order, all_jets


def test_c_computes_what_python_does(in_c):
    order, all_jets = in_c
    names = [*EACH, *range(20)]
    for i, (name, jets) in enumerate(zip(names, all_jets, strict=True)):
        polynomials = ABOVE_ONE if name == "acosh" else INSIDE if isinstance(name, str) else composition(name)[1]
        expansion = TaylorExpansion(jets, ORDERS)
        for (_, entry), row in jets.inputs.items():
            expansion.rows[row][: len(polynomials[entry])] = list(map(float, polynomials[entry]))
        rows, choice = np.array(expansion.rows), np.full(max(len(jets.branches), 1), np.nan)
        for k in range(ORDERS + 1):
            expansion.order(k)
            order(i, ctypes.c_void_p(rows.ctypes.data), ctypes.c_void_p(choice.ctypes.data), k)
        size = np.nanmax(np.abs(np.array(expansion.rows)), axis=0) + 1e-300  # a branch not taken may be no number
        np.testing.assert_allclose(rows / size, np.array(expansion.rows) / size, rtol=0, atol=1e-12, err_msg=str(name))
        assert np.array_equal(choice[: len(jets.branches)], expansion.choice)
