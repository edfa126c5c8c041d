"""Measure what docs/stability.md says: factors of a step, ringing, steps that change, and more than a thousand extreme cells.

Run it from anywhere; it writes docs/images/stability_*.png and the tables of docs/stability.md. About two minutes.
"""

from __future__ import annotations

import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from page import put

from nsmodel import FirstOrderSystem, FrictionOscillator, MonotoneInclusion, SweepingProcess, Trajectory, relay, simulate
from nsmodel.plot.study import heat_map

DOCS = Path(__file__).resolve().parents[1]
IMAGES = DOCS / "images"
sys.path.insert(0, str(DOCS.parent / "tests"))

INK, GREY = "#30363D", "#8F9BAA"
BLUE, RED, GREEN, PURPLE = "#0072B2", "#C8501E", "#00795A", "#8E5EA2"
X, S = ca.SX.sym("x"), ca.SX.sym("s")
X2, Q2 = ca.SX.sym("x", 2), ca.SX.sym("q", 2)
N = 20


# -- factors of a step -------------------------------------------------------------------------------------------------


def per_step(run: Trajectory, energy: Callable[[Trajectory], np.ndarray]) -> float:
    """The mean factor of a step, from the second one on."""
    size = energy(run)
    with np.errstate(invalid="ignore"):  # 0/0 where one step ends it
        return float((size[-1] / size[1]) ** (1 / (len(run) - 1)))


def decay(z: float) -> dict[str, float]:
    """x' = -x with steps h = z: the measured factor of each scheme."""
    far, grid = 1e300, {"t_end": N * z, "step": z}
    size = lambda run: np.abs(run.x[:, 0])  # noqa: E731
    found = {
        "explicit": per_step(simulate(SweepingProcess(q=X, f=-X, constraints={"wall": X + far}, q0=1, **grid)), size),
        "catching-up": per_step(simulate(MonotoneInclusion(x=X, field=-X, lower=-far, x0=1, **grid)), size),
    }
    for theta in (1.0, 0.5, 0.25):
        found[f"theta = {theta:g}"] = per_step(simulate(FirstOrderSystem(x=X, f=-X, x0=1, theta=theta, **grid)), size)
    return found


def swing(z: float) -> dict[str, float]:
    """x'' = -x with steps h = z: the measured factor of the amplitude sqrt(x^2 + v^2)."""
    rate, grid = [X2[1], -X2[0]], {"t_end": N * z, "step": z}
    size = lambda run: np.hypot(run.x[:, 0], run.x[:, 1])  # noqa: E731
    found = {"explicit": per_step(simulate(SweepingProcess(q=X2, f=rate, q0=[1, 0.2], **grid)), size)}
    for theta in (1.0, 0.5):
        found[f"theta = {theta:g}"] = per_step(simulate(FirstOrderSystem(x=X2, f=rate, x0=[1, 0.2], theta=theta, **grid)), size)
    proximal = FrictionOscillator(x=X, potential=X**2 / 2, x0=1, v0=0.2, **grid)
    found["inertial proximal"] = per_step(simulate(proximal), lambda run: np.hypot(run.x[:, 0], run.v[:, 0]))
    return found


LINES = {
    "explicit": (RED, "o", lambda z: np.abs(1 - z), lambda z: np.hypot(1, z)),
    "catching-up": (PURPLE, "x", lambda z: np.abs(1 - z), None),
    "theta = 1": (BLUE, "s", lambda z: 1 / (1 + z), lambda z: 1 / np.hypot(1, z)),
    "theta = 0.5": (GREEN, "^", lambda z: np.abs(1 - z / 2) / (1 + z / 2), lambda z: np.ones_like(z)),
    "theta = 0.25": ("#B7791F", "v", lambda z: np.abs(1 - 0.75 * z) / (1 + 0.25 * z), None),
    "inertial proximal": (PURPLE, "+", None, lambda z: 1 / np.hypot(1, z)),
}


