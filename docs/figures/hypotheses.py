"""Draw the two pictures of docs/hypotheses.md: what gamma measures (A5), and what P B = C' asks for (5.1).

Run it from anywhere; it writes docs/images/mfcq.png and docs/images/passivity.png.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle

IMAGES = Path(__file__).resolve().parents[1] / "images"
INK, GREY, BLUE, RED, GREEN = "#30363D", "#8F9BAA", "#0072B2", "#C8501E", "#00795A"
FORBIDDEN, EDGE = "#EADDCF", "#9A7B5F"


def arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], colour: str, width: float = 1.8) -> None:
    """Draw an arrow between two points."""
    style = {"arrowstyle": "-|>,head_length=0.5,head_width=0.25", "color": colour, "lw": width, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", xy=end, xytext=start, arrowprops=style, zorder=5)


def plain(ax: Axes, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Equal scales and no frame."""
    ax.set_xlim(*x)
    ax.set_ylim(*y)
    ax.set_aspect("equal")
    ax.axis("off")


def title(ax: Axes, words: str) -> None:
    """Put a bold title above the axes."""
    ax.set_title(words, loc="left", fontsize=12, fontweight="bold", color=INK)


# -- A5 ----------------------------------------------------------------------------------------------------------------


def corner(ax: Axes, d: float) -> None:
    """A point in the notch between two discs with centres (-d, 0) and (d, 0), radius 1, that close in at speed 1."""
    tip = np.array([0.0, np.sqrt(1 - d**2)])
    for side in (-1, 1):
        ax.add_patch(Circle((side * d, 0), 1, color=FORBIDDEN, lw=0))
        notch = np.degrees(np.arccos(d))
        ends = (notch, 240) if side == -1 else (-60, 180 - notch)
        ax.add_patch(Arc((side * d, 0), 2, 2, theta1=ends[0], theta2=ends[1], color=EDGE, lw=1.4))
        arrow(ax, (side * (d + 0.62), 0.02), (side * (d + 0.22), 0.02), EDGE)
        ax.text(side * (d + 0.42), 0.12, "1", ha="center", va="bottom", fontsize=12, color=EDGE)
        arrow(ax, tuple(tip), tuple(tip + 0.62 * (tip - [side * d, 0])), BLUE)
    ax.plot(*tip, "o", color=INK, ms=7, zorder=6)
    ax.text(0, tip[1] - 0.13, "$q$", ha="center", va="top", fontsize=14, color=INK)
    speed = d / tip[1]
    arrow(ax, tuple(tip), (0, tip[1] + 0.3 * speed), RED, 2.6)
    caption(ax, "the discs close in at speed 1,", f"$q$ is pushed out at speed {speed:.2g}")
    plain(ax, (-2.02, 2.02), (-0.19, 1.72))


def hull(ax: Axes, d: float) -> None:
    """The unit normals of the two discs at the point, their hull, and its distance from 0."""
    height = np.sqrt(1 - d**2)
    ax.add_patch(Arc((0, 0), 2, 2, theta1=0, theta2=180, color=GREY, lw=1, ls=(0, (4, 3))))
    ax.plot([-d, d], [height, height], color=INK, lw=4, solid_capstyle="round", zorder=4)
    for side, name in ((1, "$n_1$"), (-1, "$n_2$")):
        arrow(ax, (0, 0), (side * d, height), BLUE)
        ax.text(side * (d + 0.1), height + 0.04, name, ha="center", va="bottom", fontsize=14, color=BLUE)
    ax.plot([0, 0], [0, height], color=RED, lw=2.6, zorder=6, solid_capstyle="butt")
    ax.plot(0, 0, "o", color=INK, ms=5, zorder=6)
    caption(ax, "bar: hull of the unit normals", rf"its distance from 0: $1/\gamma$ = {height:.2f}")
    plain(ax, (-1.45, 1.45), (-0.06, 1.06))


def caption(ax: Axes, first: str, second: str) -> None:
    """Put two lines below the axes, the second one in red."""
    ax.text(0.5, -0.03, first, transform=ax.transAxes, ha="center", va="top", fontsize=11.5, color=INK)
    ax.text(0.5, -0.14, second, transform=ax.transAxes, ha="center", va="top", fontsize=11.5, color=RED)


def mfcq() -> Figure:
    """Gamma at a wide corner and at a narrow one."""
    figure = Figure(figsize=(8.0, 5.3), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.12, hspace=0.1, wspace=0.06)
    axes = figure.subplots(2, 2, height_ratios=[1.0, 0.92])
    for column, (name, d) in enumerate((("Wide corner", 0.6), ("Narrow gap", 0.98))):
        corner(axes[0, column], d)
        hull(axes[1, column], d)
        title(axes[0, column], rf"{name}: $\gamma$ = {1 / np.sqrt(1 - d**2):.3g}")
    return figure


