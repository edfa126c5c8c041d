"""Expressions as C: each operation, and random expressions, beside CasADi's own evaluation."""

from __future__ import annotations

import ctypes
import operator
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from conftest import optimised

from nsmodel.codegen.expressions import c_function, c_number
from nsmodel.codegen.fragments import C_FOLDER, prefix_names, prune_unused, resolve_conditions
from nsmodel.errors import CodegenError

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
DOUBLES = ctypes.POINTER(ctypes.c_double)

UNARY = {
    "sqrt": ca.sqrt, "exp": ca.exp, "log": ca.log, "sin": ca.sin, "cos": ca.cos, "tan": ca.tan, "asin": ca.asin, "acos": ca.acos,
    "atan": ca.atan, "sinh": ca.sinh, "cosh": ca.cosh, "tanh": ca.tanh, "asinh": ca.asinh, "acosh": ca.acosh, "atanh": ca.atanh,
    "fabs": ca.fabs, "floor": ca.floor, "ceil": ca.ceil, "sign": ca.sign, "erf": ca.erf, "log1p": ca.log1p, "expm1": ca.expm1,
    "neg": lambda a: -a, "sq": lambda a: a**2, "twice": lambda a: 2 * a, "inv": lambda a: 1 / a, "not": ca.logic_not,
    "cube": lambda a: a**3, "power": lambda a: a**2.5,
}  # fmt: skip
BINARY = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv, "pow": operator.pow,
    "fmin": ca.fmin, "fmax": ca.fmax, "atan2": ca.atan2, "fmod": ca.fmod, "copysign": ca.copysign, "hypot": ca.hypot,
    "remainder": ca.remainder, "lt": operator.lt, "le": operator.le, "eq": operator.eq, "ne": operator.ne,
    "and": ca.logic_and, "or": ca.logic_or, "if_else": lambda a, b: ca.if_else(a, b, 0),
    "choice": lambda a, b: ca.if_else(a < b, a, b),
}  # fmt: skip
SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, 3.7, -2.3, 1e-300, 1e300, -1e300, np.inf, -np.inf, np.nan])


def compiled(folder, inputs, outputs, name="f"):
    """The C function as a Python one of one array, which returns the outputs one after another."""
    common = resolve_conditions((C_FOLDER / "common.c").read_text(), frozenset())
    text = "typedef struct { double t, h; } model_solver;\n" + common + c_function(name, inputs, outputs, "what it computes")
    arguments = ", ".join([*inputs, *outputs])
    given = ", ".join([*(f"const double *{key}" for key in inputs), *(f"double *{key}" for key in outputs)])
    text += f"void call({given});\nvoid call({given}) {{ model_solver s = {{0, 0}}; {name}(&s, {arguments}); }}\n"
    source = folder / f"{name}.c"
    source.write_text("#include <math.h>\n#include <string.h>\n" + prune_unused(prefix_names(text, "model")))
    command = [
        "gcc",
        "-std=c99",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-pedantic",
        optimised("-O2"),
        "-fPIC",
        "-shared",
        "-o",
        f"{source}.so",
        source,
        "-lm",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    function = ctypes.CDLL(f"{source}.so").call
    sizes = [e.numel() for e in outputs.values()]

    def call(*values):
        arrays = [np.ascontiguousarray(value, float) for value in values] + [np.full(size, 7.0) for size in sizes]
        function(*(array.ctypes.data_as(DOUBLES) for array in arrays))
        return np.concatenate(arrays[len(values) :])

    return call


def assert_same(ours, theirs):
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
    np.testing.assert_allclose(ours, theirs, rtol=4e-15, atol=1e-307)


def test_every_operation(tmp_path):
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    parts = [f(a) for f in UNARY.values()] + [f(a, b) for f in BINARY.values()]
    out = ca.vertcat(*parts)
    ours, theirs = compiled(tmp_path, {"a": a, "b": b}, {"out": out}), ca.Function("f", [a, b], [out])
    names = [*UNARY, *BINARY]
    for x in SPECIAL:
        for y in SPECIAL:
            found, expected = ours([x], [y]), np.array(theirs(x, y)).ravel()
            for name, mine, other in zip(names, found, expected, strict=True):
                assert (np.isnan(mine) and np.isnan(other)) or mine == pytest.approx(other, rel=4e-15), (name, x, y)


def grown(rng, leaves, depth):
    """A random expression."""
    if depth == 0:
        return leaves[rng.integers(len(leaves))]
    one = grown(rng, leaves, depth - 1)
    if rng.uniform() < 0.4:
        name = rng.choice(["sin", "cos", "tanh", "fabs", "neg", "sq", "twice", "sign", "not", "floor"])
        return UNARY[name](one)
    name = rng.choice(["add", "sub", "mul", "div", "fmin", "fmax", "lt", "le", "and", "or", "choice", "hypot", "copysign"])
    return BINARY[name](one, grown(rng, leaves, int(rng.integers(depth))))


def test_random_expressions_with_shared_parts(tmp_path):
    rng = np.random.default_rng(1)
    x = ca.SX.sym("x", 4)
    outputs = {}
    for k in range(60):
        leaves = [*ca.vertsplit(x), ca.SX(float(rng.normal())), ca.SX(int(rng.integers(-3, 4)))]
        shared = grown(rng, leaves, 3)
        outputs[f"out{k}"] = ca.vertcat(*(grown(rng, [*leaves, shared], 5) for _ in range(3)))
    ours, theirs = compiled(tmp_path, {"x": x}, outputs), ca.Function("f", [x], [ca.vertcat(*outputs.values())])
    for _ in range(200):
        at = rng.normal(size=4) * 10.0 ** rng.integers(-2, 3, 4)
        found, expected = ours(at), np.array(theirs(at)).ravel()
        good = np.isfinite(expected) & (np.abs(expected) < 1e12)
        np.testing.assert_allclose(found[good], expected[good], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))


