"""Rooms, shortest ways, people, what is measured, pictures and films: against closed forms, brute force and hand-made runs."""

from __future__ import annotations

import stat
from dataclasses import replace
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from PIL import Image, ImageDraw

from nsmodel import Bodies, Family, Items, ManyBodies, ModelError, StorageError, Trajectory, UsageError, simulate
from nsmodel.cli import main
from nsmodel.crowd import Noise, People, Room, arrivals, box, crowd, desired_velocity, disc, measure, place
from nsmodel.errors import MissingExtraError, PlotError
from nsmodel.modeling.model_files import case_files
from nsmodel.models.crowd.geometry import distances, has_free_path
from nsmodel.models.crowd.people import exit_zone_expression
from nsmodel.models.crowd.room import outlines, simplify_outline
from nsmodel.models.many_bodies.arching import find_arches, is_held_by_contacts
from nsmodel.models.many_bodies.contact_solver import COLD_BODIES_START, BodiesStepper
from nsmodel.models.many_bodies.schemes import BodiesProblem
from nsmodel.plot import animate, save_all
from nsmodel.plot import crowd as pictures
from nsmodel.solvers.contacts import NO_CONTACTS, Contacts

DOOR = [(10, 4), (10, 6)]
HALVES = [[(5, 0), (5, 7)], [(5, 9), (5, 10)]]


def hall(**more):
    """10 m x 10 m, a door of 2 m in the middle of the east wall."""
    walls = [[(0, 0), (10, 0)], [(10, 0), (10, 4)], [(10, 6), (10, 10)], [(10, 10), (0, 10)], [(0, 10), (0, 0)]]
    return Room(walls=walls + more.pop("walls", []), exits={"east": DOOR} | more.pop("exits", {}), **more)


def two_doors():
    """A corridor 12 m x 4 m with a door of 1 m at either end."""
    walls = [
        [(0, 0), (12, 0)],
        [(12, 0), (12, 1.5)],
        [(12, 2.5), (12, 4)],
        [(12, 4), (0, 4)],
        [(0, 4), (0, 2.5)],
        [(0, 1.5), (0, 0)],
    ]
    return Room(walls=walls, exits={"west": [(0, 1.5), (0, 2.5)], "east": [(12, 1.5), (12, 2.5)]})


def leaking():
    """The hall with a gap of 3 cm in a wall, far from its door."""
    walls = [
        [(0, 0), (10, 0)],
        [(0, 10), (10, 10)],
        [(10, 0), (10, 4)],
        [(10, 6), (10, 10)],
        [(0, 0), (0, 5.0)],
        [(0, 5.03), (0, 10)],
    ]
    return Room(walls=walls, exits={"east": DOOR})


def courtyard(width):
    """A room round three sides of a yard, with an exit into it: the other wing begins ``width`` behind the exit."""
    x = 2 + width
    corners = [(2, 2), (2, 1), (x, 1), (x, 4), (x + 3, 4), (x + 3, 0), (0, 0), (0, 4), (2, 4), (2, 3.5)]
    return Room(walls=list(pairwise(corners)), exits={"court": [(2, 2), (2, 3.5)]})


def turn(radius, start, centre, end):
    """The length of a string pulled tight clockwise round a disc: the tangent points by bisection over angles."""
    angle = np.linspace(0, 2 * np.pi, 200_001)
    rim = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    tangents = []
    for point, sense in ((start, 1), (end, -1)):
        way = sense * (np.array(centre) + rim - point)
        touches = np.flatnonzero(np.diff(np.sign((rim * way).sum(axis=1))) != 0)
        (k,) = touches[rim[touches, 0] * way[touches, 1] - rim[touches, 1] * way[touches, 0] < 0]
        tangents.append((np.linalg.norm(way[k]), angle[k]))
    (a, u), (b, v) = tangents
    return a + b + radius * ((u - v) % (2 * np.pi))


# ---------------------------------------------------------------------------------------------- shortest ways


def test_in_an_empty_room_the_way_is_straight_to_the_nearest_point_of_the_door():
    wanted = desired_velocity(hall(), 1, clearance=0.3, spacing=0.05)
    keep = 0.3 / np.cos(np.pi / 12)
    q = np.random.default_rng(0).uniform([0.5, 0.5], [9.0, 9.5], (300, 2))
    goal = np.column_stack([np.full(300, 10.0), np.clip(q[:, 1], 4 + keep, 6 - keep)])
    length = np.linalg.norm(goal - q, axis=1)
    far = (10 - q[:, 0]) / length > 0.97  # Elsewhere the jamb is in the way.
    assert far.sum() > 60
    assert np.abs(wanted.distance(q) - length)[far].max() < 2e-3
    direction = (goal - q) / length[:, None]
    assert np.linalg.norm(wanted.directions(q) - direction, axis=1)[far].max() < 0.02


@pytest.mark.parametrize("clearance", [0.1, 0.3])
def test_around_the_end_of_a_wall_the_way_is_a_string_pulled_tight(clearance):
    room = hall(walls=[[(5, 0), (5, 7)]])
    wanted = desired_velocity(room, 1, clearance=clearance, spacing=0.05)
    for start in [(1, 1), (3, 2.5), (4, 5), (4.5, 1)]:
        end = (10, 6 - clearance / np.cos(np.pi / 12))
        exact = turn(clearance, start, (5, 7), end)
        assert exact - 0.005 < wanted.distance(start)[0] < exact + 0.035 * clearance * np.pi + 0.005


def test_who_is_as_far_from_two_doors_goes_either_way_and_others_to_the_nearer_one():
    wanted = desired_velocity(two_doors(), 1)
    q = np.random.default_rng(1).uniform([0.5, 0.5], [11.5, 3.5], (500, 2))
    west = wanted.directions(q)[:, 0] < 0
    clear = np.abs(q[:, 0] - 6) > 0.1
    assert (west == (q[:, 0] < 6))[clear].all()
    on_the_line = wanted.directions(np.column_stack([np.full(50, 6.0), np.linspace(0.5, 3.5, 50)]))
    assert np.abs(np.linalg.norm(on_the_line, axis=1) - 1).max() < 1e-12


def test_each_person_goes_to_the_exit_wanted_at_the_own_speed():
    wanted = desired_velocity(two_doors(), 3, to=["west", "east", None], speed=[1, 2, 3])
    q = np.array([(11.0, 2.0), (1.0, 2.0), (9.0, 2.0)])
    assert np.allclose(wanted(0.0, q), [(-1, 0), (2, 0), (3, 0)], atol=1e-6)
    assert wanted.exits == (("west",), ("east",), ("west", "east"))
    assert wanted.values.shape[0] == 3


