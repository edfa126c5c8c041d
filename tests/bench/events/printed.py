"""A problem in continuous time as C++ that computes Taylor coefficients order by order; linear operations cost O(1) an order."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.event_driven.problem import ContinuousProblem

Value = float | str  # A number, or the name of a row.
UNARY: dict[int, str] = {
    ca.OP_NEG: "-{0}[k]", ca.OP_TWICE: "2*{0}[k]", ca.OP_SQ: "square({0}, k)", ca.OP_SQRT: "root({0}, {y}, k)",
    ca.OP_EXP: "exponential({0}, {y}, k)",
}  # fmt: skip
NUMBERS: dict[int, Callable[..., float]] = {
    ca.OP_ADD: float.__add__, ca.OP_SUB: float.__sub__, ca.OP_MUL: float.__mul__, ca.OP_DIV: float.__truediv__,
    ca.OP_NEG: float.__neg__, ca.OP_SQ: lambda a: a * a, ca.OP_TWICE: lambda a: 2 * a, ca.OP_SIN: math.sin, ca.OP_COS: math.cos,
}  # fmt: skip


class Recurrences:
    """A member function ``name(int k)`` that computes order k of the rows of an expression into ``out``."""

    def __init__(self, name: str, inputs: list[ca.SX], expression: ca.SX, out: str) -> None:
        self.name, self.count = name, 0
        self.lines: list[str] = []
        self._lines_in_time = {"T"}  # Rows of which only orders 0 and 1 are not 0.
        self._pairs: dict[str, tuple[str, str]] = {}
        function = ca.Function(name, inputs, [ca.densify(expression)])
        rows = [lambda i: "T", "x[{}]".format, "l[{}]".format]
        work: dict[int, Value] = {}
        for k in range(function.n_instructions()):
            op, i, o = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
            if op == ca.OP_CONST:
                work[o[0]] = float(function.instruction_constant(k))
            elif op == ca.OP_INPUT:
                work[o[0]] = rows[i[0]](i[1])
            elif op == ca.OP_OUTPUT:
                value = work[i[0]]
                order = f"{value}[k]" if isinstance(value, str) else f"k == 0 ? {value!r} : 0"
                self.lines.append(f"{out.format(o[1])} = {order};")
            else:
                work[o[0]] = self._row(op, [work[j] for j in i])

    def text(self) -> str:
        """The rows in between and the function."""
        body = "\n".join(f"        {line}" for line in self.lines)
        return (
            f"    double {self.name}_rows[{max(self.count, 1)}][PM + 2];\n    void {self.name}(int k)\n    {{\n{body}\n    }}\n"
        )

    def _new(self) -> str:
        self.count += 1
        return f"{self.name}_rows[{self.count - 1}]"

    def _row(self, op: int, args: list[Value]) -> Value:
        if all(isinstance(a, float) for a in args):
            return NUMBERS[op](*args)
        if op in (ca.OP_SIN, ca.OP_COS):
            return self._sine_cosine(str(args[0]))[op == ca.OP_COS]
        y = self._new()
        self.lines.append(f"{y}[k] = {self._formula(op, args, y)};")
        if op in (ca.OP_ADD, ca.OP_SUB, ca.OP_MUL) and sum(isinstance(a, float) or a in self._lines_in_time for a in args) == 2:
            linear = op != ca.OP_MUL or any(isinstance(a, float) for a in args)
            self._lines_in_time |= {y} if linear else set()
        return y

    def _sine_cosine(self, a: str) -> tuple[str, str]:
        if a not in self._pairs:
            self._pairs[a] = s, c = self._new(), self._new()
            name = "sine_cosine_of_line" if a in self._lines_in_time else "sine_cosine"
            self.lines.append(f"{name}({a}, {s}, {c}, k);")
        return self._pairs[a]

    def _formula(self, op: int, args: list[Value], y: str) -> str:
        if op in UNARY:
            return UNARY[op].format(*args, y=y)
        if op == ca.OP_INV:
            return f"quotient(k == 0, {args[0]}, {y}, k)"
        a, b = args
        a_k, b_k = (f"{v}[k]" if isinstance(v, str) else f"(k == 0 ? {v!r} : 0)" for v in (a, b))
        if op in (ca.OP_ADD, ca.OP_SUB):
            return f"{a_k} {'+' if op == ca.OP_ADD else '-'} {b_k}"
        if op == ca.OP_MUL:
            if isinstance(a, str) and isinstance(b, str):
                return f"product({a}, {b}, k)"
            return f"{a!r}*{b_k}" if isinstance(a, float) else f"{b!r}*{a_k}"
        if op == ca.OP_DIV:
            return f"quotient({a_k}, {b}, {y}, k)" if isinstance(b, str) else f"{a_k}/{b!r}"
        raise NotImplementedError(op)


def model_text(p: ContinuousProblem, stages: int) -> str:
    """The text that ``main.cpp`` includes as MODEL; ``stages`` of Radau IIA's method, 0: without it."""
    inputs, B, D, C = [p.t, p.x, p.l], ca.jacobian(p.g, p.l), ca.jacobian(p.h, p.l), ca.jacobian(p.h, p.x)
    linear = not ca.depends_on(ca.veccat(B, D, C), ca.veccat(*inputs)) and not ca.depends_on(p.h, p.t)
    index = 1 if D.nnz() else 2
    ends = [[float(v) for v in np.array(ca.DM(end)).ravel()] for end in (p.law.lower, p.law.upper)]
    head = [
        f"constexpr int NX = {p.x.numel()}, M = {p.l.numel()}, INDEX = {index};",
        f"constexpr bool LINEAR = {str(linear).lower()};",
    ]
    head += [f"static const double {name}[M] = {_row(end)};" for name, end in zip(("LO", "UP"), ends, strict=True)]
    head += _tableau(stages) if stages else []
    rates = p.f if linear else p.f + p.g
    parts = [Recurrences("F", inputs, rates, "dx[{}]"), Recurrences("H", inputs, p.h, "y[{}][k]")]
    rows = "    double T[PM + 2], x[NX][PM + 2], l[M][PM + 2], y[M][PM + 2], dx[NX];\n"
    body = [rows, *(part.text() for part in parts)]
    if linear:
        B, C, W = (ca.DM(ca.Function("m", [], [e])()["o0"]) for e in (B, C, D if index == 1 else C @ B))
        moves, columns, normals = (
            [(j, f"x[{i}][k] += {v!r}*v;") for i, j, v in _entries(B)], [(j, f"out[{i}] = {v!r};") for i, j, v in _entries(W)],
            [(i, f"out[{j}] = {v!r};") for i, j, v in _entries(C)],
        )  # fmt: skip
        body += [
            "    void linearise() {}\n", _member("add_B(int j, double v, int k)", *_cases(moves)),
            _member("W(int j, double *out)", *_copy("M", "0"), *_cases(columns)),
            _member("normal_of(int j, double *out)", *_copy("NX", "0"), *_cases(normals)),
        ]  # fmt: skip
    else:
        W = D if index == 1 else C @ ca.jacobian(rates, p.l)
        parts = [
            Recurrences("W_", inputs, ca.vec(ca.densify(W)), "w[{}]"),
            Recurrences("C_", inputs, ca.vec(ca.densify(C).T), "c[{}]"),
        ]
        body += [
            "    double w[M*M], c[M*NX];\n", *(part.text() for part in parts), "    void linearise() { W_(0); }\n",
            _member("add_B(int, double, int)"), _member("W(int j, double *out)", *_copy("M", "w[i + M*j]")),
            _member("normal_of(int j, double *out)", "C_(0);", *_copy("NX", "c[i + NX*j]")),
        ]  # fmt: skip
    return "\n".join(head) + "\n\nstruct Model {\n" + "\n".join(body) + "};\n"


