"""The data of a run: named arrays and metadata, what their columns are called, and in which units they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from nsmodel._utils import did_you_mean
from nsmodel.errors import StorageError, UsageError
from nsmodel.files.archive import LIST_PREFIXES
from nsmodel.modeling.base import Model
from nsmodel.modeling.parts import class_named
from nsmodel.solvers.contacts import Contacts

Contents = tuple[dict[str, np.ndarray], dict[str, Any]]  # The arrays and the metadata of a run.


class _Unread:
    """What is read into a run when it is first asked for, by whichever thread comes first."""

    def __init__(self, read: Callable[[], Contents]) -> None:
        self._read, self._lock = read, Lock()

    def put_into(self, attributes: dict[str, Any]) -> None:
        with self._lock:
            if "arrays" not in attributes:
                arrays, metadata = self._read()
                attributes |= {"metadata": metadata, "arrays": arrays}
                del attributes["_unread"]


@dataclass(frozen=True, repr=False, eq=False)
class RunData:
    """Holds the arrays and the metadata of a run; attributes find them by the names of the model."""

    arrays: dict[str, np.ndarray]
    metadata: dict[str, Any]

    def __getstate__(self) -> dict[str, Any]:
        """The arrays and the metadata, made where they were not asked for yet."""
        return {"arrays": self.arrays, "metadata": self.metadata}

    @property
    def t(self) -> np.ndarray:
        """The times (N+1,) of the rows."""
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
        """Newton iterations of the step that ended at each row (N+1,): 0 where none was made, as at the start."""
        return np.nan_to_num(self.arrays["newton"]) if "newton" in self.arrays else np.zeros(len(self.t))

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
        names = multiplier_names(self)
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

    def _get_array(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            known = self._attribute_names()
            raise AttributeError(
                f"this run has no '{name}'; it has {', '.join(known)}{did_you_mean(name, [*known, *dir(type(self))])}"
            )
        return self.arrays[name]

    def _attribute_names(self) -> list[str]:
        stems, names = self.metadata.get("stems", ()), self.metadata.get("state_names", ())
        known = multiplier_names(self) if "multipliers" in self.arrays else ()
        multipliers = [name.partition("[")[0] for i, name in enumerate(known) if name != f"l_{i}"]
        return list(dict.fromkeys([*stems, *names, *self.metadata.get("input_groups", ()), *self.arrays, *multipliers]))

    def __getattr__(self, name: str) -> np.ndarray:
        """Find a state by its symbol or name, an array by its own, or a multiplier."""
        if name in ("arrays", "metadata"):
            if (unread := vars(self).get("_unread")) is not None:
                unread.put_into(vars(self))
            if name in vars(self):
                return vars(self)[name]
        if name.startswith("__") or name in ("arrays", "metadata"):  # copy and pickle ask an instance before it has arrays.
            raise AttributeError(name)
        stems, names = self.metadata.get("stems", {}), self.metadata.get("state_names", ())
        if name in stems:
            at = stems[name]
            return self.x[:, at[0]] if len(at) == 1 else self.x[:, at]
        if name in names:
            return self.x[:, list(names).index(name)]
        if name in (groups := self.metadata.get("input_groups", {})):
            at = [list(input_names(self)).index(one) for one in groups[name]]
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


R = TypeVar("R", bound=RunData)


def deferred_run(kind: type[R], read: Callable[[], Contents]) -> R:
    """A run whose arrays and metadata are made by ``read`` when one of them is first asked for."""
    run = kind.__new__(kind)
    vars(run)["_unread"] = _Unread(read)
    return run


def model_type(run: RunData) -> type[Model]:
    """Return the class of the run's model; what all share where it is not known here."""
    return class_named(run.metadata.get("model_class")) or Model


def state_names(run: RunData) -> list[str]:
    """Return one name for each column of ``run.x``."""
    return _names_or_numbered(run.metadata.get("state_names"), "x", run.x.shape[1])


def multiplier_names(run: RunData) -> list[str]:
    """Return one name for each column of ``run.multipliers``; none where the run has no multipliers."""
    width = run.multipliers.shape[1] if "multipliers" in run.arrays else 0
    return _names_or_numbered(run.metadata.get("multiplier_names"), "l", width)


def input_names(run: RunData) -> list[str]:
    """Return one name for each column of ``run.inputs``; none where the run has no inputs."""
    return list(run.metadata.get("input_names", ()))


def output_names(run: RunData) -> dict[str, list[str]]:
    """Return {name of an output: names of its columns}, in the order in which they were declared."""
    sizes = {name: text["size"] for name, text in run.metadata.get("outputs", {}).items() if name in run.arrays}
    return {name: [name] if size == 1 else [f"{name}_{i}" for i in range(size)] for name, size in sizes.items()}


