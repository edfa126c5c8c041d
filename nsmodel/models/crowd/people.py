"""People in a room: where they start without overlap, who comes in through a door and when; and the crowd as a model.

A will that changes: the direction that each person wants, turned at random now and then.

An arch before a door holds for ever where all wishes are steady. Models of crowds have fluctuations for that: a random force
in Helbing and Molnar (Social force model for pedestrian dynamics, Phys. Rev. E 51, 1995), a random angle that is even on an
interval in Vicsek et al. (Novel type of phase transition in a system of self-driven particles, Phys. Rev. Lett. 75, 1995); the
latter is the one here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.parameters import describe_argument
from nsmodel.models.crowd.geometry import (
    LEAF_SIZE,
    checked_array,
    checked_number,
    contains,
    crosses_any,
    nearest_points,
    per_person_values,
    polygon_sides,
    radius_range,
    random_generator,
)
from nsmodel.models.crowd.paths import CORNER_DISTANCE, DesiredVelocity, desired_velocity
from nsmodel.models.crowd.room import Room, checked_polygon
from nsmodel.models.many_bodies.families import Bodies, Family, Items
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.proof.verdict import not_none


@dataclass(frozen=True)
class Noise:
    """How a will changes: every ``every`` seconds each person draws an angle, even on [-angle, angle], to turn the wish by.

    The angle of person i in the n-th interval is a function of (seed, n, i) alone, by a generator that counts (Philox): it is
    the same however a run is stepped, and after it was resumed.

    Attributes:
        angle: the largest angle, rad; pi forgets where the exit is.
        every: s.
        seed: a whole number >= 0.
    """

    angle: float
    every: float = 0.5
    seed: int = 1

    def __post_init__(self) -> None:
        angle = checked_number(self.angle, "noise: angle", "an angle > 0 and at most pi, in radians")
        if angle > np.pi:
            raise ModelError(f"noise: angle: {angle:g}; expected an angle > 0 and at most pi, in radians")
        checked_number(self.every, "noise: every", "a number > 0, in s")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int | np.integer) or not 0 <= self.seed < 2**128:
            raise ModelError(f"noise: seed: {describe_argument(self.seed)}; expected a whole number >= 0")

    def angles(self, t: float, count: int) -> np.ndarray:
        """The angles (count,) at time t."""
        interval = int(np.floor(t / self.every + 1e-9))
        raw = np.random.Philox(counter=interval << 64, key=int(self.seed)).random_raw(count)
        return self.angle * (2.0**-52 * (raw >> np.uint64(11)) - 1.0)


@dataclass(frozen=True, eq=False)
class NoisyVelocity:
    """The velocity wanted, turned by noise inside the room: ``(t, q (N, 2)) -> (N, 2)``; who is past a door walks on."""

    desired: DesiredVelocity
    noise: Noise

    __repr__ = short_repr

    def __call__(self, t: float, q: np.ndarray) -> np.ndarray:
        """The velocity (N, 2) of people at q (N, 2)."""
        wanted = self.desired(t, q)
        angle = np.where(self.desired.outside(q), 0.0, self.noise.angles(t, len(q)))
        c, s = np.cos(angle), np.sin(angle)
        return np.column_stack([c * wanted[:, 0] - s * wanted[:, 1], s * wanted[:, 0] + c * wanted[:, 1]])


MAX_PUSH_ROUNDS = 4000  # Of pushing apart, before `place` says that there is no room.
# Rounds after which those who still overlap somebody placed before, who does not give way, are put elsewhere.
WEDGED_ROUNDS = 200
# Radii are enlarged by it while `place` pushes people apart, m, and half of it is left: no contact is closed at the start.
MIN_SEPARATION = 1e-3
# How deep the place behind a door is in which people are taken away, m, or two strides if these are longer: none steps over it.
EXIT_ZONE_DEPTH = 1.0


@dataclass(frozen=True, eq=False)
class People:
    """A group: places (N, 2) and radii (N,) in m, the exit wanted (see `desired_velocity`), speed in m/s, times of entry in s."""

    places: np.ndarray
    radii: np.ndarray
    to: Any = None
    speed: Any = 1.0
    enter: Any = 0.0

    __repr__ = short_repr

    def __post_init__(self) -> None:
        places = checked_array(self.places, "places", "(N, 2), in metres")
        if places.ndim != 2 or places.shape[1] != 2 or not len(places):
            raise ModelError(f"places: shape {places.shape}; expected (N, 2)")
        count = len(places)
        for name, unit, zero in (("radii", "m", False), ("speed", "m/s", True), ("enter", "s", True)):
            object.__setattr__(self, name, per_person_values(getattr(self, name), name, count, unit, zero=zero))
        object.__setattr__(self, "places", places)
        if isinstance(self.to, list | np.ndarray):
            if len(self.to) != count:
                raise ModelError(f"to: {len(self.to)} exits; expected one for each of {count} people")
            object.__setattr__(self, "to", list(self.to))

    def __len__(self) -> int:
        """Return how many they are."""
        return len(self.places)


def place(
    room: Room, count: int, radii: Any = (0.2, 0.25), *, seed: int = 1, inside: Any = None, beside: Sequence[People] = (),
    to: Any = None, speed: Any = 1.0,
) -> People:  # fmt: skip
    """Put people into a room at random, without overlap: scattered evenly, then pushed apart.

    Args:
        room: the room.
        count: how many.
        radii: (least, largest) of radii drawn evenly, m; or one radius for all.
        seed: of the random numbers; the same seed gives the same people.
        inside: a polygon (P, 2), see `box`, that holds the centres; the whole room if left out.
        beside: groups placed before, which these people do not overlap.
        to: the exit they take, see `desired_velocity`.
        speed: m/s, one number or (count,).

    Returns:
        The group. Places are at least 1 mm apart. Up to 55 % of the area can be covered in any room; more takes longer, or fails.

    Raises:
        ModelError: they do not fit; the message says how full the room would be.
    """
    from scipy.spatial import KDTree

    if not isinstance(count, int | np.integer) or count < 1:
        raise ModelError(f"place: {describe_argument(count)} people; expected a whole number >= 1")
    if not isinstance(beside, list | tuple) or not all(isinstance(group, People) for group in beside):
        raise ModelError(f"beside: {describe_argument(beside)}; expected a list of groups of people")
    low, high = radius_range(radii)
    rng = random_generator(seed)
    sizes = rng.uniform(low, high, count)
    corners = None if inside is None else checked_polygon(inside, "inside")
    grid = room.grid(min(0.1, low / 2))
    allowed = room.inside(grid)
    if corners is not None:
        allowed &= contains(corners, grid.nodes.reshape(-1, 2)).reshape(allowed.shape)
        if not allowed.any():
            raise ModelError("place: no free point of the room is in the polygon inside=")
    nodes, walls = grid.nodes[allowed], np.concatenate([room.segments, room.doors])
    fixed = np.concatenate([np.zeros((0, 2)), *(people.places for people in beside)])
    taken = np.concatenate([np.zeros(0), *(people.radii for people in beside)])
    if len(fixed):
        away, who = KDTree(fixed, LEAF_SIZE).query(nodes)
        nodes = nodes[away > taken[who] + low]
    area, covered = len(nodes) * grid.spacing**2, np.pi * (sizes**2).sum()
    sizes = np.concatenate([sizes, taken])
    q = None
    if covered < 0.85 * area:
        start = nodes[rng.integers(len(nodes), size=count)]
        moved = start + grid.spacing * rng.uniform(-0.5, 0.5, (count, 2))
        start = np.where(crosses_any(start, moved, walls)[:, None], start, moved)
        q = _separate_discs(np.concatenate([start, fixed]), sizes, count, walls, corners, nodes, rng)
    if q is None:
        raise ModelError(
            f"place: {count} people do not fit: they would cover {covered:.3g} m2 of {area:.3g} m2 "
            f"({covered / max(area, 1e-300):.0%}); take fewer people, smaller radii or a larger place"
        )
    return People(q[:count], sizes[:count], to, speed)


def arrivals(
    room: Room, door: str, rate: float, until: float, radii: Any = (0.2, 0.25), *, seed: int = 1, to: Any = None, speed: Any = 1.0
) -> People:
    """People who come in through an exit of the room, one after the other: each appears inside, 0.2 m clear of the exit's line.

    Args:
        room: the room.
        door: the name of the exit.
        rate: people a second; the times between two are exponential (a Poisson process).
        until: the last time at which anybody comes, s.
        radii: (least, largest) of radii drawn evenly, m; or one radius for all.
        seed: of the random numbers.
        to: the exit they take, see `desired_velocity`; all exits but this one if left out.
        speed: m/s.

    Raises:
        ModelError: no such exit, or no other one; a wrong rate or time; nobody comes.
    """
    if door not in room.exits:
        raise ModelError(f"arrivals: the room has no exit '{door}'; it has {', '.join(room.exits)}")
    others = tuple(name for name in room.exits if name != door)
    if to is None and not others:
        raise ModelError(f"arrivals: '{door}' is the only exit, and people who come in by it have nowhere to go; name it in to=")
    rate, until = checked_number(rate, "rate", "a number > 0, in 1/s"), checked_number(until, "until", "a number > 0, in s")
    low, high = radius_range(radii)
    rng = random_generator(seed)
    times = np.cumsum(rng.exponential(1 / rate, int(rate * until + 10 * np.sqrt(rate * until) + 20)))
    times = times[times <= until]
    if not times.size:
        raise ModelError(f"arrivals: at {rate:g} a second nobody comes until {until:g} s; take a later time or another seed")
    sizes, share = rng.uniform(low, high, times.size), rng.uniform(0, 1, times.size)
    of = room.door_names == door
    doors, outward = room.doors[of], room.outward[of]
    k = rng.integers(len(doors), size=times.size)
    along = doors[k, 1] - doors[k, 0]
    width = np.linalg.norm(along, axis=1)
    reach = sizes + 0.01  # They come in clear of the jambs.
    if (2 * reach > width).any():
        raise ModelError(f"arrivals: exit '{door}' is {width.min():.3g} m wide, and the largest person {2 * sizes.max():.3g} m")
    part = (reach + share * (width - 2 * reach)) / width
    places = doors[k, 0] + part[:, None] * along - (sizes + 0.2)[:, None] * outward[k]
    return People(places, sizes, others if to is None else to, speed, times)


def crowd(
    room: Room, *groups: People, t_end: float, step: float = 0.02, beyond: float = 0.5, clearance: float | None = None,
    spacing: float | None = None, noise: Noise | None = None, title: str | None = None,
) -> ManyBodies:  # fmt: skip
    """The crowd of Maury and Venel: each person has the admissible velocity that is nearest to the one desired.

    People are discs that overlap neither each other nor walls. They want to go the shortest way to their exit and leave when
    they are ``beyond`` metres behind it.

    Args:
        room: the room.
        groups: who is in it, from `place`, `arrivals` or `People`.
        t_end: end of the run, s.
        step: s.
        beyond: how far behind an exit a centre is when its person is taken away, m.
        clearance: how far the ways keep from walls, m; the largest radius if left out.
        spacing: of the tables of directions, m; half of the least radius if left out.
        noise: turns the directions wanted at random, so that no arch holds for ever; left out, all wishes are steady.
        title: of the run.

    Raises:
        ModelError: nobody, a group with an exit that does not exist, a person that can reach no exit, no room behind an exit
            to take people away in.
    """
    if not isinstance(room, Room):
        raise ModelError(f"crowd: {describe_argument(room)}; expected a Room")
    if noise is not None and not isinstance(noise, Noise):
        raise ModelError(f"noise: {describe_argument(noise)}; expected Noise(angle), or None")
    if not groups or not all(isinstance(group, People) for group in groups):
        raise ModelError(f"crowd: {describe_argument(groups)}; expected groups of people, from place(room, count)")
    places, radii = (np.concatenate([getattr(group, key) for group in groups]) for key in ("places", "radii"))
    speed, enter = (np.concatenate([getattr(group, key) for group in groups]) for key in ("speed", "enter"))
    to = [wish for group in groups for wish in (group.to if isinstance(group.to, list) else [group.to] * len(group))]
    people, walls = Bodies(places, r=radii), room.segments
    i, j = people.member("i"), people.member("j")
    least = float(radii.min())
    spacing = least / 2 if spacing is None else checked_number(spacing, "spacing")
    if spacing > 2 / 3 * least:
        raise ModelError(f"spacing: {spacing:g}; expected at most two thirds of the least radius, {2 / 3 * least:.3g} m")
    beyond = checked_number(beyond, "beyond", "a number >= 0, in metres", zero=True)
    clearance = float(radii.max()) if clearance is None else clearance
    desired = desired_velocity(room, len(places), to=to, speed=speed, clearance=clearance, spacing=spacing)
    _check_exits_reachable(room, places, desired)
    leave = exit_zone_expression(room, i.q, beyond, float(speed.max()) * checked_number(step, "step", "a number > 0, in s"))
    families = {"pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)}
    if len(walls):
        w = Items(a=walls[:, 0], b=walls[:, 1]).member("w")
        along = w.b - w.a
        part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
        families["wall"] = Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w)
    return ManyBodies(
        bodies=people,
        f=desired if noise is None else NoisyVelocity(desired, noise),
        constraints=families,
        leave=leave,
        enter=enter,
        t_end=t_end,
        step=step,
        scene={"radii": radii, "walls": walls, "exits": room.doors, "exit_names": room.door_names},
        units={"t": "s", "q": "m"},
        title=title or f"{len(places)} people leave a room",
    )


def exit_zone_expression(room: Room, q: ca.SX, beyond: float, stride: float = 0.0) -> ca.SX:
    """An expression > 0 where q is more than ``beyond`` behind an exit, in a place that holds nothing of the room.

    It is 1 m deep, or two strides, and ``beyond`` wider than the exit on each side, but ends where the room goes on.

    Raises:
        ModelError: the room goes on less than a stride behind that.
    """
    grid = room.grid(0.1)
    nodes, depth = grid.nodes[room.inside(grid)], max(EXIT_ZONE_DEPTH, 2 * stride)
    found = None
    for (a, b), normal, name in zip(room.doors, room.outward, room.door_names, strict=True):
        width = float(np.linalg.norm(b - a))
        along = (b - a) / width
        out, part = (nodes - a) @ normal, (nodes - a) @ along
        here = (out > beyond - grid.spacing) & (out < beyond + depth + grid.spacing)
        left, right = (  # As far as the room does not go on beside the exit.
            min(beyond, float(side[here & (side > 0)].min(initial=np.inf) - grid.spacing)) for side in (-part, part - width)
        )
        across = here & (part >= 0) & (part <= width)
        deep = min(depth, float(out[across].min(initial=np.inf)) - grid.spacing - beyond)
        if deep < max(stride, grid.spacing):
            raise ModelError(
                f"exit '{name}': the room goes on {max(deep + beyond, 0):.3g} m behind it, where people are taken away after "
                f"{beyond:g} m; take a smaller beyond=" + (f", or a step of less than {stride:.3g} m" if stride else "")
            )
        x, y = ca.dot(ca.DM(normal), q - a), ca.dot(ca.DM(along), q - a)
        this = ca.fmin(ca.fmin(x - beyond, beyond + deep - x), ca.fmin(y + left, width + right - y))
        found = this if found is None else ca.fmax(found, this)
    return not_none(found)


def _check_exits_reachable(room: Room, places: np.ndarray, desired: DesiredVelocity) -> None:
    """Refuse a start from which no way leads to an exit that the person may take; the message says why."""
    lost = np.flatnonzero(np.isnan(desired.distance(places, desired.group)))
    if not lost.size:
        return
    at, names = places[lost[0]], desired.exits[desired.group[lost[0]]]
    grid, who = room.grid(desired.spacing), f"person {lost[0]} at ({at[0]:.4g}, {at[1]:.4g})"
    if room.in_obstacle(at[None])[0]:
        raise ModelError(f"{who} is in an obstacle")
    if not room.inside(grid)[grid.nearest(at[None])][0]:
        raise ModelError(f"{who} is outside the room")
    raise ModelError(
        f"{who} can reach no exit ({', '.join(names)}): no way to an exit is {2 * CORNER_DISTANCE * desired.clearance:.3g} m "
        f"wide, which a clearance of {desired.clearance:.3g} m needs"
    )


def _separate_discs(
    q: np.ndarray, radii: np.ndarray, count: int, walls: np.ndarray, polygon: np.ndarray | None, nodes: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray | None:  # fmt: skip
    """Discs moved until none overlaps another or a wall, the first ``count`` of them; None where that fails.

    Each overlap pushes both discs apart by half of it and a little more, as Uzawa's iteration does; nobody goes through a wall.
    Who stays wedged between those that do not move starts again from one of the nodes.
    """
    from scipy.spatial import KDTree

    radii, most = radii + MIN_SEPARATION, float(radii.min()) / 2
    for k in range(1, MAX_PUSH_ROUNDS + 1):
        pairs = KDTree(q, LEAF_SIZE).query_pairs(2 * radii.max() + MIN_SEPARATION, output_type="ndarray")
        i, j = pairs.T
        gap = q[i] - q[j]
        size = np.linalg.norm(gap, axis=1)
        over = radii[i] + radii[j] - size
        near = (over > 0) & (i < count)  # i < j, and the last ones stay where they are.
        i, j, over, push = i[near], j[near], over[near], gap[near] / np.maximum(size[near], 1e-12)[:, None]
        feet = nearest_points(q[:count], walls)
        away = q[:count, None] - feet
        reach = np.linalg.norm(away, axis=2)
        into = np.maximum(radii[:count, None] - reach, 0)
        if not (over > MIN_SEPARATION / 2).any() and not (into > MIN_SEPARATION / 2).any():
            return q
        move = np.zeros_like(q)
        half = (0.55 * over[:, None]) * push
        np.add.at(move, i, half)
        np.subtract.at(move, j, half)
        move[:count] += ((1.1 * into / np.maximum(reach, 1e-12))[..., None] * away).sum(axis=1)
        move *= np.minimum(1, most / np.maximum(np.linalg.norm(move, axis=1), 1e-12))[:, None]
        goal = q[:count] + move[:count]
        if polygon is not None:
            out = np.flatnonzero(~contains(polygon, goal))
            rim = nearest_points(goal[out], polygon_sides(polygon))
            best = np.linalg.norm(rim - goal[out][:, None], axis=2).argmin(axis=1)
            goal[out] = rim[np.arange(len(out)), best]
        stays = crosses_any(q[:count], goal, walls)
        q = np.concatenate([np.where(stays[:, None], q[:count], goal), q[count:]])
        if k % WEDGED_ROUNDS == 0:
            wedged = np.unique(i[j >= count])
            q[wedged] = nodes[rng.integers(len(nodes), size=len(wedged))]
    return None
