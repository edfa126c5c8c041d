"""What pieces of stiff modes in C are made of: the matrices of Radau IIA; f, g and h on one side of each switch, and slopes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from nsmodel.codegen.expression import c_function
from nsmodel.codegen.tables import table
from nsmodel.pieces.collocation import Collocation, collocation
from nsmodel.pieces.integrator import LEAST_RTOL
from nsmodel.pieces.lengths import ROUGHEST, order_of
from nsmodel.pieces.radau import stages_of
from nsmodel.pieces.sides import on_sides

if TYPE_CHECKING:
    from nsmodel.codegen.piece_scene import PieceScene

LEAST, MOST = (stages_of(order_of(rtol)) for rtol in (ROUGHEST, LEAST_RTOL))  # Stages.
KEPT_BYTES = 32 << 10  # Memory for the matrices of modes, or of lengths.
MOST_UNKNOWN = 32  # Rows of x and l: matrices of the stages are dense, and kept.


def kept_in(size: int, least: int, most: int) -> int:
    """How many matrices of so many bytes are kept."""
    return max(least, min(KEPT_BYTES // size, most))


def memory(unknown: int) -> dict[str, int]:
    """The constants of the header, for so many rows of x and l."""
    return {"STAGES": MOST, "OCTAVES": kept_in(16 * MOST * max(unknown, 1) ** 2, 1, 16)}


def collocation_code(scene: PieceScene, given: Mapping[str, ca.SX]) -> str:
    """The tables and functions; ``given``: t, x, l and parameters by their names."""
    p, (B, D, _) = scene.problem, scene.matrices
    whole = replace(p, p=ca.veccat(p.p, scene.derived.symbols))
    of = on_sides(whole, {name: made.jets for name, made in scene.printers.items()}, B, D)
    of = of._replace(values=scene.derived.back(of.values), slopes=scene.derived.back(of.slopes))
    sided = dict(given) | ({"s->at.choice": of.choices} if of.choices.numel() else {})
    text = _tables()
    if of.choices.numel():
        text += _function("sides", sided, dict(zip(("rate", "y", "watched"), map(ca.densify, of.values), strict=True)))
    return text + "\n" + _function("slopes_on_sides", sided, dict(zip(("f_x", "g_l", "h_x", "h_l"), of.slopes, strict=True)))


def _function(name: str, given: Mapping[str, ca.SX], out: Mapping[str, ca.SX]) -> str:
    return c_function(name, given, out).replace("model_solver", "model_pieces")


def _tables() -> str:
    """The matrices of all stages there are, one after the other in the order of ``collocation`` in c/pieces_radau.c."""
    stages = range(LEAST, MOST + 1, 2)
    made = [np.concatenate([np.ravel(part) for part in _parts(collocation(s))]) for s in stages]
    return (
        f"#define FEWEST_STAGES {LEAST}\n"
        + "".join(table(f"radau_{s}", all_of, str(len(all_of))) for s, all_of in zip(stages, made, strict=True))
        + (f"static const double *const radau_tables[] = {{{', '.join(f'radau_{s}' for s in stages)}}};\n")
    )


def _parts(of: Collocation) -> list[np.ndarray | float]:
    """Real blocks for complex pairs: w = (w_0, u, v, ...) with a w_0, and (a u - b v, b u + a v) of a pair a + b i."""
    order = np.argsort(np.imag(of.rates))
    rates, left, right = of.rates[order], of.left[order], of.right[:, order]
    return [
        of.share, of.nodes, of.between, of.weights,
        np.concatenate([np.real(rates[:1]), *([[z.real, z.imag] for z in rates[1:]])]),
        of.inverse, of.powers, of.middle, of.values, of.slopes,
        np.vstack([np.real(left[:1]), *(part for row in left[1:] for part in (np.real(row), np.imag(row)))]),
        np.column_stack([np.real(right[:, :1]), *(part for c in right[:, 1:].T for part in (np.real(c), -np.imag(c)))]),
    ]  # fmt: skip
