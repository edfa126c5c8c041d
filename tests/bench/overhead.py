"""What an event-driven run costs from Python, beside heyoka where it is installed, and beside the C that it is made of.

    overhead.py             all scenes
    overhead.py NAME...     cases of nsmodel besides, by name: without heyoka

A run is asked for again and again, set up once: `nsmodel.prepare(...).run()`, and heyoka's `propagate_until` of one integrator,
its switches terminal events whose callback changes a parameter. Each at its cheapest tolerance whose last state errs by no more
than the target; microseconds of wall time, the least of many. *read*: with the arrays of the run, which heyoka does not make.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import nsmodel  # noqa: E402
from nsmodel import FirstOrderSystem, LureSystem, prepare, relay, simulate  # noqa: E402
from nsmodel.codegen.event_driven_runs import CompiledPieceIntegrator  # noqa: E402

TARGETS = (1e-4, 1e-8, 1e-12)
TOLERANCES = tuple(10.0**-k for k in range(3, 15))
SECONDS = 0.3  # That a setting is repeated for.


class Scene(NamedTuple):
    """x'' = -k(sign x), from (1, 0): ``rates`` (k, a): x'' = -k x - a where x > 0, and where x < 0; the state at the end."""

    name: str
    model: Any
    rates: tuple[tuple[float, float], tuple[float, float]]
    end: np.ndarray


def sign_oscillator(switches: int) -> Scene:
    """x'' = -sgn x: parabolas of quarter period sqrt 2."""
    t_end = math.sqrt(2) * 2 * switches
    law = {"law": relay(1), "A": [[0, 1], [0, 0]], "B": [0, 1], "C": [1, 0]}
    model = LureSystem(x0=[1, 0], t_end=t_end, step=0.01, title="x'' = -sgn x", **law)
    return Scene(f"x'' = -sgn x, {switches} switches", model, ((0.0, 1.0), (0.0, -1.0)), np.array([(-1.0) ** switches, 0.0]))


def bilinear_oscillator(switches: int) -> Scene:
    """x'' = -x where x > 0, -4 x where x < 0: half periods pi and pi/2."""
    x = ca.SX.sym("x", 2)
    odd = switches % 2
    t_end = switches // 2 * 1.5 * math.pi + odd * 0.75 * math.pi  # In the middle of a half period.
    f = [x[1], -ca.if_else(x[0] > 0, 1, 4) * x[0]]
    model = FirstOrderSystem(x=x, f=f, x0=[1, 0], t_end=t_end, step=0.01, title="bilinear oscillator")
    return Scene(
        f"bilinear oscillator, {switches} switches", model, ((1.0, 0.0), (4.0, 0.0)), np.array([-0.5 if odd else 1.0, 0.0])
    )


def least(run: Callable[[], Any]) -> float:
    """Microseconds of the quickest of many."""
    best, began = math.inf, time.perf_counter()
    while time.perf_counter() - began < SECONDS:
        start = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - start)
    return 1e6 * best


def cheapest(settings: dict[float, tuple[Callable[[], Any], float]], target: float) -> tuple[float, float]:
    """(microseconds, tolerance) of those that err by the target at most."""
    found = [(least(run), tolerance) for tolerance, (run, error) in settings.items() if error <= target]
    return min(found[:]) if found else (math.nan, math.nan)


def by_heyoka(scene: Scene) -> dict[float, tuple[Callable[[], Any], float]]:
    """Its integrators, by tolerance."""
    import heyoka as hy

    x, v = hy.make_vars("x", "v")
    (k, a), (other_k, other_a) = scene.rates
    found = {}
    for tolerance in TOLERANCES:

        def flip(run: Any, sign: int) -> bool:
            del sign
            run.pars[0], run.pars[1] = k + other_k - run.pars[0], a + other_a - run.pars[1]
            return True

        system = [(x, v), (v, -hy.par[0] * x - hy.par[1])]
        run = hy.taylor_adaptive(system, [1.0, 0.0], tol=tolerance, pars=[k, a], t_events=[hy.t_event(x, callback=flip)])

        def go(run: Any = run) -> np.ndarray:
            run.time, run.state[:], run.pars[:] = 0.0, (1.0, 0.0), (k, a)
            run.reset_cooldowns()
            run.propagate_until(scene.model.t_end)
            return run.state

        found[tolerance] = go, float(np.abs(go() - scene.end).max())
    return found


def by_nsmodel(scene: Scene) -> dict[float, tuple[Callable[[], Any], float]]:
    """Its prepared runs, by tolerance."""
    found = {}
    for tolerance in TOLERANCES:
        ready = prepare(scene.model, rtol=tolerance, method="event-driven", compiled=True)
        found[tolerance] = ready.run, float(np.abs(ready.run().x[-1] - scene.end).max())
    return found


def c_share(run: Callable[[], Any]) -> float:
    """Microseconds of a run that C takes, the least of many."""
    spent, own = [0.0], {name: getattr(CompiledPieceIntegrator, name) for name in ("begin", "advance")}

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any, **more: Any) -> Any:
            start = time.perf_counter()
            try:
                return function(*given, **more)
            finally:
                spent[0] += time.perf_counter() - start

        return call

    for name, function in own.items():
        setattr(CompiledPieceIntegrator, name, timed(function))
    best, began = math.inf, time.perf_counter()
    while time.perf_counter() - began < SECONDS:
        spent[0] = 0.0
        run()
        best = min(best, spent[0])
    for name, function in own.items():
        setattr(CompiledPieceIntegrator, name, function)
    return 1e6 * best


def main(names: list[str]) -> None:
    """Print both tables."""
    print(f"{'':42} {'target':>7} {'run':>9} {'of it C':>9} {'read':>9} {'heyoka':>9} {'heyoka/run':>11}")
    for scene in (sign_oscillator(3), sign_oscillator(177), bilinear_oscillator(3), bilinear_oscillator(199)):
        ours, theirs = by_nsmodel(scene), by_heyoka(scene) if find_spec("heyoka") else {}
        for target in TARGETS:
            run, tolerance = cheapest(ours, target)
            if math.isnan(run):
                errors = (min(error for _, error in of.values()) if of else math.nan for of in (ours, theirs))
                print(f"{scene.name:42} {target:7.0e}   not reached: {next(errors):.1e}, by heyoka {next(errors):.1e}")
                continue
            go = ours[tolerance][0]
            other = cheapest(theirs, target)[0]
            read = least(lambda go=go: go().arrays)
            print(f"{scene.name:42} {target:7.0e} {run:9.0f} {c_share(go):9.0f} {read:9.0f} {other:9.0f} {other / run:11.2f}")
    if names:
        print(f"\n{'rtol 1e-8':42} {'run':>9} {'of it C':>9} {'simulate':>9} {'of it C':>9}")
    for name in names:
        model, how = nsmodel.load(name), {"rtol": 1e-8, "method": "event-driven", "compiled": True}
        go, whole = prepare(model, **how).run, lambda model=model, how=how: simulate(model, **how)
        print(f"{name:42} {least(go):9.0f} {c_share(go):9.0f} {least(whole):9.0f} {c_share(whole):9.0f}")


if __name__ == "__main__":
    main(sys.argv[1:])
