"""Laws -y ∈ N_K(l), a kind of set a file: what it is, what solvers, checks and readers ask of it; its C beside it."""

from __future__ import annotations

from pathlib import Path

from nsmodel.modeling.laws.ball import Ball, BallSet, ball
from nsmodel.modeling.laws.base import CurvedSet, Law, LawFactor, StateNames, product
from nsmodel.modeling.laws.box import Box, box, complementarity, equality, relay
from nsmodel.modeling.laws.cone import Cone, ConeSet, second_order_cone
from nsmodel.modeling.laws.coulomb import Coulomb, CoulombSet, coulomb
from nsmodel.modeling.laws.ellipsoid import Ellipsoid, EllipsoidSet, ellipsoid
from nsmodel.modeling.laws.polyhedron import Polyhedron, polyhedron

FACTOR_KINDS: dict[str, type[LawFactor]] = {kind.kind: kind for kind in (Box, Ball, Cone, Polyhedron, Ellipsoid, Coulomb)}
CURVED_KINDS = [name for name, kind in FACTOR_KINDS.items() if kind.curved is not LawFactor.curved]
STATE_NAMES: dict[str, StateNames] = {label: names for kind in FACTOR_KINDS.values() for label, names in kind.STATE_NAMES.items()}
LAW_C_FOLDER = Path(__file__).parent  # NAME.c of the curved kinds

__all__ = [
    "CURVED_KINDS",
    "FACTOR_KINDS",
    "LAW_C_FOLDER",
    "STATE_NAMES",
    "BallSet",
    "Box",
    "ConeSet",
    "CoulombSet",
    "CurvedSet",
    "EllipsoidSet",
    "Law",
    "LawFactor",
    "StateNames",
    "ball",
    "box",
    "complementarity",
    "coulomb",
    "ellipsoid",
    "equality",
    "polyhedron",
    "product",
    "relay",
    "second_order_cone",
]
