"""False statements that the program of certificates answers with yes: a random search, and how well it finds dropped premises.

    python -m tests.search.forgeries --attempts 100000          # every rule
    python -m tests.search.forgeries --rule A5 --seed 7
    python -m tests.search.forgeries --mutants --attempts 4000  # the checker with one premise dropped at a time

Certificates of small models are changed at random: statements strengthened, premises weakened, proofs and models changed, numbers
replaced by 0, negative, huge, empty, repeated, infinite ones and by other types. What is then answered "yes" is looked at by
``falsity``, which shares no code with the checker. The status is 1 where a forgery is found, or too few mutants are.
"""

from __future__ import annotations

import argparse
import ast
import copy
import functools
import json
import random
import sys
import time
import types
import warnings
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import casadi as ca

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    SweepingProcess,
    check,
    complementarity,
    relay,
)
from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.write import certificate_of

from . import falsity
from .claims import FORGERIES, OF_PARAMETERS, TRUE, over

Statement = dict[str, Any]
Pair = tuple[Any, Statement]


class Forgery(NamedTuple):
    """A statement that is answered yes and is false, and the counterexample."""

    rule: str
    model: Any
    statement: Statement
    sentence: str
    counterexample: str


# -- certificates to begin with


def models() -> Iterator[Any]:
    """Small models that have all hypotheses that can be proved, in each of the ways that the rules know."""
    t, s = (ca.SX.sym(name) for name in "ts")
    x, q, l = (ca.SX.sym(name, 2) for name in "xql")
    one, z = ca.SX.sym("z"), ca.SX.sym("w")
    step: dict[str, Any] = {"t_end": 1.0, "step": 0.1}

    def sweeping(constraints: Any, f: Any, q0: Any, **more: Any) -> SweepingProcess:
        return SweepingProcess(t=t, q=q, constraints=constraints, f=ca.vertcat(*f), q0=q0, **step, **more)

    yield sweeping({"disc": 2 * ca.norm_2(q) - 1}, (-2 * q[0], -2 * q[1]), (2, 1)), None
    disc = {"disc": ca.norm_2(q - ca.vertcat(ca.sin(t), 0)) - 1}
    yield sweeping(disc | {"wall": 3 - q[0] + t / 4}, (-q[0] + ca.cos(t), -q[1]), (2, 1)), None
    yield sweeping({"a": q[0], "b": q[1] + q[0] / 2}, (1, -1), (1, 1)), None
    yield (
        sweeping({"bowl": q[0] ** 2 + q[1] ** 2 - 1, "flat": q[0] + 3}, (ca.sin(q[1]), q[0] / 3), (2, 0)),
        {"q_0": (-2, 2), "q_1": (-2, 2)},
    )
    yield sweeping({"bowl": ca.exp(q[0]) + q[1] ** 4 - 1 + t / 8}, (-(q[0] ** 3), 0), (1, 1)), {"q_0": (-1, 1), "q_1": (-1, 1)}
    segment = ca.vertcat(q[0] - ca.fmin(ca.fmax(q[0], -1), 1), q[1])
    yield sweeping({"segment": ca.norm_2(segment) - 0.5}, (0, 0), (0, 2)), None

    def oscillator(theta: Any, g: Any, **more: Any) -> FrictionOscillator:
        return FrictionOscillator(x=x, s=s, friction=theta, potential=g, x0=[0.5, 0.25], **step, **more)

    yield oscillator(s + s**4 / 12 + s**3 / 6 + s**2 / 4, x[0] ** 2 + x[1] ** 2 - x[0] + ca.fabs(x[1])), None
    yield (
        oscillator(
            2 * s + ca.exp(-s),
            x[0] ** 4 + x[1] ** 4 + x[0] * x[1] + x[0] ** 2 + x[1] ** 2,
            constraints={"wall": 2 - x[0], "ball": 4 - x[0] ** 2 - x[1] ** 2},
            damping=[[1, 1], [-1, 1]],
        ),
        None,
    )
    yield oscillator(ca.sqrt(1 + s**2) + s, ca.exp(x[0]) + x[0] ** 2 + x[1] ** 2), {"x_0": (-1, 1), "x_1": (-1, 1)}
    yield FrictionOscillator(x=one, s=s, friction=s, potential=one**2, x0=[1], t_end=1.0, steps=[0.1, 0.2, 0.3, 0.4]), None
    elements = {"a": (ca.DM([[1, 0]]), s), "b": (ca.DM([[0, 1]]), 2 * s)}
    yield oscillator(elements, x[0] ** 2 + x[1] ** 2), None

    def first(f: Any, g: Any, h: Any, law: Any, **more: Any) -> FirstOrderSystem:
        return FirstOrderSystem(
            t=t, x=x, lam=l, f=ca.vertcat(*f), g=ca.vertcat(*g), h=ca.vertcat(*h), law=law, x0=[1, 1], **step, **more
        )

    yield first((-x[0] + x[1], x[1] / 2), (l[0], l[0] + l[1]), (x[0] + x[1] + l[0], x[1] + l[1]), relay(2)), None
    yield first((x[1], -x[0]), (0, l[0] + l[1]), (x[1], x[1]), relay(2)), None
    yield first((ca.tanh(x[1]), ca.sin(x[0])), (l[0], l[1]), (x[0], x[1]), relay(2)), {"x_0": (-1, 1), "x_1": (-1, 1)}
    yield FirstOrderSystem(x=one, lam=z, f=[3 * one], g=[z], h=[one + z], law=complementarity(1), x0=[1], **step), None

    def lure(A: Any, B: Any, C: Any, law: Any = None, **more: Any) -> LureSystem:
        return LureSystem(x=x, A=A, B=B, C=C, law=law, x0=[1, 0.5], **step, **more) if law else LureSystem(
            x=x, A=A, B=B, C=C, x0=[1, 0.5], **step, **more)  # fmt: skip

    linear = ca.vertcat(-x[0] + x[1], -x[0] - 2 * x[1])
    yield lure(linear, [[1], [1]], [[1, 1]], relay(1), D=[[0.5]]), None
    yield lure(linear, [[1], [0]], [[1, 0]], complementarity(1)), None
    yield lure(ca.vertcat(x[1] - ca.tanh(x[0]), -x[0] - ca.tanh(x[1])), [[0], [1]], [[0, 1]], relay(1)), None
    yield lure(linear, [[1, 0], [0, 1]], [[1, 0], [0, 1]], complementarity(2), D=[[0, 1], [-1, 0]]), None

    def inclusion(F: Any, **more: Any) -> MonotoneInclusion:
        return MonotoneInclusion(x=x, field=ca.vertcat(*F), x0=[0.5, 0.5], **step, **more)

    ball = {"ball": 4 - x[0] ** 2 - x[1] ** 2}
    yield inclusion((-x[0] + x[1], -x[1]), operator=ca.vertcat(ca.sign(x[0] - 1) + x[0], x[1]), constraints=ball), None
    yield inclusion((-x[0], 1 - x[1]), phi=ca.fabs(x[0]) + x[1] ** 2, lower=[-1, -1], upper=[2, 3]), None
    yield (
        inclusion((x[1] - x[0] ** 3, -x[0]), operator=ca.vertcat(x[0] ** 3 + x[0], ca.tanh(x[1])), constraints=ball),
        {"x_0": (-3, 3), "x_1": (-3, 3)},
    )
    yield inclusion((x[1] - x[0], -x[0] - x[1]), phi=x[0] ** 4 + x[1] ** 4), None
    yield (
        inclusion((ca.sqrt(1 + x[0] ** 2), ca.sqrt(3 + x[1])), phi=ca.exp(x[0]) + x[1] ** 2, constraints=ball),
        {"x_0": (-2, 2), "x_1": (-2, 2)},
    )