def factors() -> tuple[Figure, list[str]]:
    """Measured factors on the lines of the formulas, and the largest relative difference."""
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)
    worst = 0.0
    z, line = np.array([1e-2, 3e-2, 0.1, 0.3, 0.7, 1.5, 2.0, 4.0, 10.0, 30.0, 100.0]), np.geomspace(5e-3, 200, 800)
    for column, (ax, measure, title) in enumerate(
        zip(figure.subplots(1, 2), (decay, swing), ("Decay x' = -k x", "Oscillation x'' = -w² x"), strict=True)
    ):
        seen = [measure(float(one)) for one in z]
        for name, (colour, mark, *formulas) in LINES.items():
            formula = formulas[column]
            if formula is None:
                continue
            values = np.array([one[name] for one in seen])
            away = np.abs(formula(z) - 1) > 1e-9 if column == 0 else np.ones(z.size, bool)
            worst = max(worst, float(np.max(np.abs(values / formula(z) - 1)[away & (formula(z) > 0)])))
            label = "explicit (sweeping)" if name == "explicit" else name
            if mark in "ox" or name == "inertial proximal":
                ax.plot(z, values, mark, color=colour, ms=7 if mark != "o" else 5, mfc="none", zorder=5, label=label)
            else:
                ax.plot(z, values, mark, color=colour, ms=5, mfc="none", label=label)
            if name not in ("catching-up", "inertial proximal"):
                ax.plot(line, formula(line), color=colour, lw=1.1)
        ax.axhline(1, color=INK, lw=0.8, ls=(0, (5, 4)))
        dressed(ax, title, "h k" if column == 0 else "h w", "factor of one step")
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_ylim(3e-3, 150)
        ax.legend(fontsize=8, frameon=False, loc="upper left")
    return figure, [f"The points lie on the formulas within {worst:.1g} (relative)."]


