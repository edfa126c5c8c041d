"""The methods that apply to a model: its schemes, interpreted and compiled, each further solver, variable steps; and timing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import casadi as ca

from nsmodel.errors import UsageError
from nsmodel.model.base import Model
from nsmodel.simulate import prepare
from nsmodel.solve.choose import SOLVERS
from nsmodel.solve.qp import SOLVERS as QP_SOLVERS
from nsmodel.study.lines import SCHEME, SOLVER
from nsmodel.trajectory import Trajectory

WEIGHTS = ((1.0, 1.0), (0.5, 1.0), (0.5, 0.5))  # theta, gamma
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
FINE = (1e-9, 1e-11)  # Those that steps do not reach.
REPEATS = 5  # Timed runs of a point at most, after the warm-up;
ENOUGH = 0.25  # none is added once they have taken so many seconds together.
LONG = 1.0  # A run that takes so many seconds is made once.


@dataclass(frozen=True)
class Method:
    """A way to run a model: the model with its weights, the options of the run, the scheme's order where all is smooth."""

    name: str
    model: Model
    options: Mapping[str, Any] = field(default_factory=dict)
    order: int = 1
    kind: str = SCHEME

    def but(self, words: str, **options: Any) -> Method:
        """Return the method with further options, and words in its name that say so."""
        return replace(self, name=f"{self.name}, {words}" if self.name else words, options={**self.options, **options})


class Measured(NamedTuple):
    """A run, its least CPU seconds, the least wall seconds of its preparation; wall seconds of all preparations, of all runs."""

    run: Trajectory
    seconds: float
    setup: float
    preparing: float
    running: float


def schemes(model: Model) -> list[Method]:
    """Return the model's own scheme, then those with other weights theta and gamma where its class has them."""
    if model.weights is None:
        return [Method("", model)]
    theta, gamma = map(float, model.weights)
    return [_weighted(model, *weights) for weights in dict.fromkeys([(theta, gamma), *WEIGHTS])]


def _weighted(model: Any, theta: float, gamma: float) -> Method:
    other = copy(model)
    other._set(theta=theta, gamma=gamma)
    second = theta == 0.5 and (gamma == 0.5 or not model.multiplier_names)
    return Method(f"theta = {_fraction(theta)}, gamma = {_fraction(gamma)}", other, order=2 if second else 1)


def _fraction(weight: float) -> str:
    return "1/2" if weight == 0.5 else f"{weight:g}"


def ways(scheme: Method) -> list[Method]:
    """Return the scheme interpreted and compiled, with the default chain of solvers."""
    return [scheme.but("interpreted", compiled=False), scheme.but("compiled", compiled=True)]


def event_driven(model: Model) -> list[Method]:
    """Return one smooth piece after another, whatever the scheme, interpreted and compiled."""
    return ways(Method("event-driven", model, {"method": "event-driven"}))


def with_solvers(scheme: Method, names: Sequence[str] | None) -> list[Method]:
    """Return the scheme, interpreted, with each solver alone; ``names`` None: all that are installed.

    Raises:
        UsageError: a name that is no solver.
    """
    for name in names or ():
        if name not in SOLVERS:
            raise UsageError(f"solver '{name}' is unknown; choose one of {', '.join(SOLVERS)}")
    chosen = SOLVERS[1:] if names is None else [name for name in names if name != "auto"]
    return [
        replace(scheme.but(name, compiled=False, solver=name), name=name, kind=SOLVER)
        for name in chosen
        if names is not None or name not in QP_SOLVERS or ca.has_conic(name)
    ]


def not_compiled(warnings: Sequence[str]) -> str:
    """Say, from a run's warnings, why it was not compiled as it was to be; empty where it was."""
    return next((text.partition(": ")[2] for text in warnings if text.startswith("not compiled")), "")


def timed(model: Model, options: Mapping[str, Any]) -> Measured:
    """Run, forget the first run where it is short, and time further ones: the steps in CPU time, the preparation apart.

    Raises:
        NsmodelError: what preparing and running raise.
    """
    setup, wall, seconds = [], [], []
    while True:
        start = time.perf_counter()
        prepared = prepare(model, **options)
        setup.append(time.perf_counter() - start)
        start = time.perf_counter()
        run = prepared.go()
        seconds.append(prepared.cpu_seconds)
        wall.append(time.perf_counter() - start)
        once = wall[0] > LONG
        if once or len(seconds) == 1 + REPEATS or (len(seconds) > 1 and sum(wall) + sum(setup[1:]) > ENOUGH):
            return Measured(run, min(seconds[1:] or seconds), min(setup), sum(setup), sum(wall))
