"""A problem on one side of each of its switches, as graphs again: f + g, h and what the switches look at, analytic everywhere.

In the dialect `printed.SYMBOLS`: order 0 of the recurrences over CasADi's symbols, with the choices of the branches as inputs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.pieces import series
from nsmodel.pieces.expansion import compile_recurrences
from nsmodel.pieces.jets import TaylorRecurrences
from nsmodel.pieces.printed import SYMBOL_DIALECT
from nsmodel.pieces.system import ModeSystem
from nsmodel.scheme.continuous import ContinuousProblem

_SYMBOLIC_FUNCTIONS = {name: getattr(ca, name if name != "pow" else "power") for name in series.ORDER_0_FUNCTIONS} | {
    "where": ca.if_else, "both": ca.logic_and, "one": ca.logic_or
}  # fmt: skip


SlopeMatrix = np.ndarray | ca.SX  # Of numbers, or of expressions of the parameters.


class FixedBranches(NamedTuple):
    """Columns of choices of the branches, one part after the other, f + g, h and what each branch looks at; and the slopes."""

    choices: ca.SX
    values: list[ca.SX]
    slopes: list[ca.SX]


def fixed_branches(
    p: ContinuousProblem, recurrences: Mapping[str, TaylorRecurrences], B: SlopeMatrix | None, D: SlopeMatrix | None
) -> FixedBranches:
    """The graphs of (t, x, l, p) and choices; ``jets`` are of f, of h without D l, and of g where it is not B l.

    The slopes are f_x + g_x, g_l, h_x and h_l.
    """
    given, choices, outputs, watched = {}, [], {}, []
    for which, symbols in enumerate((p.t, p.x, p.l, p.p)):
        given |= {(which, i): symbol for i, symbol in enumerate(ca.vertsplit(ca.vec(symbols)))}
    for name, of in recurrences.items():
        own = [ca.SX.sym(f"side_{name}_{i}") for i in range(len(of.branches))]
        outputs[name], looked = _replay_recurrences(of, given, own)
        choices += own
        watched += looked
    rate = outputs["f"] + (outputs["g"] if B is None else ca.mtimes(ca.SX(B), p.l))
    y = outputs["h"] if D is None else outputs["h"] + ca.mtimes(ca.SX(D), p.l)
    slopes = [ca.jacobian(a, b) for a in (rate, y) for b in (p.x, p.l)]
    return FixedBranches(ca.vertcat(ca.SX(0, 1), *choices), [rate, y, ca.vertcat(ca.SX(0, 1), *watched)], slopes)


def fixed_branch_functions(system: ModeSystem) -> tuple[ca.Function, ca.Function]:
    """The values and the slopes as functions of (t, x, l, choices)."""
    p, of = system.problem, fixed_branches(system.problem, system.jets, system.B, system.D)
    inputs = [p.t, p.x, p.l, of.choices]
    return (
        ca.Function("sides", inputs, [ca.densify(e) for e in of.values]),
        ca.Function("slopes_on_sides", inputs, [ca.densify(e) for e in of.slopes]),
    )


def _replay_recurrences(
    recurrences: TaylorRecurrences, given: dict[tuple[int, int], ca.SX], choices: list[ca.SX]
) -> tuple[ca.SX, list[ca.SX]]:
    """The outputs, and the rows that branches look at."""
    rows = [[ca.SX(0)] for _ in range(recurrences.count)]
    for place, row in recurrences.inputs.items():
        rows[row] = [given[place]]
    for row, number in recurrences.numbers.items():
        rows[row] = [ca.SX(number)]
    start, _ = compile_recurrences(recurrences, rows, choices, SYMBOL_DIALECT, _SYMBOLIC_FUNCTIONS)
    start()
    return ca.vertcat(ca.SX(0, 1), *(rows[row][0] for row in recurrences.outputs)), [rows[b.row][0] for b in recurrences.branches]
