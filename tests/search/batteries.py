"""Short runs that reach the code of a package: what `constants` runs beside one another, all of them interpreted."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import casadi as ca
import numpy as np

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    Sensitivity,
    Trajectory,
    complementarity,
)
from tests import ball_models, derivative_models, event_models, event_scenes, event_ties, stiff_scenes

from .hidden import KINDS
from .models import case

Run = Callable[[], Trajectory | Sensitivity]
Scene = tuple[str, float, Run]  # Its name; what it is asked for, relative.

CASES = {  # By the part of their time that is run.
    "buck_light_load": 0.5, "boost": 0.2, "diode_bridge": 0.3, "elastoplastic": 0.5, "friction_chain": 0.02, "obstacle": 0.03,
    "friction_oscillator": 1, "inclusion_8_2": 1, "integrate_and_fire": 0.5, "observer": 0.5, "sampled_pi": 0.5,
    "schmitt_trigger": 1, "sliding_mode": 0.5, "three_pulse_rectifier": 0.2, "thyristor": 1, "total_variation": 0.03,
    "two_discs": 1, "two_surfaces": 1, "woodpecker": 0.1, "rocking_block": 0.5, "hook_ball": 0.3, "ball_on_ramp": 1,
    "evacuation": 0.01, "arch": 0.01,
}  # fmt: skip
CONTROLLED = ("buck_light_load", "friction_oscillator", "diode_bridge", "two_discs", "sampled_pi", "twisting")
MECHANICAL = ("woodpecker", "rocking_block", "hook_ball", "ball_on_ramp", "evacuation", "arch")


def fallen() -> LureSystem:
    """A mass falls onto a floor, and is lifted from t = 3 on: pieces, a stretch of steps, pieces."""
    t = ca.SX.sym("t")
    return LureSystem(
        t=t, A=[[0, 1], [0, 0]], B=[0, 1], C=[[1, 0]], f=[0, -1 + 2 * ca.if_else(t > 3, 1, 0)], law=complementarity(1), x0=[1, 0],
        t_end=5, switch_times=[3],
    )  # fmt: skip


def walled() -> FrictionOscillator:
    """An oscillator with dry friction that hits a wall."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    wall = {"floor": x + 0.5}
    return FrictionOscillator(x=x, potential=x**2 / 2, friction=0.15 * s, s=s, constraints=wall, x0=2, v0=0, t_end=10)


def string(n: int) -> FirstOrderSystem:
    """A string that falls onto an obstacle of two humps: a large sparse step."""
    i, x, l = np.arange(1, n + 1) / (n + 1), ca.SX.sym("x", n), ca.SX.sym("l", n)
    stiffness = 1e3 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
    obstacle = 0.3 * np.sin(2 * np.pi * i) ** 2 - 0.4
    f = -ca.sparsify(ca.DM(stiffness)) @ x - 40
    return FirstOrderSystem(x=x, lam=l, f=f, h=x - obstacle, g=l, law=complementarity(n), x0=np.zeros(n), t_end=0.1, step=0.01)


def rounded() -> MonotoneInclusion:
    """A rotation in a disc, on which points are projected but approximately."""
    x = ca.SX.sym("x", 2)
    field = ca.vertcat(x[1] + 0.5, -x[0])
    return MonotoneInclusion(
        x=x, field=field, constraints={"disc": 1 - ca.sumsqr(x)}, x0=[0.9, 0], tolerances=1e-5, t_end=2, step=0.1
    )


SCENES: dict[str, tuple[Callable[[], Any], float]] = {
    "release": (lambda: event_scenes.release(1.0)[0], 2), "play": (lambda: event_scenes.play()[0], 6),
    "mains": (event_scenes.mains_bridge, 0.01), "pendulums": (event_scenes.pendulums, 1),
    "stiff relay": (lambda: event_scenes.stiff_relay(1e4), 2), "twisting": (event_scenes.twisting, 10),
    "grazing": (lambda: event_scenes.grazing(1e-6), 6), "brief": (lambda: event_scenes.brief_contact(7, [0, 1, 0.3, 0, 1.2]), 5),
    "filter": (event_scenes.capacitor_filter, 1e-3), "van der pol": (stiff_scenes.van_der_pol, 300),
    "kinetics": (stiff_scenes.kinetics, 40), "damped chain": (lambda: stiff_scenes.damped_chain(1e6)[0], 0.5),
}  # fmt: skip
HARD = (  # Random models in which steps were refused once, or wrong.
    "oscillator:34", "first:1000", "lure:5", "lure:6", "lure:422", "lure:910", "first:645", "first:832", "sweeping:4",
    "sweeping:80", "sweeping:268", "sweeping:260", "sweeping:615", "sweeping:370", "sweeping:457", "inclusion:1", "inclusion:3",
    "oscillator:7", "lure:0", "first:3",
)  # fmt: skip


def scene(name: str, model: Any, t_end: float, rtol: float, **options: Any) -> Scene:
    """A run that is event-driven, as far as its method lets it be."""
    return name, rtol, lambda: nsmodel.simulate(model, t_end=t_end, rtol=rtol, compiled=False, **options)


