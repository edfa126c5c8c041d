"""The result of a run: named arrays, one row a time, and metadata that JSON can hold."""

from __future__ import annotations

import textwrap
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from nsmodel.archive import LIST, read_npz, write_npz
from nsmodel.classes.registry import class_named
from nsmodel.contacts import Contacts
from nsmodel.errors import MissingExtraError, StorageError, UsageError
from nsmodel.model.base import Model
from nsmodel.storage import dumps, write_csv

_WIDTH = 100
_STATES_SHOWN = 8
_ARCH_SHOWN = 8
FOR_GOOD = {  # How a run of many bodies knows that nothing will ever change again.
    "given back": "nothing will ever change, the step gives back its state bit for bit; the run ends",
    "held": "nothing will ever change, the contacts alone hold them in place; the run ends",
}
CONTROL = ("rtol", "accepted", "rejected", "extrapolated", "at_least_step", "least_step")


@dataclass(frozen=True, repr=False, eq=False)
class Trajectory:
    """A run of N steps; row 0 of every array is the start, where multipliers, outputs and residual are NaN.

    ``arrays`` is {name: array of N+1 rows}, among them t (N+1,) and x (N+1, n); ``metadata`` holds title, model class,
    names, units, parameters, scheme, solver counts, warnings, status, ... ``len(run)`` is N.

    A run of many bodies has x = NaN where a body is not there, gap_min (N+1,) the least of all constraints, pressure
    (N+1, bodies) the sum of the reactions on each body, and lists of all K contacts, row after row: ``contact_row (K,)``,
    ``contact_family``, ``contact_first``, ``contact_second``, ``contact_reaction``; ``contacts`` gives those of a row.

    The state is also an attribute under the user's own symbols (``run.q``, (N+1, k); (N+1,) for a scalar symbol), each
    state under its name, and each further array under its own (``run.energy``); AttributeError lists what there is.
    """

    arrays: dict[str, np.ndarray]
    metadata: dict[str, Any]

    @property
    def t(self) -> np.ndarray:
        """Times (N+1,)."""
        return self._array("t")

    @property
    def x(self) -> np.ndarray:
        """States (N+1, n)."""
        return self._array("x")

    @property
    def multipliers(self) -> np.ndarray:
        """Multipliers l (N+1, m)."""
        return self._array("multipliers")

    @property
    def y(self) -> np.ndarray:
        """Outputs y of the law (N+1, m)."""
        return self._array("y")

    @property
    def index_set(self) -> np.ndarray:
        """Codes (N+1, m') int8: 0 where y_i = 0, -1 and +1 where l_i is at its lower and upper end, -2 at the start."""
        return self._array("index_set")

    @property
    def residual(self) -> np.ndarray:
        """Residual of each step without unit (N+1,); inf where it is unknown."""
        return self._array("residual")

    @property
    def step(self) -> np.ndarray:
        """Length of the step that ended at each row (N+1,)."""
        return self._array("step")

    @property
    def newton(self) -> np.ndarray:
        """Newton iterations of each step (N+1,): 0 where its equations are affine, NaN at the start."""
        return self.arrays["newton"] if "newton" in self.arrays else np.where(np.isfinite(self.step), 0.0, np.nan)

    @property
    def active(self) -> np.ndarray:
        """True where y_i = 0: contact, stick, sliding (N+1, m')."""
        return self.index_set == 0

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
        names = multiplier_names(self)
        if name in names:
            return self.multipliers[:, names.index(name)]
        columns = [i for i, full in enumerate(names) if full.startswith(f"{name}[")]
        if not columns:
            raise UsageError(f"no multiplier is called '{name}'; this run has {', '.join(names) or 'none'}")
        return self.multipliers[:, columns]

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

    def save(self, path: str | Path) -> None:
        """Write one npz file with all arrays and the metadata; StorageError where that fails."""
        write_npz(path, self.arrays, self.metadata)

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read what ``save`` wrote; StorageError for a missing, damaged or foreign file."""
        arrays, metadata = read_npz(path)
        missing = [name for name in ("t", "x") if name not in arrays]
        if missing:
            raise StorageError(f"{path} holds no array '{missing[0]}': it is no trajectory; give a run's own npz file")
        return cls(arrays, metadata)

    def to_csv(self, path: str | Path) -> None:
        """Write columns t, the states, ``multiplier:NAME``, ``y:NAME``, residual, each entry of the other arrays but lists."""
        write_csv(path, dict(_columns(self)))

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` along ``time``: a variable a state, other arrays whole, metadata as attributes.

        MissingExtraError where xarray is not installed.
        """
        return _dataset(self)

    def plot(self, **options: Any) -> Any:
        """Draw an overview of the run; the options are those of ``nsmodel.plot.overview``."""
        from nsmodel.plot import overview

        return overview(self, **options)

    def summary(self) -> dict[str, Any]:
        """Return the run in short as numbers, strings, lists and dictionaries; None for what does not apply."""
        return _summary(self)

    def summary_text(self, *, messages: bool = True) -> str:
        """Return the run in short as a table of at most 100 columns; ``messages=False`` leaves out warnings and errors."""
        summary = _summary(self)
        return _text(summary if messages else summary | {"warnings": [], "message": ""})

    def _array(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            raise AttributeError(f"this run has no '{name}'; it has {', '.join(self._found())}")
        return self.arrays[name]

    def _found(self) -> list[str]:
        stems, names = self.metadata.get("stems", ()), self.metadata.get("state_names", ())
        return list(dict.fromkeys([*stems, *names, *self.arrays]))

    def __getattr__(self, name: str) -> np.ndarray:
        """Find a state by its symbol or name, or an array by its own."""
        # copy and pickle ask an empty instance for dunder names before it has arrays.
        if name.startswith("__") or name in ("arrays", "metadata"):
            raise AttributeError(name)
        stems, names = self.metadata.get("stems", {}), self.metadata.get("state_names", ())
        if name in stems:
            columns = stems[name]
            return self.x[:, columns[0]] if len(columns) == 1 else self.x[:, columns]
        if name in names:
            return self.x[:, list(names).index(name)]
        return self._array(name)

    def __dir__(self) -> list[str]:
        """List the states and arrays among the attributes."""
        return sorted({*super().__dir__(), *self._found()})

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.t) - 1

    def __repr__(self) -> str:
        """Return one line: title, class, steps, times, status."""
        kind, span = self.metadata.get("model_class", "model"), f"t = {self.t[0]:.6g} to {self.t[-1]:.6g}"
        return f"Trajectory({self.title!r}, {kind}, {len(self)} steps, {span}, {self.status})"


