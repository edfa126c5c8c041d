"""Random states, parameters and steps, hostile ones among them, through the C libraries of different kinds of models.

Every accepted step is judged again from the model's own mathematics, in extended precision, with nothing of `nsmodel.solvers`.
"""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import optimised
from contact_subjects import CONTACTS
from library_fuzz import (
    BAD_PARAMETER,
    BAD_STEP,
    COMPILER,
    COUNT,
    DONE,
    EPS,
    LAW,
    MOTION,
    NONE,
    NOT_FINITE,
    NOT_SOLVED,
    ROUND_OFF,
    SANITIZE,
    STEP,
    STRICT,
    UNRESOLVED,
    Binary,
    Input,
    Step,
    Subject,
    ball_law,
    box_law,
    inputs_of,
    judged,
    linear_step,
    magnitude,
    motion,
    ratios,
)

from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, MonotoneInclusion, SweepingProcess, codegen, relay
from nsmodel._utils import INVISIBLE_CHARACTERS

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


# Diode bridge: L = 10 mH, C = 1 uF, R = 1 kOhm; natural sizes 1 V and 1 mA, natural time sqrt(L C) = 1e-4 s.


def bridge_input(rng: np.random.Generator, any_step: bool) -> Input:
    h = 1e-4 * 10 ** rng.uniform(-6, 3) if any_step else 1e-6
    return Input(rng.uniform(0, 1), h, magnitude(rng, 2) * [1, 1e-3], np.zeros(2), NONE)


def judge_bridge(step: Step) -> tuple[float, float]:
    L, C, R = np.longdouble(1e-2), np.longdouble(1e-6), np.longdouble(1e3)
    A = np.array([[0, -1 / C], [1 / L, 0]])
    B = np.array([[0, 0, -1 / C, 1 / C], [0, 0, 0, 0]])
    v, (p, q, i, j) = step.after[0], step.l
    y = np.array([(p + q) / R - i, (p + q) / R - j, p - v, q + v])
    size = np.array([(abs(p) + abs(q)) / R + abs(i), (abs(p) + abs(q)) / R + abs(j), abs(p) + abs(v), abs(q) + abs(v)])
    law = box_law(step.l, y, 0, np.inf, size, np.array([R, R, 1, 1]))
    return law, linear_step(step, A, B, lambda t: np.zeros(2), 0.5)


# Two masses: all sizes are of order 1; masses, friction forces and stiffness are parameters.


def masses_input(rng: np.random.Generator) -> Input:
    p = 10 ** rng.uniform(-3, 3, 5)
    return Input(rng.uniform(0, 100), 10 ** rng.uniform(-6, 3), magnitude(rng, 4), np.zeros(4), p)


def judge_masses(step: Step) -> tuple[float, float]:
    m1, m2, mu1, mu2, k = step.p
    A = np.array([[0, 1, 0, 0], [-k / m1, 0, k / m1, 0], [0, 0, 0, 1], [k / m2, 0, -k / m2, 0]])
    B = np.array([[0, 0], [mu1 / m1, 0], [0, 0], [0, mu2 / m2]])
    v, w = step.after[[1, 3]], step.h * np.array([mu1 / m1, mu2 / m2])
    law = box_law(step.l, v, -1, 1, np.abs(v) + np.abs(w * step.l), 1 / np.sqrt(np.maximum(np.abs(w), np.finfo(w.dtype).tiny)))
    return law, linear_step(step, A, B, lambda t: np.array([0, 2 * np.sin(t) / m1, 0, 0]), 0.5)


# Two genes: concentrations of order 1, rates of order 1; they switch at 4 and at 8, where more than chance puts the states.


def genes_input(rng: np.random.Generator) -> Input:
    x = magnitude(rng, 2)
    near = rng.random(2) < 0.3
    x = np.where(near, rng.choice([4, 8], 2) + magnitude(rng, 2, -6, 0) * rng.integers(0, 2, 2), x)
    return Input(rng.uniform(0, 100), 10 ** rng.uniform(-6, 3), x, np.zeros(2), NONE)


