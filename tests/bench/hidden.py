"""Scenes that hide motion by nsmodel, SciPy's solve_ivp, CVODE and heyoka: how many runs are wrong without a word.

    python tests/bench/hidden.py [--count N] [--jobs N]

Random scenes of tests/search/hidden.py that every tool can take as they are, x' = f(t, x), and one more kind; two kinds have a
switch, which SciPy, CVODE and heyoka are given as an event that ends a run. Truth is a closed form or a quadrature. A run is
*silently wrong* if its last state errs by more than 10 rtol of the largest value and nothing was said: no failure, no exception,
no number that is not finite, no warning, no line on stdout or stderr. At a pole there is no solution to be right about: a run
that goes beyond it without a word is wrong, one that stops is right.

All tools have the same rtol, and their own defaults but for these: atol is 1e-3 rtol times the size of the answer (heyoka has one
tolerance), and f may be asked for 100 000 times (heyoka: so many steps), else the run is "too long"; nsmodel has a minute.
Tools that are not installed (scikit-sundae for CVODE, heyoka) are skipped. Runs go to results/hidden_peers.json.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from nsmodel import simulate  # noqa: E402
from nsmodel.proof.expression_graph import fold_graph  # noqa: E402
from nsmodel.simulation.event_driven import event_driven_problem  # noqa: E402
from tests.search.hidden import KINDS, MOST_SECONDS, RIGHT, SAID, WRONG, Scene, X, first_order, pulse, t  # noqa: E402

SHORT = bool(os.environ.get("NSMODEL_SHORT"))
COUNT = 1 if SHORT else 25  # Scenes of a kind.
TOLERANCES = (1e-3,) if SHORT else (1e-3, 1e-6, 1e-9)
LONG = "too long"
MOST = 100_000  # Evaluations of f; steps of heyoka.
STEPS = 1000  # At least so many, where max_step is set by hand: the step of the models is t_end/1000.
PARTS = (WRONG, RIGHT, SAID, LONG)


class Stopped(Exception):
    """The tool says that it failed, and why."""


class TooLong(Exception):
    """f was asked for too often."""


class Task(NamedTuple):
    """x' = rate, h a condition whose sign is that of -l where there is one."""

    scene: Scene
    t: ca.SX
    x: ca.SX
    l: ca.SX
    rate: ca.SX
    h: ca.SX
    x0: list[float]
    t_end: float
    rtol: float

    @property
    def atol(self) -> float:
        """Of SciPy and CVODE."""
        return 1e-3 * self.rtol * abs(self.scene.size)

    @property
    def first(self) -> float:
        """l at the start."""
        return -math.copysign(1, float(ca.Function("h", [self.t, self.x], [self.h])(0, self.x0))) if self.h.numel() else 0.0


def of_a_bump(r: random.Random) -> Scene:
    """s' = v, x' = a pulse at the place s: nothing depends on t."""
    t_end, v, a = r.uniform(1, 20), 10 ** r.uniform(-1, 1), 10 ** r.uniform(-2, 2)
    p = pulse(r, v * t_end)
    exact = a * p.integral(0, v * t_end) / v
    return Scene(first_order([v, a * ca.substitute(p.of, t, X[0])], [0, 0], t_end, X), exact, exact)


SCENES: dict[str, Callable[[random.Random], Scene]] = {
    "pulse": KINDS["pulse"], "bump": of_a_bump, "decay": KINDS["decay"], "power": KINDS["power"], "pole": KINDS["pole"],
    "flat condition": KINDS["flat condition"], "pulse in a condition": KINDS["pulse in a condition"],
}  # fmt: skip


def task(kind: str, seed: int, rtol: float) -> Task:
    """The scene of a seed."""
    scene = SCENES[kind](random.Random(seed))
    p = event_driven_problem(scene.model)
    t_end = float(scene.model.t_end)
    return Task(scene, p.t, p.x, p.l, ca.densify(p.rate), ca.densify(p.h), ca.DM(p.x0).full().ravel().tolist(), t_end, rtol)


# -- tools: the last state of the last component -----------------------------------------------------------------------


def by_nsmodel(task: Task) -> float:
    """Event-driven, by its defaults."""
    return float(simulate(task.scene.model, rtol=task.rtol, method="event-driven").x[-1, -1])


class Rate:
    """rate and h as functions of t and x, the first of which counts how often it is asked."""

    def __init__(self, task: Task) -> None:
        inputs, self.asked, self.l = [task.t, task.x, task.l], 0, task.first
        buffers: list[Any] = [ca.Function("of", inputs, [expr]).buffer() for expr in (task.rate, task.h)]
        self._rate, self._h = buffers
        self._place = np.empty(1), np.empty(len(task.x0)), np.full(task.l.numel(), self.l)
        self._out = np.empty(len(task.x0)), np.empty(task.h.numel())
        for (buffer, _), out in zip((self._rate, self._h), self._out, strict=True):
            for i, place in enumerate(self._place):
                buffer.set_arg(i, place.data)
            buffer.set_res(0, out.data)

    def flip(self) -> None:
        """The other end of l."""
        self.l = -self.l
        self._place[2][:] = self.l

    def rate(self, t: float, x: np.ndarray) -> np.ndarray:
        """x'."""
        self.asked += 1
        if self.asked > MOST:
            raise TooLong
        self._place[0][0], self._place[1][:] = t, x
        self._rate[1]()
        return self._out[0].copy()

    def h(self, t: float, x: np.ndarray) -> float:
        """The condition; it comes to 0 from the side that ``direction`` tells."""
        self._place[0][0], self._place[1][:] = t, x
        self._h[1]()
        return float(self._out[1][0])


