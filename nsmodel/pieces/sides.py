"""A problem on one side of each of its switches, as graphs again: f + g, h and what the switches look at, analytic everywhere.

The fourth dialect of `printed`: order 0 of the recurrences over CasADi's symbols, with the choices of the branches as inputs.
"""

from __future__ import annotations

import casadi as ca

from nsmodel.pieces import series
from nsmodel.pieces.expansion import compiled
from nsmodel.pieces.jets import Jets
from nsmodel.pieces.printed import PYTHON
from nsmodel.pieces.system import System

_GRAPH = PYTHON._replace(
    either="where({0}, {1}, {2})".format,
    both="both({0} != 0.0, {1} != 0.0)",
    one="one({0} != 0.0, {1} != 0.0)",
    ratio="{0} / {1}",
    choose="pass",
)
_KNOWN = {name: getattr(ca, name if name != "pow" else "power") for name in series.STARTS} | {
    "where": ca.if_else, "both": ca.logic_and, "one": ca.logic_or
}  # fmt: skip


def on_sides(system: System) -> tuple[ca.Function, ca.Function]:
    """Functions of (t, x, l, choices): (f + g, h, what each branch looks at), and (f_x + g_x, g_l, h_x, h_l).

    The choices are those of the branches of ``system.parts``, one part after the other.
    """
    p, given, choices, outputs, watched = system.problem, {}, [], {}, []
    for which, symbols in enumerate((p.t, p.x, p.l)):
        given |= {(which, i): symbol for i, symbol in enumerate(ca.vertsplit(ca.vec(symbols)))}
    for name, jets in system.jets.items():
        own = [ca.SX.sym(f"side_{name}_{i}") for i in range(len(jets.branches))]
        outputs[name], looked = _replayed(jets, given, own)
        choices += own
        watched += looked
    rate = outputs["f"] + (outputs["g"] if system.B is None else ca.mtimes(ca.SX(system.B), p.l))
    y = outputs["h"] if system.D is None else outputs["h"] + ca.mtimes(ca.SX(system.D), p.l)
    inputs = [p.t, p.x, p.l, ca.vertcat(ca.SX(0, 1), *choices)]
    slopes = [ca.jacobian(a, b) for a in (rate, y) for b in (p.x, p.l)]
    return (
        ca.Function("sides", inputs, [ca.densify(e) for e in (rate, y, ca.vertcat(ca.SX(0, 1), *watched))]),
        ca.Function("slopes_on_sides", inputs, [ca.densify(e) for e in slopes]),
    )


def _replayed(jets: Jets, given: dict[tuple[int, int], ca.SX], choices: list[ca.SX]) -> tuple[ca.SX, list[ca.SX]]:
    """The outputs, and the rows that branches look at."""
    rows = [[ca.SX(0)] for _ in range(jets.count)]
    for place, row in jets.inputs.items():
        rows[row] = [given[place]]
    for row, number in jets.numbers.items():
        rows[row] = [ca.SX(number)]
    start, _ = compiled(jets, rows, choices, _GRAPH, _KNOWN)
    start()
    return ca.vertcat(ca.SX(0, 1), *(rows[row][0] for row in jets.outputs)), [rows[b.row][0] for b in jets.branches]