def judge_genes(step: Step) -> tuple[float, float]:
    (a, b), l, x, h = step.after, step.l, step.state, step.h
    rate = np.array([4.5, 1.5])
    force = 40 * np.array([l[1] * (1 - l[2]), l[0] * (1 - l[3])])
    y = np.array([4 - a, 4 - b, 8 - a, 8 - b])
    law = box_law(l, y, 0, 1, np.array([4, 4, 8, 8]) + np.abs([a, b, a, b]))
    E = step.after - x + h * rate * (step.after + x) / 2 - h * force
    moved = np.abs(step.after - x) * (1 + h * rate / 2) + h * np.abs(rate * x) + h * np.abs(force)
    return law, motion(E, moved, (1 + h * rate) * (np.abs(step.after) + np.abs(x)))


# Three discs of radius 0.5 between walls that close: |x|, |y| <= 5 - t, so that t + h > 4.5 leaves no room.

RADIUS, WIDE = 0.5, 5.0
PAIRS = [(1, 0), (2, 0), (2, 1)]


def room(load_case: Callable[..., Any]) -> SweepingProcess:
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 6)
    at = ca.vertsplit(q, 2)
    pairs = {f"{i}-{j}": ca.norm_2(at[i] - at[j]) - 2 * RADIUS for i, j in PAIRS}
    walls = {"right": WIDE - t - RADIUS - q, "left": WIDE - t - RADIUS + q}
    f = ca.vertcat(*(ca.vertcat(1 - p[0], ca.sin(t) - p[1]) for p in at))
    return SweepingProcess(t=t, q=q, f=f, constraints=pairs | walls, q0=[-2, 0, 0, 0, 2, 0], t_end=2, step=0.01)


def room_input(rng: np.random.Generator) -> Input:
    """Discs that do not overlap, inside of the walls as they are after the step."""
    h = 10 ** rng.uniform(-6, 0.3)
    t = rng.uniform(0, 1) * (WIDE - 1.6 - h)
    free = WIDE - t - h - RADIUS
    while True:
        q = rng.uniform(-free, free, (3, 2))
        if rng.random() < 0.3:
            q[1] = q[0] + np.array([1, 0]) * (2 * RADIUS + 10 ** rng.uniform(-9, 0))
        gaps = [np.hypot(*(q[i] - q[j])) - 2 * RADIUS for i, j in PAIRS]
        if min(gaps) >= 0 and np.abs(q).max() <= free:
            return Input(t, h, q.ravel(), np.zeros(6), NONE)


def no_room(step: Step) -> bool:
    """The walls overlap, by more than what is small beside the way to them."""
    way = 1 + (1 + step.h) * (np.abs(step.state).max() + 1)
    return step.t + step.h > WIDE - RADIUS + 1e-5 * way


def judge_room(step: Step) -> tuple[float, float]:
    q, z, h, t = step.state, step.after, step.h, step.t
    here = q.reshape(3, 2)
    if min(np.abs(here[i] - here[j]).max() for i, j in PAIRS) < 1e-140:
        return 0.0, 0.0  # the square of the distance, and with it the direction, is lost
    rows, gaps = np.zeros((15, 6), np.longdouble), np.zeros(15, np.longdouble)
    for k, (i, j) in enumerate(PAIRS):
        difference = here[i] - here[j]
        far = np.sqrt(difference @ difference)
        rows[k, 2 * i : 2 * i + 2], rows[k, 2 * j : 2 * j + 2] = difference / far, -difference / far
        gaps[k] = far - 2 * RADIUS
    rows[3:9], rows[9:15] = -np.eye(6), np.eye(6)
    gaps[3:] = WIDE - t - h - RADIUS - np.concatenate([q, -q])
    f = (np.array([[1, np.sin(t)]]) - here).ravel()
    y = gaps + rows @ (z - q)
    size = np.abs(gaps) + np.abs(rows) @ (np.abs(q) + h * np.abs(f) + np.abs(rows.T) @ step.l) + 1
    law = box_law(step.l, y, 0, np.inf, size)
    E = z - q - h * f - rows.T @ step.l
    moved = np.abs(z - q) + h * np.abs(f) + np.abs(rows.T) @ np.abs(step.l)
    return law, motion(E, moved, np.abs(z) + (1 + h) * np.abs(q) + h)


