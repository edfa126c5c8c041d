"""Laws -y ∈ N_K(l), a kind of set a file: what it is, what solvers, checks and readers ask of it; its C beside it."""

from __future__ import annotations

from pathlib import Path

from nsmodel.laws.ball import Ball, BallSet, ball
from nsmodel.laws.block import Block, Words
from nsmodel.laws.box import Box, box, complementarity, equality, relay
from nsmodel.laws.cone import Cone, ConeSet, second_order_cone
from nsmodel.laws.curved import Curved
from nsmodel.laws.ellipsoid import Ellipsoid, EllipsoidSet, ellipsoid
from nsmodel.laws.law import Law, product
from nsmodel.laws.polyhedron import Polyhedron, polyhedron

KINDS: dict[str, type[Block]] = {kind.kind: kind for kind in (Box, Ball, Cone, Polyhedron, Ellipsoid)}
CURVED = [name for name, kind in KINDS.items() if kind.curved is not Block.curved]
WORDS: dict[str, Words] = {label: words for kind in KINDS.values() for label, words in kind.WORDS.items()}
C = Path(__file__).parent  # NAME.c of the curved kinds

__all__ = [
    "CURVED",
    "KINDS",
    "WORDS",
    "BallSet",
    "Block",
    "Box",
    "C",
    "ConeSet",
    "Curved",
    "EllipsoidSet",
    "Law",
    "Words",
    "ball",
    "box",
    "complementarity",
    "ellipsoid",
    "equality",
    "polyhedron",
    "product",
    "relay",
    "second_order_cone",
]
