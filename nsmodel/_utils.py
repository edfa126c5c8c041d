"""Names of a module that are imported at their first use, and names that it had.

What follows from a model alone is computed once: models, and problems made of them, do not change.

What is near where a name is none.

Packages that not everybody needs, imported when something asks for them.

What a notebook asks of results: their HTML, and whether there is one at all.

Text of the user's as it may be shown: titles and names may carry what moves a cursor or turns the direction of reading.

What an object is, in ten lines at most: the ``repr`` of what would print all of its arrays and expressions.

What is taken where the user says nothing.

How much memory this process may take.

A sum of floats whose bits do not depend on the Python.
"""

from __future__ import annotations

import builtins
import contextlib
import difflib
import inspect
import os
import re
import sys
import textwrap
import weakref
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import wraps
from importlib import import_module
from math import isfinite
from pathlib import Path
from threading import Lock
from types import ModuleType
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from nsmodel.errors import MissingExtraError

T = TypeVar("T", bound=Callable[..., Any])


def lazy_attributes(package: str, names: Mapping[str, Sequence[str]]) -> None:
    """Let a package have names that are taken from its modules at their first use.

    A name may be that of a module too, as with the function ``simulate`` of the module ``simulate``: the function has it.

    Args:
        package: its ``__name__``.
        names: {module: names that are taken from it}.
    """
    module_of = {name: module for module, listed in names.items() for name in listed}

    class LazyPackage(ModuleType):
        def __getattr__(self, name: str) -> Any:
            if name not in module_of:
                raise AttributeError(f"module {package!r} has no attribute {name!r}{did_you_mean(name, dir(self))}")
            value = vars(self)[name] = getattr(import_module(module_of[name]), name)
            return value

        def __setattr__(self, name: str, value: Any) -> None:
            if not (name in module_of and isinstance(value, ModuleType)):  # the import of a module puts it into its package
                super().__setattr__(name, value)

        def __dir__(self) -> list[str]:
            return sorted({*vars(self), *module_of})

    sys.modules[package].__class__ = LazyPackage


NAMES_ELSEWHERE = {"to_dataframe": "to_pandas", "to_df": "to_pandas", "dataframe": "to_pandas", "animate": "film"}  # Of the same.


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A question with what is near among the names that there are, as the end of a message; "" where nothing is."""
    listed = [str(one) for one in known]
    same = NAMES_ELSEWHERE.get(str(name))
    near = [same] if same in listed else difflib.get_close_matches(str(name), listed, 1, 0.5)
    return f". Did you mean '{near[0]}'?" if near else ""


def check_keywords(what: str, given: Iterable[str], known: Collection[str]) -> None:
    """Refuse a keyword argument that is none.

    Raises:
        TypeError: with the name that is near.
    """
    for name in given:
        if name not in known:
            raise TypeError(f"{what}() got an unexpected keyword argument {name!r}{did_you_mean(name, known)}")


def checks_keywords(function: T) -> T:
    """The function, which answers a keyword argument that it does not have by what is near."""
    known = inspect.signature(function).parameters

    @wraps(function)
    def checked(*positional: Any, **given: Any) -> Any:
        check_keywords(function.__name__, given, known)
        return function(*positional, **given)

    return checked  # pyrefly: ignore[bad-return]


def former_names(module: str, **names: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a module for names that it had: pickles of earlier versions find what they name.

    Args:
        module: its ``__name__``.
        names: {former name: name}.
    """

    def __getattr__(name: str) -> Any:
        if name in names:
            return getattr(sys.modules[module], names[name])
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return __getattr__


def cached_per_object(function: T) -> T:
    """The function of an object that does not change, computed once for each object and forgotten with it.

    What it returns is shared: it must not be changed, nor hold on to the object.
    """
    known: dict[int, tuple[weakref.ref[Any], Any]] = {}

    @wraps(function)
    def cached(made: Any) -> Any:
        at = id(made)
        if at not in known or known[at][0]() is not made:
            value = function(made)
            known[at] = weakref.ref(made, lambda _: known.pop(at, None)), value
        return known[at][1]

    return cached  # pyrefly: ignore[bad-return]


def remember(cache: dict[Any, Any], key: Any, make: Callable[[], Any], most: int) -> Any:
    """Return what is kept under a key, made where it is not there; where there are ``most`` the oldest is forgotten."""
    if key not in cache:
        if len(cache) >= most:
            cache.pop(next(iter(cache)))
        cache[key] = make()
    return cache[key]


def cached_per_object_and_key(most: int) -> Callable[[T], T]:
    """As `cached_per_object`, of an object and a key that can be hashed: the last ``most`` keys are kept for each object."""

    def decorate(function: T) -> T:
        @cached_per_object
        def known(made: Any) -> dict[Any, Any]:
            del made
            return {}

        lock, missing = Lock(), object()

        @wraps(function)
        def cached(made: Any, key: Any) -> Any:
            own = known(made)
            value = own.get(key, missing)
            if value is missing:
                value = function(made, key)
                with lock:
                    remember(own, key, lambda: value, most)
            return value

        return cached  # pyrefly: ignore[bad-return]

    return decorate