# A mass in the plane, isotropic dry and quadratic friction, a quartic potential, linear damping, a round wall of radius 2.

STIFF, DAMPING = np.array([1.0, 3.0]), np.array([[0.2, 0.3], [-0.3, 0.1]])


def rubbing(load_case: Callable[..., Any]) -> FrictionOscillator:
    x, s, mu = ca.SX.sym("x", 2), ca.SX.sym("s"), ca.SX.sym("mu")
    return FrictionOscillator(
        x=x, potential=ca.dot(STIFF, x**2) / 2 + x[0] ** 4 / 4, friction=mu * s + s**3 / 3, s=s, damping=DAMPING,
        constraints={"wall": 4 - ca.sumsqr(x)}, x0=[1, 0], v0=[0, 1], t_end=5, step=0.01, parameters={mu: 0.5},
    )  # fmt: skip


def rubbing_input(rng: np.random.Generator) -> Input:
    """Within the wall; a free motion of up to 5000 radii in a step."""
    x, h = rng.normal(size=2), 10 ** rng.uniform(-6, 3)
    x *= 2 * rng.random() ** 0.5 / np.hypot(*x)
    return Input(0.0, h, x, np.clip(magnitude(rng, 2), -7e3 / h, 7e3 / h), 10 ** rng.uniform(-6, 3, 1))


def judge_rubbing(step: Step) -> tuple[float, float]:
    x, old, h, (mu,) = step.state[:2], step.state[2:], step.h, step.p
    z, d, xi, n = step.after[:2], step.after[2:], step.l[:2], step.l[2:]
    spring = STIFF * z + np.array([z[0] ** 3, 0])
    parts = [d, -old, h * (DAMPING @ d), np.sqrt(d @ d) * d, -(h**2) * xi, h**2 * spring, h**2 * 2 * n * z]
    # What is off free motion, d - old, and what that does to each force.
    stiff = (1 + 2 * np.sqrt(d @ d)) * np.eye(2) + h * np.abs(DAMPING) + h**2 * np.diag(STIFF + 3 * z**2 + 2 * np.abs(n))
    moved = stiff @ np.abs(d - old) + h**2 * (np.abs(xi) + 2 * np.abs(n * z))
    E = motion(np.sum(parts, axis=0), moved, np.sum(np.abs(parts), axis=0) + stiff @ (np.abs(x) + np.abs(d)))
    gap = 4 - z @ z
    pushed = h**2 * np.abs(2 * z) @ (np.abs(xi) + np.abs(2 * n * z))
    felt = ROUND_OFF / LAW * np.abs(2 * z) @ (np.abs(x) + np.abs(d))
    size, unit = np.array([4 + z @ z + pushed + felt]), 1 / np.abs(2 * z).max()
    wall = box_law(n, np.array([gap]), 0, np.inf, size, unit, np.abs(xi).max())
    moved_by_d = ratios(z - x - d, 4 * EPS * (np.abs(z) + np.abs(x) + np.abs(d))).max() * LAW
    slides = d if min(h**2, 1) * mu > 1e9 * UNRESOLVED else np.zeros(2)  # else friction is too weak to be looked at
    rubs = ball_law(xi, slides, mu, np.sum(np.abs(parts)), np.abs(2 * n * z).max())
    return max(rubs, wall, float(moved_by_d)), E


# A point in half a disc, driven against friction; projections may be off by eps.