@functools.cache
def originals() -> dict[str, list[Pair]]:
    """Statements that are proved, by rule; the smallest certificates first."""
    found: dict[str, list[Pair]] = {rule: [] for rule in verify.STATEMENTS}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for model, region in models():
            certificate = json.loads(json.dumps(certificate_of(check(model, [], quick=True, region=region))))
            for s in certificate["statements"]:
                if s["proof"] is not None and len(json.dumps(s)) < 6000:
                    found[s["id"]].append((certificate["model"], s))
    for model, s in [*TRUE.values(), *((model, over(s, *ends)) for model, s, ends, _ in OF_PARAMETERS.values())]:
        found[s["id"]].append((model, s))
    return {rule: sorted(pairs, key=lambda pair: len(json.dumps(pair))) for rule, pairs in found.items()}


@functools.cache
def beginnings() -> dict[str, list[Pair]]:
    """What is changed: statements that are proved, and known forgeries, by rule."""
    return {
        rule: [*pairs, *(pair for pair in FORGERIES.values() if pair[1]["id"] == rule)] for rule, pairs in originals().items()
    }


# -- changes

NUMBERS = ("0", "1", "-1", "2", "1/2", "-1/2", "3", "-2", "1/1000", "1000000", "-1000000", "123/97", "inf", "-inf")
FACTORS = tuple(map(Fraction, ("-1", "1/2", "9/10", "11/10", "2", "10", "1/10", "999/1000", "1001/1000", "3/2")))
EXPONENTS = ("-3", "-2", "-1", "-1/2", "-1/3", "1/3", "1/2", "2/3", "1", "3/2", "2", "5/2", "3", "4")
JUNK = (None, True, 0, -1, 0.5, float("nan"), "", "nan", [], {}, ["0"], "x")
OPERATIONS = ("exp", "sin", "cos", "tanh")
UNREADABLE = (KeyError, IndexError, TypeError, AttributeError, ValueError)  # A change does not fit what another has left.


