"""The result of a run: named arrays, one row a time, and metadata that JSON can hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from nsmodel._utils import cached_per_object, display, escape_invisible, html_repr
from nsmodel.errors import UsageError
from nsmodel.event_driven import dense_output
from nsmodel.files.archive import read_archive, write_npz
from nsmodel.files.metadata import RUN_FIELDS, check_field_types
from nsmodel.files.storage import write_csv
from nsmodel.simulation import columns, summary, windows
from nsmodel.simulation.run_data import RunData, check_run_arrays


@dataclass(frozen=True, repr=False, eq=False)
class Trajectory(RunData):
    """A run of N steps; row 0 of every array is the start, where multipliers, outputs and residual are NaN.

    ``arrays`` is {name: array of N+1 rows}, among them t (N+1,) and x (N+1, n); ``metadata`` holds title, model class,
    names, units, parameters, scheme, solver counts, warnings, status, ... ``len(run)`` is N.

    A run of many bodies has x = NaN where a body is not there, gap_min (N+1,) the least of all constraints, pressure
    (N+1, bodies) the sum of the reactions on each body, and lists of all K contacts, row after row: ``contact_row (K,)``,
    ``contact_family``, ``contact_first``, ``contact_second``, ``contact_reaction``; ``contacts`` gives those of a row.

    The state is also an attribute under the user's own symbols (``run.q``, (N+1, k); (N+1,) for a scalar symbol), each
    state under its name, each further array under its own (``run.energy``), and each multiplier that the model names
    (``run.friction``); AttributeError lists what there is. ``run["name"]`` finds any column, an output among them, by its name.
    """

    arrays: dict[str, np.ndarray]
    metadata: dict[str, Any]

    _repr_html_ = html_repr("run_html")

    def at(self, t: Any) -> dense_output.At:
        """Return the run at times t, a number or (k,) of them: states, velocities, multipliers and outputs, (k, ...) each.

        Of an event-driven run to its tolerance, at an event as they are after it. Of a run by time stepping a row is given as
        it is. Between rows states are on the straight line from row to row; velocities of an oscillator, multipliers and outputs
        are those of the step that t lies in, which are those of the row that ends it. At the start what no step has computed is
        that of the first step. Of many bodies x is NaN where one of both rows has no such body, and multipliers are in
        ``contacts``: they have no columns. Rows of ``save_every`` count as if they were steps.

        On stretches of steps (``run.stepped``) of an event-driven run the same holds, but for a parabola through the rows of a
        step in which nothing switches.

        Raises:
            UsageError: a time that is not a number or outside the run.
        """
        times = dense_output.as_times(t)
        outside = times[~((times >= self.t[0]) & (times <= self.t[-1]))]
        if outside.size:
            raise UsageError(f"t = {outside[0]:.10g}: the run goes from {self.t[0]:.10g} to {self.t[-1]:.10g}")
        whole = self.is_event_driven and len(self.arrays["piece_start"]) > 0
        return dense_output.evaluate_pieces(self.arrays, times) if whole else dense_output.interpolate_rows(self.arrays, times)

    __iter__: ClassVar[None] = None  # Columns are found by their names alone.

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a column by its name: a state or a symbol of several, a multiplier, an input, an array, an output.

        Raises:
            UsageError: no column is called so.
        """
        if not isinstance(name, str):
            raise UsageError(f"run[{name!r:.40}]: expected the name of a column, such as run['x']; run.x has the rows")
        is_attribute = name in self._attribute_names() or isinstance(getattr(type(self), name, None), property)
        if is_attribute and isinstance(found := getattr(self, name, None), np.ndarray):
            return found
        try:
            return self.multiplier(name)
        except (UsageError, AttributeError):
            return np.asarray(self.evaluate(name))

    def evaluate(self, given: Any, units: Mapping[str, str] | None = None) -> Any:
        """Return the values of an expression at the rows, (N+1,) or (N+1, k); or the run with further columns.

        Args:
            given: an expression, the name of a column, or {name: expression}: then the run is returned with these columns,
                which pictures, files and integrals have too. A symbol stands for the column of its name: ``t``, a state, a
                multiplier (all of them: ``l``, or ``l_0``, ...), ``y``, an input, a parameter, any array (``energy``, ``v``).
                Row k has the multipliers and the inputs of the step that ends there; row 0 has NaN where multipliers enter.
            units: {name: unit} of the further columns.

        Raises:
            UsageError: a symbol that the run does not have, a name that it has already, a matrix.
        """
        return columns.expression_at_rows(self, given, units)

    def integral(self, what: Any, t0: float | None = None, t1: float | None = None) -> Any:
        """Return the integral of a quantity from t0 to t1, a number or (k,); left out they are the ends of the run.

        The quantity is taken once a step, where the scheme takes its rates: for theta = 1/2 in the middle, with the multipliers
        and both inputs of the step, so that energies balance (see `nsmodel.simulation.windows`). Of a step that the window cuts
        its share counts. Of an event-driven run it is a Gauss sum over its polynomials. Rows of ``save_every`` count as if they
        were steps.

        Args:
            what: the name of an output or of a column, or an expression as in ``evaluate``.
            t0, t1: the window.

        Raises:
            UsageError: a window outside the run, a name that the run does not have; of an event-driven run a quantity that is
                known at its rows alone, or a multiplier that has an impulse in the window.
        """
        return windows.weighted_integral(windows.window_samples(self, what, t0, t1))

    def mean(self, what: Any, t0: float | None = None, t1: float | None = None) -> Any:
        """Return the mean of ``what``, a quantity, from t0 to t1: its ``integral`` over the length."""
        return windows.weighted_mean(windows.window_samples(self, what, t0, t1))

    def rms(self, what: Any, t0: float | None = None, t1: float | None = None) -> Any:
        """Return the root of the mean of the square of ``what``, a quantity, from t0 to t1; see ``integral``."""
        return windows.weighted_rms(windows.window_samples(self, what, t0, t1))

    def spectrum(self, what: Any, t0: float | None = None, t1: float | None = None, *, harmonics: int = 50) -> windows.Spectrum:
        """Return Fourier coefficients of ``what`` from t0 to t1: ``frequency`` (K+1,), ``coefficient`` (K+1,) or (K+1, k).

        q(t) ~ sum_k Re(c_k exp(2 pi i f_k (t - t0))), f_k = k/(t1 - t0), k up to ``harmonics``: take whole periods. They
        are integrals over the window, of straight lines over each step, and no sum over samples: steps may differ, and edges of
        inputs are as they are.
        """
        return windows.spectrum(self, what, t0, t1, harmonics)

    def smooth(self, points: int = 2000, t0: float | None = None, t1: float | None = None) -> Trajectory:
        """Return an event-driven run with about ``points`` rows read off its polynomials, two at each jump; others as they are.

        ``t0``, ``t1``: of an event-driven run these times alone; left out they are its ends. UsageError for a window outside.
        """
        if "piece_x" not in self.arrays or not len(self.arrays["piece_start"]):
            return self
        drawn = replace(self, arrays=dense_output.sample_pieces(self.arrays, points, *windows.check_window(self, t0, t1)))
        return replace(drawn, arrays=drawn.arrays | columns.resampled_outputs(drawn, self.arrays))

    @property
    def events(self) -> tuple[dense_output.Event, ...]:
        """The switches of an event-driven run, in order; UsageError for a run by time stepping, which has none but its rows'."""
        if not self.is_event_driven:
            raise UsageError("events are found by event-driven runs: give rtol; for time steps see run.index_set")
        return _events_of(self)

    def save(self, path: str | Path) -> None:
        """Write one npz file at ``path`` with all arrays and the metadata; StorageError where that fails."""
        write_npz(path, self.arrays, self.metadata)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read what ``save`` wrote at ``path``.

        Every array and number is compared with its digest. Of a file of an older version, which has none, an
        ``UnverifiedWarning`` says so.

        Raises:
            StorageError: a missing, damaged or foreign file.
        """
        archive, arrays = read_archive(path)
        check_field_types(archive.metadata, RUN_FIELDS, path)
        check_run_arrays(arrays, archive.metadata, path)
        archive.warn_unverified(stacklevel=2)
        return cls(arrays, archive.metadata)

    def to_csv(self, path: str | Path) -> None:
        """Write to ``path`` t, states, ``multiplier:NAME``, ``y:NAME``, ``input:NAME``, residual, the other arrays but lists."""
        write_csv(path, dict(columns.csv_columns(self)))

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` along ``time``: a variable a state, other arrays whole, metadata as attributes.

        Further dimensions are ``multiplier``, ``input`` and ``state`` with their names, and ``body``; units are attributes.
        MissingExtraError where xarray is not installed.
        """
        return columns.run_dataset(self)

    def to_pandas(self) -> Any:
        """Return the table of ``to_csv`` as a ``pandas.DataFrame``: a row a time, a column a quantity, units in its ``attrs``.

        MissingExtraError where pandas is not installed.
        """
        return columns.run_frame(self)

    def plot(self, **options: Any) -> Any:
        """Draw an overview of the run; the options are those of ``nsmodel.plot.overview``."""
        return display("overview", self, **options)

    def film(self, path: str | Path, **options: Any) -> Path:
        """Write a film of bodies in the plane as GIF or, with the program ffmpeg, as MP4, and return its path.

        Args:
            path: NAME.gif or NAME.mp4.
            options: those of ``nsmodel.plot.animate``: seconds, fps, scale, size, dpi.

        Raises:
            PlotError: a run without a scene of discs, another ending, no such folder, a length or rate that is not > 0.
            MissingExtraError: MP4 without ffmpeg.
        """
        return display("animate", self, path, **options)

    def view(self, path: str | Path | None = None, model: Any = None) -> Path:
        """Write one HTML file that shows the run, and return its path; without a path a temporary file, opened in the browser.

        Columns over time, index set, events, phase plane, configuration; zoomed and played in the browser. The file needs
        nothing else, and loads nothing.

        Args:
            path: of the file; its folder is made where it is missing.
            model: the run's. Of a sweeping process of one or two states the page shows the set that they may not enter; of
                an event-driven run the energy between its rows.

        Raises:
            StorageError: the file cannot be written.
            PlotError: the model is not that of the run, or has parameters without a value.
        """
        return display("write_run_page", self, path, model)

    def summary(self) -> dict[str, Any]:
        """Return the run in short as numbers, strings, lists and dictionaries; None for what does not apply."""
        return summary.run_summary(self)

    def summary_text(self, *, messages: bool = True) -> str:
        """Return the run in short as a table of at most 100 columns; ``messages=False`` leaves out warnings and errors."""
        found = summary.run_summary(self)
        return escape_invisible(summary.summary_text(found if messages else found | {"warnings": [], "message": ""}))

    def __repr__(self) -> str:
        """Return one line: title, class, steps, times, status."""
        kind, span = self.metadata.get("model_class", "model"), f"t = {self.t[0]:.6g} to {self.t[-1]:.6g}"
        return f"Trajectory({self.title!r}, {kind}, {len(self)} steps, {span}, {self.status})"


@cached_per_object
def _events_of(run: Trajectory) -> tuple[dense_output.Event, ...]:
    return dense_output.find_mode_changes(run.arrays)