def event_driven() -> Iterator[Scene]:
    """Linear and nonlinear, dry friction, balls, stiff, sliding, infinitely many events, circuits, blocks, ties, what hides."""
    for name, (make, t_end) in SCENES.items():
        yield scene(name, make(), t_end, 1e-6, method="event-driven")
    for name, part in CASES.items():
        if name not in MECHANICAL:
            model = nsmodel.load(name)
            yield scene(name, model, part * float(model.t_end), 1e-8)
    for seed in (0, 2):
        yield scene(f"balls {seed}", ball_models.random_model(seed)[1], 1.0, 1e-6)
    for kind, seed in (("loops", 0), ("corners", 1), ("masses", 0), ("cascades", 0)):
        yield scene(f"{kind} {seed}", event_ties.CLASSES[kind](seed).model, 2.0, 1e-8)
    for kind, seed in (("sweeping", 1), ("lure", 0), ("inclusion", 1)):
        yield scene(f"{kind} {seed}", event_models.CLASSES[kind](seed).model, 0.5, 1e-10)
    for kind in sorted(KINDS.keys() - {"potential", "input"}):  # These take half a second.
        hidden = KINDS[kind](random.Random(f"{kind} {5 if kind == 'pole' else 3}"))
        yield scene(f"hidden: {kind}", hidden.model, float(hidden.model.t_end), 1e-3, method=hidden.method)
    yield scene("fallen", fallen(), 2.0, 1e-2)
    yield scene("walled", walled(), 6.0, 1e-2)
    yield from proved()


def proved() -> Iterator[Scene]:
    """Pieces whose bounds and signs are proved."""
    for name in ("release", "grazing"):
        make, t_end = SCENES[name]
        yield scene(f"{name}, proved", make(), t_end, 1e-8, certify="interval")


BY_LEMKE = (
    "lure:6", "lure:422", "lure:910", "sweeping:80", "sweeping:268", "sweeping:260", "sweeping:457", "oscillator:34", "first:3",
)  # fmt: skip


def constant_steps() -> Iterator[Scene]:
    """Four steps of models that are hard, some by solvers that come late, some of cases; large and approximate ones."""
    for name in (*BY_LEMKE, "sweeping:4", "lure:0"):
        kind, seed = name.split(":")
        model, solver = case(kind, int(seed)).model(), "lemke" if name in BY_LEMKE else "ipopt"
        yield (
            f"{name} by {solver}",
            1e-9,
            lambda model=model, solver=solver: nsmodel.simulate(
                model, compiled=False, solver=solver, t_end=4 * float(model.step)
            ),
        )
    yield "string by bands", 1e-9, lambda: nsmodel.simulate(string(70), compiled=False)
    yield "disc by cuts", 1e-9, lambda: nsmodel.simulate(rounded(), compiled=False)
    for name in HARD:
        kind, seed = name.split(":")
        model = case(kind, int(seed)).model()
        yield name, 1e-9, lambda model=model: nsmodel.simulate(model, compiled=False, t_end=4 * float(model.step))
    for name, part in CASES.items():
        model = nsmodel.load(name)
        t_end = max(0.1 * part * float(model.t_end), 6 * float(model.step or 0))
        yield name, 1e-9, lambda model=model, t_end=t_end: nsmodel.simulate(model, compiled=False, t_end=t_end)


def controlled_steps() -> Iterator[Scene]:
    """Steps chosen by their error, and pieces that are proved."""
    for name in CONTROLLED:
        model = nsmodel.load(name)
        yield (
            f"{name}, controlled",
            1e-3,
            lambda model=model: nsmodel.simulate(
                model, compiled=False, rtol=1e-3, method="time-stepping", t_end=0.3 * float(model.t_end)
            ),
        )


def derivatives() -> Iterator[Scene]:
    """Of random models by parameters and starts."""
    for kind in derivative_models.KINDS:
        for seed in (0, 1, 2):
            model, by = derivative_models.made(kind, seed)
            yield f"{kind} {seed}", 1e-8, lambda model=model, by=by: nsmodel.sensitivity(model, by=by, compiled=False, t_end=3.0)


BATTERIES = {
    "event_driven": (event_driven,), "solvers": (constant_steps,), "simulation": (controlled_steps, proved),
    "derivatives": (derivatives,),
}  # fmt: skip


def runs(package: str) -> Iterator[Scene]:
    """Those of a package; of one that has none all."""
    for battery in BATTERIES.get(package, sum(BATTERIES.values(), ())):
        yield from battery()


def values(result: Trajectory | Sensitivity) -> tuple[np.ndarray, list[np.ndarray]]:
    """(rows, columns) of what is compared, derivatives or states at times between the rows; and what has all the bits."""
    if isinstance(result, Sensitivity):
        jacobian = np.asarray(result.jacobian)
        return jacobian.reshape(-1, jacobian.shape[-1]), [jacobian]
    found = result.at(float(result.t[-1]) * (np.arange(64) + 1 / np.pi) / 64)
    own = [np.asarray(result.arrays[name]) for name in ("t", "x", "v", "multipliers") if name in result.arrays]
    own.append(np.frombuffer(repr(result.metadata.get("certificate")).encode(), np.uint8))
    return found.x.reshape(64, -1), own
