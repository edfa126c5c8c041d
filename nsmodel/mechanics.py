"""Helpers for mechanical systems in the plane and in space: gaps and slips of usual bodies, gravity."""

from nsmodel.models.mechanical_system.geometry import corner, disc, gravity, point, segment, sphere

__all__ = ["corner", "disc", "gravity", "point", "segment", "sphere"]