FEEDBACK, DRIVE, FRICTION = np.array([[2.0, -0.5], [0.5, 1.0]]), np.array([3.0, -0.4]), np.array([0.5, 1.0])
LEFT, SLACK = -0.5, 1e-6


def half_disc(load_case: Callable[..., Any]) -> MonotoneInclusion:
    x = ca.SX.sym("x", 2)
    return MonotoneInclusion(
        x=x, field=DRIVE - FEEDBACK @ x, phi=ca.dot(FRICTION, ca.fabs(x)), constraints={"disc": 1 - ca.sumsqr(x)},
        lower=[LEFT, -np.inf], tolerances=SLACK, x0=[0, 0], t_end=3, step=0.01,
    )  # fmt: skip


def half_disc_input(rng: np.random.Generator) -> Input:
    x = rng.normal(size=2)
    x *= rng.random() ** 0.5 / np.hypot(*x)
    x[0] = max(x[0], LEFT)
    x *= rng.random(2) < 0.8
    return Input(0.0, 10 ** rng.uniform(-6, 3), x, np.zeros(2), NONE)


def judge_half_disc(step: Step) -> tuple[float, float]:
    x, z, h = step.state, step.after, step.h
    field = DRIVE - FEEDBACK @ x
    v = np.where(x == 0, field - np.clip(field, -FRICTION, FRICTION), field - FRICTION * np.sign(x))
    inside = max(LEFT - z[0], z @ z - 1, 0) / (8 * EPS)
    if (x == 0).any() and (x[0] <= LEFT or x @ x >= 1):
        return inside * LAW, 0.0  # another velocity may have been chosen
    y = x + h * v
    corner = np.array([LEFT, np.copysign(np.sqrt(1 - np.longdouble(LEFT) ** 2), y[1])])
    candidates = [y, y / np.sqrt(y @ y) if y.any() else y, np.array([LEFT, y[1]]), corner]
    # z ** 2 - 1 is round-off on the circle; the nearest point of C is the nearest admissible candidate.
    nearest = min((p - y) @ (p - y) for p in candidates if p[0] >= LEFT and p @ p <= 1 + 4 * EPS)
    excess = (z - y) @ (z - y) - nearest
    round_off = 64 * EPS * (nearest + (x @ x) + h * h * (field @ field))
    return inside * LAW, max(float((excess - SLACK) / (round_off + EPS)), 0) * MOTION


SUBJECTS = {
    "diode bridge": Subject(lambda load: load("diode_bridge"), lambda rng: bridge_input(rng, False), judge_bridge, length=1e-6),
    "diode bridge, any step": Subject(
        lambda load: load("diode_bridge"), lambda rng: bridge_input(rng, True), judge_bridge, options=(("any_step", True),)
    ),
    "diode bridge, worst case": Subject(
        lambda load: load("diode_bridge"),
        lambda rng: bridge_input(rng, False),
        judge_bridge,
        length=1e-6,
        options=(("worst_case", True),),
    ),
    "two masses": Subject(lambda load: load("two_masses"), masses_input, judge_masses),
    "genes": Subject(lambda load: load("gene_network"), genes_input, judge_genes),
    "closing room": Subject(room, room_input, judge_room, no_room),
    "rubbing": Subject(rubbing, rubbing_input, judge_rubbing, bad_parameters=lambda p: p[0] < 0),
    "half disc": Subject(half_disc, half_disc_input, judge_half_disc, lie=1.01),
} | CONTACTS


@pytest.fixture(scope="module")
def binary(tmp_path_factory, load_case):
    """Return binary(name, *flags) -> Binary of a subject, compiled once."""
    base = tmp_path_factory.mktemp("fuzz")

    @cache
    def build(name, *flags):
        folder = base / f"{len(list(base.iterdir()))}"
        return Binary(SUBJECTS[name].model(load_case), folder, flags, **dict(SUBJECTS[name].options))

    return build


# ---------------------------------------------------------------------------------------------- the fuzz