def import_extra(package: str) -> Any:
    """Return the package, which has an extra of its name; MissingExtraError where it is not installed."""
    try:
        return import_module(package)
    except ImportError as error:
        raise MissingExtraError(f"{package} is not installed; pip install 'nsmodel[{package}]'") from error


def display(name: str, *arguments: Any, **options: Any) -> Any:
    """Return what a function of `nsmodel.plot.displays` makes of a result; results import no pictures otherwise."""
    return getattr(import_module("nsmodel.plot.displays"), name)(*arguments, **options)


def html_repr(name: str) -> Callable[[Any], str]:
    """The ``_repr_html_`` of a class: the display of this name."""

    def _repr_html_(self: Any) -> str:
        """Return it as HTML, for notebooks."""
        return display(name, self)

    return _repr_html_


def has_live_display() -> bool:
    """Whether somebody sees what is written over itself on standard error: at a terminal, or in a notebook."""
    return sys.stderr.isatty() or in_notebook()


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


# Control characters, ends of lines, marks of direction, characters of no width (but the joiners that scripts need).
INVISIBLE_CHARACTERS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u2069\ufeff]")


def one_line(text: str) -> str:
    """The text with a blank for each character that is not seen.

    >>> one_line("a" + chr(27) + "[31m" + chr(0x202E) + "b")
    'a [31m b'
    """
    return INVISIBLE_CHARACTERS.sub(" ", text)


def escape_invisible(text: str) -> str:
    r"""The text with an escape for each character that is not seen; lines and tabs stay.

    >>> escape_invisible("a" + chr(27) + "[31m" + chr(0x202E) + "b")
    'a\\x1b[31m\\u202eb'
    """
    return INVISIBLE_CHARACTERS.sub(
        lambda match: match[0] if match[0] in "\n\t" else match[0].encode("unicode_escape").decode(), text
    )


def print_escaped(*parts: Any, **options: Any) -> None:
    """``print``, of what may be shown."""
    builtins.print(*(escape_invisible(str(part)) for part in parts), **options)


# Columns of what is printed: reprs, summaries, tables; one width, so that they align with each other, and fit pages.
TEXT_WIDTH = 100
REPR_LINES = 10  # Lines of a repr, at most: several fit on a screen.
MAX_ENTRIES = 4  # Entries of a list, and of a dictionary, that are shown: with 20 letters each they fit into a line.
MAX_ARRAY_NUMBERS = 6  # Numbers of an array that are shown; of more its shape.
MAX_VALUE_LENGTH = 60  # Characters of one value that is shown: it fits into a line behind its name.


def short_repr(self: Any) -> str:
    """Return class and fields, those left out that are None or empty: at most ten lines of 100 columns.

    Long values are cut, arrays and matrices given by their shape.

    >>> from types import SimpleNamespace
    >>> made = SimpleNamespace(name="wall", at=np.zeros((300, 2)), over=None)
    >>> short_repr(made)
    "SimpleNamespace(name='wall', at=array 300 x 2)"
    """
    parts = [
        f"{name}={describe_shortly(value)}"
        for name, value in _repr_fields(self)
        if not (value is None or (isinstance(value, str | tuple | list | Mapping) and not value))
    ]
    return "\n".join(wrap_lines(f"{type(self).__name__}({', '.join(parts)})"))


def describe_shortly(value: Any) -> str:
    """A value in at most 60 characters."""
    if isinstance(value, str):
        return repr(truncate_text(value, MAX_VALUE_LENGTH - 2))
    if isinstance(value, bool | int) or value is None:
        return truncate_text(str(value))
    if isinstance(value, float | np.number):
        return f"{value:.6g}"
    if isinstance(value, ca.SX | ca.MX | ca.DM):
        return _describe_expression(value)
    if isinstance(value, np.ndarray):
        return _describe_array(value)
    if isinstance(value, Mapping):
        return truncate_text(
            f"{{{_first_entries((f'{key}: {describe_shortly(one)}' for key, one in value.items()), len(value))}}}"
        )
    if isinstance(value, tuple | list):
        return truncate_text(f"({_first_entries(map(describe_shortly, value), len(value))})")
    if callable(value) and hasattr(value, "__name__"):
        return truncate_text(value.__name__)
    return truncate_text(repr(value))


def truncate_text(text: str, width: int = MAX_VALUE_LENGTH) -> str:
    """The text on one line, its end left out where it is longer."""
    text = " ".join(one_line(text).split())
    return text if len(text) <= width else f"{text[: width - 4].rstrip()} ..."