def places(item: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all parts of a nest of lists and dictionaries."""
    yield path
    if isinstance(item, dict | list):
        for key, part in item.items() if isinstance(item, dict) else enumerate(item):
            yield from places(part, (*path, key))


def at(item: Any, path: Sequence[Any]) -> Any:
    """The part at a path."""
    for key in path:
        item = item[key]
    return item


def is_number(item: Any) -> bool:
    """Whether it is a fraction in text."""
    try:
        return isinstance(item, str) and Fraction(item) is not None
    except (ValueError, ZeroDivisionError):
        return False


def is_power(item: Any) -> bool:
    """Whether it is a step with an exponent."""
    return isinstance(item, list) and item[:1] == ["pow"]


def any_number(rng: random.Random) -> str:
    """A number of the list, or any fraction."""
    return rng.choice(NUMBERS) if rng.random() < 0.7 else str(Fraction(rng.randint(-99, 99), rng.randint(1, 30)))


def other_number(old: str, rng: random.Random) -> str:
    """A number to put in the place of one: a little or much more or less, another sign, or any."""
    kind = rng.random()
    if kind < 0.4 or not is_number(old):
        return any_number(rng)
    if kind < 0.6:
        return str(Fraction(old) + Fraction(rng.choice([-1, 1]) * rng.randint(1, 9), 10 ** rng.randint(0, 6)))
    return str(Fraction(old) * rng.choice(FACTORS))


def change_number(part: Any, rng: random.Random) -> None:
    """One number, or all in one list, become others."""
    found = [path for path in places(part) if is_number(at(part, path))]
    if not found:
        return
    path = rng.choice(found)
    inner = at(part, path[:-1])
    if isinstance(inner, list) and rng.random() < 0.2:
        new = rng.choice(["0", None])
        inner[:] = [new or other_number(x, rng) if is_number(x) else x for x in inner]
    else:
        inner[path[-1]] = other_number(inner[path[-1]], rng)


def scale(part: Any, factor: Fraction, rng: random.Random) -> None:
    """All numbers of a named part are multiplied by one."""
    found = [path for path in places(part) if path and isinstance(path[-1], str) and path[-1] not in ("steps", "graph", "inputs")]
    if not found:
        return
    root = rng.choice(found)
    for path in list(places(at(part, root))):
        whole = root + path
        if is_number(at(part, whole)):
            at(part, whole[:-1])[whole[-1]] = str(factor * Fraction(at(part, whole)))


def change_step(part: Any, rng: random.Random) -> None:
    """A step of a program becomes another, or a value passes through one more."""
    found = [path for path in places(part) if path and path[-1] == "steps"]
    if not found:
        return
    program = at(part, rng.choice(found)[:-1])
    steps, k = program["steps"], rng.randrange(len(program["steps"]) or 1)
    if not steps:
        return
    place = rng.randrange(len(program["outputs"]) or 1)
    last, kind = program["outputs"][place] if program["outputs"] else 0, rng.random()
    if kind < 0.35 and program["outputs"]:
        u = rng.choice([last, k])
        steps.append(rng.choice([[rng.choice(OPERATIONS), u], ["pow", u, rng.choice(EXPONENTS)], ["fmax", last, k],
                                 ["mul", last, k], ["add", last, k]]))  # fmt: skip
        if rng.random() < 0.5:  # The old value, and 0 times the new one.
            steps += [["const", "0"], ["mul", len(steps) - 1, len(steps)], ["add", last, len(steps) + 1]]
        program["outputs"][place] = len(steps) - 1
    elif kind < 0.5 and program["outputs"]:
        steps += [["const", other_number("1", rng)], [rng.choice(["mul", "add", "fmax"]), last, len(steps)]]
        program["outputs"][place] = len(steps) - 1
    elif steps[k][0] in OPERATIONS:
        steps[k][0] = rng.choice(OPERATIONS)
    elif steps[k][0] in ("add", "mul", "fmax"):
        steps[k][0] = rng.choice(["add", "mul", "fmax"])
    elif steps[k][0] == "in":
        steps[k][1] = rng.randrange(len(program["inputs"]))
    elif steps[k][0] == "pow":
        steps[k][2] = rng.choice(EXPONENTS)
    else:
        steps[k][1] = other_number(steps[k][1], rng)


def change_shape(part: Any, rng: random.Random) -> None:
    """Something is left out, repeated, swapped with its neighbour, or replaced by another type."""
    found = [path for path in places(part) if path]
    if not found:
        return
    path = rng.choice(found)
    inner, key, kind = at(part, path[:-1]), path[-1], rng.random()
    if kind < 0.3:
        del inner[key]
    elif isinstance(inner, list) and kind < 0.6:
        inner.insert(key, copy.deepcopy(inner[key]))
    elif isinstance(inner, list) and kind < 0.8:
        other = rng.randrange(len(inner))
        inner[key], inner[other] = inner[other], inner[key]
    else:
        inner[key] = copy.deepcopy(rng.choice(JUNK))


def change_cover(proof: Any, rng: random.Random) -> None:
    """A cover is cut once more, or replaced by one part, or left out or made up."""
    names = ("cover", "time", "slope")
    found = [path for path in places(proof) if path and path[-1] in names]
    if not found or rng.random() < 0.2:
        proof["cover"] = rng.choice([None, [0, None, None], [1, None, None], [0, [1, None, None], [1, None, None]]])
        return
    path = rng.choice(found)
    tree = at(proof, path)
    at(proof, path[:-1])[path[-1]] = rng.choice([None, [0, tree, tree], [1, tree, tree], [0, [0, tree, tree], [0, tree, tree]]])


def change_scope(model: Any, s: Statement, rng: random.Random) -> None:
    """The box becomes wider, everything, a point, empty, or another."""
    kind = rng.random()
    if kind < 0.5 and s["scope"]:
        change_number(s["scope"], rng)
    elif kind < 0.65:
        s["scope"] = None
    else:
        programs = [at(model, path) for path in places(model) if path and path[-1] == "inputs"]
        ends = {name: [any_number(rng), any_number(rng)] for name in rng.choice(programs)}
        if rng.random() < 0.8:
            ends = {name: sorted(pair, key=lambda x: float(x if "inf" in x else Fraction(x))) for name, pair in ends.items()}
        time = ends.pop("t", None)
        kept = (s["scope"] or {}).get("parameters")
        s["scope"] = {"states": ends, "time": time if rng.random() < 0.5 else None}
        if rng.random() < 0.1:
            s["scope"][rng.choice(["parameters", "domain"])] = {"p": ["0", "1"]}
        elif kept is not None:
            s["scope"]["parameters"] = kept


def change_shared(parts: Any, s: Statement, rng: random.Random) -> None:
    """A number becomes another wherever it stands in the model and in the proof; or in the model and in the statement."""
    whole = {"parts": parts, "proof": s["proof"], "value": s["value"]}
    found = [path for path in places(whole) if is_number(at(whole, path)) and not is_power(at(whole, path[:-1]))]
    if not found:
        return
    old = Fraction(at(whole, rng.choice(found)))
    new, opposite, names = (
        other_number(str(old), rng),
        rng.random() < 0.3,
        rng.choice([("parts", "proof"), ("parts", "value"), tuple(whole)]),
    )
    for path in found:
        inner = at(whole, path[:-1])
        if path[0] in names and Fraction(inner[path[-1]]) == old:
            inner[path[-1]] = new
        elif opposite and path[0] in names and Fraction(inner[path[-1]]) == -old and is_number(new):
            inner[path[-1]] = str(-Fraction(new))


def repair(rule: str, model: Any, s: Statement) -> None:
    """Hints that an equation determines are made to fit: M^-1; upper bounds become 0."""
    proof = s["proof"]
    if rule in ("A0", "A3", "A4"):
        for hint in proof["constraints"]:
            hint.update({"b": "0"} if "b" in hint else {})
    if rule in ("F-step", "F-W"):
        M = [[Fraction(x) for x in row] for row in model["M"]]
        size, inverse = falsity.solved(M, [[Fraction(int(i == j)) for j in range(len(M))] for i in range(len(M))])
        proof["R"] = [[str(x) for x in row] for row in inverse] if size else proof["R"]


def change_inputs(model: Any, rng: random.Random) -> None:
    """The inputs of one function, or a name in all, are others."""
    found = [path for path in places(model) if path and path[-1] == "inputs"]
    path, kind = rng.choice(found), rng.random()
    names = at(model, path)
    if kind < 0.4:
        names.append(rng.choice(["t", "u", "v"]))
    elif kind < 0.6:
        rng.shuffle(names)
    elif kind < 0.8:
        del names[rng.randrange(len(names))]
    else:
        old, new = rng.choice(names), rng.choice(["t", "u", "x", "x_0"])
        for other in found:
            at(model, other)[:] = [new if name == old else name for name in at(model, other)]


def change_part(model: Any, other: Any, names: Sequence[str], rng: random.Random) -> None:
    """A part of the model becomes that of another of its class."""
    common = [name for name in names if name in model and name in other]
    if common:
        name = rng.choice(common)
        model[name] = copy.deepcopy(other[name])


def change_law(model: Any, rng: random.Random) -> None:
    """A factor of the law becomes another."""
    for block in model.get("law") or ():
        if block.get("kind") == "box":
            for name in ("lower", "upper"):
                block[name] = [rng.choice([x, x, "0", "1", "-1", "inf", "-inf"]) for x in block[name]]
        if rng.random() < 0.1:
            block["kind"] = rng.choice(["ball", "potential"])


def forged(rule: str, rng: random.Random) -> Pair:
    """A statement of a rule, or a known forgery, with one to five changes."""
    pairs = beginnings()[rule]
    model, s = (copy.deepcopy(part) for part in pairs[int(len(pairs) * rng.random() ** 2)])
    if "e" in falsity.READ[rule] and rng.random() < 0.1:
        model["e"] = [any_number(rng) for _ in model["D"]] if rng.random() < 0.9 else copy.deepcopy(model["f"])
    for _ in range(rng.choice([1, 1, 1, 2, 2, 3, 4, 5])):
        kind = rng.random()
        parts = {name: model[name] for name in ("parameters", *falsity.READ[rule]) if name in model}
        if kind < 0.17 and s["value"]:
            change_number(s["value"], rng)
        elif kind < 0.22:
            names = [*verify.NUMBERS.get(rule, ()), *verify.OPTIONAL.get(rule, ()), rng.choice(["b", "rho", "c"])]
            name = rng.choice(names)
            s["value"].pop(name, None) if rng.random() < 0.5 else s["value"].update({name: any_number(rng)})
        elif kind < 0.34:
            change_number(s["proof"], rng)
        elif kind < 0.41:
            change_cover(s["proof"], rng)
        elif kind < 0.47:
            change_scope(model, s, rng)
        elif kind < 0.57:
            change_number(parts, rng)
        elif kind < 0.7:
            change_step(parts, rng)
        elif kind < 0.74:
            change_law(model, rng)
        elif kind < 0.79:
            change_part(model, rng.choice(pairs)[0], falsity.READ[rule], rng)
        elif kind < 0.83:
            change_shape(rng.choice([model, parts, parts, s["proof"], s]), rng)
        elif kind < 0.85:
            change_inputs(model, rng)
        elif kind < 0.87:
            s["proof"] = copy.deepcopy(rng.choice(pairs)[1]["proof"])
        elif kind < 0.95:
            change_shared(parts, s, rng)
        else:  # The proof and the statement, or the model, by the same factor.
            factor = rng.choice([Fraction(-1), Fraction(0), Fraction(2), Fraction(1, 2)])
            scale(s["proof"], factor, rng)
            scale(rng.choice([parts, s]), factor, rng)
        if not isinstance(s.get("value"), dict) or not isinstance(s.get("proof"), dict) or "scope" not in s:
            return model, s
    if rng.random() < 0.3:
        repair(rule, model, s)
    return model, s


# -- the search


class Search:
    """Changed statements of a rule, each once: what a checker answers yes, and what of that is false.
    Statements are the same where all that the rule looks at is; whether one is true is judged once, whatever its proof is.
    """

    def __init__(self, rule: str, seed: int = 0) -> None:
        self.rule, self.rng, self.found = rule, random.Random(f"{rule} {seed}"), []
        self.statements, self.judged, self.yes, self.unjudged = set(), {}, 0, 0

    def forge(self, attempts: int, seconds: float = 1e9) -> Iterator[Pair]:
        """As many further statements, fewer where time is up or nothing new is made."""
        until, enough = time.process_time() + seconds, len(self.statements) + attempts
        for _ in range(20 * attempts):
            if len(self.statements) >= enough or time.process_time() > until:
                return
            try:
                model, s = forged(self.rule, self.rng)
                key = hash(json.dumps([self._claim(model, s), s.get("proof")], sort_keys=True))
            except UNREADABLE:
                continue
            if key not in self.statements:
                self.statements.add(key)
                yield model, s

    def _claim(self, model: Any, s: Statement) -> list[Any]:
        parts = {name: model.get(name) for name in ("class", "parameters", *falsity.READ[self.rule])}
        return [parts, s.get("value"), s.get("scope"), s["proof"].get("P") if self.rule == "5.2" else None]

    def falsity(self, model: Any, s: Statement) -> str:
        """A counterexample, "" where none is found."""
        key = hash(json.dumps(self._claim(model, s), sort_keys=True))
        if key not in self.judged:
            try:
                self.judged[key] = falsity.find(model, s, len(self.judged))
            except Exception:  # Data of another form, where the rule does not look.
                self.judged[key], self.unjudged = "", self.unjudged + 1
        return self.judged[key]

    def go(self, attempts: int, seconds: float = 1e9) -> list[Forgery]:
        """The forgeries among further statements."""
        for model, s in self.forge(attempts, seconds):
            kind, sentence = verify.answer(model, s)
            if kind == "yes":
                self.yes += 1
                if counterexample := self.falsity(model, s):
                    self.found.append(Forgery(self.rule, model, s, sentence, counterexample))
        return self.found

    def __str__(self) -> str:
        """What was done, in numbers."""
        judged = f"{len(self.judged)} claims judged, {self.unjudged} of another form"
        return f"{self.rule:12} {len(self.statements)} statements, {self.yes} answered yes, {judged}, {len(self.found)} forgeries"


# -- mutants of the checker


class Premises:
    """Which premise of a marked checker is dropped, and which were seen to fail: to be false, or to raise an exception."""

    def __init__(self) -> None:
        self.places: list[str] = []
        self.dropped, self.begun, self.failed = -1, [], set()

    def drops(self, n: int) -> bool:
        """Whether a premise is dropped; else it is looked at now."""
        self.begun += [n] if n != self.dropped else []
        return n == self.dropped

    def note(self, n: int, value: Any) -> Any:
        """The value of a premise, which has been looked at."""
        while self.begun.pop() != n:
            pass
        self.failed |= set() if value is True else {n}
        return value

    def answer(self, checker: types.ModuleType, pair: Pair, dropped: int = -1) -> str:
        """What the checker answers without a premise."""
        self.dropped, self.begun, self.failed = dropped, [], set()
        kind, _ = checker.answer(*pair)
        self.failed |= set(self.begun)
        return kind


class Marked(ast.NodeTransformer):
    """Makes premises visible: the condition of a ``need``, each side of an ``and`` in one, in a leaf, and in what is returned."""

    def __init__(self, premises: Premises, owner: str) -> None:
        self.premises, self.owner = premises, owner

    def _mark(self, node: ast.expr) -> ast.expr:
        n = len(self.premises.places)
        self.premises.places.append(f"{self.owner} {node.lineno}: {ast.unparse(node)}")
        marked = ast.parse(f"premises.drops({n}) or premises.note({n}, 0)", mode="eval").body
        marked.values[1].args[1] = node  # type: ignore[attr-defined]
        return ast.copy_location(marked, node)

    def _premise(self, node: ast.expr) -> ast.expr:
        if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.And):
            node.values = [self._mark(part) for part in node.values]
            return node
        return self._mark(node)

    def visit_Call(self, node: ast.Call) -> Any:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id == "need":
            node.args[0] = self._premise(node.args[0])
        return node

    def visit_Lambda(self, node: ast.Lambda) -> Any:
        self.generic_visit(node)
        if isinstance(node.body, ast.BoolOp) and isinstance(node.body.op, ast.And):
            node.body = self._premise(node.body)
        return node

    def visit_Return(self, node: ast.Return) -> Any:
        self.generic_visit(node)
        if isinstance(node.value, ast.BoolOp) and isinstance(node.value.op, ast.And):
            node.value = self._premise(node.value)
        return node


def marked_checker() -> tuple[types.ModuleType, Premises]:
    """The checker with all premises of its rules marked, so that each can be dropped."""
    with open(verify.__file__, encoding="utf-8") as file:
        tree = ast.parse(file.read())
    first = next(node.lineno for node in tree.body if getattr(node, "name", "") == "VerifierStatement")
    premises, module = Premises(), types.ModuleType("marked")
    for k, node in enumerate(tree.body):
        name = getattr(node, "name", "")
        if node.lineno >= first and name not in ("", "answer", "read_certificate", "main"):
            for j, method in enumerate(node.body if isinstance(node, ast.ClassDef) else ()):
                if isinstance(node, ast.ClassDef) and isinstance(method, ast.FunctionDef):
                    node.body[j] = Marked(premises, f"{name}.{method.name}").visit(method)
            tree.body[k] = node if isinstance(node, ast.ClassDef) else Marked(premises, name).visit(node)
    module.__dict__["premises"] = premises
    exec(compile(ast.fix_missing_locations(tree), "marked", "exec"), module.__dict__)
    return module, premises


def found_without(
    rules: Sequence[str], attempts: int, seed: int = 0, seconds: float = 1e9, within: str | tuple[str, ...] = ""
) -> tuple[dict[str, Forgery], dict[str, int]]:
    """The premises (of functions named ``within``) without which a forgery is found; of the others, how many statements pass."""
    checker, premises = marked_checker()
    found: dict[str, Forgery] = {}
    passed = {place: 0 for place in premises.places if place.startswith(within)}
    for rule in rules:
        search = Search(rule, seed)
        for pair in search.forge(attempts, seconds):
            if premises.answer(checker, pair) == "yes":
                continue  # What the checker itself proves is looked at in its own search.
            for n in list(premises.failed):
                place = premises.places[n]
                if place in passed and premises.answer(checker, pair, n) == "yes":
                    passed[place] += 1
                    if counterexample := search.falsity(*pair):
                        found[place] = Forgery(rule, *pair, place, counterexample)
                        del passed[place]
    return found, passed


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, print what was found, and count."""
    parser = argparse.ArgumentParser(prog="python -m tests.search.forgeries", description=__doc__,
                                     formatter_class=argparse.RawTextHelpFormatter)  # fmt: skip
    parser.add_argument("--rule", action="append", choices=list(verify.STATEMENTS), help="one rule; may be repeated")
    parser.add_argument("--attempts", type=int, default=1000, help="different changed statements of each rule")
    parser.add_argument("--rounds", type=int, default=1, help="so many turns, each of all rules")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1e9, help="of the processor, at most, for a rule and turn")
    parser.add_argument("--mutants", action="store_true", help="drop one premise of the checker at a time")
    given = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    searches = [Search(rule, given.seed) for rule in given.rule or list(verify.STATEMENTS)]
    if given.mutants:
        return count_mutants(given, [search.rule for search in searches])
    for turn in range(given.rounds):
        for search in searches:
            started, before = time.process_time(), len(search.found)
            search.go(given.attempts // given.rounds, given.seconds)
            print(f"{search}, {time.process_time() - started:.0f} s", flush=True)
            for one in search.found[before:][:3]:
                print("   ", one.sentence, "|", one.counterexample, "|", json.dumps([one.model, one.statement]), flush=True)
        print(f"turn {turn + 1}: {sum(len(search.statements) for search in searches)} statements", flush=True)
    return int(any(search.found for search in searches))


def count_mutants(given: argparse.Namespace, rules: list[str]) -> int:
    """For each premise whether the search finds a forgery without it."""
    found, passed = found_without(rules, given.attempts, given.seed, given.seconds)
    for place, count in passed.items():
        print(f"not found ({count} pass): {place}")
    print(f"{len(found)} of {len(found) + len(passed)} dropped premises are found")
    return int(len(found) < 0.9 * (len(found) + len(passed)))


if __name__ == "__main__":
    sys.exit(main())