def test_an_exit_that_is_not_taken_is_a_wall():
    walls = [[(0, 0), (10, 0)], [(10, 0), (10, 4)], [(10, 6), (10, 10)], [(10, 10), (3, 10)], [(2, 10), (0, 10)]]
    room = Room(walls=[*walls, [(0, 10), (0, 0)], [(5, 0), (5, 10)]], exits={"east": DOOR, "north": [(2, 10), (3, 10)]})
    wanted = desired_velocity(room, 2, to=["east", "north"])
    assert np.isnan(wanted.distance([(2.5, 5), (7, 5)], np.array([0, 1]))).all()
    assert np.allclose(wanted.distance([(7, 5), (2.5, 5)], np.array([0, 1])), [3, 5])


def test_the_velocity_is_finite_everywhere_and_leads_on_outside():
    wanted = desired_velocity(hall(obstacles=[disc((5, 5), 1)]), 4000)
    q = np.random.default_rng(2).uniform(-30, 40, (4000, 2))
    q[:500] = np.random.default_rng(3).uniform(-1, 11, (500, 2))
    q[0] = np.nan
    assert np.isfinite(wanted(0.0, q)).all()
    assert np.allclose(wanted.directions(np.array([(10.3, 5.0), (10.4, 5.7), (80.0, 90.0)])), [1, 0])


def test_everybody_gets_out_on_the_field_alone_and_in_no_more_than_its_length():
    room = hall(walls=[[(5, 0), (5, 7)], [(7, 10), (7, 3)]], obstacles=[disc((8.5, 4), 0.4), box((2, 2), (3, 4))])
    nodes = room.grid(0.25)
    q = nodes.nodes[room.inside(nodes)]
    q = q[distances(q, room.segments) > 0.3]
    wanted = desired_velocity(room, len(q), clearance=0.25)
    start, step, out = wanted.distance(q), 0.03, np.full(len(q), np.inf)
    assert len(q) > 500
    assert np.isfinite(start).all()
    for k in range(1, int(start.max() / step) + 30):
        q = q + step * wanted(0.0, q)
        out[(q[:, 0] > 10) & np.isinf(out)] = k * step
    assert (out - start).max() < 0.25


def test_sight_agrees_with_many_points_on_the_way():
    rng = np.random.default_rng(4)
    walls = rng.uniform(0, 10, (6, 2, 2))
    p, q = rng.uniform(0, 10, (2, 4000, 2))
    apart = (distances(p, walls) > 0.3) & (distances(q, walls) > 0.3)
    p, q = p[apart], q[apart]
    least = np.min([distances(p + s * (q - p), walls) for s in np.linspace(0, 1, 400)], axis=0)
    clear = np.abs(least - 0.3) > 0.03
    assert (has_free_path(p, q, walls, 0.3) == (least > 0.3))[clear].all()


def test_who_can_reach_no_exit_is_named():
    room = hall(obstacles=[box((2, 2), (4, 4))], walls=[[(5, 0), (5, 4.9)], [(5, 5.1), (5, 10)]])
    with pytest.raises(ModelError, match=r"person 1 at \(1, 1\) can reach no exit \(east\): no way to an exit is 0.518 m wide"):
        crowd(room, People([(8, 1), (1, 1)], 0.25), t_end=1)


# ---------------------------------------------------------------------------------------------- rooms, pictures


def floor_plan():
    """The hall in pixels of 5 cm: walls 20 cm thick around it, a door 2 m wide."""
    image = Image.new("RGB", (208, 208), "white")
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0, 207, 207), outline="black", width=4)
    draw.rectangle((204, 84, 207, 123), fill="red")
    return image


def test_a_picture_and_segments_give_the_same_ways(tmp_path):
    path = tmp_path / "plan.png"
    floor_plan().save(path)
    room = Room.from_picture(path, 0.05, exits={"east": "red"})
    assert len(room.walls) == 12  # A ring with a gap.
    assert np.allclose(np.abs(room.exits["east"] - [[(10.3, 4.2), (10.3, 6.2)]]).max(), 0)
    other = desired_velocity(hall(), 1, clearance=0.3)
    wanted = desired_velocity(room, 1, clearance=0.3)
    q = np.random.default_rng(5).uniform(0.5, 9, (400, 2))
    assert np.abs(wanted.distance(q + 0.2) - other.distance(q)).max() < 0.16  # The door is 10 cm farther out.
    assert np.linalg.norm(wanted.directions(q + 0.2) - other.directions(q), axis=1).mean() < 0.03


def test_a_slanting_wall_of_a_picture_is_no_staircase():
    image = floor_plan()
    ImageDraw.Draw(image).line((40, 40, 130, 97), fill="black", width=6)
    room = Room.from_picture(np.asarray(image), 0.05, exits={"east": (255, 0, 0)})
    slanting = room.walls[(room.walls > 0.5).all(axis=(1, 2)) & (room.walls < 9.9).all(axis=(1, 2))]
    assert len(slanting) < 12
    assert distances(np.array([(85.5, 208 - 69)]) * 0.05, slanting)[0] < 0.2


