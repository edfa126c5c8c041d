"""What rounding is told beside: how large everything has been so far."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Sizes:
    """The largest of each x, y, l and argument of a switch so far; of l in an interval at least its width."""

    x: list[float]
    y: list[float]
    l: list[float]
    switches: list[float]
