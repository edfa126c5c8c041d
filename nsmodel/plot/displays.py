"""What results show of themselves, a function a display: methods of results find it here by its name (`_utils.display`).

Pictures and pages are imported when they are asked for: who draws a run needs no sweeps.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nsmodel.plot.html.notebook import (
    model_html,
    report_html,
    run_html,
    sensitivity_html,
    statistics_html,
    stress_html,
    study_html,
    sweep_html,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from nsmodel.derivatives.result import Sensitivity
    from nsmodel.hypotheses.report import Report
    from nsmodel.simulation.trajectory import Trajectory
    from nsmodel.study.result import Study
    from nsmodel.study.stress_result import Stress
    from nsmodel.sweep.variable import Variable

__all__ = [
    "film_trajectory",
    "model_html",
    "plot_sensitivity",
    "plot_stress",
    "plot_study",
    "plot_trajectory",
    "plot_variable",
    "report_html",
    "run_html",
    "sensitivity_html",
    "statistics_html",
    "stress_html",
    "study_html",
    "sweep_html",
    "view_report",
    "view_study",
    "view_trajectory",
]


def plot_trajectory(run: Trajectory, **options: Any) -> Figure:
    """Draw what `Trajectory.plot` draws."""
    from nsmodel.plot.figures import overview

    return overview(run, **options)


def plot_study(study: Study, ax: Axes | None) -> Axes:
    """Draw what `Study.plot` draws."""
    from nsmodel.plot.study import work_precision

    return work_precision(study, ax=ax)


def plot_sensitivity(found: Sensitivity, ax: Axes | None) -> Axes:
    """Draw what `Sensitivity.plot` draws."""
    from nsmodel.plot.sensitivity import sensitivity

    return sensitivity(found, ax=ax)


def plot_stress(result: Stress, ax: Axes | None) -> Axes:
    """Draw what `Stress.plot` draws."""
    from nsmodel.plot.study import stress

    return stress(result, ax=ax)


def plot_variable(variable: Variable, **options: Any) -> Axes:
    """Draw what `Variable.plot` draws: a map, lines, or the picture that fits, as the options ask."""
    from nsmodel.plot.sweep import sweep_line, sweep_map, sweep_overview

    draw = sweep_map if "y" in options else sweep_line if options.keys() - {"ax"} else sweep_overview
    return draw(variable, **options)


def film_trajectory(run: Trajectory, path: str | Path, **options: Any) -> Path:
    """Write the film of `Trajectory.film`."""
    from nsmodel.plot.film import animate

    return animate(run, path, **options)


def view_trajectory(run: Trajectory, path: str | Path | None, model: Any) -> Path:
    """Write the page of `Trajectory.view`."""
    from nsmodel.plot.html.run_page import write_run_page

    return write_run_page(run, path, model)


def view_study(study: Study, path: str | Path | None) -> Path:
    """Write the page of `Study.view`."""
    from nsmodel.plot.html.study_page import write_study_page

    return write_study_page(study, path)


def view_report(report: Report, path: str | Path | None) -> Path:
    """Write the page of `Report.view`."""
    from nsmodel.plot.html.report_page import write_report_page

    return write_report_page(report, path)
