"""CasADi expressions evaluated in 64 decimal digits, and linear systems solved in them."""

from __future__ import annotations

import decimal
from collections.abc import Sequence
from decimal import Decimal
from typing import Any

import casadi as ca
import mpmath
import numpy as np

DIGITS = 64
CONTEXT = decimal.Context(prec=DIGITS, Emin=-999999, Emax=999999, traps=[decimal.InvalidOperation, decimal.DivisionByZero])
mpmath.mp.dps = DIGITS + 6


def by_mpmath(name: str):
    function = getattr(mpmath, name)
    return lambda a: Decimal(mpmath.nstr(function(mpmath.mpf(str(a))), DIGITS))


def _sign(a: Decimal) -> int:
    return (a > 0) - (a < 0)


def _tanh(a: Decimal) -> Decimal:
    e = (-2 * abs(a)).exp()
    return ((1 - e) / (1 + e)).copy_sign(a)


def _power(a: Decimal, b: Decimal) -> Decimal:
    return a ** int(b) if b == int(b) else a**b


_BINARY = {
    ca.OP_ADD: "{0}+{1}", ca.OP_SUB: "{0}-{1}", ca.OP_MUL: "{0}*{1}", ca.OP_DIV: "{0}/{1}", ca.OP_POW: "_power({0},{1})",
    ca.OP_CONSTPOW: "_power({0},{1})", ca.OP_FMIN: "min({0},{1})", ca.OP_FMAX: "max({0},{1})", ca.OP_LT: "D({0}<{1})",
    ca.OP_LE: "D({0}<={1})", ca.OP_EQ: "D({0}=={1})", ca.OP_NE: "D({0}!={1})", ca.OP_AND: "D(bool({0}) and bool({1}))",
    ca.OP_OR: "D(bool({0}) or bool({1}))", ca.OP_IF_ELSE_ZERO: "({1} if {0} else D(0))", ca.OP_COPYSIGN: "{0}.copy_sign({1})",
    ca.OP_HYPOT: "({0}*{0}+{1}*{1}).sqrt()",
}  # fmt: skip
_UNARY = {
    ca.OP_ASSIGN: "{0}", ca.OP_NEG: "-{0}", ca.OP_EXP: "{0}.exp()", ca.OP_LOG: "{0}.ln()", ca.OP_SQRT: "{0}.sqrt()",
    ca.OP_SQ: "{0}*{0}", ca.OP_TWICE: "2*{0}", ca.OP_FABS: "abs({0})", ca.OP_SIGN: "D(_sign({0}))", ca.OP_INV: "1/{0}",
    ca.OP_NOT: "D(not {0})", ca.OP_SIN: "_sin({0})", ca.OP_COS: "_cos({0})", ca.OP_TANH: "_tanh({0})",
    ca.OP_COSH: "({0}.exp()+(-{0}).exp())/2", ca.OP_SINH: "({0}.exp()-(-{0}).exp())/2", ca.OP_LOG1P: "(1+{0}).ln()",
    ca.OP_EXPM1: "({0}.exp()-1)", ca.OP_ATAN: "_atan({0})",
}  # fmt: skip
_NAMES = {
    "D": Decimal, "_sin": by_mpmath("sin"), "_cos": by_mpmath("cos"), "_atan": by_mpmath("atan"), "_tanh": _tanh,
    "_sign": _sign, "_power": _power, "min": min, "max": max, "abs": abs, "bool": bool,
}  # fmt: skip


def exact(value: float) -> Decimal:
    """The double as it is, to DIGITS digits."""
    return CONTEXT.create_decimal(Decimal(float(value)))


def column(values: Sequence[float]) -> list[Decimal]:
    """Doubles (or what is already exact) as decimals."""
    return [v if isinstance(v, Decimal) else exact(v) for v in values]


def floats(values: Sequence[Decimal]) -> np.ndarray:
    return np.array([float(v) for v in values])