def by_scipy(method: str, task: Task, steps: int = 0) -> float:
    """solve_ivp; a run that its event ends goes on with the other l."""
    of, begin, x = Rate(task), 0.0, np.array(task.x0)
    more: dict[str, Any] = {"max_step": task.t_end / steps} if steps else {}

    def event(t: float, x: np.ndarray) -> float:
        return of.h(t, x)

    event.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    while begin < task.t_end:
        event.direction = of.l  # pyright: ignore[reportFunctionMemberAccess]
        more["events"] = event if task.h.numel() else None
        found = solve_ivp(of.rate, (begin, task.t_end), x, method, rtol=task.rtol, atol=task.atol, **more)
        if not found.success:
            raise Stopped(found.message)
        begin, x = float(found.t[-1]), found.y[:, -1]
        of.flip()
    return float(x[-1])


def by_cvode(method: str, task: Task) -> float:
    """scikit-sundae's CVODE; so are its roots."""
    from sksundae.cvode import CVODE  # pyright: ignore[reportMissingImports]

    of, begin, x = Rate(task), 0.0, np.array(task.x0)

    def rate(t: float, x: np.ndarray, out: np.ndarray) -> None:
        out[:] = of.rate(t, x)

    def event(t: float, x: np.ndarray, out: np.ndarray) -> None:
        out[0] = of.h(t, x)

    event.terminal = [True]  # pyright: ignore[reportFunctionMemberAccess]
    while begin < task.t_end:
        event.direction = [int(of.l)]  # pyright: ignore[reportFunctionMemberAccess]
        more: dict[str, Any] = {"eventsfn": event, "num_events": 1} if task.h.numel() else {}
        found = CVODE(rate, method=method, rtol=task.rtol, atol=task.atol, **more).solve([begin, task.t_end], x)
        if not found.success:
            raise Stopped(found.message)
        begin, x = float(found.t[-1]), np.array(found.y[-1])
        of.flip()
    return float(x[-1])


