"""Gaps and slips of usual bodies: points, discs, corners and segments in the plane, spheres in space; gravity.

Each helper returns a `Contact` of a body with a wall or with another body. A body in the plane has positions (x, y) or
(x, y, phi) and velocities (vx, vy) or (vx, vy, omega), a sphere (x, y, z) and (vx, vy, vz) or (vx, vy, vz, wx, wy, wz), its spin
w in the axes of space. A wall is (a point on it, its normal away from the wall).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.models.mechanical_system.model import Contact

FLOOR = ((0.0, 0.0), (0.0, 1.0))  # Of the plane: y >= 0.
GROUND = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))  # Of space: z >= 0.


def gravity(masses: Any, g: float = 9.81, size: int = 2) -> np.ndarray:
    """The weights of bodies as forces: the last of ``size`` directions points up.

    Args:
        masses: of each body: (m,) of points; (m, I) of bodies in the plane, (m, I, I, I) in space, whose inertias have no weight.
        g: the acceleration.
        size: 2 in the plane, 3 in space.
    """
    forces = []
    for one in masses:
        own = np.atleast_1d(np.asarray(one, float))
        forces += [0.0] * (size - 1) + [-float(own[0]) * g] + [0.0] * (own.size - 1)
    return np.array(forces)


def point(q: ca.SX, v: ca.SX, wall: Any = FLOOR, **given: Any) -> Contact:
    """A point (x, y) or (x, y, z) above a wall.

    Args:
        q, v: its position and velocity.
        wall: (a point on it, its normal); in space it is given.
        given: mu, e, e_t of the `Contact`; ``speed``: the velocity of the wall, a belt's.
    """
    q, v = ca.SX(q), ca.SX(v)
    base, normal = _wall(wall, q.numel())
    return _contact(q, v, base, normal, given)


def disc(q: ca.SX, v: ca.SX, radius: Any, other: Any = FLOOR, **given: Any) -> Contact:
    """A disc in the plane, (x, y) or (x, y, phi), with a wall or with another disc.

    Args:
        q, v: its positions and velocities.
        radius: its radius.
        other: a wall, (a point on it, its normal), or another disc, (q, v, radius).
        given: mu, e, e_t of the `Contact`; ``speed``: the velocity of the wall, (2,).
    """
    return _round_body(ca.SX(q), ca.SX(v), radius, other, 2, given)


def corner(q: ca.SX, v: ca.SX, at: Sequence[float], wall: Any = FLOOR, **given: Any) -> Contact:
    """A corner of a body in the plane, (x, y, phi), above a wall.

    Args:
        q, v: positions and velocities of the body.
        at: where the corner is in the body, (2,), at phi = 0.
        wall, given: as of `point`.
    """
    q, v = ca.SX(q), ca.SX(v)
    if q.numel() != 3:
        raise ModelError(f"corner: the body has {q.numel()} positions; expected x, y and the angle phi")
    arm = _rotated(ca.SX(list(map(float, at))), q[2])
    base, normal = _wall(wall, 2)
    return _contact(q[:2] + arm, _rim_velocity(v, arm), base, normal, given)


def segment(q: ca.SX, v: ca.SX, radius: Any, first: Sequence[float], last: Sequence[float], **given: Any) -> Contact:
    """A disc in the plane, outside of the segment from one fixed point to another.

    Args:
        q, v, radius: of the disc.
        first, last: the ends of the segment, (2,) each.
        given: mu, e, e_t of the `Contact`.
    """
    q, v, a, b = ca.SX(q), ca.SX(v), np.asarray(first, float), np.asarray(last, float)
    along = b - a
    if not along @ along > 0:
        raise ModelError(f"segment: both ends are {a.tolist()}; give two different points")
    part = ca.fmin(ca.fmax(ca.dot(q[:2] - ca.DM(a), ca.DM(along)) / float(along @ along), 0), 1)
    away = q[:2] - ca.DM(a) - part * ca.DM(along)
    normal = away / ca.norm_2(away)
    return _round_contact(ca.norm_2(away) - radius, normal, _rim_velocity(v, -radius * normal), given)


def sphere(q: ca.SX, v: ca.SX, radius: Any, other: Any = GROUND, **given: Any) -> Contact:
    """A sphere in space with a plane or with another sphere.

    Args:
        q, v: (x, y, z), and (vx, vy, vz) or with its spin (vx, vy, vz, wx, wy, wz) in space.
        radius: its radius.
        other: a plane, (a point on it, its normal), or another sphere, (q, v, radius).
        given: mu, e, e_t of the `Contact`; ``speed``: the velocity of the plane, (3,).
    """
    return _round_body(ca.SX(q), ca.SX(v), radius, other, 3, given)


def _round_body(q: ca.SX, v: ca.SX, r: Any, other: Any, size: int, given: dict[str, Any]) -> Contact:
    """With a wall, or with another round body, (q, v, radius)."""
    if not isinstance(other, Sequence) or len(other) != 3:
        base, normal = _wall(other, size)
        return _contact(q[:size] - r * normal, _rim_velocity(v, -r * normal), base, normal, given)
    q_2, v_2, r_2 = ca.SX(other[0]), ca.SX(other[1]), other[2]
    away = q[:size] - q_2[:size]
    normal = away / ca.norm_2(away)
    velocity = _rim_velocity(v, -r * normal) - _rim_velocity(v_2, r_2 * normal)
    return _round_contact(ca.norm_2(away) - r - r_2, normal, velocity, given)


def _contact(place: ca.SX, velocity: ca.SX, base: np.ndarray, normal: np.ndarray, given: dict[str, Any]) -> Contact:
    speed = np.asarray(given.pop("speed", np.zeros(normal.size)), dtype=object)
    moving = velocity - ca.vertcat(*map(ca.SX, speed.ravel().tolist()))
    return _round_contact(ca.dot(ca.DM(normal), place - ca.DM(base)), ca.SX(ca.DM(normal)), moving, given)


def _round_contact(gap: ca.SX, normal: ca.SX, velocity: ca.SX, given: dict[str, Any]) -> Contact:
    """A contact with its slip in the directions across the normal, where it has friction."""
    if "mu" not in given:
        return Contact(gap, **given)
    slip = ca.vertcat(*(ca.dot(direction, velocity) for direction in _across(normal)))
    return Contact(gap, slip=slip, **given)


def _across(normal: ca.SX) -> list[ca.SX]:
    """Unit vectors across a unit normal: to its right in the plane; two in space (Duff et al., J. Comput. Graph. Tech. 6, 2017).

    Of a normal that moves those in space turn by a jump where its z changes sign: the law is the same in all directions.
    """
    if normal.numel() == 2:
        return [ca.vertcat(normal[1], -normal[0])]
    x, y, z = ca.vertsplit(normal)
    s = ca.if_else(z < 0, -1, 1)
    a = -1 / (s + z)
    return [ca.vertcat(1 + s * a * x * x, s * a * x * y, -s * x), ca.vertcat(a * x * y, s + a * y * y, -y)]


def _rim_velocity(v: ca.SX, arm: Any) -> ca.SX:
    """The velocity of a point of a body at ``arm`` from its centre."""
    arm = ca.SX(arm)
    if arm.numel() == 2:
        spin = v[2] if v.numel() > 2 else 0
        return v[:2] + spin * ca.vertcat(-arm[1], arm[0])
    return v[:3] + ca.cross(v[3:6], arm) if v.numel() > 3 else v[:3]


def _rotated(arm: ca.SX, phi: ca.SX) -> ca.SX:
    c, s = ca.cos(phi), ca.sin(phi)
    return ca.vertcat(c * arm[0] - s * arm[1], s * arm[0] + c * arm[1])


def _wall(wall: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    try:
        base, normal = (np.asarray(part, float).ravel() for part in wall)
    except (TypeError, ValueError):
        raise ModelError(f"wall: {wall!r}; expected (a point on it, its normal), {size} numbers each") from None
    length = np.linalg.norm(normal)
    if base.size != size or normal.size != size or not 0 < length < np.inf:
        raise ModelError(f"wall: {wall!r}; expected (a point on it, its normal), {size} numbers each, the normal not 0")
    return base, normal / length
