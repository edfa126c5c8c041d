"""A class with one hypothesis more says all that it said before: consequences name what they rest on by id."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Sequence
from functools import partial, wraps
from importlib import import_module
from types import FunctionType, ModuleType
from typing import Any

import casadi as ca
import pytest
from search import golden
from search.checked import draw

import nsmodel
from nsmodel import Bodies, Family, FirstOrderSystem, FrictionOscillator, ManyBodies, complementarity, within
from nsmodel.hypotheses.findings import UNKNOWN, Finding, Hypothesis, make_finding
from nsmodel.modeling import parts
from nsmodel.modeling.parts import MODEL_CLASSES

FURTHER = Hypothesis("further", "something that nobody has decided", "no paper")
NOT_DECIDED = make_finding(FURTHER, UNKNOWN, "not decided")


def modules_of(package: str) -> list[ModuleType]:
    """All modules of a class."""
    folder = import_module(package)
    return [folder, *(import_module(f"{package}.{found.name}") for found in pkgutil.iter_modules(folder.__path__))]


def with_further(item: Any) -> Any:
    """A list of findings with one more in front; anything else as it is."""
    is_list = isinstance(item, Sequence) and item and all(isinstance(one, Finding) for one in item)
    return [NOT_DECIDED, *(one for one in item if one.id != FURTHER.id)] if is_list else item


def told_of_further(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that is given the further finding with others, and hands it on with its own."""

    @wraps(function)
    def told(*given: Any, **named: Any) -> Any:
        made = function(*map(with_further, given), **{name: with_further(item) for name, item in named.items()})
        return tuple(map(with_further, made)) if type(made) is tuple else with_further(made)

    return told


@pytest.fixture
def further(monkeypatch):
    """Give each class a hypothesis in front of its others: in its table, from its checks, and to all that reads findings."""
    for package in MODEL_CLASSES.values():
        for module in modules_of(package):
            for name, item in vars(module).copy().items():
                if name == "HYPOTHESES":
                    monkeypatch.setattr(module, name, (FURTHER, *item))
                elif isinstance(item, FunctionType) and (name.startswith("check") or name.endswith(("consequences", "findings"))):
                    monkeypatch.setattr(module, name, told_of_further(item))
    parts._read_part.cache_clear()
    yield
    parts._read_part.cache_clear()


def said(report: nsmodel.hypotheses.report.Report) -> dict[str, Any]:
    """Verdicts, scopes, numbers and what consequences rest on, without what is said of the further hypothesis."""
    kept = golden.document(report)
    kept["findings"].pop(FURTHER.id, None)
    return kept


def forced_oscillator() -> FrictionOscillator:
    """A force that moves, in the plane."""
    x, s, u = ca.SX.sym("x"), ca.SX.sym("s"), ca.SX.sym("u")
    return FrictionOscillator(x=x, s=s, potential=x**2, friction=0.3 * s, force=u, inputs={u: None}, x0=1.0, t_end=1.0, step=0.1)


def bodies_with_a_speed() -> ManyBodies:
    """Discs that a parameter drives."""
    p = ca.SX.sym("p")
    people = Bodies(q0=[(0.0, 0.0), (3.0, 0.0)], r=[0.5, 0.5])
    i, j = people.member("i"), people.member("j")
    apart = {"apart": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)}
    return ManyBodies(bodies=people, f=-p * i.q, constraints=apart, parameters={p: 1.0}, t_end=1.0, step=0.1)


def decay(**step: float) -> FirstOrderSystem:
    """A state above 0 that a parameter draws to it."""
    x, l, p = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("p")
    law = complementarity(1)
    return FirstOrderSystem(x=x, lam=l, f=[-p * x], g=[l], h=[x], law=law, parameters={p: 1.0}, x0=[1.0], t_end=1.0, **step)


def decay_in_steps() -> FirstOrderSystem:
    """The same in steps."""
    return decay(step=0.1)


def boxes(model: Any) -> dict[str, Any]:
    """A quick check over a box of all parameters."""
    return {"parameters": {name: (value, value * 1.01 + 0.01) for name, value in model.parameters.items()}, "quick": True}


POINTS = {
    "sweeping": (1, 3, 4), "oscillator": (0, 1, 2), "first_order": (1, 2, 3), "lure": (0, 1, 2), "inclusion": (1, 2, 5),
    "bodies": (1, 3),
}  # fmt: skip
PARAMETRIC = ("sweeping", 11), ("lure", 3), ("inclusion", 28)
SCENES: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    **{f"{name}:{seed}": (partial(draw, name, seed), {"quick": True}) for name, seeds in POINTS.items() for seed in seeds},
    **{stem: (partial(nsmodel.load, stem), {}) for stem in ("buck", "moving_disc", "cabot_4_3", "inclusion_8_2")},
    **{f"{make.__name__} in a box": (make, boxes(make())) for make in (decay_in_steps, bodies_with_a_speed)},
    **{f"{name}:{seed} in a box": (partial(draw, name, seed), boxes(draw(name, seed))) for name, seed in PARAMETRIC},
    "cabot_4_1 in a box": (partial(nsmodel.load, "cabot_4_1"), boxes(nsmodel.load("cabot_4_1"))),
    "forced oscillator": (forced_oscillator, {"bounds": {"u": within(-1, 1)}, "quick": True}),
    "leash": (partial(nsmodel.load, "leash"), {"quick": True}),
    "no step": (decay, {"quick": True}),
}


@pytest.mark.parametrize("name", SCENES)
def test_a_further_hypothesis_changes_nothing_that_is_said(name, request):
    make, given = SCENES[name]
    before = said(nsmodel.check(make(), **given))
    request.getfixturevalue("further")
    after = nsmodel.check(make(), **given)
    assert after[FURTHER.id].verdict == UNKNOWN
    assert said(after) == before
