"""A law in [a, b] made smooth, l = (a + b)/2 - (b - a)/2 tanh(y/eps), as a right-hand side in plain Python for LSODA."""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca
import numpy as np

from nsmodel.event_driven.problem import ContinuousProblem

FORMULAS = {
    ca.OP_ADD: "{0} + {1}", ca.OP_SUB: "{0} - {1}", ca.OP_MUL: "{0}*{1}", ca.OP_DIV: "{0}/{1}", ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0}*{0}", ca.OP_TWICE: "2*{0}", ca.OP_SIN: "sin({0})", ca.OP_TANH: "tanh({0})", ca.OP_ASSIGN: "{0}",
}  # fmt: skip


def smoothed(p: ContinuousProblem) -> Callable[[float], Callable]:
    """eps to the right-hand side rate(t, x); y must not depend on l."""
    eps = ca.SX.sym("eps")
    a, b = (np.array(ca.DM(end)).ravel() for end in (p.law.lower, p.law.upper))
    l = (a + b) / 2 - (b - a) / 2 * ca.tanh(p.h / eps)
    rate = ca.substitute(p.f + p.g, p.l, l)
    return _python(ca.Function("rate", [p.t, p.x, eps], [ca.densify(rate)]), p.x.numel())


def _python(f: ca.Function, n: int) -> Callable[[float], Callable]:
    names = [["t"], [f"x{i}" for i in range(n)], ["eps"]]
    lines, work, outputs = [], {}, [""] * n
    for k in range(f.n_instructions()):
        op, i, o = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_INPUT:
            work[o[0]] = names[i[0]][i[1]]
        elif op == ca.OP_CONST:
            work[o[0]] = repr(f.instruction_constant(k))
        elif op == ca.OP_OUTPUT:
            outputs[o[1]] = work[i[0]]
        else:
            lines.append(f"        w{k} = {FORMULAS[op].format(*(work[j] for j in i))}")
            work[o[0]] = f"w{k}"
    head = f"def of(eps):\n    def rate(t, x):\n        {', '.join(names[1])} = x.tolist()\n"
    scope: dict = {"sin": math.sin, "tanh": math.tanh}
    exec(
        compile(head + "\n".join(lines) + f"\n        return ({', '.join(outputs)},)\n    return rate\n", "<rate>", "exec"), scope
    )
    return scope["of"]