def test_outlines_hold_exactly_the_pixels():
    mask = np.random.default_rng(6).random((12, 15)) < 0.5
    loops = outlines(mask)
    area = sum((loop[:, 0] * np.roll(loop[:, 1], -1) - np.roll(loop[:, 0], -1) * loop[:, 1]).sum() / 2 for loop in loops)
    assert area == mask.sum()
    line = np.zeros((5, 9), bool)
    line[2, 1:8] = True
    assert len(simplify_outline(outlines(line)[0])) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"exits": {"east": "blau"}}, "exit 'east': 'blau' is not the name of a colour"),
        ({"exits": {"east": (0, 0, 300)}}, "expected a name or \\(red, green, blue\\) from 0 to 255"),
        ({"exits": {"east": "blue"}}, r"no pixel of the picture \(208 x 208\) has the colour \(0, 0, 255\) of east"),
        ({"exits": {"east": (90, 0, 0)}}, "the colours of walls and east, .* are too alike"),
        ({"pixel": -1}, "pixel: -1 .*in metres"),
        ({"image": np.zeros((3, 4))}, r"shape \(3, 4\), float64; expected numbers \(H, W, 3\)"),
        ({"image": "nowhere.png"}, "nowhere.png cannot be read as a picture"),
    ],
)
def test_what_is_wrong_with_a_picture_is_said(change, message):
    with pytest.raises(ModelError, match=message):
        Room.from_picture(**{"image": np.asarray(floor_plan()), "exits": {"east": "red"}} | change)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"exits": {}}, "expected a dictionary of at least one"),
        ({"exits": {"a": [(0, 0)]}}, r"exit 'a': shape \(1, 2\); expected \(2, 2\)"),
        ({"exits": {"a": [(0, 0), (0, 0)]}}, r"exit 'a'\[0\] begins and ends at \(0, 0\)"),
        ({"exits": {"a": DOOR}, "walls": [[(0, 0), (np.nan, 1)]]}, "walls: nan is not a finite number"),
        ({"exits": {"a": DOOR}, "obstacles": [[(0, 0), (1, 1)]]}, r"obstacles\[0\]: shape \(2, 2\); expected \(P, 2\)"),
    ],
)
def test_what_is_wrong_with_a_room_is_said(arguments, message):
    with pytest.raises(ModelError, match=message):
        Room(**arguments)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: Room(walls=[[(0, 0), (1, 0)]], exits={"a": DOOR}).outward,
            r"'a' ends at \(10, 6\), 10.8 m from the nearest wall",
        ),
        (lambda: hall(exits={"east": [(10, 4), (10, 5.98)]}).outward, r"'east' ends at \(10, 5.98\), 0.02 m from"),
        (
            lambda: Room(walls=[[(10, 2), (10, 4)], [(10, 6), (10, 8)]], exits={"a": DOOR}).outward,
            "'a' at .* is outside on both sides",
        ),
        (lambda: hall(walls=HALVES, exits={"b": [(5, 7), (5, 9)]}).outward, r"'b' at \(5, 8\) is inside on both sides"),
        (lambda: hall(exits={"b": [(0, 2), (0, 3)]}).outward, r"'b' lies on the wall from \(0, 10\) to \(0, 0\): leave a gap"),
        (lambda: Room(walls=None, exits={"a": DOOR}), "walls: None .*expected end points"),
        (lambda: Room(walls=5, exits={"a": DOOR}), r"walls: shape \(\); expected"),
        (lambda: hall(obstacles=5), "obstacles: 5 .*expected a list of polygons"),
        (lambda: Room(exits={1: DOOR}), "exits: 1 .*expected a string"),
        (lambda: leaking().inside(leaking().grid(0.01)), "at a spacing of 0.01 m the room is open"),
        (lambda: box(0, 1), r"box: 0 .*expected two corners \(x, y\)"),
        (lambda: disc((0, np.nan), 1), "disc: centre: nan is not a finite number"),
        (lambda: disc((0, 0, 0), 1), r"disc: centre \(0, 0, 0\).*expected \(x, y\)"),
        (lambda: desired_velocity(hall(), 1, to="north"), "no exit 'north'; it has east"),
        (lambda: desired_velocity(hall(), 2, to=["east"]), "to: 1 exits; expected one for each of 2"),
        (lambda: desired_velocity(hall(), 1, clearance=1.0), "'east' is 2 m wide; a clearance of 1 m on both sides needs 2.07"),
        (lambda: desired_velocity(hall(), 1, spacing=0), "spacing: 0 .*expected a number > 0"),
        (lambda: desired_velocity(hall(), 2, speed=[1, 2, 3]), r"speed: .*shape \(3,\); expected one number >= 0 or \(2,\)"),
        (lambda: desired_velocity(hall(), 2, speed=-1), "speed: -1 .*expected one number >= 0"),
        (lambda: desired_velocity(hall(), 1, to=5), "to: 5 .*expected the name of an exit"),
        (lambda: desired_velocity(hall(), 1, to=()), r"to: \(\) .*expected the name of an exit"),
        (lambda: hall().way_out("north"), "no exit 'north'; it has east"),
        (lambda: disc((0, 0), -1), "radius: -1"),
        (lambda: place(hall(), 2000), "2000 people do not fit: they would cover 320 m2 of 100 m2"),
        (lambda: place(hall(), 0), "0 .*people; expected a whole number"),
        (lambda: place(hall(), 3, radii=(0.3, 0.2)), "radii: .*or \\(least, largest\\)"),
        (lambda: place(hall(), 3, radii=[0.2, 0.2, 0.2]), "radii: .*or \\(least, largest\\)"),
        (lambda: place(hall(), 5.0), "5.0 .*expected a whole number"),
        (lambda: place(hall(), 3, seed="a"), "seed: 'a' .*expected a whole number"),
        (lambda: place(hall(), 3, inside=[(1, 1), (2, np.nan), (1, 2)]), "inside: nan is not a finite number"),
        (lambda: place(hall(), 3, inside=box((20, 0), (30, 5))), "no free point of the room is in the polygon"),
        (lambda: place(hall(), 3, beside=place(hall(), 2)), "beside: .*expected a list of groups"),
        (lambda: place(hall(), 3, to=["east"]), "to: 1 exits; expected one for each of 3"),
        (lambda: arrivals(two_doors(), "east", 1, 5, radii=(0.2, np.nan)), "radii: nan is not a finite number"),
        (lambda: arrivals(hall(), "west", 1, 5), "no exit 'west'; it has east"),
        (lambda: arrivals(hall(), "east", 1, 5), "'east' is the only exit"),
        (lambda: arrivals(two_doors(), "east", -1, 5), "rate: -1 .*in 1/s"),
        (lambda: arrivals(two_doors(), "east", 1, 5, radii=0.6), "1 m wide, and the largest person 1.2 m"),
        (lambda: arrivals(two_doors(), "east", 1e-3, 1), "nobody comes until 1 s"),
        (lambda: crowd(hall(), t_end=1), "expected groups of people"),
        (lambda: crowd(hall(), People([(1, 1)], 0.2), t_end=1, beyond=-1), "beyond: -1"),
        (lambda: crowd(None, People([(1, 1)], 0.2), t_end=1), "crowd: None .*expected a Room"),
        (lambda: crowd(hall(), People([(1, 1)], 0.2), t_end=1, spacing=0.3), "spacing: 0.3; expected at most two thirds"),
        (lambda: crowd(hall(), People([(12, 1)], 0.2), t_end=1), r"person 0 at \(12, 1\) is outside the room"),
        (lambda: crowd(hall(obstacles=[box((4, 4), (6, 6))]), People([(5, 5)], 0.2), t_end=1), "person 0 .* is in an obstacle"),
        (lambda: crowd(courtyard(0.4), People([(1, 3)], 0.2), t_end=1), "exit 'court': the room goes on .* smaller beyond="),
        (lambda: crowd(courtyard(2.0), People([(1, 3)], 0.2, speed=3), t_end=1, step=1), "or a step of less than 3 m"),
        (lambda: People(np.zeros((0, 2)), 0.2), r"places: shape \(0, 2\)"),
        (lambda: People([(1, np.nan)], 0.2), "places: nan is not a finite number"),
        (lambda: People([(1, 1)], 0.2, speed="fast"), "speed: 'fast' .*expected one number >= 0"),
        (lambda: People([1, 2], 0.2), r"places: shape \(2,\)"),
        (lambda: People([(1, 2)], [0.2, 0.3]), r"radii: .*shape \(2,\)"),
        (lambda: People([(1, 2)], 0.2, speed=[1, 2]), r"speed: .*shape \(2,\)"),
    ],
)
def test_what_is_wrong_with_people_is_said(call, message):
    with pytest.raises(ModelError, match=message):
        call()


# ---------------------------------------------------------------------------------------------- people


def least_gap(people):
    gaps = np.linalg.norm(people.places[:, None] - people.places, axis=2) - people.radii[:, None] - people.radii
    return gaps[np.triu_indices(len(people), 1)].min()


