"""Scenes switch by switch: CVODE, stopped at the roots of its conditions, and SciPy's solve_ivp with events, written by hand."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from events import by_hand
from events.programs import Programs, compiler, with_cvode
from events.scenes import Scene, scenes

from nsmodel.simulation.event_driven import event_driven_problem
from peers.in_scipy import measure
from peers.programs import Run

TOLERANCES = tuple(10.0**-k for k in range(3, 14))


def runs(name: str) -> Iterator[Run]:
    """All tolerances of both, of a scene of `events.scenes`."""
    scene = next((scene for scene in scenes() if scene.name == name), None)
    if scene is None or scene.hand is None:
        return
    problem, t_end = event_driven_problem(scene.model), float(scene.model.t_end)
    x0, columns = np.array([float(v) for v in problem.x0.elements()]), slice(problem.states)
    t = np.linspace(0, t_end, by_hand.ROWS)
    if compiler() is not None and with_cvode():
        with tempfile.TemporaryDirectory() as folder:
            programs = Programs(problem, t_end, Path(folder), cvode=True)
            for rtol in TOLERANCES:
                found = programs.cvode(rtol, scene.stiff, scene.h_max)
                label = f"rtol = {rtol:.0e}"
                if found is None:
                    yield Run("CVODE with roots, C++", label, message="it stopped")
                else:
                    yield Run("CVODE with roots, C++", label, found.seconds, t, found.x[:, columns])
    for rtol in TOLERANCES:
        yield _by_hand(scene, x0, t_end, rtol, t, columns)


def _by_hand(scene: Scene, x0: np.ndarray, t_end: float, rtol: float, t: np.ndarray, columns: slice) -> Run:
    def job() -> np.ndarray:
        x = by_hand.run(scene.hand, x0, t_end, "DOP853", rtol, scene.h_max)
        return np.full((len(t), len(x0)), np.nan) if x is None else x

    method, label = "solve_ivp with events by hand", f"rtol = {rtol:.0e}"
    seconds, x = measure(job)
    return Run(method, label, seconds, t, x[:, columns]) if np.isfinite(x).all() else Run(method, label, message="it stopped")
