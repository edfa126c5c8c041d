"""The result of a run: named arrays, one row a time, and metadata that JSON can hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel._utils import escape_invisible, html_repr
from nsmodel.errors import StorageError, UsageError
from nsmodel.event_driven import dense_output
from nsmodel.files.archive import LIST_PREFIXES, read_archive, write_npz
from nsmodel.files.metadata import RUN_FIELDS, check_field_types
from nsmodel.files.storage import write_csv
from nsmodel.modeling import columns
from nsmodel.modeling.columns import expression_at_rows, resampled_outputs
from nsmodel.simulation import summary, windows
from nsmodel.solvers.contacts import Contacts


@dataclass(frozen=True, repr=False, eq=False)
class Trajectory:
    """A run of N steps; row 0 of every array is the start, where multipliers, outputs and residual are NaN.

    ``arrays`` is {name: array of N+1 rows}, among them t (N+1,) and x (N+1, n); ``metadata`` holds title, model class,
    names, units, parameters, scheme, solver counts, warnings, status, ... ``len(run)`` is N.

    A run of many bodies has x = NaN where a body is not there, gap_min (N+1,) the least of all constraints, pressure
    (N+1, bodies) the sum of the reactions on each body, and lists of all K contacts, row after row: ``contact_row (K,)``,
    ``contact_family``, ``contact_first``, ``contact_second``, ``contact_reaction``; ``contacts`` gives those of a row.

    The state is also an attribute under the user's own symbols (``run.q``, (N+1, k); (N+1,) for a scalar symbol), each
    state under its name, each further array under its own (``run.energy``), and each multiplier that the model names
    (``run.friction``); AttributeError lists what there is.
    """

    arrays: dict[str, np.ndarray]
    metadata: dict[str, Any]

    _repr_html_ = html_repr("run")

    @property
    def t(self) -> np.ndarray:
        """Times (N+1,)."""
        return self._get_array("t")

    @property
    def x(self) -> np.ndarray:
        """States (N+1, n)."""
        return self._get_array("x")

    @property
    def multipliers(self) -> np.ndarray:
        """Multipliers l (N+1, m)."""
        return self._get_array("multipliers")

    @property
    def y(self) -> np.ndarray:
        """Outputs y of the law (N+1, m)."""
        return self._get_array("y")

    @property
    def index_set(self) -> np.ndarray:
        """Codes (N+1, m') int8: 0 where y_i = 0, -1 and +1 where l_i is at its lower and upper end, -2 at the start."""
        return self._get_array("index_set")

    @property
    def residual(self) -> np.ndarray:
        """Residual of each step without unit (N+1,); inf where it is unknown."""
        return self._get_array("residual")

    @property
    def step(self) -> np.ndarray:
        """Length of the step that ended at each row (N+1,)."""
        return self._get_array("step")

    @property
    def inputs(self) -> np.ndarray:
        """Inputs (N+1, nu) at the end of the step that ends at each row, u(t-); at the start u(0+).

        ``inputs_begin`` are those at its begin, just after the row before. Each is also found under its own name.
        """
        return self._get_array("inputs")

    @property
    def newton(self) -> np.ndarray:
        """Newton iterations of each step (N+1,): 0 where its equations are affine, NaN at the start."""
        return self.arrays["newton"] if "newton" in self.arrays else np.where(np.isfinite(self.step), 0.0, np.nan)

    @property
    def active(self) -> np.ndarray:
        """True where y_i = 0: contact, stick, sliding (N+1, m')."""
        return self.index_set == 0

    @property
    def is_event_driven(self) -> bool:
        """Whether the rows are read off the polynomials of pieces."""
        return "piece_start" in self.arrays

    @property
    def status(self) -> str:
        """How the run ended."""
        return self.metadata.get("status", "unknown")

    @property
    def title(self) -> str:
        """The model's title."""
        return self.metadata.get("title") or "untitled"

    def multiplier(self, name: str) -> np.ndarray:
        """Return the multiplier called ``name`` (N+1,), or all k called ``name[...]`` (N+1, k); else UsageError."""
        names = columns.multiplier_names(self)
        if name in names:
            return self.multipliers[:, names.index(name)]
        entries = [i for i, full in enumerate(names) if full.startswith(f"{name}[")]
        if not entries:
            raise UsageError(f"no multiplier is called '{name}'; this run has {', '.join(names) or 'none'}")
        return self.multipliers[:, entries]

    def contacts(self, row: int) -> Contacts:
        """Return the contacts that acted in the step that ended at a row, sorted by family and members.

        ``family`` counts in ``metadata["families"]``. UsageError for another model's run, or a row that is not there.
        """
        if "contact_row" not in self.arrays:
            raise UsageError("this run has no contacts: they belong to a model of many bodies (ManyBodies)")
        if not -len(self.t) <= row < len(self.t):
            raise UsageError(f"row {row}: the run has the rows 0 to {len(self.t) - 1}")
        row = range(len(self.t))[row]
        at = slice(*np.searchsorted(self.arrays["contact_row"], [row, row + 1]))
        return Contacts(*(self.arrays[f"contact_{name}"][at] for name in Contacts._fields))

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
            UsageError: a time that is no number or outside the run.
        """
        times = dense_output.as_times(t)
        outside = times[~((times >= self.t[0]) & (times <= self.t[-1]))]
        if outside.size:
            raise UsageError(f"t = {outside[0]:.10g}: the run goes from {self.t[0]:.10g} to {self.t[-1]:.10g}")
        whole = self.is_event_driven and len(self.arrays["piece_start"]) > 0
        return dense_output.evaluate_pieces(self.arrays, times) if whole else dense_output.interpolate_rows(self.arrays, times)

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
        return expression_at_rows(self, given, units)

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
        return replace(drawn, arrays=drawn.arrays | resampled_outputs(drawn, self.arrays))

    @property
    def events(self) -> tuple[dense_output.Event, ...]:
        """The switches of an event-driven run, in order; UsageError for a run by time stepping, which has none but its rows'."""
        if not self.is_event_driven:
            raise UsageError("events are found by event-driven runs: give rtol; of time steps see run.index_set")
        return dense_output.find_mode_changes(self.arrays)

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
        _check_run_arrays(arrays, archive.metadata, path)
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
        from nsmodel.plot.figures import overview

        return overview(self, **options)

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
        from nsmodel.view.run import view_run

        return view_run(self, path, model)

    def summary(self) -> dict[str, Any]:
        """Return the run in short as numbers, strings, lists and dictionaries; None for what does not apply."""
        return summary.run_summary(self)

    def summary_text(self, *, messages: bool = True) -> str:
        """Return the run in short as a table of at most 100 columns; ``messages=False`` leaves out warnings and errors."""
        found = summary.run_summary(self)
        return escape_invisible(summary.summary_text(found if messages else found | {"warnings": [], "message": ""}))

    def _get_array(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            raise AttributeError(f"this run has no '{name}'; it has {', '.join(self._attribute_names())}")
        return self.arrays[name]

    def _attribute_names(self) -> list[str]:
        stems, names = self.metadata.get("stems", ()), self.metadata.get("state_names", ())
        known = columns.multiplier_names(self) if "multipliers" in self.arrays else ()
        multipliers = [name.partition("[")[0] for i, name in enumerate(known) if name != f"l_{i}"]
        return list(dict.fromkeys([*stems, *names, *self.metadata.get("input_groups", ()), *self.arrays, *multipliers]))

    def __getattr__(self, name: str) -> np.ndarray:
        """Find a state by its symbol or name, an array by its own, or a multiplier."""
        # copy and pickle ask an empty instance for dunder names before it has arrays.
        if name.startswith("__") or name in ("arrays", "metadata"):
            raise AttributeError(name)
        stems, names = self.metadata.get("stems", {}), self.metadata.get("state_names", ())
        if name in stems:
            at = stems[name]
            return self.x[:, at[0]] if len(at) == 1 else self.x[:, at]
        if name in names:
            return self.x[:, list(names).index(name)]
        if name in (groups := self.metadata.get("input_groups", {})):
            at = [list(columns.input_names(self)).index(one) for one in groups[name]]
            return self.inputs[:, at[0]] if len(at) == 1 else self.inputs[:, at]
        if name not in self.arrays and name in self._attribute_names():
            return self.multiplier(name)
        return self._get_array(name)

    def __dir__(self) -> list[str]:
        """List the states and arrays among the attributes."""
        return sorted({*super().__dir__(), *self._attribute_names()})

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.t) - 1

    def __repr__(self) -> str:
        """Return one line: title, class, steps, times, status."""
        kind, span = self.metadata.get("model_class", "model"), f"t = {self.t[0]:.6g} to {self.t[-1]:.6g}"
        return f"Trajectory({self.title!r}, {kind}, {len(self)} steps, {span}, {self.status})"


# What the arrays of a run must be: {name: (kinds of number, axes)}.
_ARRAY_TYPES = {
    **dict.fromkeys(("t",), ("if", 1)),
    **dict.fromkeys(("x",), ("if", 2)),
    **dict.fromkeys("residual step newton energy gap_min predictor_distance correction error tolerance".split(), ("if", 1)),
    **dict.fromkeys("multipliers y v gap reactions selection defect inputs inputs_begin pressure".split(), ("f", 2)),
    **dict.fromkeys("piece_start piece_unit piece_event_width contact_reaction".split(), ("f", 1)),
    **dict.fromkeys("piece_impulse piece_jump piece_defect".split(), ("f", 2)),
    **dict.fromkeys("piece_x piece_multipliers piece_y".split(), ("f", 3)),
    **dict.fromkeys("contact_row contact_family contact_first contact_second".split(), ("i", 1)),
    **dict.fromkeys("index_set piece_codes".split(), ("i", 2)),
    **dict.fromkeys("piece_event piece_stepped piece_proved stepped".split(), ("b", 1)),
}
_KIND_NAMES = {"if": "numbers", "bif": "numbers", "f": "floating-point numbers", "i": "whole numbers", "b": "booleans"}
_REQUIRED_TOGETHER = {  # And which go with lists of each kind, see LIST.
    "piece_": "piece_start piece_unit piece_x piece_multipliers piece_y piece_codes piece_event piece_impulse".split(),
    "contact_": ["contact_row", "pressure", "gap_min", *(f"contact_{name}" for name in Contacts._fields)],
}


def _check_run_arrays(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, Any], path: str | Path) -> None:
    """Raise StorageError for arrays that are not those of one run, of one number of rows."""
    needed = ["t", "x"]
    for kind, names in _REQUIRED_TOGETHER.items():
        needed += names if any(name.startswith(kind) for name in arrays) else []
    for name in needed:
        if name not in arrays:
            raise StorageError(f"{path} holds no array '{name}': it is no trajectory; give a run's own npz file")
    t = arrays["t"]
    if t.ndim != 1 or not len(t) or t.dtype.kind == "b" or not np.isfinite(t).all() or (np.diff(t) < 0).any():
        raise StorageError(f"{path}: array 't' is no list of finite times, one after the other: it is no trajectory")
    lengths = {"": len(t)}
    for name, array in arrays.items():
        kind = next((start for start in LIST_PREFIXES if name.startswith(start)), "")
        length, (kinds, axes) = len(array) if array.ndim else -1, _ARRAY_TYPES.get(name, ("bif", max(array.ndim, 1)))
        expected = lengths.setdefault(kind, length)
        if array.dtype.kind not in kinds:
            raise StorageError(
                f"{path}: array '{name}' is of type {array.dtype}; expected {_KIND_NAMES[kinds]}: it is no trajectory"
            )
        if array.ndim != axes or length != expected:
            of = f"{axes} axes, the first of {expected} {'entries' if kind else 'rows'}"
            raise StorageError(f"{path}: array '{name}' has shape {array.shape}; expected {of}: it is no trajectory")
    for name, first, last in (("piece_start", -np.inf, t[0]), ("contact_row", 0, len(t) - 1)):
        values = arrays.get(name, np.zeros(0))
        ends = (values[:1] >= first).all() and (values[:1] <= last).all() and (values[-1:] <= max(last, t[-1])).all()
        if not (ends and np.isfinite(values).all() and (np.diff(values) >= 0).all()):
            raise StorageError(f"{path}: array '{name}' is not of this run, or not in order: it is no trajectory")
    columns = {"x": max((i for stem in metadata.get("stems", {}).values() for i in stem), default=-1) + 1}
    columns["inputs"] = len(metadata.get("input_names", ()))
    for name, members in metadata.get("input_groups", {}).items():
        if set(members) - set(metadata.get("input_names", ())):
            raise StorageError(f"{path}: input_groups['{name}'] is {members}; expected some of {metadata.get('input_names', [])}")
    for name, least in columns.items():
        if name in arrays and arrays[name].shape[1] < least:
            raise StorageError(f"{path}: array '{name}' has shape {arrays[name].shape}; its names ask for {least} columns")