@pytest.mark.parametrize("name", SUBJECTS)
def test_every_accepted_step_is_right_and_every_other_input_is_refused(binary, name):
    """A status for every call, no crash, no hang; what is refused changes nothing; what is feasible is accepted."""
    subject, built = SUBJECTS[name], binary(name, "-O2")
    inputs, ordinary = inputs_of(subject, COUNT, 1)
    rows = built.run(inputs)
    status = rows[:, :6].astype(int)
    assert rows[:, 6].all(), "a refused call has changed something"

    def codes(parts, refused):
        return np.array([DONE if np.isfinite(part).all() else refused for part in parts])

    lengths = np.array([given.h for given in inputs])
    good_length = lengths == subject.length if subject.length else (lengths > 0) & (lengths < np.inf)
    np.testing.assert_array_equal(status[:, 0], codes([given.t for given in inputs], NOT_FINITE))
    np.testing.assert_array_equal(status[:, 2], np.where(good_length, DONE, BAD_STEP))
    np.testing.assert_array_equal(status[:, 3], codes([given.x for given in inputs], NOT_FINITE))
    bad_p = np.array([subject.bad_parameters(given.p) for given in inputs])
    finite_p = codes([given.p for given in inputs], NOT_FINITE)
    np.testing.assert_array_equal(status[:, 1], np.where(bad_p & (finite_p == DONE), BAD_PARAMETER, finite_p))
    if built.about["velocity"]:
        with np.errstate(over="ignore"):  # the difference of positions, h v, may overflow
            differences = [given.second * h for given, h in zip(inputs, rows[:, 8], strict=True)]
        np.testing.assert_array_equal(status[:, 4], codes(differences, NOT_FINITE))

    assert set(status[:, STEP]) <= {DONE, NOT_SOLVED, NOT_FINITE, BAD_STEP}
    accepted = status[:, STEP] == DONE
    assert accepted[ordinary].mean() >= 0.99
    assert 0.1 < accepted[~ordinary].mean() < 0.99
    assert (rows[accepted, 9] <= 1e-9).all()
    assert np.isfinite(rows[accepted]).all()
    if subject.impossible:
        impossible = [subject.impossible(built.step(row)) for row in rows]
        assert any(impossible)
        assert not (accepted & impossible).any()
    for row in rows[accepted]:
        law, moved = judged(built, subject, row)
        assert law <= LAW
        assert moved <= MOTION


@pytest.mark.parametrize("name", SUBJECTS)
@pytest.mark.long
def test_the_same_under_the_sanitizers(binary, name):
    """Nothing is read or written out of bounds, nothing is undefined; and an unoptimised build gives the same statuses."""
    inputs, _ = inputs_of(SUBJECTS[name], 400, 2)
    rows = binary(name, *SANITIZE).run(inputs)
    np.testing.assert_array_equal(rows[:, : STEP + 1], binary(name, "-O2").run(inputs)[:, : STEP + 1])


@pytest.mark.parametrize("name", SUBJECTS)
def test_what_a_wrong_step_looks_like(tmp_path, load_case, name):
    """The checks above see an answer that is wrong in its sixth digit; a projection may be so by its eps."""
    subject, rng = SUBJECTS[name], np.random.default_rng(3)
    wrong = f"s->x[i] = {subject.lie}*s->work.x_next[i]"
    lie = ("memcpy(s->x, s->work.x_next, sizeof s->x);", f"for (int i = 0; i < SCENE_NSTATE; i++) {wrong};")
    built = Binary(subject.model(load_case), tmp_path, (optimised("-O1"),), lie, **dict(subject.options))
    rows = built.run([subject.ordinary(rng) for _ in range(100)])
    caught = [law > LAW or moved > MOTION for law, moved in (judged(built, subject, row) for row in rows if row[STEP] == DONE)]
    assert np.mean(caught) > 0.5