def dressed(ax: Axes, title: str, xlabel: str, ylabel: str) -> None:
    """The look of all pictures."""
    ax.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK)
    ax.set_xlabel(xlabel, fontsize=9)
    ax.set_ylabel(ylabel, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(color="#E6E8EB", lw=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


# -- ringing, steps that change ----------------------------------------------------------------------------------------


def ringing() -> tuple[Figure, list[str]]:
    """A stiff decay at h k = 50, and the energy of an oscillator while its steps grow or shrink."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)
    left, right = figure.subplots(1, 2)
    z = 50.0
    for theta, colour, mark in ((1.0, BLUE, "s"), (0.5, GREEN, "^")):
        run = simulate(FirstOrderSystem(x=X, f=-X, x0=1, theta=theta, step=z, t_end=12 * z))
        left.plot(run.x[:, 0], f"-{mark}", color=colour, ms=4, lw=1.1, label=f"theta = {theta:g}")
    run = simulate(MonotoneInclusion(x=X, field=0.4 - X, lower=0, upper=2, x0=1, step=z, t_end=12 * z))
    left.plot(run.x[:, 0], "-x", color=PURPLE, ms=5, lw=1.1, label="catching-up, 0 ≤ x ≤ 2")
    dressed(left, "Steps 50 times the decay time", "step", "x")
    left.set_ylim(-1.2, 3.4)
    left.legend(fontsize=8, frameon=False, loc="upper right")
    lines = ["| steps | energy after 40 steps, of the first | largest growth in one step |", "| --- | --- | --- |"]
    for name, ratio, colour in (("constant", 1.0, INK), ("growing by 10 %", 1.1, BLUE), ("shrinking by 10 %", 1 / 1.1, RED)):
        steps = 0.05 * ratio ** np.arange(40)
        run = simulate(FrictionOscillator(x=X, potential=X**2 / 2, x0=1, v0=0.5, steps=steps))
        right.plot(run.energy / run.energy[0], color=colour, lw=1.4, label=name)
        growth = np.max(run.energy[1:] / run.energy[:-1])
        lines.append(f"| {name} | {run.energy[-1] / run.energy[0]:.3g} | {growth:.4f} |")
    dressed(right, "Inertial proximal, steps that change", "step", "energy, of the first")
    right.set_yscale("log")
    right.legend(fontsize=8, frameon=False, loc="lower left")
    return figure, lines


# -- numbers -----------------------------------------------------------------------------------------------------------


def explicit_table() -> list[str]:
    """Sweeping with f = -k q onto a wall it never touches, and catching-up in [0, 2] with the rest point 0.4."""
    lines = ["| h k | sweeping: q after 100 steps, from 1 | catching-up in [0, 2]: distance from rest |", "| --- | --- | --- |"]
    for z in (0.5, 1.0, 1.9, 2.0, 2.1, 10.0):
        grid = {"step": z, "t_end": 100 * z}
        free = simulate(SweepingProcess(q=X, f=-X, constraints={"wall": X + 1e200}, q0=1, **grid))
        held = simulate(MonotoneInclusion(x=X, field=0.4 - X, lower=0, upper=2, x0=1, **grid))
        lines.append(f"| {z:g} | {abs(free.x[-1, 0]):.2g} | {np.abs(held.x[-2:, 0] - 0.4).max():.2g} |")
    return lines


def stick_table() -> list[str]:
    """How far from 0 a state sticks that friction 1 holds against a push of 0.5."""
    lines = ["| h | catching-up: largest of the last 50 | implicit Euler: largest of the last 50 |", "| --- | --- | --- |"]
    l = ca.SX.sym("l")
    for h in (0.1, 0.01, 0.001):
        grid = {"step": h, "t_end": 400 * h}
        explicit = simulate(MonotoneInclusion(x=X, field=0.5, phi=ca.fabs(X), x0=100.3 * h, **grid))
        implicit = simulate(FirstOrderSystem(x=X, lam=l, f=0.5, h=X, g=l, law=relay(1), x0=100.3 * h, **grid))
        lines.append(f"| {h:g} | {np.abs(explicit.x[-50:]).max():.2g} | {np.abs(implicit.x[-50:]).max():.2g} |")
    return lines


def damping_table() -> list[str]:
    """Energy that is left after ten periods without any friction."""
    lines = ["| steps a period | inertial proximal | theta = 1 | theta = 1/2 |", "| --- | --- | --- | --- |"]
    for count in (10, 100, 1000, 10000):
        h = 2 * np.pi / count
        grid = {"step": h, "t_end": 10 * count * h}
        proximal = simulate(FrictionOscillator(x=X, potential=X**2 / 2, x0=1, v0=0, **grid)).energy
        row = [proximal[-1] / proximal[0]]
        for theta in (1.0, 0.5):
            run = simulate(FirstOrderSystem(x=X2, f=[X2[1], -X2[0]], x0=[1, 0], theta=theta, **grid))
            row.append(float((run.x[-1] ** 2).sum()))
        lines.append(f"| {count} | " + " | ".join(f"{value:.3g}" for value in row) + " |")
    return lines


# -- a thousand cells --------------------------------------------------------------------------------------------------

DECADES = (-12, -9, -6, -3, -1, 0, 3)


def cells() -> tuple[Figure, list[str]]:
    """All cells of tests/stress_scenes.py as a heat map of scenes and steps, and as a table."""
    from stress_scenes import RIGHT, STOPPED, WRONG, cells, outcome

    counts: dict[str, Counter] = defaultdict(Counter)
    blocks: dict[tuple[str, int], Counter] = defaultdict(Counter)
    kinds: dict[str, str] = {}
    varied: dict[str, dict[str, list[float]]] = {}
    for cell in cells():
        verdict = outcome(cell).verdict
        kinds[cell.scene] = cell.kind
        counts[cell.scene][verdict] += 1
        decade = min(range(len(DECADES)), key=lambda j: abs(DECADES[j] - np.log10(cell.at["step"])))
        blocks[cell.scene, decade][verdict] += 1
        for name, value in cell.at.items():
            varied.setdefault(cell.scene, {}).setdefault(name, []).append(value)
    scenes = list(counts)
    table = {}
    for (scene, decade), found in blocks.items():
        worst = next(verdict for verdict in (WRONG, STOPPED, RIGHT) if found[verdict])
        table[scenes.index(scene), decade] = (worst, f"{found[RIGHT]}/{found.total()}")
    figure = Figure(figsize=(8.6, 5.6), layout="constrained")
    rows = [f"{scene} ({kinds[scene]})" for scene in scenes]
    columns = [f"1e{decade}" if decade else "1" for decade in DECADES]
    words = {RIGHT: "all right", STOPPED: "some stopped, with the reason", WRONG: "some wrong"}
    heat_map(
        figure.add_subplot(), rows, columns, table, "Extreme cells: how many are right", "step, in natural times of the scene",
        labels=words,
    )  # fmt: skip
    lines = ["| scene | class | from ... to | cells | right | stopped | wrong |", "| --- | --- | --- | --- | --- | --- | --- |"]
    for scene in scenes:
        found = counts[scene]
        ranges = "; ".join(f"{name} {spread(values)}" for name, values in varied[scene].items())
        lines.append(
            f"| {scene} | {kinds[scene]} | {ranges} | {found.total()} | {found[RIGHT]} | {found[STOPPED]} | {found[WRONG]} |"
        )
    total = sum(counts.values(), Counter())
    lines.append(f"| **all** | | | **{total.total()}** | **{total[RIGHT]}** | **{total[STOPPED]}** | **{total[WRONG]}** |")
    return figure, lines


def spread(values: Sequence[float]) -> str:
    """The least and the largest value."""
    return f"{min(values):.3g} ... {max(values):.3g}"


def main() -> None:
    """Write the pictures and the tables."""
    for name, measure in (("factors", factors), ("ringing", ringing), ("cells", cells)):
        figure, lines = measure()
        figure.savefig(IMAGES / f"stability_{name}.png", dpi=110)
        put("stability.md", name, "\n".join(lines))
    for name, measure in (("explicit", explicit_table), ("stick", stick_table), ("damping", damping_table)):
        put("stability.md", name, "\n".join(measure()))


if __name__ == "__main__":
    main()
