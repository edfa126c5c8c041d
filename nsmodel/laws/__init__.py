"""The kinds of sets that a law is made of, by name: what each does stands in a file of its own."""

from __future__ import annotations

import casadi as ca

from nsmodel.errors import ModelError
from nsmodel.laws.ball import Ball
from nsmodel.laws.cone import Cone
from nsmodel.laws.curved import Curved

CURVED: dict[str, type[Curved]] = {kind.kind: kind for kind in (Ball, Cone)}
FLAT = ("box", "polyhedron")  # A polyhedron is rewritten for boxes.


def curved_set(kind: str, size: int, upper: ca.SX) -> Curved:
    """The set of a curved block, its numbers in ``upper`` (size, 1).

    Raises:
        ModelError: a kind that is not known.
    """
    if kind not in CURVED:
        raise ModelError(f"law: kind '{kind}' is not known; expected one of {', '.join([*FLAT, *CURVED])}")
    return CURVED[kind].of(size, upper)