def join_within_width(items: Iterable[str], width: int = TEXT_WIDTH) -> str:
    """Items with commas, as many as have room, and how many more there are.

    >>> join_within_width(["one", "two", "three", "four"], 16)
    'one, ... 3 more'
    """
    items = list(items)
    room, kept = width - len(f", ... {len(items)} more"), 0
    if len(", ".join(items)) <= width:
        return ", ".join(items)
    while kept < len(items) and len(", ".join(items[: kept + 1])) <= room:
        kept += 1
    return (
        ", ".join([*items[:kept], f"... {len(items) - kept} more"]) if kept or len(items) > 1 else truncate_text(items[0], width)
    )


def align_columns(rows: Sequence[Sequence[str]], side: Callable[[str, int], str] = str.rjust) -> list[str]:
    """Rows of words as lines, each column as wide as its longest word; ``side``: ``str.rjust`` or ``str.ljust``.

    >>> align_columns([("x", "name"), ("10", "y")])
    [' x  name', '10     y']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(side, row, widths)).rstrip() for row in rows]


def labelled_lines(label: str, text: str, width: int = 16) -> list[str]:
    """A text in lines of 100 columns behind a label, which has a column of so many letters."""
    return textwrap.wrap(text, TEXT_WIDTH, initial_indent=f"  {label:{width}}", subsequent_indent=" " * (width + 2))


def wrap_lines(text: str) -> list[str]:
    """The text in lines of 100 columns, ten at most."""
    lines = textwrap.wrap(text, TEXT_WIDTH, subsequent_indent="    ", break_on_hyphens=False)
    return lines if len(lines) <= REPR_LINES else [*lines[: REPR_LINES - 1], "    ..."]


def _repr_fields(made: Any) -> list[tuple[str, Any]]:
    if is_dataclass(made):
        return [(field.name, getattr(made, field.name)) for field in fields(made) if field.repr]
    if hasattr(made, "_asdict"):
        return list(made._asdict().items())
    return list(getattr(made, "made_of", vars(made)).items())


def _describe_expression(value: Any) -> str:
    """One expression as it stands; of a matrix its shape, where it does not fit."""
    text = str(value)
    return (
        text
        if len(text) <= MAX_VALUE_LENGTH
        else truncate_text(text)
        if value.numel() == 1
        else f"{type(value).__name__} {_format_shape(value.shape)}"
    )


def _describe_array(value: np.ndarray) -> str:
    if (value.ndim > 1 and value.size > 1) or value.size > MAX_ARRAY_NUMBERS:
        return f"array {_format_shape(value.shape)}"
    return f"[{', '.join(map(describe_shortly, value.ravel().tolist()))}]"


def _format_shape(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _first_entries(items: Iterable[str], count: int) -> str:
    kept = [item for item, _ in zip(items, range(MAX_ENTRIES), strict=False)]
    return ", ".join([*kept, *([f"... {count} in all"] if count > MAX_ENTRIES else [])])


def format_number(value: float) -> str:
    """A number with six digits, zero without a sign."""
    return f"{value + 0.0:.6g}" if isfinite(value) else str(value)


EPS = sys.float_info.epsilon  # 2^-52, relative: from 1 to the next double; an operation is rounded by half of it, at most.
# The largest residual of a step that is accepted, relative: far below what steps err by, far above rounding.
DEFAULT_TOLERANCE = 1e-9
MIN_TOLERANCE = 1e-14  # Below it, 45 EPS, there is rounding alone.


_CGROUP_LIMIT_FILE = Path("/sys/fs/cgroup/memory.max")  # Of a container, on Linux.


def usable_memory() -> int | None:
    """Bytes of memory of this machine, or of the container; None where the system does not say."""
    found = []
    with contextlib.suppress(OSError, ValueError):
        found.append(int(_CGROUP_LIMIT_FILE.read_text(encoding="ascii")))
    if sys.platform == "win32":
        with contextlib.suppress(OSError, AttributeError):
            found.append(_windows_memory())
    else:
        with contextlib.suppress(OSError, ValueError):
            found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min((one for one in found if one > 0), default=None)


def _windows_memory() -> int:
    import ctypes

    class MemoryStatus(ctypes.Structure):
        _fields_ = [("length", ctypes.c_ulong), ("load", ctypes.c_ulong), *((f"of_{i}", ctypes.c_ulonglong) for i in range(7))]

    status = MemoryStatus(length=ctypes.sizeof(MemoryStatus))
    ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status))  # pyrefly: ignore[missing-attribute]
    return int(status.of_0)


def format_bytes(size: float) -> str:
    """A number of bytes, such as "8.1 GB"."""
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            return f"{size:,.0f} {unit}" if unit == "bytes" or size >= 100 else f"{size:.2g} {unit}"
        size /= 1000
    raise AssertionError


def sum_in_order(numbers: Iterable[float], start: float = 0) -> float:
    """Return start + number + number + ..., each addition rounded.

    From Python 3.12 on ``sum`` carries the rounding errors of floats along: answers made with it would differ in their last bits
    from those of Python 3.11, and of the C, whose order of operations is this one.
    """
    total = start
    for number in numbers:
        total += number
    return total