class Exact:
    """``call(*columns)``: the outputs of a CasADi function of SX columns, each a list of decimals."""

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> None:
        f = ca.Function("f", list(inputs), [ca.densify(ca.vec(e)) for e in outputs], {"cse": True})
        lines, constants = ["def run(inputs, outputs, k):"], []
        for i in range(f.n_instructions()):
            op, source, target = f.instruction_id(i), f.instruction_input(i), f.instruction_output(i)
            if op == ca.OP_INPUT:
                lines.append(f"    w{target[0]}=inputs[{source[0]}][{source[1]}]")
            elif op == ca.OP_OUTPUT:
                lines.append(f"    outputs[{target[0]}][{target[1]}]=w{source[0]}")
            elif op == ca.OP_CONST:
                constants.append(exact(f.instruction_constant(i)))
                lines.append(f"    w{target[0]}=k[{len(constants) - 1}]")
            else:
                form = _UNARY[op] if op in _UNARY else _BINARY[op]
                lines.append(f"    w{target[0]}=" + form.format(*(f"w{j}" for j in source)))
        lines.append("    return outputs")
        space: dict[str, Any] = dict(_NAMES)
        exec("\n".join(lines), space)
        self._run, self._constants, self._sizes = space["run"], constants, [e.numel() for e in outputs]

    def __call__(self, *inputs: Sequence[Decimal]) -> list[list[Decimal]]:
        with decimal.localcontext(CONTEXT):
            return self._run(inputs, [[Decimal(0)] * size for size in self._sizes], self._constants)


class Rounding:
    """``call(*columns)``: in units of eps, how far rounding of inputs, constants and each operation moves the outputs at most."""

    def __init__(self, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> None:
        self._f = f = ca.Function("f", list(inputs), [ca.densify(ca.vec(e)) for e in outputs], {"cse": True})
        self._code = [
            (f.instruction_id(i), f.instruction_input(i), f.instruction_output(i),
             f.instruction_constant(i) if f.instruction_id(i) == ca.OP_CONST else 0.0)
            for i in range(f.n_instructions())
        ]  # fmt: skip
        self._sizes = [e.numel() for e in outputs]
        a, b = ca.SX.sym("a"), ca.SX.sym("b")
        self._rule = {}
        for op in {op for op, *_ in self._code} - {ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST}:
            e = ca.SX.unary(op, a) if op in _UNARY else ca.SX.binary(op, a, b)
            self._rule[op] = ca.Function("rule", [a, b], [e, ca.gradient(e, a), ca.gradient(e, b)])

    def __call__(self, *inputs: Sequence[float]) -> list[np.ndarray]:
        value: dict[int, float] = {}
        error: dict[int, float] = {}
        out = [np.zeros(size) for size in self._sizes]
        for op, source, target, constant in self._code:
            if op == ca.OP_OUTPUT:
                out[target[0]][target[1]] = error[source[0]]
                continue
            t = target[0]
            if op == ca.OP_INPUT:
                value[t] = float(inputs[source[0]][source[1]])
                error[t] = abs(value[t])
            elif op == ca.OP_CONST:
                value[t], error[t] = constant, abs(constant) if constant != round(constant, 3) else 0.0
            elif op == ca.OP_ADD or op == ca.OP_SUB:
                i, j = source
                e = error[i] + error[j]
                value[t] = value[i] + value[j] if op == ca.OP_ADD else value[i] - value[j]
                error[t] = e + abs(value[t])
            elif op == ca.OP_MUL:
                i, j = source
                e = abs(value[i]) * error[j] + abs(value[j]) * error[i]
                value[t] = value[i] * value[j]
                error[t] = e + abs(value[t])
            elif op == ca.OP_NEG:
                value[t], error[t] = -value[source[0]], error[source[0]]
            else:
                i, j = source[0], source[-1]
                v, da, db = (float(part) for part in self._rule[op](value[i], value[j]))
                e = abs(da) * error[i] + (abs(db) * error[j] if len(source) > 1 else 0.0)
                value[t], error[t] = v, (e if e == e else abs(v)) + abs(v)
        return out


def solve(J: list[list[Decimal]], r: list[Decimal]) -> list[Decimal] | None:
    """J^{-1} r by elimination with scaled partial pivoting; None where a pivot vanishes beside its row (1e-45)."""
    with decimal.localcontext(CONTEXT):
        n = len(r)
        rows = [[*row, r[i]] for i, row in enumerate(J)]
        size = [max((abs(v) for v in row), default=Decimal(0)) for row in J]
        if not all(size):
            return None
        for k in range(n):
            p = max(range(k, n), key=lambda i: abs(rows[i][k]) / size[i])
            if abs(rows[p][k]) <= Decimal("1e-45") * size[p]:
                return None
            rows[k], rows[p], size[k], size[p] = rows[p], rows[k], size[p], size[k]
            top = rows[k]
            for i in range(k + 1, n):
                row = rows[i]
                if row[k]:
                    f = row[k] / top[k]
                    for j in range(k + 1, n + 1):
                        if top[j]:
                            row[j] -= f * top[j]
        u = [Decimal(0)] * n
        for k in reversed(range(n)):
            s = rows[k][n]
            for j in range(k + 1, n):
                if u[j]:
                    s -= rows[k][j] * u[j]
            u[k] = s / rows[k][k]
        return u