@pytest.mark.parametrize("count", [20, 300])
def test_people_are_placed_without_overlap_and_the_same_for_the_same_seed(count):
    room = hall(obstacles=[disc((5, 5), 1)])
    people, same, other = (place(room, count, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(people.places, same.places)
    assert not np.array_equal(people.places, other.places)
    assert least_gap(people) > 1e-3
    assert (distances(people.places, room.segments) > people.radii).all()
    assert (np.linalg.norm(people.places - 5, axis=1) > 1).all()
    assert ((people.radii >= 0.2) & (people.radii <= 0.25)).all()


def test_groups_keep_to_their_place_and_apart():
    room, west = hall(), box((0, 0), (5, 10))
    first = place(room, 60, inside=west)
    second = place(room, 60, inside=west, beside=[first], seed=2)
    both = People(np.concatenate([first.places, second.places]), np.concatenate([first.radii, second.radii]))
    assert both.places[:, 0].max() <= 5
    assert least_gap(both) > 0


def test_who_arrives_comes_in_through_the_door_at_the_rate_and_leaves_by_the_other():
    people = arrivals(two_doors(), "west", rate=2.0, until=200.0, seed=5)
    assert abs(len(people) - 400) < 4 * 20
    assert people.to == ("east",)
    gaps = np.diff(people.enter)
    assert abs(gaps.mean() - 0.5) < 0.1
    assert abs(gaps.std() - 0.5) < 0.1
    assert ((people.places[:, 1] - people.radii > 1.5) & (people.places[:, 1] + people.radii < 2.5)).all()
    model = crowd(two_doors(), People([(3, 2), (8, 2)], 0.2, to="west"), people, t_end=2)
    assert model.enter.shape == (len(people) + 2,)
    assert (model.f(0.0, model.bodies.q0)[:2, 0] < 0).all()
    assert (model.f(0.0, model.bodies.q0)[2:, 0] > 0).all()


def test_people_leave_behind_a_door_and_nowhere_else():
    q = ca.SX.sym("q", 2)
    left = ca.Function("left", [q], [exit_zone_expression(two_doors(), q, 0.5)])
    for place_, out in [((12.4, 2), False), ((12.6, 2), True), ((-0.6, 1.6), True), ((-0.4, 2), False), ((6, 2), False)]:
        assert (float(left(place_)) > 0) == out
    assert float(left((13, 6))) < 0


def test_nobody_leaves_who_is_in_another_part_of_the_room():
    room = courtyard(1.0)
    run = simulate(crowd(room, People([(3.3, 3.0), (5.5, 3.0), (1.0, 3.0)], 0.2, speed=0.1), t_end=2))
    assert np.isnan(measure.evacuation_times(run)).all()
    bent = [(0, 0), (3, 0), (3, 0.5), (3, 2), (3, 2.2), (6, 2.2), (6, 4), (0, 4), (0, 0)]
    walls = [pair for pair in pairwise(bent) if pair != ((3, 0.5), (3, 2))]
    room = Room(walls=walls, exits={"door": [(3, 0.5), (3, 2)]})
    run = simulate(crowd(room, People([(3.9, 2.42), (1, 1)], 0.2, speed=[0, 1]), t_end=5))
    assert np.isfinite(measure.evacuation_times(run)).tolist() == [False, True]


def test_who_moves_far_in_a_step_leaves_all_the_same():
    run = simulate(crowd(hall(), People([(9, 5), (5, 5)], 0.2, speed=2.0), t_end=8, step=0.5))
    assert np.isfinite(measure.evacuation_times(run)).all()


def test_people_find_a_place_beside_others_that_stay():
    for seed in range(10):
        room = Room(walls=[[(0, 0), (6, 0)], [(6, 0), (6, 1.4)], [(6, 2.6), (6, 4)], [(6, 4), (0, 4)], [(0, 4), (0, 0)]],
                    exits={"door": [(6, 1.4), (6, 2.6)]})  # fmt: skip
        first = place(room, 25, seed=seed)
        second = place(room, 25, seed=seed + 100, beside=[first])
        assert least_gap(People(np.vstack([first.places, second.places]), np.hstack([first.radii, second.radii]))) > 0


@pytest.mark.parametrize("x", [9.5, 9.7, 9.8, 9.9])
def test_a_pillar_before_a_door_is_not_the_room(x):
    room = hall(obstacles=[disc((x, 5), 0.15)])
    assert 98 < room.inside(room.grid(0.1)).sum() * 0.01 < 101
    assert len(place(room, 5)) == 5


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.3, 0.785])
@pytest.mark.parametrize("blurred", [False, True])
def test_a_turned_floor_plan_is_closed(angle, blurred):
    fine = 4 if blurred else 1
    image = Image.new("RGB", (300 * fine, 300 * fine), "white")
    draw = ImageDraw.Draw(image)

    def turned(*points):
        x, y = np.array(points, float).T - 150
        return [
            tuple(fine * p)
            for p in np.column_stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)]) + 150
        ]

    for a, b in pairwise([(60, 60), (240, 60), (240, 240), (60, 240), (60, 60)]):
        draw.line(turned(a, b), fill="black", width=4 * fine)
    draw.line(turned((240, 120), (240, 144)), fill="red", width=7 * fine)
    room = Room.from_picture(np.asarray(image.resize((300, 300), Image.Resampling.BOX)), 0.05)
    people = place(room, 5)
    assert len(crowd(room, people, t_end=1).names) == 10
    width = np.linalg.norm(np.diff(room.exits["exit"][0], axis=0))
    assert 1.0 < width < 1.5
    assert np.abs(np.diff(room.exits["exit"][0], axis=0)[0] / width @ [np.cos(angle), -np.sin(angle)]) < 0.2


@pytest.mark.parametrize(("wide", "thick"), [(20, 20), (20, 24), (20, 10)])
@pytest.mark.parametrize("side", ["south", "east"])
def test_a_door_in_a_thick_wall_goes_from_wall_to_wall(side, wide, thick):
    pixels = np.full((200, 200, 3), 255)
    pixels[:thick], pixels[-thick:], pixels[:, :thick], pixels[:, -thick:] = 0, 0, 0, 0
    patch = (slice(90, 90 + wide), slice(-thick, None))
    pixels[patch if side == "east" else patch[::-1]] = (255, 0, 0)
    room = Room.from_picture(pixels, 0.1)
    assert np.linalg.norm(np.diff(room.exits["exit"][0], axis=0)) == pytest.approx(0.1 * wide)
    assert np.abs(room.outward[0]) == pytest.approx([0, 1] if side == "south" else [1, 0])


@pytest.fixture(scope="module")
def small_run():
    """Twelve people leave the corridor, half of them by each door."""
    return simulate(crowd(two_doors(), place(two_doors(), 12), t_end=8, step=0.02), compiled=False)