def model_type(run: Trajectory) -> type[Model]:
    """Return the class of the run's model; what all share where it is not known here."""
    found = class_named(run.metadata.get("model_class"))
    return Model if found is None else found.type


def state_names(run: Trajectory) -> list[str]:
    """Return one name for each column of ``run.x``."""
    return _names(run.metadata.get("state_names"), "x", run.x.shape[1])


def multiplier_names(run: Trajectory) -> list[str]:
    """Return one name for each column of ``run.multipliers``; none where the run has no multipliers."""
    width = run.multipliers.shape[1] if "multipliers" in run.arrays else 0
    return _names(run.metadata.get("multiplier_names"), "l", width)


def units_of(run: Trajectory) -> dict[str, str]:
    """Return {name: unit} as declared, with the unit of a symbol or group handed on to each of its members."""
    units, names = dict(run.metadata.get("units", {})), state_names(run)
    for stem, columns in run.metadata.get("stems", {}).items():
        if stem in units:
            units |= {names[i]: units.get(names[i], units[stem]) for i in columns}
    for name in multiplier_names(run):
        if (group := name.split("[")[0]) in units:
            units.setdefault(name, units[group])
    return units


def extrapolated(run: Trajectory) -> np.ndarray:
    """Return, for each row (N+1,), whether error control has moved its state off what its step gave."""
    return run.arrays.get("correction", np.zeros(len(run.t))) > 0


def _names(given: Sequence[str] | None, stem: str, width: int) -> list[str]:
    return list(given) if given is not None and len(given) == width else [f"{stem}_{i}" for i in range(width)]


def _free(name: str, taken: Container[str], prefix: str) -> str:
    return f"{prefix}:{name}" if name in taken else name


