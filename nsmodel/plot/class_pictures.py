"""Where the states of a run are in the plane, as the class of its model draws it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nsmodel.errors import PlotError
from nsmodel.plot import crowd, forbidden_set

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from nsmodel.plot.plane import GapFunction
    from nsmodel.simulation.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class ClassPictures:
    """The pictures of one class of models.

    Attributes:
        panels: (run, model) -> {name: (height, what draws it)}, what its sheets have beside those of all runs.
        configuration: (run, model, row, ax), see `configuration`.
        gap: (model, run) -> min_i g_i on many points at once, and whether it moves with t; of classes with a forbidden set.
    """

    panels: Callable[[Trajectory, Any], dict[str, tuple[float, Callable[..., Axes]]]]
    configuration: Callable[[Trajectory, Any, int, Axes | None], Axes]
    gap: Callable[[Any, Trajectory], tuple[GapFunction, bool]] | None = None


CLASS_PICTURES: Mapping[str, ClassPictures] = {
    "SweepingProcess": ClassPictures(
        panels=forbidden_set.panels, configuration=forbidden_set.configuration, gap=forbidden_set.gap
    ),
    "ManyBodies": ClassPictures(panels=crowd.panels, configuration=lambda run, model, row, ax: crowd.frame(run, row, ax=ax)),
}


def pictures_of(run: Trajectory) -> ClassPictures | None:
    """Return the pictures that the class of the run's model has; None where it has none."""
    return CLASS_PICTURES.get(run.metadata.get("model_class", ""))


def configuration(run: Trajectory, model: Any = None, row: int = -1, *, ax: Axes | None = None) -> Axes:
    """Draw where a sweeping process is, and where it may not be.

    One state: the plane (t, q) with the forbidden set shaded. Two: the plane with the forbidden set at the time of
    `row`, its boundary at some earlier times, and the path so far. A scene of discs: the discs, walls and paths so far;
    of many bodies what `crowd.frame` draws.

    Args:
        run: the run of a `SweepingProcess`, or of `ManyBodies` in the plane.
        model: its model with numbers for all parameters: `t`, `q` (CasADi SX) and `constraints`, each >= 0. A scene
            can do without.
        row: the row of the run shown; the last by default.
        ax: where to draw; a new figure by default.

    Raises:
        PlotError: another class of model, more than two states and no scene, no model, or no such row.

    """
    own = pictures_of(run)
    if own is None:
        kind = run.metadata.get("model_class")
        raise PlotError(f"a configuration is drawn for a SweepingProcess, and this run is of a {kind}")
    return own.configuration(run, model, row, ax)