def by_heyoka(task: Task) -> float:
    """heyoka's Taylor series; events are terminal ones of its own, found on the series."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    states = hy.make_vars(*(f"x{i}" for i in range(len(task.x0))))
    states = states if isinstance(states, list) else [states]
    where = {task.t.element_hash(): hy.time, **{x.element_hash(): s for x, s in zip(ca.vertsplit(task.x), states, strict=True)}}
    where |= {l.element_hash(): hy.par[0] for l in ca.vertsplit(task.l)}
    algebra: dict[int, Callable[..., Any]] = {
        ca.OP_ASSIGN: lambda a: a, ca.OP_ADD: lambda a, b: a + b, ca.OP_SUB: lambda a, b: a - b, ca.OP_MUL: lambda a, b: a * b,
        ca.OP_DIV: lambda a, b: a / b, ca.OP_NEG: lambda a: -a, ca.OP_INV: lambda a: 1.0 / a, ca.OP_SQ: lambda a: a * a,
        ca.OP_TWICE: lambda a: 2.0 * a, ca.OP_EXP: hy.exp, ca.OP_TANH: hy.tanh, ca.OP_TAN: hy.tan, ca.OP_LT: hy.lt,
        ca.OP_IF_ELSE_ZERO: lambda a, b: hy.select(a, b, hy.expression(0.0)),
    }  # fmt: skip

    def translated(expr: ca.SX) -> list[Any]:
        return fold_graph(expr, lambda s: where[s.element_hash()], hy.expression, lambda op, args: algebra[op](*args))

    events = [hy.t_event(h) for h in translated(task.h)]
    system = list(zip(states, translated(task.rate), strict=True))
    run = hy.taylor_adaptive(system, task.x0, tol=task.rtol, pars=[task.first] * len(events), t_events=events)
    while True:
        outcome = run.propagate_until(task.t_end, max_steps=MOST)[0]
        if outcome == hy.taylor_outcome.time_limit:
            return float(run.state[-1])
        if outcome == hy.taylor_outcome.step_limit:
            raise TooLong
        if int(outcome) != -1:
            raise Stopped(str(outcome))
        run.pars[0] = -run.pars[0]


def tools() -> dict[str, Callable[[Task], float]]:
    """Those that are here."""
    scipy: dict[str, Callable[[Task], float]] = {
        f"solve_ivp, {name}": partial(by_scipy, name) for name in ("RK45", "DOP853", "LSODA")
    }
    by_hand = {f"solve_ivp, DOP853, max_step = t_end/{STEPS}": partial(by_scipy, "DOP853", steps=STEPS)}
    cvode = {f"CVODE, {name}": partial(by_cvode, name) for name in ("Adams", "BDF")} if find_spec("sksundae") else {}
    heyoka = {"heyoka": by_heyoka} if find_spec("heyoka") else {}
    return {"nsmodel": by_nsmodel} | scipy | by_hand | cvode | heyoka


def missing() -> list[str]:
    """The names of those that are not."""
    return [name for name, module in (("scikit-sundae", "sksundae"), ("heyoka", "heyoka")) if find_spec(module) is None]


# -- verdicts ----------------------------------------------------------------------------------------------------------


@contextmanager
def heard() -> Iterator[Callable[[], str]]:
    """What is written to stdout and stderr meanwhile, by C too."""
    sys.stdout.flush()
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        kept = {number: os.dup(number) for number in (1, 2)}
        for number in kept:
            os.dup2(file.fileno(), number)

        def words() -> str:
            file.seek(0)
            return file.read().decode(errors="replace")

        try:
            yield words
        finally:
            for number, copy in kept.items():
                os.dup2(copy, number)
                os.close(copy)


def judged(tool: str, kind: str, seed: int, rtol: float) -> dict[str, Any]:
    """One run: its verdict, its error in units of what it may err by, and what was said."""
    about: dict[str, Any] = {"tool": tool, "kind": kind, "seed": seed, "rtol": rtol}
    this = task(kind, seed, rtol)
    exact, start = this.scene.exact, time.monotonic()
    with warnings.catch_warnings(record=True) as told, heard() as words:
        warnings.simplefilter("always")
        try:
            found = tools()[tool](this)
        except TooLong:
            return about | {"verdict": LONG}
        except Exception as error:
            return about | {"verdict": RIGHT if exact is None else SAID, "words": f"{type(error).__name__}: {error}"}
        said = "\n".join([*(str(one.message) for one in told), words()]).strip()
    about |= {"found": found} | ({"words": said} if said else {})
    if exact is None:
        return about | {"verdict": RIGHT if said or not math.isfinite(found) else WRONG}
    if not math.isfinite(found):
        return about | {"verdict": SAID}
    about["error"] = abs(found - exact) / (rtol * abs(this.scene.size) * this.scene.condition)
    if about["error"] > 10:
        return about | {"verdict": SAID if said else WRONG}
    return about | {"verdict": LONG if tool == "nsmodel" and time.monotonic() - start > MOST_SECONDS else RIGHT}


def of_scene(scene: tuple[str, int]) -> list[dict[str, Any]]:
    """All tools on a scene, at all tolerances."""
    return [judged(tool, *scene, rtol) for tool in tools() for rtol in TOLERANCES]


def measured(count: int = COUNT, jobs: int = 1) -> list[dict[str, Any]]:
    """All runs; they are written to results/ too."""
    scenes = [(kind, seed) for kind in SCENES for seed in range(count)]
    with ProcessPoolExecutor(jobs) as pool:
        found = [one for some in pool.map(of_scene, scenes) for one in some]
    (ROOT / "results").mkdir(exist_ok=True)
    (ROOT / "results" / "hidden_peers.json").write_text(json.dumps(found, indent=1))
    return found


def shares(runs: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Of each tool the per cent of its runs with each verdict."""
    names = dict.fromkeys(one["tool"] for one in runs)
    counted = {tool: Counter(one["verdict"] for one in runs if one["tool"] == tool) for tool in names}
    return {tool: {part: 100 * count[part] / count.total() for part in PARTS} for tool, count in counted.items()}


def table(runs: list[dict[str, Any]]) -> str:
    """Markdown: of each tool the shares, and those of wrong runs by rtol."""
    tolerances = sorted({one["rtol"] for one in runs}, reverse=True)
    by_rtol = [shares([one for one in runs if one["rtol"] == rtol]) for rtol in tolerances]
    at = [f"at rtol {rtol:.0e}".replace("e-0", "e-") for rtol in tolerances]
    heads = ["silently wrong", *at, "right", "said", "too long", "runs"]
    lines = [f"| tool | {' | '.join(heads)} |", "| --- |" + " ---: |" * len(heads)]
    for tool, share in shares(runs).items():
        cells = [share[WRONG], *(one[tool][WRONG] for one in by_rtol), share[RIGHT], share[SAID], share[LONG]]
        count = sum(one["tool"] == tool for one in runs)
        lines.append(f"| {tool} | {' | '.join(f'{cell:.1f} %' for cell in cells)} | {count} |")
    return "\n".join(lines)


def main() -> None:
    """Run all, print the table, and each run of nsmodel that is not right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=COUNT, help="scenes of a kind")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    if missing():
        print(f"{' and '.join(missing())}: not installed, skipped")
    runs = measured(given.count, given.jobs)
    print(f"Scenes that hide motion\n\n{table(runs)}\n")
    for one in runs:
        if one["tool"] == "nsmodel" and one["verdict"] != RIGHT:
            print(json.dumps(one))


if __name__ == "__main__":
    main()