def test_a_crowd_leaves(small_run):
    run = small_run
    times = measure.evacuation_times(run)
    assert np.isfinite(times).all()
    q = measure.positions(run)
    radii = np.array(run.metadata["scene"]["radii"])
    for row in range(0, len(run.t), 20):
        here = np.isfinite(q[row, :, 0])
        if here.sum() > 1:
            assert least_gap(People(q[row, here], radii[here])) > -1e-9
    outs = [measure.flow(run, two_doors().way_out(name)) for name in ("west", "east")]
    assert sum(len(out.times()) for out in outs) == 12
    assert sum(len(out.times(forward=False)) for out in outs) == 0
    lengths = desired_velocity(two_doors(), 12).distance(q[0])
    assert (times[np.concatenate([out.person for out in outs])] > lengths[np.concatenate([out.person for out in outs])]).all()


# ---------------------------------------------------------------------------------------------- measures


def hand_made(x, t=None, pressure=None, radii=None, **scene):
    x = np.asarray(x, float)
    t = np.arange(len(x), dtype=float) if t is None else np.asarray(t, float)
    n = x.shape[1]
    arrays = {"t": t, "x": x.reshape(len(x), -1), "pressure": np.zeros((len(x), n)) if pressure is None else np.asarray(pressure)}
    about = {
        "radii": [0.2] * n if radii is None else radii,
        "walls": hall().walls.tolist(),
        "exits": hall().doors.tolist(),
    } | scene
    return Trajectory(arrays, {"model_class": "ManyBodies", "units": {"t": "s", "q": "m"}, "scene": about, "title": "by hand"})


GONE = (np.nan, np.nan)


def test_evacuation_times_are_those_of_the_first_row_without_a_person():
    run = hand_made([[(1, 1), GONE, (3, 3)], [(2, 1), (5, 5), (3, 3)], [GONE, (6, 5), (3, 3)], [GONE, GONE, (3, 3)]])
    assert np.array_equal(measure.evacuation_times(run), [2, 3, np.nan], equal_nan=True)
    assert np.array_equal(measure.present(run).sum(axis=1), [2, 3, 2, 1])


def test_flow_agrees_with_looking_at_each_step():
    rng = np.random.default_rng(7)
    q = np.cumsum(rng.normal(0, 0.4, (60, 40, 2)), axis=0)
    q[40:, :10] = np.nan
    a, b = np.array((-1.0, 0.3)), np.array((2.0, -0.4))
    found = measure.flow(hand_made(q, t=0.5 * np.arange(60)), [a, b])
    expected = []
    for k in range(59):
        for i in range(40):
            p, w = q[k, i], q[k + 1, i] - q[k, i]
            if np.isfinite(w).all():
                s, along = np.linalg.solve(np.column_stack([w, a - b]), a - p)
                if 0 <= s < 1 and 0 <= along <= 1:
                    right = np.array((b[1] - a[1], a[0] - b[0]))
                    expected.append((0.5 * (k + s), i, w @ right > 0))
    expected.sort()
    assert len(expected) > 50
    assert np.allclose(found.time, [time for time, _, _ in expected])
    assert found.person.tolist() == [i for _, i, _ in expected]
    assert found.forward.tolist() == [forward for _, _, forward in expected]
    assert found.count(1e9) + found.count(1e9, forward=False) == len(expected)
    assert found.net(10.0) == sum(1 if forward else -1 for time, _, forward in expected if time <= 10)
    assert found.specific(0, 20) == pytest.approx(found.net(20.0) / 20 / np.linalg.norm(b - a))


def test_a_passage_that_stops_on_the_line_counts_once_and_specific_flow_is_that_of_the_gaps():
    x = np.array([-1.0, 0.0, 0.0, 1.0])
    run = hand_made(np.stack([np.column_stack([x - k, np.full(4, 0.5)]) for k in range(1)], axis=1))
    assert measure.flow(run, [(0, 2), (0, 0)]).time.tolist() in ([1.0], [2.0])
    train = -np.arange(10) * 0.5 + np.arange(0, 12)[:, None]  # One passes each half second.
    run = hand_made(np.stack([train, np.full_like(train, 0.25)], axis=2))
    found = measure.flow(run, [(0.2, 1), (0.2, 0)])
    assert found.forward.all() or not found.forward.any()
    forward = bool(found.forward[0])
    found = found if forward else measure.flow(run, [(0.2, 0), (0.2, 1)])
    assert found.specific() == pytest.approx(2.0)
    assert found.width == 1


@pytest.mark.long
def test_a_flow_that_rows_do_not_show_is_refused():
    model = crowd(hall(), place(hall(), 15), t_end=10)
    every = measure.flow(simulate(model), hall().way_out("east"))
    assert len(every.times()) == 15
    few = simulate(model, save_every=5)
    assert len(measure.flow(few, hall().way_out("east")).times()) == 15
    fewer = simulate(model, save_every=100)
    with pytest.raises(UsageError, match=r"people left between two rows, and no row shows by which exit.*save_every"):
        measure.flow(fewer, hall().way_out("east"))


def test_specific_flow_of_people_who_cross_at_once_is_not_a_number():
    run = simulate(crowd(hall(), People([(9.5, 4.7), (9.5, 5.3)], 0.2), t_end=3))
    assert np.isnan(measure.flow(run, hall().way_out("east")).specific())


def test_maps_agree_with_looking_at_each_cell():
    rng = np.random.default_rng(8)
    q = rng.uniform(0.3, 9.7, (4, 30, 2))
    q[2:, :5] = np.nan
    pressure = np.where(np.isnan(q[..., 0]), np.nan, rng.uniform(0, 3, (4, 30)))
    run = hand_made(q, pressure=pressure)
    maps = measure.maps(run, spacing=0.25, cut_off=1.5)
    x, y = (maps.x[:-1] + maps.x[1:]) / 2, (maps.y[:-1] + maps.y[1:]) / 2
    inside = [(i, j) for j in range(len(y)) for i in range(len(x)) if 0 < x[i] < 10 and 0 < y[j] < 10]
    outside = [(i, j) for j in range(len(y)) for i in range(len(x)) if 10 <= x[i] <= 11.5 and 4 <= y[j] <= 6]
    nearest = np.full((4, len(inside + outside)), -1)
    for k in range(4):
        for c, (i, j) in enumerate(inside + outside):
            d = np.linalg.norm(q[k] - (x[i], y[j]), axis=1)
            d[np.isnan(d)] = np.inf
            nearest[k, c] = d.argmin() if d.min() < 1.5 else -1
    for c, (i, j) in list(enumerate(inside))[::37]:
        owners = nearest[:, c]
        density = np.mean([0 if o < 0 else 1 / (0.0625 * (nearest[k] == o).sum()) for k, o in enumerate(owners)])
        assert maps.density[j, i] == pytest.approx(density)
        if (owners >= 0).any():
            push = np.mean([pressure[k, o] for k, o in enumerate(owners) if o >= 0])
            assert maps.pressure[j, i] == pytest.approx(push)
            moves = [q[max(k, 1), o] - q[max(k, 1) - 1, o] for k, o in enumerate(owners) if o >= 0]
            assert np.allclose(maps.velocity[j, i], np.mean(moves, axis=0))
    assert np.isfinite(maps.density).sum() == len(inside)
    total = np.nansum([1.0 * (nearest[k] >= 0).any() for k in range(4)])
    assert total == 4