def _entries(matrix: Any) -> list[tuple[int, int, float]]:
    matrix = ca.sparsify(matrix)
    return list(zip(*matrix.sparsity().get_triplet(), map(float, matrix.nonzeros()), strict=True))


def _member(head: str, *lines: str) -> str:
    return f"    void {head}\n    {{\n" + "".join(f"        {line}\n" for line in lines) + "    }\n"


def _copy(count: str, what: str) -> list[str]:
    return [f"for (int i = 0; i < {count}; i++)", f"    out[i] = {what};"]


def _cases(lines: list[tuple[int, str]]) -> list[str]:
    of: dict[int, list[str]] = {}
    for which, line in lines:
        of.setdefault(which, []).append(line)
    return ["switch (j) {", *(f"case {which}: {' '.join(of[which])} break;" for which in sorted(of)), "}"]


def _row(values: Iterable[float]) -> str:
    return "{" + ", ".join(("-" if v < 0 else "") + "INFINITY" if math.isinf(v) else repr(float(v)) for v in values) + "}"


def _tableau(stages: int) -> list[str]:
    """Radau IIA: A, and P with x(s) = x_0 + h sum_k s^(k+1) sum_i P_ki K_i; nodes are the roots of P_s - P_(s-1) on [0, 1]."""
    difference = np.polynomial.Legendre([*[0] * (stages - 1), -1, 1], domain=[0, 1])
    c = np.sort(difference.roots().real)
    powers = np.vander(c, stages, increasing=True)
    P = np.linalg.inv(powers) / np.arange(1, stages + 1)[:, None]
    A = (powers * c[:, None]) @ P
    tables = (("RADAU_A", A), ("RADAU_P", P))
    return [f"static const double RADAU_C[{stages}] = {_row(c)};"] + [
        f"static const double {name}[{stages}][{stages}] = {{{', '.join(map(_row, table))}}};" for name, table in tables
    ]
