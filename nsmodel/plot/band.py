"""A line over time, or, of what goes up and down too often to be one, a band of its extremes and its local mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nsmodel.plot import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

MAX_SWINGS = 150  # Ways from bottom to top that can be told apart beside each other.
BAND_POINTS = 400  # Of a band.
MEAN_POINTS = 8 * BAND_POINTS  # Of means, of which means are taken.
EXTREMA_PER_MEAN = 6  # A mean is over so many turns, twice: about a hundredth is left of what goes up and down.
EXTREMA_PER_BAND = 2.5


def swing_count(values: np.ndarray) -> float:
    """How often values go from one end of their range to the other, in all; NaN left out."""
    known = _finite_values(values)
    span = np.ptp(known) if known.size else 0.0
    return float(np.abs(np.diff(known)).sum() / span) if span > 0 else 0.0


def turning_point_count(values: np.ndarray) -> int:
    """How often values go up after they went down, or down after up."""
    changes = np.diff(_finite_values(values))
    up = changes[changes != 0] > 0
    return int(np.count_nonzero(up[1:] != up[:-1]))


def _finite_values(values: np.ndarray) -> np.ndarray:
    finite = np.isfinite(values)
    return values if finite.all() else values[finite]


def draw_curve(ax: Axes, t: np.ndarray, values: np.ndarray, **look: Any) -> tuple[Line2D, float | None]:
    """Draw values over time: a thinned line; or a band and the mean, where a line would be a block of ink.

    Args:
        ax: where to draw.
        t: times (K,), not decreasing.
        values: (K,); with ``drawstyle="steps-pre"`` in ``look`` each holds from the time before to its own.
        look: of the line.

    Returns:
        The line, and the length of time that its means are over; None where it is the values themselves.
    """
    if swing_count(values) <= MAX_SWINGS or not t[-1] > t[0]:
        kept = style.thin(values)
        look |= {} if len(t) > 1 else {"marker": "o", "markersize": 4}
        return ax.plot(t[kept], values[kept], **look)[0], None
    count, length = turning_point_count(values), t[-1] - t[0]
    width = max(EXTREMA_PER_MEAN / count, 1 / BAND_POINTS) * length
    at, fine = (np.linspace(t[0], t[-1], n) for n in (BAND_POINTS, MEAN_POINTS))
    low, high = _windowed_extremes(t, values, at, max(EXTREMA_PER_BAND / count, 1 / BAND_POINTS) * length)
    ax.fill_between(at, low, high, color=look.get("color"), alpha=0.22, linewidth=0)
    held = look.pop("drawstyle", None) is not None
    middle = _windowed_mean(fine, _windowed_mean(t, values, fine, width, held=held), at, width, held=False)
    return ax.plot(at, middle, **look)[0], width


def means_note(widths: Sequence[float | None], unit: str) -> str:
    """What a title says of curves that are bands, of which `curve` returned these lengths; empty where there are none."""
    means = [width for width in widths if width is not None]
    if not means:
        return ""
    span = f"{min(means):.2g}" if max(means) < 1.1 * min(means) else f"{min(means):.2g} to {max(means):.2g}"
    return f": means over {span} {unit}".rstrip() + ", bands of extremes"


def _windowed_extremes(t: np.ndarray, values: np.ndarray, at: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest value around each time, the rows on both sides included."""
    first = np.maximum(np.searchsorted(t, at - width / 2) - 1, 0)
    stop = np.minimum(np.searchsorted(t, at + width / 2, side="right") + 1, len(t))
    bounds = np.stack([first, stop], axis=1).ravel()
    low = np.minimum.reduceat(np.append(np.nan_to_num(values, nan=np.inf), np.inf), bounds)[::2]
    high = np.maximum.reduceat(np.append(np.nan_to_num(values, nan=-np.inf), -np.inf), bounds)[::2]
    return np.where(np.isfinite(low), low, np.nan), np.where(np.isfinite(high), high, np.nan)


def _windowed_mean(t: np.ndarray, values: np.ndarray, at: np.ndarray, width: float, *, held: bool) -> np.ndarray:
    """The mean in time over ``width`` around each time, of what is there of it; ``held``: values hold from the time before."""
    middle = values[1:] if held else (values[1:] + values[:-1]) / 2
    known = np.isfinite(middle)
    length = np.where(known, np.diff(t), 0)
    left, right = np.maximum(at - width / 2, t[0]), np.minimum(at + width / 2, t[-1])

    def window_integral(part: np.ndarray) -> np.ndarray:
        total = np.concatenate([[0.0], np.cumsum(part)])
        return np.interp(right, t, total) - np.interp(left, t, total)

    known_length, whole = window_integral(length), window_integral(length * np.where(known, middle, 0))
    return np.divide(whole, known_length, out=np.full(len(at), np.nan), where=known_length > 0)