def test_the_room_of_a_run_has_the_names_of_its_exits():
    room = Room(walls=two_doors().walls, exits={"sides": two_doors().doors})
    for given in (two_doors(), room):
        run = simulate(crowd(given, People([[6, 2]], 0.2), t_end=0.02))
        found = measure.room_of(run)
        assert list(found.exits) == list(given.exits)
        assert np.array_equal(found.doors, given.doors)


def test_what_cannot_be_measured_is_said():
    run = hand_made([[(1, 1)], [(2, 2)]])
    with pytest.raises(UsageError, match=r"segments: shape \(1, 2\)"):
        measure.flow(run, [(0, 1)])
    with pytest.raises(UsageError, match=r"segments: 'east' .*expected \(2, 2\)"):
        measure.flow(run, "east")
    for wrong in ({"spacing": 0}, {"spacing": np.nan}, {"cut_off": -1}, {"most_rows": 0}):
        with pytest.raises(UsageError, match=rf"{next(iter(wrong))}: .*expected"):
            measure.maps(run, **wrong)
    wanted = desired_velocity(hall(), 2)
    with pytest.raises(UsageError, match=r"q: shape \(1, 3\); expected \(N, 2\)"):
        wanted.distance((1, 2, 3))
    with pytest.raises(UsageError, match=r"group: 5 .*from 0 to 0"):
        wanted.distance((1, 2), 5)
    with pytest.raises(UsageError, match="no row is between 5 and 9"):
        measure.maps(run, start=5, end=9)
    with pytest.raises(UsageError, match="the run has no exits"):
        measure.maps(hand_made([[(1, 1)], [(2, 2)]], exits=[]))
    with pytest.raises(UsageError, match="specific flow from 3 to None"):
        measure.flow(run, DOOR).specific(3)
    with pytest.raises(UsageError, match="people have two states each; this run has 3"):
        measure.positions(Trajectory({"t": np.zeros(1), "x": np.zeros((1, 3))}, {}))


# ---------------------------------------------------------------------------------------------- pictures, films


def test_pictures_take_and_return_axes(small_run):
    from matplotlib.figure import Figure

    maps = measure.maps(small_run, most_rows=5, spacing=0.25)
    ax = Figure().add_subplot
    out = measure.flow(small_run, two_doors().way_out("east"))
    for draw in (
        lambda ax: pictures.frame(small_run, ax=ax),
        lambda ax: pictures.evacuation(small_run, ax=ax),
        lambda ax: pictures.pressures(small_run, ax=ax),
        lambda ax: pictures.paths(small_run, ax=ax),
        lambda ax: pictures.flow(out, ax=ax),
        lambda ax: pictures.density(maps, small_run, ax=ax),
        lambda ax: pictures.pressure(maps, small_run, ax=ax),
        lambda ax: pictures.velocity(maps, ax=ax),
    ):
        mine = ax()
        assert draw(mine) is mine
    with pytest.raises(PlotError, match="row 1000 does not exist"):
        pictures.frame(small_run, 1000)
    with pytest.raises(PlotError, match="without discs in the plane"):
        pictures.frame(Trajectory(small_run.arrays, {}), 0)


def test_a_run_has_its_files(small_run, tmp_path):
    names = {path.name for path in save_all(small_run, None, tmp_path)}
    assert names == {"frame.png", "evacuation.png", "maps.png", "paths.png", "overview.png"}


@pytest.mark.parametrize("name", ["maps", "frame"])
@pytest.mark.long
def test_no_broad_margin_beside_a_room(small_run, tmp_path, name):
    save_all(small_run, None, tmp_path)
    with Image.open(tmp_path / f"{name}.png") as picture:
        ink = np.flatnonzero((np.asarray(picture.convert("L")) < 250).any(axis=0))
    assert ink[0] < 30
    assert picture.width - ink[-1] < 30


def test_a_film_has_its_frames_and_leaves_nothing_else(small_run, tmp_path):
    path = animate(small_run, tmp_path / "film.gif", seconds=1.5, fps=10, size=(3, 2), dpi=60)
    with Image.open(path) as film:
        assert film.n_frames == 15
        assert film.size == (180, 120)
        assert film.info["duration"] == 100
        first = np.asarray(film.convert("RGB"), float)
        film.seek(14)
        last = np.asarray(film.convert("RGB"), float)
    assert np.abs(first - last).max() > 50
    assert [one.name for one in tmp_path.iterdir()] == ["film.gif"]


@pytest.mark.parametrize(("seconds", "fps"), [(3, 15), (2, 30), (1, 50)])
def test_a_gif_lasts_as_long_as_asked(small_run, tmp_path, seconds, fps):
    with Image.open(animate(small_run, tmp_path / "film.gif", seconds=seconds, fps=fps)) as film:
        lasting = 0
        for k in range(film.n_frames):
            film.seek(k)
            lasting += film.info["duration"]
    assert lasting == 1000 * seconds


def test_pictures_of_people_who_never_came(tmp_path):
    room = two_doors()
    people = arrivals(room, "west", 1, 20, seed=2)
    assert people.enter.max() > 4
    run = simulate(crowd(room, people, t_end=4))
    pictures.frame(run)
    pictures.paths(run)
    pictures.velocity(measure.maps(run, room), run)
    animate(run, tmp_path / "film.gif", seconds=0.3)


def test_a_film_that_cannot_be_written_is_refused_before_the_run(tmp_path, capsys):
    model = str(case_files()["evacuation"])
    assert main(["run", model, "--film", str(tmp_path / "nowhere" / "film.gif")]) == 2
    assert "nowhere does not exist" in capsys.readouterr().err
    assert main(["run", model, "--film", str(tmp_path / "film.txt")]) == 2
    assert "a film ends in .gif or .mp4" in capsys.readouterr().err


def test_a_film_in_one_call(small_run, tmp_path):
    options = {"seconds": 0.5, "fps": 4, "size": (3, 2), "dpi": 60}
    path = small_run.film(tmp_path / "film.gif", **options)
    assert path.read_bytes() == animate(small_run, tmp_path / "other.gif", **options).read_bytes()
    with pytest.raises(PlotError, match="without discs in the plane"):
        Trajectory(small_run.arrays, {}).film(tmp_path / "film.gif", seconds=1)


