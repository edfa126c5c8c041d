"""Make the figures and tables of docs/study.md that show nsmodel beside other programs: error against CPU time.

Run it from anywhere; it writes docs/images/study_*.png. Programs that are not installed are skipped with a line. Siconos is
looked for in the system's Python, CVODE by the compiler, the others in the Python that NSMODEL_PEERS_PYTHON names. Half an hour.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from page import put, save
from scipy.optimize import brentq

import nsmodel
from nsmodel import LureSystem, relay
from nsmodel.plot.style import LINES, blank, dress
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.study import Line, Point

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "bench"))

from events.programs import compiler, with_cvode  # noqa: E402
from peers import programs  # noqa: E402

IMAGES, RESULTS = ROOT / "docs" / "images", ROOT / "results"
TARGETS = (1e-2, 1e-4, 1e-6, 1e-8)
MEASURES = {"end": "relative error at the end", "max": "largest relative error over the run"}
STEPPING, EVENTS = "time-stepping", "event-driven"  # How runs with an rtol go on.
TOLERANCES = {STEPPING: (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7), EVENTS: (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)}
SHORT, LONG = range(6, 14), range(6, 19)  # Powers of 2: numbers of steps of interpreted and of compiled runs.
REPEATS, ENOUGH = 5, 0.4  # Timed runs after the warm-up; none is added once they have taken so many seconds.
COLOURS = (
    *LINES, "#A05A2C", "#8A9A00", "#B22222", "#708090", "#20B2AA", "#4B0082", "#DAA520", "#2E8B57", "#C71585", "#000000"
)  # fmt: skip
MARKERS = "osD^vP*X<>hpd8H1234"
SHADES = 128  # Of a picture.
OWN = 6  # From this colour on they are those of other programs.
TUNED = ("SciPy LSODA", "SciPy Radau")  # Lines of all settings of a smoothed law.
WRONG = 0.1  # A tuned run that is further off takes no part; that it reported success is told.


@dataclass(frozen=True)
class Scene:
    """A case, what is told of it, its closed form, and the methods: (name, model, compiled, powers of 2).

    Instead of powers of 2, the numbers of steps, STEPPING or EVENTS: runs with an rtol.
    """

    case: str
    title: str
    exact: Callable[[np.ndarray], np.ndarray]
    methods: Sequence[tuple[str, Any, bool, Iterable[int] | str]] = field(default_factory=list)

    @property
    def model(self) -> Any:
        """The model of the first method: its states are those compared, its end is the end."""
        return self.methods[0][1]

    def point(self, label: str, t: np.ndarray, x: np.ndarray, seconds: float, step: float | None = None) -> Point:
        """A run with its errors beside the closed form; each state relative to its largest value."""
        right = self.exact(t)
        error = (np.abs(x - right) / np.abs(right).max(axis=0)).max(axis=1)
        return Point(label, seconds, {"max": float(error.max()), "end": float(error[-1])}, step=step, steps=len(t) - 1)


# -- scenes ------------------------------------------------------------------------------------------------------------


def load(case: str, **fields: Any) -> Any:
    """The model of a case with other fields; without its closed form: comparing is not part of what is timed."""
    model = nsmodel.load(case)
    model._set(exact=None, **fields)
    return model


def closed_form(case: str) -> Callable[[np.ndarray], np.ndarray]:
    """The closed form that a case declares."""
    return nsmodel.load(case).exact


def friction_oscillator() -> Scene:
    """The inertial proximal method, and the same physics as a relay: x' = v, v' = -x + l, l in -Sgn(v)."""
    model = load("friction_oscillator")
    lure = {"A": [[0, 1], [-1, 0]], "B": [0, 1], "C": [0, 1], "law": relay(1), "x0": [5.3, 0], "t_end": 12, "step": 1e-3}
    methods = [
        ("nsmodel, inertial proximal", model, False, SHORT),
        ("nsmodel, inertial proximal", model, True, LONG),
        ("nsmodel, inertial proximal, variable steps", model, True, STEPPING),
        ("nsmodel, event-driven", model, False, EVENTS),
        ("nsmodel, event-driven", model, True, EVENTS),
        ("nsmodel, relay, theta = 1/2", LureSystem(**lure, theta=0.5), True, LONG),
    ]
    return Scene("friction_oscillator", "Oscillator with dry friction", closed_form("friction_oscillator"), methods)


def sliding_relay() -> Scene:
    """A relay that slides from t = 0.46 on; sin t is its disturbance."""
    one, half = load("sliding_relay"), load("sliding_relay", theta=0.5)
    methods = [
        ("nsmodel, theta = 1", one, False, SHORT),
        ("nsmodel, theta = 1", one, True, LONG),
        ("nsmodel, theta = 1, variable steps", one, True, STEPPING),
        ("nsmodel, event-driven", one, False, EVENTS),
        ("nsmodel, event-driven", one, True, EVENTS),
        ("nsmodel, theta = 1/2", half, True, LONG),
    ]
    return Scene("sliding_relay", "Relay with sliding", closed_form("sliding_relay"), methods)


def diode_bridge() -> Scene:
    """The bridge. For its states it is no more than the resistor: v_C' = -i_L/C - v_C/(R C), i_L' = v_C/L.

    Where v_C > 0, l = (v_C, 0, v_C/R, 0) and y = (0, v_C/R, 0, v_C) are the only solution; where v_C < 0 the pairs change places.
    Both carry the current v_C/R.
    """
    model = load("diode_bridge")
    L, C, R = 1e-2, 1e-6, 1e3
    lam, V = np.linalg.eig([[-1 / (R * C), -1 / C], [1 / L, 0]])

    def exact(t: np.ndarray) -> np.ndarray:
        return (np.exp(np.outer(t, lam)) @ (V * np.linalg.solve(V, [10.0, 0.0])).T).real

    long = range(9, 19)
    methods = [
        ("nsmodel, theta = 1/2, gamma = 1", model, False, range(9, 14)),
        ("nsmodel, theta = 1/2, gamma = 1", model, True, long),
        ("nsmodel, theta = 1/2, gamma = 1, variable steps", model, True, STEPPING),
        ("nsmodel, event-driven", model, False, EVENTS),
        ("nsmodel, event-driven", model, True, EVENTS),
        ("nsmodel, theta = gamma = 1/2", load("diode_bridge", gamma=0.5), True, long),
    ]
    return Scene("diode_bridge", "Diode bridge", exact, methods)


def point_past_disc() -> Scene:
    """A sweeping process: a stream carries a point past a disc."""
    model = load("point_past_disc")
    methods = [
        ("nsmodel, prediction-correction", model, False, SHORT),
        ("nsmodel, prediction-correction", model, True, LONG),
        ("nsmodel, prediction-correction, variable steps", model, True, STEPPING),
        ("nsmodel, event-driven", model, False, EVENTS),
        ("nsmodel, event-driven", model, True, EVENTS),
    ]
    return Scene("point_past_disc", "Point carried past a disc", closed_form("point_past_disc"), methods)


def buck() -> Scene:
    """The converter from rest. Where its current ends it is 0 for the rest of the period; each piece is a matrix exponential."""
    model, (Vin, L, C, R, T, D) = load("buck"), (24.0, 100e-6, 47e-6, 5.0, 10e-6, 0.4)
    lam, V = np.linalg.eig([[0, -1 / L], [1 / C, -1 / (R * C)]])

    def conducts(x: np.ndarray, to: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        parts = V * np.linalg.solve(V, x - to)
        return lambda s: to + (np.exp(np.multiply.outer(s, lam)) @ parts.T).real

    def blocks(v: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda s: np.stack([0 * s, v * np.exp(-s / (R * C))], axis=-1)

    begins, pieces, x = [], [], np.zeros(2)
    for k in range(40):
        on = conducts(x, np.array([Vin / R, Vin]))
        off, rest = conducts(on(np.array(D * T)), np.zeros(2)), (1 - D) * T
        begins, pieces, x = [*begins, k * T, (k + D) * T], [*pieces, on, off], off(np.array(rest))
        if x[0] < 0:
            ends = float(brentq(lambda s, off=off: off(np.array(s))[0], 0, rest, xtol=1e-22, rtol=1e-15))
            held = blocks(off(np.array(ends))[1])
            begins, pieces, x = [*begins, (k + D) * T + ends], [*pieces, held], held(np.array(rest - ends))

    def exact(t: np.ndarray) -> np.ndarray:
        rows = np.searchsorted(begins, t, side="right") - 1
        return np.array([pieces[row](np.array(s - begins[row])) for row, s in zip(rows, t, strict=True)])

    methods = [
        ("nsmodel, theta = 1/2, gamma = 1", model, False, range(10, 14)),
        ("nsmodel, theta = 1/2, gamma = 1", model, True, range(10, 19)),
        ("nsmodel, event-driven", model, False, EVENTS),
        ("nsmodel, event-driven", model, True, EVENTS),
    ]
    return Scene("buck", "Buck converter", exact, methods)


# -- lines -------------------------------------------------------------------------------------------------------------


def ours(scene: Scene) -> list[Line]:
    """Return a line for each method of nsmodel; what cannot be compiled here is measured interpreted, once.

    Of the states those are compared that the scene's model has.
    """
    T, n, lines = scene.model.t_end, len(scene.model.names), {}
    for name, model, compiled, powers in scene.methods:
        if isinstance(powers, str):
            asked: list[Any] = [(f"rtol = {rtol:g}", {"rtol": rtol, "method": powers}) for rtol in TOLERANCES[powers]]
        else:
            asked = [(f"h = {T / 2**k:.3g}", {"step": T / 2**k}) for k in powers]
        points, way = [], "compiled" if compiled else "interpreted"
        for label, options in asked:
            run, seconds = timed(model, **options, compiled=compiled)
            points.append(scene.point(label, run.t, run.x[:, :n], seconds, options.get("step")))
            if any(words.startswith("not compiled") for words in run.metadata["warnings"]):
                way = "interpreted"
        lines.setdefault(f"{name}, {way}", points)
    return [Line(name, tuple(points)) for name, points in lines.items()]


def timed(model: Any, **options: Any) -> tuple[Any, float]:
    """A run and the CPU seconds of its steps: the least of several after a warm-up."""
    found: list[float] = []
    while len(found) < 2 or (len(found) <= REPEATS and sum(found) < ENOUGH):
        prepared = prepared_loop(model, **options)
        run = prepared.go()
        found.append(prepared.cpu_seconds)
    return run, min(found[1:])


def others(scene: Scene) -> list[Line]:
    """Return a line for each method of the other programs."""
    found: dict[str, list[Point]] = {}
    for run in programs.runs(scene.case):
        point = Point.failed(run.label, run.message)
        if not run.message:
            point = scene.point(run.label, run.t, run.x, run.seconds)
        found.setdefault(run.method, []).append(point)
    return [tuned(name, points) if name in TUNED else Line.measured(name, points) for name, points in found.items()]


def tuned(name: str, points: list[Point]) -> Line:
    """Of all settings, those that no other beats in both time and error: the best a user could have chosen, with hindsight."""
    done = sorted((point for point in points if point.drawn), key=lambda point: point.seconds)
    best: list[Point] = []
    for point in done:
        if point.error < (best[-1].error if best else WRONG):
            best.append(point)
    wrong, failed = [point.error for point in done if point.error > WRONG], len(points) - len(done)
    note = f"the best of {len(points)} settings; {failed} stopped"
    if wrong:
        note += f"; {len(wrong)} reported success with an error above {WRONG:g}, the worst of {max(wrong):.2g}"
    return Line.measured(f"{name}, best eps", best, note)


# -- figures and tables ------------------------------------------------------------------------------------------------


def draw(scene: Scene, lines: list[Line]) -> Figure:
    """Draw seconds over both errors; nsmodel's lines are solid, the others' dashed."""
    figure = blank(10.5, 5.6)
    axes = figure.subplots(1, 2, sharey=True)
    own = sum(line.kind != "peer" for line in lines)
    places = [*range(own), *range(OWN, OWN + len(lines) - own)]
    for ax, (measure, words) in zip(axes, MEASURES.items(), strict=True):
        for k, line in zip(places, lines, strict=True):
            drawn = [point for point in line.points if point.drawn and point.errors[measure] > 0]
            look = {"linestyle": (0, (4, 2)), "linewidth": 1.2} if line.kind == "peer" else {"linestyle": "-", "linewidth": 2.0}
            errors, seconds = [point.errors[measure] for point in drawn], [point.seconds for point in drawn]
            failed = sum(point.status == "failed" for point in line.points)
            label = f"{line.name} ({failed} failed)" if failed else line.name
            ax.loglog(errors, seconds, color=COLOURS[k], marker=MARKERS[k], markersize=4.5, label=label, **look)
            for point in (drawn[0], drawn[-1]) if line.kind != "peer" and drawn else ():
                at = point.errors[measure], point.seconds
                ax.annotate(point.label, at, (3, 4), textcoords="offset points", fontsize=6.5, color=COLOURS[k])
        dress(ax, scene.title if measure == "end" else "", words, "CPU time of the steps [s]" if measure == "end" else "")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def cost(line: Line, measure: str, target: float) -> str:
    """CPU seconds of the coarsest run from which on all runs, to the finest, keep the error; "-" where there is none."""
    kept = "-"
    for point in reversed([point for point in line.points if point.drawn]):
        if point.errors[measure] > target:
            break
        kept = f"{point.seconds:.2g}"
    return kept


def table(lines: list[Line]) -> str:
    """CPU seconds by method for the targets, at the end and over the run, as Markdown."""
    head = [f"{target:.0e}".replace("e-0", "e-") + f" {where}" for where in ("at the end", "over the run") for target in TARGETS]
    out = ["| method | " + " | ".join(head) + " |", "| --- |" + " ---: |" * len(head)]
    for line in lines:
        cells = [cost(line, measure, target) for measure in MEASURES for target in TARGETS]
        out.append(f"| {line.name} | " + " | ".join(cells) + " |")
    return "\n".join(out)


def main() -> None:
    """Write figures and tables; where a program is missing the page stays as it is, and the figures go to results/."""
    found = {"Siconos": programs.siconos(), "CVODE": compiler() and with_cvode()}
    found |= {program: programs.from_pypi(program) for program in programs.FROM_PYPI}
    missing = [program for program, path in found.items() if not path]
    if missing:
        print(f"{', '.join(missing)}: not installed, skipped; docs/study.md stays as it is, the figures go to {RESULTS}\n")
        RESULTS.mkdir(exist_ok=True)
    for scene in (friction_oscillator(), sliding_relay(), diode_bridge(), point_past_disc(), buck()):
        lines = [*ours(scene), *others(scene)]
        save(draw(scene, lines), (RESULTS if missing else IMAGES) / f"study_{scene.case}.png", SHADES)
        text = "\n".join([table(lines), *remarks(lines)])
        if missing:
            print(f"{scene.case}\n\n{text}\n", flush=True)
        else:
            put("study.md", scene.case, text)


def remarks(lines: list[Line]) -> list[str]:
    """What is to be told of lines and of runs that failed, as a Markdown list."""
    told = [f"- {line.name}: {line.note}." for line in lines if line.note]
    failed = [(line, point) for line in lines for point in line.points if point.status == "failed"]
    told += [f"- {line.name}, {point.label}: failed: {point.message}." for line, point in failed]
    return ["", *told] if told else []


if __name__ == "__main__":
    main()