def test_a_huge_state_does_not_spoil_the_steps_after_it(binary):
    """The multiplier of a state of 1e100 V is no start for one of 1 V, but the step is found all the same."""
    built = binary("diode bridge, any step", "-O2")
    huge, after = (Input(0.0, 1e-7, np.array(x), np.zeros(2), NONE) for x in ([1e100, 0.0], [1.0, 0.0]))
    rows = built.run([huge, after, after])
    np.testing.assert_array_equal(rows[:, STEP], DONE)
    assert max(judged(built, SUBJECTS["diode bridge, any step"], rows[2])) <= LAW


def test_a_step_that_would_move_far_excuses_nothing(binary):
    """Free motion would end at x = 8e4, where the quartic potential is 4e19: beside that, no force near the answer counts."""
    built, subject = binary("rubbing", "-O2"), SUBJECTS["rubbing"]
    x, v = np.array([0.3596151815160936, -0.05883490423365626]), np.array([282.0, -15.0])
    rows = built.run([Input(0.0, h, x, v, np.array([mu])) for h in (250.0, 286.4, 320.0) for mu in (3e-5, 0.5, 20.0)])
    assert (rows[:, STEP] == DONE).sum() >= 5
    assert max(judged(built, subject, row)[1] for row in rows if row[STEP] == DONE) <= MOTION


# ---------------------------------------------------------------------------------------------- names


TEXTS = (".c", ".h", ".md", ".json")
HOSTILE_NAMES = {
    "ends of comments": ("a */ b /* c /*/", ["*/", "/*"], "*/ m"),
    "quotes and escapes": ('say "x" \\', ['q"', "a\\n\\"], "\\"),
    "lines": ("two\nlines \\\n#error", ["a\nb", "\tc\r"], "\n"),
    "formats": ("100 % %s %n", ["%s%n%d", "@NAME@"], "%"),
    "trigraphs": ("??/ *??/", ["??/", "???=?"], "??/"),
    "prefixes": ("model_a MODEL_B", ["model_x", "MODEL_Y"], "model_"),
    "a digit first": ("3 discs", ["int", "while"], "1"),
    "a keyword": ("int", ["double", "x,y"], "void"),
    "unicode": ("Überdruck 中文 ∈", ["é", "😀" * 2000], "µm"),
    "nothing": ("", [" ", "''"], ""),
    "control": ("\x01\x7f", ["\x0b1", "\x1f7" * 2000], "\x02"),
    "directions": ("a\u202eb\x1b[31m", ["\u2066q\u2069", "\x9b1m"], "\u200f"),
    "long": ("x" * 5000, ["y" * 9000, "z"], "w" * 5000),
}