def units_of(run: RunData) -> dict[str, str]:
    """Return {name: unit} as declared, with the unit of a symbol or group handed on to each of its members."""
    units, names = dict(run.metadata.get("units", {})), state_names(run)
    for stem, members in run.metadata.get("stems", {}).items():
        if stem in units:
            units |= {names[i]: units.get(names[i], units[stem]) for i in members}
    for stem, entries in run.metadata.get("input_groups", {}).items():
        units |= {name: units.get(name, units[stem]) for name in entries if stem in units}
    for name in multiplier_names(run):
        if (group := name.split("[")[0]) in units:
            units.setdefault(name, units[group])
    return units


def extrapolated_rows(run: RunData) -> np.ndarray:
    """Return, for each row (N+1,), whether error control has moved its state off what its step gave."""
    return run.arrays.get("correction", np.zeros(len(run.t))) > 0


def _names_or_numbered(given: Sequence[str] | None, stem: str, width: int) -> list[str]:
    return list(given) if given is not None and len(given) == width else [f"{stem}_{i}" for i in range(width)]


CONTACT_AXES = {  # What metadata["axes"] names: of each axis the arrays that have a column for each entry.
    "contact": ("u_N", "gap", "acting", "missed", "penetration", "impulse_work"), "slip": ("u_T",),
}  # fmt: skip
# What the arrays of a run must be: {name: (kinds of number, axes)}.
_ARRAY_TYPES = {
    **dict.fromkeys(("t",), ("if", 1)),
    **dict.fromkeys(("x", "halving"), ("if", 2)),
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


def check_run_arrays(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, Any], path: str | Path) -> None:
    """Raise StorageError for arrays that are not those of one run, of one number of rows."""
    needed = ["t", "x"]
    for kind, names in _REQUIRED_TOGETHER.items():
        needed += names if any(name.startswith(kind) for name in arrays) else []
    for name in needed:
        if name not in arrays:
            raise StorageError(f"{path} holds no array '{name}': it is not a trajectory; give a run's own npz file")
    t = arrays["t"]
    if t.ndim != 1 or not len(t) or t.dtype.kind == "b" or not np.isfinite(t).all() or (np.diff(t) < 0).any():
        raise StorageError(f"{path}: array 't' is not a list of increasing finite times: it is not a trajectory")
    lengths = {"": len(t)}
    for name, array in arrays.items():
        kind = next((start for start in LIST_PREFIXES if name.startswith(start)), "")
        length, (kinds, axes) = len(array) if array.ndim else -1, _ARRAY_TYPES.get(name, ("bif", max(array.ndim, 1)))
        expected = lengths.setdefault(kind, length)
        if array.dtype.kind not in kinds:
            raise StorageError(
                f"{path}: array '{name}' is of type {array.dtype}; expected {_KIND_NAMES[kinds]}: it is not a trajectory"
            )
        if array.ndim != axes or length != expected:
            of = f"{axes} axes, the first of {expected} {'entries' if kind else 'rows'}"
            raise StorageError(f"{path}: array '{name}' has shape {array.shape}; expected {of}: it is not a trajectory")
    for name, first, last in (("piece_start", -np.inf, t[0]), ("contact_row", 0, len(t) - 1)):
        values = arrays.get(name, np.zeros(0))
        ends = (values[:1] >= first).all() and (values[:1] <= last).all() and (values[-1:] <= max(last, t[-1])).all()
        if not (ends and np.isfinite(values).all() and (np.diff(values) >= 0).all()):
            raise StorageError(f"{path}: array '{name}' is not of this run, or not in order: it is not a trajectory")
    columns = {"x": max((i for stem in metadata.get("stems", {}).values() for i in stem), default=-1) + 1}
    columns["halving"], columns["inputs"] = arrays["x"].shape[1], len(metadata.get("input_names", ()))
    for name, members in metadata.get("input_groups", {}).items():
        if set(members) - set(metadata.get("input_names", ())):
            raise StorageError(f"{path}: input_groups['{name}'] is {members}; expected some of {metadata.get('input_names', [])}")
    for name, least in columns.items():
        if name in arrays and arrays[name].shape[1] < least:
            raise StorageError(f"{path}: array '{name}' has shape {arrays[name].shape}; its names ask for {least} columns")
    for axis, names in metadata.get("axes", {}).items():
        if axis not in CONTACT_AXES:
            raise StorageError(f"{path}: axes names '{axis}'; expected some of {list(CONTACT_AXES)}")
        for name in CONTACT_AXES[axis]:
            if name in arrays and arrays[name].size != len(t) * len(names):
                raise StorageError(
                    f"{path}: array '{name}' has shape {arrays[name].shape}; axes['{axis}'] names {len(names)} columns"
                )
