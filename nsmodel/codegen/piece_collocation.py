"""What pieces of stiff modes in C are made of: the matrices of Radau IIA; f, g and h on one side of each switch, and slopes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from nsmodel.codegen.expression import c_function
from nsmodel.codegen.tables import c_table
from nsmodel.pieces.collocation import Collocation, radau_collocation
from nsmodel.pieces.integrator import MIN_RTOL
from nsmodel.pieces.lengths import ROUGHEST, taylor_order
from nsmodel.pieces.radau import stage_count
from nsmodel.pieces.sides import fixed_branches

if TYPE_CHECKING:
    from nsmodel.codegen.piece_scene import PieceSpec

MIN_STAGES, MAX_STAGES = (stage_count(taylor_order(rtol)) for rtol in (ROUGHEST, MIN_RTOL))  # Stages.
MATRICES_BYTES = 32 << 10  # Memory for the matrices of modes, or of lengths.
MAX_UNKNOWNS = 32  # Rows of x and l: matrices of the stages are dense, and kept.


def kept_matrix_count(size: int, least: int, most: int) -> int:
    """How many matrices of so many bytes are kept."""
    return max(least, min(MATRICES_BYTES // size, most))


def collocation_sizes(unknown: int) -> dict[str, int]:
    """The constants of the header, for so many rows of x and l."""
    return {"STAGES": MAX_STAGES, "OCTAVES": kept_matrix_count(16 * MAX_STAGES * max(unknown, 1) ** 2, 1, 16)}


def collocation_code(spec: PieceSpec, given: Mapping[str, ca.SX]) -> str:
    """The tables and functions; ``given``: t, x, l and parameters by their names."""
    p, (B, D, _) = spec.problem, spec.matrices
    whole = replace(p, p=ca.veccat(p.p, spec.parameter_parts.symbols))
    of = fixed_branches(whole, {name: made.jets for name, made in spec.printers.items()}, B, D)
    of = of._replace(values=spec.parameter_parts.back(of.values), slopes=spec.parameter_parts.back(of.slopes))
    sided = dict(given) | ({"s->at.choice": of.choices} if of.choices.numel() else {})
    text = _radau_tables()
    if of.choices.numel():
        text += _piece_function("sides", sided, dict(zip(("rate", "y", "watched"), map(ca.densify, of.values), strict=True)))
    return (
        text + "\n" + _piece_function("slopes_on_sides", sided, dict(zip(("f_x", "g_l", "h_x", "h_l"), of.slopes, strict=True)))
    )


def _piece_function(name: str, given: Mapping[str, ca.SX], out: Mapping[str, ca.SX]) -> str:
    return c_function(name, given, out).replace("model_solver", "model_pieces")


def _radau_tables() -> str:
    """The matrices of all stages there are, one after the other in the order of ``collocation`` in c/pieces_radau.c."""
    stages = range(MIN_STAGES, MAX_STAGES + 1, 2)
    made = [np.concatenate([np.ravel(part) for part in _real_coefficients(radau_collocation(s))]) for s in stages]
    return (
        f"#define FEWEST_STAGES {MIN_STAGES}\n"
        + "".join(c_table(f"radau_{s}", all_of, str(len(all_of))) for s, all_of in zip(stages, made, strict=True))
        + (f"static const double *const radau_tables[] = {{{', '.join(f'radau_{s}' for s in stages)}}};\n")
    )


def _real_coefficients(of: Collocation) -> list[np.ndarray | float]:
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