@pytest.mark.parametrize("kind", HOSTILE_NAMES)
def test_what_the_user_writes_stays_words(kind, tmp_path):
    """Titles, states, parameters and units of any text: strict C, a valid table and description, and the names unchanged."""
    title, names, word = HOSTILE_NAMES[kind]
    x, l, p = ca.SX.sym("x", 2), ca.SX.sym("l", 2), ca.SX.sym(f"p{word}")
    model = FirstOrderSystem(
        x=x, lam=l, f=[-p * x[0], x[0]], h=x, g=l, law=relay(2), x0=[1, 2], t_end=0.1, step=0.01, parameters={p: 2.0},
        names=names, units={names[0]: word, "t": word}, title=title,
    )  # fmt: skip
    about = codegen.write(model, tmp_path).about
    name = about["name"]
    command = [COMPILER, *STRICT, "-O0", "-o", "example", "example_main.c", f"{name}.c", "-lm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]
    output = subprocess.run([tmp_path / "example"], capture_output=True, check=True).stdout.decode()
    rows = list(csv.reader(io.StringIO(output, newline="")))
    assert rows[0] == ["t", *names, "l_0", "l_1"]
    assert len(rows) == 12
    assert json.loads((tmp_path / f"{name}.json").read_text())["states"] == names
    assert not any(
        INVISIBLE_CHARACTERS.search(path.read_text().replace("\n", "").replace("\t", ""))
        for path in tmp_path.glob("*.*")
        if path.suffix in TEXTS
    )
    if kind == "quotes and escapes":
        assert codegen.load(tmp_path).solver().step() == DONE


def test_no_name_in_the_code_is_one_that_a_title_can_make():
    """A library called "newton" has a newton_step: no static function may have the name of an exported one behind a prefix."""
    text = "\n".join(path.read_text() for path in (Path(codegen.__file__).parent / "c").glob("*.[ch]"))
    exported = set(re.findall(r"\bmodel_(\w+)\(", text)) - {"place", "rollout", "fetch", "size"}  # those in a run of their own
    static = set(re.findall(r"^static [^;{}=]*?\b(\w+)\(", text, re.MULTILINE))
    assert {"step", "init", "set_state", "status_text"} <= exported
    assert {"step_by_newton", "lu_factor"} <= static
    assert not [name for name in static if any(name.endswith(f"_{end}") for end in exported)]


@pytest.mark.parametrize("name", ["newton", "fixed", "catching_up", "model"])
def test_a_library_may_have_the_name_of_a_method(name, tmp_path, load_case):
    for stem in ("gene_network", "diode_bridge", "inclusion_8_2"):
        codegen.write(load_case(stem), tmp_path / stem, name=name)
        command = [COMPILER, *STRICT, "-fsyntax-only", f"{name}.c", "example_main.c"]
        done = subprocess.run(command, cwd=tmp_path / stem, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[:3000]


# ---------------------------------------------------------------------------------------------- found by fuzzing


def accepted_from_random_states(folder: Path, model: Any, count: int, lie: tuple[str, str] = ("", "")) -> float:
    rng = np.random.default_rng(0)
    binary = Binary(model, folder, (optimised("-O1"),), lie)
    empty = np.zeros(binary.nx)
    rows = binary.run([Input(1.0, 0.05, magnitude(rng, binary.nx, -3, 1), empty, NONE, True) for _ in range(count)])
    return float((rows[:, STEP] == DONE).mean())


def test_a_smooth_potential_has_multipliers_without_a_law(tmp_path):
    """l = -dPhi(y) is an expression: no row, no solver, and still the user's multiplier."""
    y = ca.SX.sym("y")
    model = LureSystem(A=[[-1]], B=[[1]], C=[[1]], y=y, phi=ca.cosh(y), x0=[1], t_end=1, step=0.05)
    about = codegen.write(model, tmp_path, name="scene").about
    assert (about["sizes"]["M"], about["sizes"]["NL"]) == (0, 1)
    solver = codegen.load(tmp_path).solver()
    assert solver.step() == DONE
    np.testing.assert_allclose(solver.multipliers, -np.sinh(solver.x), rtol=1e-9)
    assert accepted_from_random_states(tmp_path / "b", model, 50) == 1


def test_a_level_that_is_0_may_be_round_off_of_the_others(tmp_path):
    """A max in a max has a level, 0 where its argument is negative: it passes as 0 and as the others' rounding."""
    y = ca.SX.sym("y", 3)
    first = 0.6 * y[2] - 0.3 * y[0] + 0.7 * y[1] + 0.8
    second = 1.1 * y[2] - 1.6 * y[0] - 1.5 * y[1] - 0.1
    phi = sum(1.7 * ca.fmax(ca.fmax(e, 0), 2 * e - 1) for e in (first, second))
    D = [[1.2, 0.8, -0.1], [-0.2, 2.9, -1.7], [0.3, -0.7, 0.9]]
    model = LureSystem(A=[[-2]], B=[[-0.5, 0.3, 1]], C=[[-0.5], [0.3], [1]], D=D, y=y, phi=phi, x0=[1], t_end=1, step=0.05)
    assert accepted_from_random_states(tmp_path / "a", model, 200) == 1
    blunt = ("return fabs(sum) <= SUM_ERROR*EPS*size ? 0 : sum;", "(void)size; return sum;")
    assert accepted_from_random_states(tmp_path / "b", model, 200, blunt) == 1