def test_mp4_goes_through_ffmpeg_or_says_so(small_run, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingExtraError, match=r"MP4 needs the program ffmpeg"):
        small_run.film(tmp_path / "film.mp4", seconds=1)
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\n/bin/cat > "$last"\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    path = animate(small_run, tmp_path / "film.mp4", seconds=1, fps=5, size=(3, 2), dpi=61)
    assert path.stat().st_size == 5 * 182 * 122 * 3  # Raw pictures, sides even.
    program.write_text("#!/bin/sh\n/bin/cat > /dev/null\necho no codec >&2\nexit 3\n")
    with pytest.raises(PlotError, match=r"could not write .*no codec"):
        animate(small_run, tmp_path / "other.mp4", seconds=1, fps=5, size=(3, 2), dpi=60)
    with pytest.raises(PlotError, match=r"film.avi: a film ends in .gif or .mp4"):
        animate(small_run, tmp_path / "film.avi")
    with pytest.raises(PlotError, match="seconds: 0; expected a number > 0"):
        animate(small_run, tmp_path / "film.gif", seconds=0)


# ---------------------------------------------------------------------------------------------- how a run ends


def hopper(wish=None, **more):
    """Nine people before a hole between two slanting walls, all drawn to a place below it; with this seed an arch holds."""
    rng, k = np.random.default_rng(8), np.arange(9)
    walls = np.array([[(-2, 1.5), (-0.425, 0)], [(0.425, 0), (2, 1.5)]])
    radii = rng.uniform(0.2, 0.3, 9)
    x = np.tile([-0.65, 0, 0.65], 3) + rng.uniform(-0.02, 0.02, 9)
    people = Bodies(np.column_stack([x, 1.0 + 0.65 * (k // 3) + rng.uniform(-0.02, 0.02, 9)]), r=radii)
    items = Items(a=walls[:, 0], b=walls[:, 1])
    i, j, w = people.member("i"), people.member("j"), items.member("w")
    along, way = w.b - w.a, ca.vertcat(0, -1) - i.q
    part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
    families = {
        "pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j),
        "wall": Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w),
    }
    scene = {"radii": radii, "walls": walls, "exits": [[(-0.425, 0), (0.425, 0)]], "exit_names": ["hole"]}
    return ManyBodies(
        bodies=people, f=way / ca.norm_2(way) if wish is None else wish, constraints=families, leave=-0.5 - i.q[1], scene=scene,
        units={"t": "s"}, **({"t_end": 20, "step": 0.05} | more),
    )  # fmt: skip


def downwards(t, q):
    """The wish of `hopper` as a function, of which nobody says that it does not depend on t."""
    way = np.array([0, -1]) - q
    return way / np.linalg.norm(way, axis=1)[:, None]


@pytest.fixture(scope="module")
def jammed():
    """A run that ends before an arch."""
    return simulate(hopper())


def test_a_run_ends_when_nobody_is_left(tmp_path):
    model = crowd(two_doors(), People([(10, 2), (11, 2)], 0.2), t_end=20.0, step=0.05)
    run = simulate(model)
    assert run.status == "done"
    assert np.isnan(run.x[-1]).all()
    assert np.isfinite(run.x[-2]).any()
    assert run.t[-1] == measure.evacuation_times(run).max() == run.summary()["bodies"]["empty_at"] < 10
    assert f"end empty at t = {run.t[-1]:g} s" in " ".join(run.summary_text().split())
    for every in (7, 10_000):
        sparse = simulate(model, save_every=every)
        assert (sparse.t[-1], sparse.metadata["steps"]) == (run.t[-1], len(run))
    simulate(model, out=tmp_path / "run", t_end=1.0)
    parts = simulate(model, out=tmp_path / "run", resume=True)
    assert {name: a.tobytes() for name, a in parts.arrays.items()} == {name: a.tobytes() for name, a in run.arrays.items()}
    again = simulate(model, out=tmp_path / "run", resume=True, t_end=30.0)
    assert again.t[-1] == run.t[-1]


def test_an_empty_room_waits_for_those_who_are_to_come():
    room = two_doors()
    one, late = People([(11, 2)], 0.2), People([(11, 2)], 0.2, enter=5.0)
    run = simulate(crowd(room, one, late, t_end=100.0))
    there = measure.present(run).sum(axis=1)
    assert there[run.t.searchsorted(4.0)] == 0
    assert 5 < run.t[-1] < 10
    assert run.metadata["bodies"]["left"] == 2


def test_bodies_without_exits_that_all_leave_end_the_run():
    bodies = Bodies([[0.0], [0.5]])
    i = bodies.member("i")
    run = simulate(ManyBodies(bodies=bodies, f=[1.0], leave=i.q[0] - 1, t_end=20, step=0.01))
    assert run.t[-1] == pytest.approx(1.01)  # one step after both were past 1
    assert run.metadata["bodies"]["empty_at"] == run.t[-1]


def test_a_run_ends_before_an_arch_and_says_who_holds_it(jammed):
    found = jammed.summary()["bodies"]["standstill"]
    assert jammed.status == "done"
    assert jammed.t[-1] < 20
    assert found["for_good"] == "held"
    rest = jammed.x[jammed.t >= found["since"]]
    assert np.nanmax(np.abs(rest - rest[0])) < 1e-13
    assert np.nanmax(np.abs(jammed.x[jammed.t.searchsorted(found["since"]) - 1] - rest[0])) > 1e-14
    (arch,) = found["arches"]
    assert (arch["exit"], arch["pressed"]) == ("hole", measure.present(jammed)[-1].sum())
    assert (arch["bodies"], arch["ends"]) == ([0, 2], ["wall 0-0", "wall 2-1"])
    contacts = jammed.contacts(-1)
    assert {(0, 0, 2), (1, 0, 0), (1, 2, 1)} <= set(zip(contacts.family, contacts.first, contacts.second, strict=True))
    q = jammed.x[-1].reshape(-1, 2)
    assert np.array_equal(q[[0, 2]], arch["at"])
    assert np.nanargmin(np.linalg.norm(q, axis=1)) in arch["bodies"]
    text = " ".join(jammed.summary_text().split())
    assert f"from t = {found['since']:g} s on, {found['bodies']} bodies: nothing will ever change, the contacts alone" in text
    assert f"before exit 'hole' {found['bodies']} bodies stand behind 0 at ({q[0, 0]:.4g}, {q[0, 1]:.4g}), 2 at (" in text
    assert "ends: 'wall 0-0' and 'wall 2-1'" in text


def test_where_no_exit_is_known_the_arch_is_that_of_the_body_with_most_pressure(jammed):
    model = hopper()
    problem, q = BodiesProblem(replace(model, scene=None)), jammed.x[-1].reshape(-1, 2)
    (arch,) = find_arches(problem, q, jammed.contacts(-1))
    assert (arch["exit"], arch["pressed"]) == (None, 8)
    assert np.nanargmax(jammed.pressure[-1]) in arch["bodies"]
    assert len(arch["ends"]) == 2


def test_what_is_held_stays_and_what_one_contact_less_holds_does_not(jammed):
    problem, warm = BodiesProblem(hopper()), COLD_BODIES_START
    step, q = BodiesStepper(problem, "auto", 1e-9), jammed.x[-1].reshape(-1, 2)
    for k in range(200):
        q, *_, warm, _, _ = step(k * 0.05, 0.05, q, warm, k)
    assert np.nanmax(np.abs(q.ravel() - jammed.x[-1])) < 1e-13
    contacts = jammed.contacts(-1)
    assert is_held_by_contacts(problem, 0.0, q, q, contacts)
    assert not is_held_by_contacts(problem, 0.0, q, q, Contacts(*(part[1:] for part in contacts)))
    assert not is_held_by_contacts(problem, 0.0, q + 1e-15, q, NO_CONTACTS)  # who touches nobody moves


def test_a_resumed_run_ends_in_the_same_step(jammed, tmp_path):
    since = jammed.summary()["bodies"]["standstill"]["since"]
    simulate(hopper(), out=tmp_path / "run", t_end=since + 0.2)
    parts = simulate(hopper(), out=tmp_path / "run", resume=True)
    assert parts.x.tobytes() == jammed.x.tobytes()
    assert parts.metadata["bodies"] == jammed.metadata["bodies"]


def test_a_will_that_may_change_is_waited_for(jammed):
    run = simulate(hopper(downwards, t_end=6.0))
    assert run.t[-1] == 6.0
    found = run.summary()["bodies"]["standstill"]
    assert found["for_good"] is None
    assert "nobody has moved by more than rounding since" in " ".join(run.summary_text().split())
    back = simulate(hopper(lambda t, q: downwards(t, q) * (1 if t < 5 else -1), t_end=6.0))
    assert np.nanmin(np.abs(back.x[-1] - run.x[-1])[1::2]) > 0.5
    late = simulate(hopper(t_end=6.0, enter=np.where(np.arange(9) == 8, 5.5, 0)))
    assert late.t[-1] == 6.0
    told = lambda t, q: downwards(t, q)  # noqa: E731
    told.autonomous = True
    assert simulate(hopper(told)).t[-1] == jammed.t[-1]


@pytest.mark.parametrize(("beside", "end"), [(0.0, "given back"), (5e-15, None)])
def test_a_balance_that_may_tip_is_no_standstill_for_good(beside, end):
    """A point pushed onto the top of a disc: a hair beside it, it slides down in the end, though for a while only by rounding."""
    bodies = Bodies([[beside, 1.0]])
    i = bodies.member("i")
    model = ManyBodies(bodies=bodies, f=[0, -1], constraints={"disc": Family(ca.norm_2(i.q) - 1, i)}, t_end=40, step=0.05)
    run = simulate(model, t_end=1.2)
    assert run.metadata["bodies"]["standstill"]["for_good"] == end
    assert run.metadata["bodies"]["standstill"]["since"] == 0
    run = simulate(model)
    assert (run.t[-1] == 40) == (end is None)
    assert (run.x[-1, 1] < 0) == (end is None)


# ---------------------------------------------------------------------------------------------- noise


def test_noise_is_a_function_of_seed_interval_and_person():
    noise = Noise(0.8, every=0.25, seed=7)
    angles = np.array([noise.angles(k * 0.25, 500) for k in range(200)])
    assert np.array_equal(angles[3], noise.angles(0.99, 500))
    assert not np.array_equal(angles[3], noise.angles(1.0, 500))
    assert np.array_equal(noise.angles(0.75, 20), angles[3, :20])  # who else is there does not matter
    assert not np.array_equal(Noise(0.8, 0.25, 8).angles(0.75, 500), angles[3])
    assert np.abs(angles).max() < 0.8
    assert abs(angles.mean()) < 4 * 0.8 / np.sqrt(3 * angles.size)
    assert abs(angles.var() / (0.8**2 / 3) - 1) < 0.02
    assert abs(np.corrcoef(angles[:-1].ravel(), angles[1:].ravel())[0, 1]) < 4 / np.sqrt(angles.size)
    # steps of any length meet the same intervals
    assert all(np.array_equal(noise.angles(k * 0.05, 5), angles[k // 5, :5]) for k in range(100))


def few(**more):
    """Five people in the corridor."""
    return crowd(two_doors(), place(two_doors(), 5), **({"t_end": 2.0, "step": 0.05} | more))


def test_noise_turns_the_wish_inside_the_room_and_keeps_the_speed():
    still, model = few(), few(noise=Noise(0.8, seed=3))
    q, t = model.bodies.q0.copy(), 3.3
    q[4] = 12.3, 1.9  # past the door
    wanted, turned = still.f(t, q), model.f(t, q)
    angle = np.arctan2(wanted[:, 0] * turned[:, 1] - wanted[:, 1] * turned[:, 0], (wanted * turned).sum(axis=1))
    assert np.allclose(angle[:4], Noise(0.8, seed=3).angles(t, 5)[:4], atol=1e-12)
    assert angle[4] == 0
    assert np.allclose(np.linalg.norm(turned, axis=1), 1)


def test_noise_is_the_same_however_it_is_stepped(tmp_path):
    model = few(noise=Noise(1.0))
    run = simulate(model)
    assert simulate(few(noise=Noise(1.0, seed=2))).x.tobytes() != run.x.tobytes()
    simulate(model, out=tmp_path / "run", t_end=0.75)
    assert simulate(model, out=tmp_path / "run", resume=True).x.tobytes() == run.x.tobytes()
    with pytest.raises(StorageError, match="another model"):
        simulate(few(noise=Noise(1.0, every=0.6)), out=tmp_path / "run", resume=True)


def test_noise_undoes_an_arch():
    noise = Noise(1.5)

    def wavering(t, q):
        angle = np.arctan2(*downwards(t, q).T[::-1]) + noise.angles(t, len(q))
        return np.column_stack([np.cos(angle), np.sin(angle)])

    run = simulate(hopper(wavering))
    assert run.metadata["bodies"]["empty_at"] == run.t[-1] < 20


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"angle": 0}, "noise: angle: 0 .*; expected an angle > 0"),
        ({"angle": 4}, "noise: angle: 4; expected an angle > 0 and at most pi"),
        ({"angle": "wide"}, "noise: angle: 'wide'"),
        ({"angle": 1, "every": 0}, "noise: every: 0 .*; expected a number > 0, in s"),
        ({"angle": 1, "seed": -1}, "noise: seed: -1 .*; expected a whole number >= 0"),
        ({"angle": 1, "seed": 0.5}, "noise: seed: 0.5"),
    ],
)
def test_what_is_wrong_with_noise_is_said(given, message):
    with pytest.raises(ModelError, match=message):
        Noise(**given)
    with pytest.raises(ModelError, match=r"noise: 0.5 \(a float\); expected Noise\(angle\), or None"):
        few(noise=0.5)
