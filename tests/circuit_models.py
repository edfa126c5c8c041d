"""Circuits of ideal diodes as models, by modified nodal analysis: all potentials and currents of sources are multipliers.

States are the currents of coils and the voltages of capacitors, multipliers the currents of diodes (complementarity with their
reverse voltages), the potentials of nodes (equality with Kirchhoff's current law) and the currents of capacitors and sources
(equality with their voltages). So P B = C' with the energy, and D is a skew matrix plus conductances: x is unique, l often not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel import LureSystem, complementarity, equality, product

T = ca.SX.sym("t")
Element = tuple[Any, ...]  # (kind, node, node, value, start): "R", "L", "C", "V", "I", "D"; a current goes from the first node.


def circuit(elements: Sequence[Element], **given: Any) -> LureSystem:
    """The model of a circuit; node 0 is ground; a diode may have a resistance as its value."""
    nodes = sorted({node for _, a, b, *_ in elements for node in (a, b)} - {0}, key=str)
    of = {kind: [e for e in elements if e[0] == kind] for kind in "RLCVID"}
    coils, capacitors, sources = of["L"], of["C"], of["V"]
    n, d = len(coils) + len(capacitors), len(of["D"])
    m = d + len(nodes) + len(capacitors) + len(sources)
    column = {node: d + k for k, node in enumerate(nodes)}
    A, B, C, D = np.zeros((n, n)), np.zeros((n, m)), np.zeros((m, n)), np.zeros((m, m))
    e = [ca.SX(0)] * m

    def put(matrix: np.ndarray, i: int, a: Any, b: Any, size: float = 1.0) -> None:
        """The voltage between two nodes into a row."""
        for node, sign in ((a, size), (b, -size)):
            if node != 0:
                matrix[i, column[node]] += sign

    for k, (_, a, b, *resistance) in enumerate(of["D"]):
        put(D, k, b, a)
        D[k, k] = resistance[0] if resistance else 0.0
    D[d:, :d] = -D[:d, d:].T
    for _, a, b, R in of["R"]:
        for node, sign in ((a, 1.0), (b, -1.0)):
            if node != 0:
                put(D, column[node], a, b, sign / R)
    for k, (_, a, b, L, *_) in enumerate(coils):
        put(B, k, a, b, 1 / L)
        C[:, k] = L * B[k]
    for k, (_, a, b, capacity, *_) in enumerate(capacitors):
        state, own = len(coils) + k, d + len(nodes) + k
        put(D, own, a, b, -1.0)
        D[:, own] -= D[own]
        B[state, own], C[own, state] = 1 / capacity, 1.0
    for k, (_, a, b, value) in enumerate(sources):
        own = d + len(nodes) + len(capacitors) + k
        put(D, own, a, b, -1.0)
        D[:, own] -= D[own]
        e[own] = e[own] + value
    for _, a, b, value in of["I"]:
        for node, sign in ((a, 1.0), (b, -1.0)):
            if node != 0:
                e[column[node]] += sign * value
    start = [element[4] if len(element) > 4 else 0.0 for element in coils + capacitors]
    law = product(complementarity(d), equality(m - d)) if m > d else complementarity(d)
    return LureSystem(t=T, A=A, B=B, C=C, D=D, f=np.zeros(n), e=ca.vertcat(*e), law=law, x0=start, **given)


def bridge(
    pulses: int, phase: float = 0.0, coil: float = 3e-3, load: tuple[float, float] = (2.0, 10.0), start: float = 0.0
) -> list[Element]:
    """A bridge of 2 n diodes fed by n phases, with coils in the lines (0: none), onto a coil and a resistor."""
    elements: list[Element] = []
    for k in range(pulses):
        at = f"v{k}" if coil else f"a{k}"
        angle = 100 * math.pi * T + (2 * math.pi * k / pulses + phase)
        elements += [("V", at, 0, 325 * ca.cos(angle)), ("D", f"a{k}", "p"), ("D", "m", f"a{k}")]
        elements += [("L", f"v{k}", f"a{k}", coil)] if coil else []
    return [*elements, ("L", "p", "q", load[0], start), ("R", "q", "m", load[1])]


def multiplier(stages: int, phase: float = 0.0, source: float = 1.0, load: float = 1e6, capacity: float = 1e-6) -> list[Element]:
    """Cockcroft and Walton: 2 n diodes and capacitors."""
    elements: list[Element] = [("V", "in", 0, 100 * ca.sin(2000 * math.pi * T + phase)), ("R", "in", "a0", source)]
    for k in range(stages):
        below = f"b{k}" if k else 0
        elements += [("C", f"a{k}", f"a{k + 1}", capacity), ("C", below, f"b{k + 1}", capacity)]
        elements += [("D", below, f"a{k + 1}"), ("D", f"a{k + 1}", f"b{k + 1}")]
    return [*elements, ("R", f"b{stages}", 0, load)]