def test_matrices_come_row_by_row(tmp_path):
    x = ca.SX.sym("x", 2)
    A = ca.vertcat(ca.horzcat(x[0], 0, 3), ca.horzcat(x[1], x[0] * x[1], 0))
    assert_same(compiled(tmp_path, {"x": x}, {"A": A})([2, 5]), [2, 0, 3, 5, 10, 0])


@pytest.mark.parametrize("size", [12, 60])  # 60: the function is cut into several
def test_a_sparse_matrix_is_cleared_and_not_set_zero_by_zero(size, tmp_path):
    x, band = ca.SX.sym("x", size), range(-(size // 8), size // 8)
    sparse = sum(ca.sparsify(ca.diag(ca.sin(k * x) * (x + k) + ca.cos(x))) @ ca.sparsify(ca.DM(np.eye(size, k=k))) for k in band)
    outputs = {"first": sparse, "second": ca.SX.ones(size, 1), "third": ca.sparsify(ca.SX(2, 2))}
    text = c_function("f", {"x": x}, outputs)
    assert text.count("memset") == text.count(f"memset(first, 0, {size * size}*sizeof *first);") == 1
    assert text.count("first[") == sparse.nnz()
    assert ("f_1(" in text) == (size == 60)
    at = np.linspace(-2, 2, size)
    expected = [np.array(value).ravel() for value in ca.Function("e", [x], list(outputs.values()))(at)]
    assert_same(compiled(tmp_path, {"x": x}, outputs)(at), np.concatenate(expected))


def test_empty_outputs_and_unused_inputs_compile(tmp_path):
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y", 1)
    assert_same(compiled(tmp_path, {"x": x, "y": y}, {"one": x[0], "none": ca.SX(0, 1)})([2, 5], [1]), [2])


@pytest.mark.parametrize(
    "value", [0.1, 1 / 3, 1e-320, 1.7976931348623157e308, -2.5, 0.0, -0.0, 3.0, 1e15, 123456789012345680.0, 2.0**70]
)
def test_numbers_are_exact(value):
    text = c_number(value).text
    assert float(text) == value
    assert np.signbit(float(text)) == np.signbit(value)
    assert set(text) & set(".eE")


def test_special_numbers():
    assert [c_number(v).text for v in (np.inf, -np.inf, np.nan)] == ["INFINITY", "-INFINITY", "NAN"]


def test_a_call_that_is_not_inlined_is_refused():
    x = ca.SX.sym("x")
    inner = ca.Function("inner", [x], [ca.sin(x)], {"never_inline": True})
    with pytest.raises(CodegenError, match="calls a CasADi Function"):
        c_function("f", {"x": x}, {"out": inner(x)})


def test_an_operation_without_c_counterpart_is_refused_by_name():
    x = ca.SX.sym("x")
    with pytest.raises(CodegenError, match=r"'erfinv' .* no counterpart in C99"):
        c_function("f", {"x": x}, {"out": ca.erfinv(x)})


def test_conditions_of_fragments():
    text = "a\n#if ONE\nb\n#if !TWO\nc\n#else\nd\n#endif\n#else\ne\n#endif\n#ifdef OTHER\nf\n#else\ng\n#endif\n"
    assert resolve_conditions(text, {"ONE"}) == "a\nb\nc\n#ifdef OTHER\nf\n#else\ng\n#endif\n"
    assert resolve_conditions(text, {"ONE", "TWO"}).startswith("a\nb\nd\n#ifdef")
    assert resolve_conditions(text, set()).startswith("a\ne\n#ifdef")


def test_what_nothing_calls_is_pruned():
    text = (
        "#define USED 1\n#define UNUSED 2 /* gone */\n\n/* gone too */\nstatic int b(int i);\n"
        "/* deep */\nstatic int a(int i)\n{\n    return i;\n}\n\n/* b */\nstatic int b(int i)\n{\n    return a(i);\n}\n\n"
        "static int c(void) { return USED; }\n\nint d(void)\n{\n    return c();\n}\n"
    )
    left = prune_unused(text)
    assert "USED 1" in left
    assert "UNUSED" not in left
    assert "gone" not in left
    assert "int a" not in left
    assert "int b" not in left
    assert "int c" in left
    assert "int d" in left


def test_names_get_the_prefix():
    text = "model_step(MODEL_N); a_model_step; remodel_x; MODEL_SOLVER"
    assert prefix_names(text, "pump") == "pump_step(PUMP_N); a_model_step; remodel_x; PUMP_SOLVER"
