"""The methods that apply to a model: its schemes, interpreted and compiled, each further solver, variable steps; and timing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import casadi as ca

from nsmodel.errors import UsageError
from nsmodel.modeling.base import Model
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.simulation.trajectory import Trajectory
from nsmodel.solvers.mlcp import QP_SOLVERS as QP_SOLVERS
from nsmodel.solvers.plan import STEP_SOLVERS
from nsmodel.study.lines import SCHEME_LINE, SOLVER_LINE

# Values of theta and gamma whose schemes are compared: implicit Euler, then weights of order two for f alone, and for both.
THETA_GAMMA_WEIGHTS = ((1.0, 1.0), (0.5, 1.0), (0.5, 0.5))
# Of runs with steps under error control: from a rough one to one that takes some 300 times the steps at order two.
STUDY_RTOLS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
FINE_RTOLS = (1e-9, 1e-11)  # And of event-driven runs, which reach these too.
MAX_REPEATS = 5  # Timed runs of a point at most, after the warm-up; the least counts, as others disturb single ones;
ENOUGH_SECONDS = 0.25  # none is added once they have taken so many seconds together.
# A run that takes so many seconds is made once: what disturbs it is small beside it, and it needs no warm-up.
LONG_RUN_SECONDS = 1.0


@dataclass(frozen=True)
class Method:
    """A way to run a model: the model with its weights, the options of the run, the scheme's order where all is smooth."""

    name: str
    model: Model
    options: Mapping[str, Any] = field(default_factory=dict)
    order: int = 1
    kind: str = SCHEME_LINE

    def with_options(self, label: str, **options: Any) -> Method:
        """Return the method with further options, and words in its name that say so."""
        return replace(self, name=f"{self.name}, {label}" if self.name else label, options={**self.options, **options})


class TimedRun(NamedTuple):
    """A run, its least CPU seconds, the least wall seconds of its preparation; wall seconds of all preparations, of all runs."""

    run: Trajectory
    seconds: float
    setup: float
    preparing: float
    running: float


def scheme_methods(model: Model) -> list[Method]:
    """Return the model's own scheme, then those with other weights theta and gamma where its class has them."""
    if model.weights is None:
        return [Method("", model)]
    theta, gamma = map(float, model.weights)
    return [_method_with_weights(model, *weights) for weights in dict.fromkeys([(theta, gamma), *THETA_GAMMA_WEIGHTS])]


def _method_with_weights(model: Any, theta: float, gamma: float) -> Method:
    other = copy(model)
    other._set(theta=theta, gamma=gamma)
    second = theta == 0.5 and (gamma == 0.5 or not model.multiplier_names)
    return Method(f"theta = {_weight_text(theta)}, gamma = {_weight_text(gamma)}", other, order=2 if second else 1)


def _weight_text(weight: float) -> str:
    return "1/2" if weight == 0.5 else f"{weight:g}"


def backend_methods(scheme: Method) -> list[Method]:
    """Return the scheme interpreted and compiled, with the default chain of solvers."""
    return [scheme.with_options("interpreted", compiled=False), scheme.with_options("compiled", compiled=True)]


def single_solver_methods(scheme: Method, names: Sequence[str] | None) -> list[Method]:
    """Return the scheme, interpreted, with each solver alone; ``names`` None: all that are installed.

    Raises:
        UsageError: a name that is no solver.
    """
    for name in names or ():
        if name not in STEP_SOLVERS:
            raise UsageError(f"solver '{name}' is unknown; choose one of {', '.join(STEP_SOLVERS)}")
    chosen = STEP_SOLVERS[1:] if names is None else [name for name in names if name != "auto"]
    return [
        replace(scheme.with_options(name, compiled=False, solver=name), name=name, kind=SOLVER_LINE)
        for name in chosen
        if names is not None or name not in QP_SOLVERS or ca.has_conic(name)
    ]


def not_compiled_reason(warnings: Sequence[str]) -> str:
    """Say, from a run's warnings, why it was not compiled as it was to be; empty where it was."""
    return next((text.partition(": ")[2] for text in warnings if text.startswith("not compiled")), "")


def time_runs(model: Model, options: Mapping[str, Any]) -> TimedRun:
    """Run, forget the first run where it is short, and time further ones: the steps in CPU time, the preparation apart.

    Raises:
        NsmodelError: what preparing and running raise.
    """
    setup, wall, seconds = [], [], []
    while True:
        start = time.perf_counter()
        prepared = prepared_loop(model, **options)
        setup.append(time.perf_counter() - start)
        start = time.perf_counter()
        run = prepared.go()
        seconds.append(prepared.cpu_seconds)
        wall.append(time.perf_counter() - start)
        once = wall[0] > LONG_RUN_SECONDS
        if once or len(seconds) == 1 + MAX_REPEATS or (len(seconds) > 1 and sum(wall) + sum(setup[1:]) > ENOUGH_SECONDS):
            return TimedRun(run, min(seconds[1:] or seconds), min(setup), sum(setup), sum(wall))