def _columns(run: Trajectory) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (name, column) of the CSV file; no name comes twice."""
    multipliers = multiplier_names(run)
    named = {"x": state_names(run), "multipliers": [f"multiplier:{name}" for name in multipliers]}
    if "y" in run.arrays and run.y.shape[1:] == (len(multipliers),):
        named["y"] = [f"y:{name}" for name in multipliers]
    first = [name for name in ("t", "x", "multipliers", "y", "residual") if name in run.arrays]
    taken: set[str] = set()
    for name in dict.fromkeys([*first, *(name for name in run.arrays if not name.startswith(LIST))]):
        array = run.arrays[name]
        indices = np.ndindex(array.shape[1:])
        titles = named.get(name) or [name + "".join(f"_{i}" for i in index) for index in indices]
        for title, column in zip(titles, array.reshape(len(array), len(titles)).T, strict=True):
            yield (free := _free(title, taken, "array")), column
            taken.add(free)


def _dataset(run: Trajectory) -> Any:
    xarray = _extra("xarray")

    units = {name: {"units": unit} for name, unit in units_of(run).items()}
    names, data = multiplier_names(run), {}
    for name, column in zip(state_names(run), run.x.T, strict=True):
        data[_free(name, {*run.arrays, "time", "multiplier"}, "state")] = ("time", column, units.get(name))
    for name, array in run.arrays.items():
        if name not in ("t", "x"):
            shared = name in ("multipliers", "y") and array.shape[1:] == (len(names),)
            along = "contact" if name.startswith(LIST) else "time"
            rest = ["multiplier"] if shared else [f"{name}_dim_{axis}" for axis in range(1, array.ndim)]
            data[name] = ((along, *rest), array, units.get(name))
    coords = {"time": ("time", run.t, units.get("t")), **({"multiplier": names} if names else {})}
    # netCDF has no attribute that is true, None or nested.
    plain = {key: type(value) in (str, int, float) for key, value in run.metadata.items()}
    attrs = {key: value if plain[key] else dumps(value) for key, value in run.metadata.items()}
    return xarray.Dataset(data, coords, attrs)


def _extra(package: str) -> Any:
    try:
        return import_module(package)
    except ImportError as error:
        raise MissingExtraError(f"{package} is not installed; pip install 'nsmodel[{package}]'") from error


def _summary(run: Trajectory) -> dict[str, Any]:
    """The numbers of a run; those of all steps come from metadata["totals"] where it is, since rows may be a sample."""
    arrays, about, units = run.arrays, run.metadata, units_of(run)
    totals = about.get("totals") or {}
    steps = arrays.get("step", np.diff(run.t, prepend=np.nan))
    computed = np.flatnonzero(np.isfinite(steps))
    energy = arrays.get("energy", np.zeros(0))
    energy = _finite(energy) if energy.ndim == 1 else np.zeros(0)
    return {
        "title": run.title,
        "model_class": about.get("model_class"),
        "scheme": about.get("scheme"),
        "status": run.status,
        "message": about.get("message") or "",
        "steps": totals.get("steps", len(run)),
        "save_every": about.get("save_every", 1),
        "t": {"start": float(run.t[0]), "end": float(run.t[-1]), "unit": units.get("t", "")},
        "step": {"min": float(steps[computed].min()), "max": float(steps[computed].max())} if computed.size else None,
        "error_control": {key: totals[key] for key in CONTROL} if "rtol" in totals else None,
        "residual": _worst(run, totals, computed),
        "index_set_changes": _changes(run, totals, computed),
        "solver_counts": dict(about.get("solver_counts") or {}),
        "newton": _newton(run, totals, computed),
        **_smallest_gap(run),
        "bodies": _bodies(run, totals),
        "largest_error": totals.get("largest_error"),
        "energy": {"start": float(energy[0]), "end": float(energy[-1])} if energy.size else None,
        "convergence": about.get("convergence"),
        "final_state": []
        if "contact_row" in arrays
        else [
            {"name": name, "value": float(value), "unit": units.get(name, "")}
            for name, value in zip(state_names(run), run.x[-1], strict=True)
        ],
        "warnings": list(about.get("warnings") or []),
    }


def _worst(run: Trajectory, totals: dict[str, Any], computed: np.ndarray) -> dict[str, Any] | None:
    """The largest residual, its time and saved row; None where no step was computed."""
    if not computed.size or "residual" not in run.arrays:
        return None
    if "worst_residual" in totals:
        worst, t = totals["worst_residual"], totals.get("worst_residual_t")
        rows = np.flatnonzero(run.t == t) if t is not None else []
        return {"worst": worst, "t": t, "row": int(rows[0]) if len(rows) else None}
    # A residual that is not a number is as unknown as an infinite one.
    residual = np.nan_to_num(run.residual[computed], nan=np.inf, posinf=np.inf)
    row = int(computed[np.argmax(residual)])
    return {"worst": float(residual.max()), "t": float(run.t[row]), "row": row}


def _changes(run: Trajectory, totals: dict[str, Any], computed: np.ndarray) -> int | None:
    codes = run.arrays.get("index_set", np.zeros((0, 0)))
    if "contact_row" in run.arrays:
        return totals.get("index_set_changes")
    if not codes.size or not computed.size:
        return None
    codes = codes[computed]
    return totals.get("index_set_changes", int((codes[1:] != codes[:-1]).any(axis=1).sum()))


def _newton(run: Trajectory, totals: dict[str, Any], computed: np.ndarray) -> dict[str, Any] | None:
    if "newton" not in run.arrays or not computed.size:
        return None
    counts = sum((run.metadata.get("solver_counts") or {}).values())
    if "newton" in totals and counts:
        return {"mean": totals["newton"] / counts, "max": int(totals["newton_max"])}
    newton = run.arrays["newton"][computed]
    return {"mean": float(newton.mean()), "max": int(newton.max())}


def _smallest_gap(run: Trajectory) -> dict[str, Any]:
    """The smallest gap of the saved rows, the constraint and the time, where the class has gaps."""
    gap = run.arrays.get("gap", run.arrays.get("y", np.zeros((0, 0))))
    if not model_type(run).gaps or not np.isfinite(gap).any():
        return {"gap_min": None, "gap_min_name": None, "gap_min_t": None}
    row, column = np.unravel_index(np.nanargmin(gap), gap.shape)
    names = multiplier_names(run)
    name = names[column] if len(names) == gap.shape[1] else str(column)
    return {"gap_min": float(gap[row, column]), "gap_min_name": name, "gap_min_t": float(run.t[row])}


def _bodies(run: Trajectory, totals: dict[str, Any]) -> dict[str, Any] | None:
    """Many bodies in short: who is there, what touches at the end, the least gap and the largest pressure of all steps."""
    if "contact_row" not in run.arrays:
        return None
    keys = ("least_gap", "least_gap_t", "largest_pressure", "largest_pressure_t", "largest_pressure_body", "most_contacts")
    touching = run.contacts(-1)
    pressed = int(np.count_nonzero(np.nan_to_num(run.arrays["pressure"][-1]) > 0))
    found = {"contacts": len(touching.first), "in_contact": pressed, **{key: totals.get(key) for key in keys}}
    return {**run.metadata.get("bodies", {}), **found}


def _finite(array: np.ndarray) -> np.ndarray:
    return array[np.isfinite(array)]


def _text(summary: dict[str, Any]) -> str:
    s, t, changes = summary, summary["t"], summary["index_set_changes"]
    unit = f" {t['unit']}" if t["unit"] else ""
    counts = sorted(s["solver_counts"].items(), key=lambda item: (-item[1], item[0]))
    # Adding 0 turns -0 into 0.
    shown = [(one["name"], f"{one['value'] + 0.0: .6g} {one['unit']}") for one in s["final_state"]]
    if len(shown) > _STATES_SHOWN:
        shown = [*shown[: _STATES_SHOWN - 2], (f"... {len(shown) - _STATES_SHOWN + 1} more", ""), shown[-1]]
    sample = "" if s["save_every"] == 1 else f" (1 row saved of {s['save_every']})"
    lines: dict[str, str | list[str] | None] = {
        "model class": s["model_class"],
        "scheme": s["scheme"] and str(s["scheme"]),
        "status": s["message"] if s["message"].startswith(s["status"]) else ": ".join(filter(None, (s["status"], s["message"]))),
        "steps": f"{s['steps']}{sample}, t = {t['start']:.6g} to {t['end']:.6g}{unit}",
        "step size": s["step"] and _range(s["step"]["min"], s["step"]["max"], unit),
        "error control": s["error_control"] and _control(**s["error_control"]),
        "worst residual": s["residual"] and f"{s['residual']['worst']:.3g}{_at(s['residual']['t'], unit)}",
        "contacts" if s["bodies"] else "index set": (
            None if changes is None else f"changed at {changes} step{'' if changes == 1 else 's'}"
        ),
        "solver calls": _aligned([(name, f"{int(count):>8d}") for name, count in counts]),
        "newton": s["newton"] and _iterations(s["newton"]["mean"], s["newton"]["max"]),
        "smallest gap": _gap(s["gap_min"], s["gap_min_name"], s["gap_min_t"], unit),
        **_bodies_lines(s["bodies"], unit),
        "largest error": None if s["largest_error"] is None else f"{s['largest_error']:.3g} from the exact state",
        "energy": s["energy"] and f"{s['energy']['start']:.6g} at the start, {s['energy']['end']:.6g} at the end",
        "convergence": s["convergence"] and _convergence(s["convergence"], unit),
        "final state": _aligned(shown),
        "warnings": s["warnings"],
    }
    table = textwrap.wrap(s["title"], _WIDTH)
    width = max(map(len, lines)) + 4
    for label, texts in lines.items():
        for i, line in enumerate([texts] if isinstance(texts, str) else texts or []):
            first, rest = f"  {label if i == 0 else '':{width - 2}}", " " * (width + 2)
            table += textwrap.wrap(line, _WIDTH, initial_indent=first, subsequent_indent=rest)
    return "\n".join(table)


def _bodies_lines(bodies: dict[str, Any] | None, unit: str) -> dict[str, str | list[str]]:
    """Many bodies as lines of the table."""
    if not bodies:
        return {}
    b, gap = bodies, bodies["least_gap"]
    lines: dict[str, str | list[str]] = {
        "bodies": f"{b['count']}: {b['there']} there at the end, {b['left']} left"
        + (f", {b['waiting']} waiting" if b["waiting"] else ""),
        "in contact": f"{b['in_contact']} bodies, {b['contacts']} contacts at the end; at most {b['most_contacts']} contacts",
    }
    if b.get("empty_at") is not None:
        lines["end"] = f"empty at t = {b['empty_at']:.6g}{unit}"
    if b.get("standstill"):
        lines["standstill"] = _standstill(b["standstill"], unit)
    if gap is not None and np.isfinite(gap):
        lines["least gap"] = f"{gap:.6g}{_at(b['least_gap_t'], unit)}"
    if b["largest_pressure_t"] is not None:
        at = _at(b["largest_pressure_t"], unit)
        lines["pressure"] = f"at most {b['largest_pressure']:.6g}, on body {b['largest_pressure_body']}{at}"
    return lines


def _standstill(found: dict[str, Any], unit: str) -> list[str]:
    """Since when nobody has moved, whether for good, and who holds whom."""
    end = FOR_GOOD.get(found["for_good"], "nobody has moved by more than rounding since")
    lines = [f"from t = {found['since']:.6g}{unit} on, {found['bodies']} bodies: {end}"]
    for arch in found["arches"]:
        places = [f"{body} at ({', '.join(f'{v:.4g}' for v in at)})" for body, at in zip(arch["bodies"], arch["at"], strict=True)]
        more = [f"{len(places) - _ARCH_SHOWN} more"] if len(places) > _ARCH_SHOWN else []
        where = "" if arch["exit"] is None else f"before exit '{arch['exit']}' "
        ends = " and ".join(f"'{name}'" for name in arch["ends"])
        lines.append(
            f"{where}{arch['pressed']} bodies stand behind {', '.join(places[:_ARCH_SHOWN] + more)}; ends: {ends or 'none'}"
        )
    return lines


def _control(rtol: float, accepted: int, rejected: int, extrapolated: int, at_least_step: int, least_step: float) -> str:
    tail = f"; {at_least_step} at the least step, whatever their error" if at_least_step else ""
    return f"rtol {rtol:g}: {accepted} steps accepted, {extrapolated} of them extrapolated, {rejected} refused{tail}"


def _at(t: float | None, unit: str) -> str:
    return "" if t is None else f" at t = {t:.6g}{unit}"


def _gap(value: float | None, name: str, t: float, unit: str) -> str | None:
    return None if value is None else f"{value:.6g} of '{name}'{_at(t, unit)}"


def _iterations(mean: float, most: int) -> str:
    if mean == most:
        return f"{most} iteration{'s' if most > 1 else ''} at every step"
    return f"{mean:.3g} iterations a step, at most {most}"


def _aligned(pairs: Sequence[tuple[str, str]]) -> list[str]:
    width = min(max((len(name) for name, _ in pairs), default=0), 40)
    return [f"{name:{width}}  {value}".rstrip() for name, value in pairs]


def _range(low: float, high: float, unit: str) -> str:
    same = high - low <= 1e-9 * abs(high)
    return f"{high:.6g}{unit}" if same else f"{low:.6g} to {high:.6g}{unit}"


def _convergence(found: dict[str, Any], unit: str) -> list[str]:
    head = "not shown to be finite"
    if found.get("finite"):
        head = f"in finite time: at rest from t = {found['t_0']:.6g}{unit} on, step {found['n_0']}"
    labels = {"theta_prime_0": "theta'(0)", "distance": "d(0, dg(x))", "margin": "margin"}
    numbers = ", ".join(f"{label} = {found[key]:.6g}" for key, label in labels.items() if found.get(key) is not None)
    return [line for line in (head, found.get("reason"), numbers) if line]
