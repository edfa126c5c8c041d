"""Crowds: rooms from segments or pictures, shortest ways out, people, and what is measured on a run.

A crowd is a `ManyBodies` model like any other; nothing here is needed to write one down by hand.
"""

from nsmodel.models.crowd.paths import DesiredVelocity, desired_velocity
from nsmodel.models.crowd.people import Noise, People, arrivals, crowd, place
from nsmodel.models.crowd.room import Room, box, disc

__all__ = ["DesiredVelocity", "Noise", "People", "Room", "arrivals", "box", "crowd", "desired_velocity", "disc", "place"]