# -- 5.1 ---------------------------------------------------------------------------------------------------------------


def plane(ax: Axes) -> None:
    """Axes of a plane of states, through 0."""
    for ends in (((-1.95, 0), (2.0, 0)), ((0, -1.45), (0, 1.75))):
        arrow(ax, *ends, GREY, 0.8)
    ax.text(1.98, -0.08, "$x_1$", ha="right", va="top", fontsize=12, color=GREY)
    ax.text(-0.08, 1.72, "$x_2$", ha="right", va="top", fontsize=12, color=GREY)
    plain(ax, (-2.0, 2.05), (-1.5, 1.8))


def oscillator(ax: Axes) -> None:
    """B = (0, 1), C = (0, 1): every ellipse p x_1^2 + x_2^2 = 1 has the tangent C x = C B at B."""
    angle = np.linspace(0, 2 * np.pi, 400)
    for p in (0.35, 1.0, 2.6):
        ax.plot(np.cos(angle) / np.sqrt(p), np.sin(angle), color=GREEN, lw=2.4 if p == 1 else 1.0, alpha=1 if p == 1 else 0.55)
    ax.plot([-1.75, 1.75], [1, 1], color=BLUE, lw=2, ls=(0, (5, 3)))
    ax.text(-1.8, 1.08, "$C x$ = $C B$", fontsize=13, color=BLUE, va="bottom")
    arrow(ax, (0, 0), (0, 1), RED, 2.6)
    ax.text(0.08, 0.45, "$B$", fontsize=14, color=RED)
    arrow(ax, (0, 1), (0, 1.5), BLUE)
    ax.text(0.1, 1.42, "$P B$ = $C'$", fontsize=14, color=BLUE, va="center")
    note(ax, "The line $C x$ = $C B$ touches the ellipses", "$x'P x$ = 1 at $B$: three of many $P$")


def impossible(ax: Axes) -> None:
    """B = (1, 0), C = (0, 1): the line C x = C B runs through 0, and no ellipse round 0 touches it."""
    angle = np.linspace(0, 2 * np.pi, 400)
    for p, tilt in ((1.0, 0.0), (1.25, 0.6), (1.25, -0.6)):  # p x1^2 + 2 tilt x1 x2 + x2^2 = p, all through B
        c, s = np.cos(angle), np.sin(angle)
        r = np.sqrt(p / (p * c**2 + 2 * tilt * c * s + s**2))
        ax.plot(r * c, r * s, color=GREEN, lw=2.4 if tilt == 0 else 1.0, alpha=1 if tilt == 0 else 0.55)
        normal = np.array([p, tilt]) / np.hypot(p, tilt)
        arrow(ax, (1, 0), tuple(np.array([1, 0]) + 0.6 * normal), GREEN, 1.6)
    ax.text(1.36, -0.33, "$P B$", fontsize=14, color=GREEN, va="top", ha="center")
    ax.plot([-1.9, 1.0], [0, 0], color=BLUE, lw=2, ls=(0, (5, 3)), zorder=4)
    ax.text(-1.95, 0.08, "$C x$ = $C B$", fontsize=13, color=BLUE, va="bottom", ha="left")
    arrow(ax, (0, 0), (1, 0), RED, 2.6)
    ax.text(0.45, -0.08, "$B$", fontsize=14, color=RED, va="top")
    arrow(ax, (1, 0), (1, 0.6), BLUE)
    ax.text(1.08, 0.62, "$C'$", fontsize=14, color=BLUE, va="center")
    note(ax, "The line $C x$ = $C B$ runs through 0:", "it cuts every ellipse round 0")


def note(ax: Axes, *lines: str) -> None:
    """Put lines below the axes."""
    for i, line in enumerate(lines):
        ax.text(0.5, -0.01 - 0.075 * i, line, transform=ax.transAxes, ha="center", va="top", fontsize=11.5, color=INK)


def passivity() -> Figure:
    """P B = C' as a tangent: where it can be had, and where not."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.1, wspace=0.04)
    left, right = figure.subplots(1, 2)
    for ax in (left, right):
        plane(ax)
    oscillator(left)
    impossible(right)
    title(left, "Friction on the speed: $P$ exists")
    title(right, "Input across the output: no $P$")
    return figure


if __name__ == "__main__":
    for name, draw in (("mfcq", mfcq), ("passivity", passivity)):
        draw().savefig(IMAGES / f"{name}.png", dpi=110)
