"""Crowds: rooms from segments or pictures, shortest ways out, people, and what is measured on a run (see `models.crowd`)."""

import sys

from nsmodel.models.crowd import (
    DesiredVelocity,
    Noise,
    People,
    Room,
    arrivals,
    box,
    crowd,
    desired_velocity,
    disc,
    measure,
    place,
)

__all__ = ["DesiredVelocity", "Noise", "People", "Room", "arrivals", "box", "crowd", "desired_velocity", "disc", "place"]

sys.modules[f"{__name__}.measure"] = measure
