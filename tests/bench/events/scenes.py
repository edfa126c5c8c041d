"""The scenes: models, references where they are at hand, and how each is written by hand."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from peers import in_scipy

import nsmodel
from events import by_hand

ROOT = Path(__file__).resolve().parents[3]
REFERENCES = ROOT.parent / "shared" / "data" / "event_driven"
sys.path.insert(0, str(ROOT / "tests"))

from event_scenes import stiff_relay  # noqa: E402


@dataclass(frozen=True)
class Scene:
    """A model, how it is written by hand, and its law made smooth for LSODA: "tanh", by hand, or not at all.

    ``h_max``: the largest step of programs that would leap over the scene; ``stiff``: whether its modes are.
    """

    name: str
    model: Any
    hand: Callable[..., by_hand.Mode] | None = None
    smooth: str | Callable[[float], Callable] | None = "tanh"
    h_max: float = 0.0
    stiff: bool = False

    def reference(self) -> np.ndarray | None:
        """States (241, n) at equidistant times in 113-bit arithmetic, where that file is at hand."""
        path = REFERENCES / f"{self.name}_ref.npz"
        return np.load(path)["rows"] if path.exists() else None


def scenes() -> list[Scene]:
    """All of them, small ones first."""
    case = {name: nsmodel.load(name) for name in (
        "friction_oscillator", "friction_oscillator_relay", "sliding_relay", "diode_bridge", "relay_oscillator", "gene_network",
        "point_past_disc")}  # fmt: skip
    hands = {
        "friction_oscillator": by_hand.friction, "friction_oscillator_relay": by_hand.friction,
        "sliding_relay": by_hand.sliding_relay, "relay_oscillator": by_hand.relay_oscillator,
        "gene_network": by_hand.gene_network,
    }  # fmt: skip
    found = [Scene(name, case[name], hand) for name, hand in hands.items()]
    found += [
        Scene("diode_bridge", case["diode_bridge"], by_hand.diode_bridge, in_scipy.diode_bridge),
        Scene("point_past_disc", case["point_past_disc"], by_hand.point_past_disc, in_scipy.point_past_disc, h_max=0.1),
        Scene("stiff_relay_3", stiff_relay(1e3), by_hand.stiff_relay(1e3), None, stiff=True),
        Scene("stiff_relay_5", stiff_relay(1e5), by_hand.stiff_relay(1e5), None, stiff=True),
    ]
    for n in (10, 50, 100, 200):
        chain = nsmodel.load("friction_chain", n=n)
        small = n == 10
        found.append(Scene(f"friction_chain_{n}", chain, by_hand.friction_chain(n) if small else None, "tanh" if small else None))
    return found
