"""C step functions: ``write`` a model's step as a self-contained C99 library, ``load`` it in Python."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nsmodel._utils import DEFAULT_TOLERANCE
from nsmodel.codegen import event_driven_source
from nsmodel.codegen.constant_steps import step_matrices
from nsmodel.codegen.export import LIBRARY_FILES, WORST_CASE_NEEDS, LibraryRequest, library_description, step_library_files
from nsmodel.codegen.features import MAX_COUNT
from nsmodel.codegen.library import Library, Solver, is_library, load
from nsmodel.codegen.source import LibrarySource, write_source
from nsmodel.codegen.step_spec import make_step_spec
from nsmodel.errors import CodegenError, UsageError
from nsmodel.files.storage import write_text
from nsmodel.modeling.base import Model
from nsmodel.modeling.fingerprint import fingerprint
from nsmodel.modeling.parameters import Values
from nsmodel.modeling.time_grid import TimeGrid, check_times, check_tolerance, format_value, make_grid
from nsmodel.modeling.variants import with_inputs
from nsmodel.proof.verdict import not_none
from nsmodel.solvers.structure import MAX_STEP_SIZES

__all__ = ["Library", "Solver", "Written", "identifier", "load", "write"]

# Of a law all of whose index sets have their inverses beforehand: 3^4 = 81 of them, as many as are tried one by one.
MAX_WORST_CASE_ROWS = 4

# No prefix: keywords, the standard headers (NAME.h would hide them), the example.
_RESERVED = frozenset(
    "auto break case char const continue default do double else enum extern float for goto if inline int long register restrict "
    "return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "assert complex ctype errno fenv inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef stdint stdio stdlib "
    "string tgmath time wchar wctype example_main".split()
)


class Written(NamedTuple):
    """What ``write`` has written: the folder, the files in it, and the library."""

    folder: Path
    files: list[str]
    about: dict[str, Any]

    def text(self) -> str:
        """The library for a person."""
        about, name = self.about, self.about["name"]
        source = sum((self.folder / f"{name}.{end}").stat().st_size for end in "hc")
        lines = [f"{about['title'] or name}: {name}.h and {name}.c, {source / 1000:.1f} kB of C99, in {self.folder}"]
        sections = {
            "scheme": [about["scheme"]],
            "used": about["used"],
            "left out": about["left_out"],
            "step": [
                ", ".join(f"{h:g}" for h in about.get("lengths") or [about["step"]] if h)
                + (", or any other" if about["any_step"] else " only (--any-step for others)")
            ],
            "inputs": [", ".join(about["inputs"])] if about.get("inputs") else [],
            "blocks": [f"{what}: {', '.join(names)}" for what, names in about.get("blocks", {}).items() if names],
            "parameters": [", ".join(f"{key} = {value:g}" for key, value in about["parameters"].items()) or "none to set"],
            "work": [
                f"{about['max_work']} linear systems, index sets and sweeps in a step at most"
                if about["max_work"] < MAX_COUNT
                else "no bound of practical use (--max-work sets one)"
            ],
            "memory": [f"{about['memory'] / 1e6:.3g} MB to work in; a jam that needs more is refused"]
            if "memory" in about
            else [],
            "build and run": [f"make -C {self.folder} run"],
        }
        for head, texts in sections.items():
            lines += [f"  {head if i == 0 else '':15} {text}" for i, text in enumerate(texts)]
        return "\n".join(lines)


def write(
    model: Model,
    out: str | os.PathLike[str],
    *,
    name: str | None = None,
    step: float | Sequence[float] | None = None,
    any_step: bool = False,
    parameters: Values | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
    max_work: int | None = None,
    worst_case: bool = False,
    event_driven: bool = False,
) -> Written:
    """Write a model's verified step as a C library into the folder ``out``.

    Args:
        model: any of the classes.
        out: the folder; the files of a library of this name are replaced.
        name: prefix of all names in C; left out: made from the model's title.
        step: time step of the code, or up to 8 lengths of steps; left out: the model's, between the edges of its signals. The
            matrices of a linear scene are numbers for one length; of several they are formed when a solver is initialised.
        any_step: let a linear scene take any step; its matrices are formed when the first step of a length is taken.
        parameters: values that become numbers in the code; the model's other parameters can be set in C.
        tolerance: largest accepted residual (relative, without unit).
        max_work: most work of a step (linear systems solved, index sets tried, sweeps), beyond which it is NOT_SOLVED; left out:
            what all methods in turn may do.
        worst_case: form the inverses of all index sets of a law of at most 4 rows when a solver is initialised, so that a step
            solves no linear system: its time is bounded by a few products of matrices and vectors.
        event_driven: write NAME_pieces.h and NAME_pieces.c too, whose ``NAME_advance(s, t_end)`` goes from switch to switch.

    Raises:
        CodegenError: the model has no C counterpart; nothing is written.
        UsageError: a wrong argument, or a folder with files that are not this library's; nothing is written.
        StorageError: the folder cannot be written.
    """
    most = _max_work(model, tolerance, max_work, event_driven=event_driven)
    name = identifier(model.title or type(model).__name__) if name is None else _check_name(name)
    bound = model.bind(parameters)
    lengths = _step_lengths(step)
    grid = _step_grid(bound, lengths, any_step=any_step)
    mark = fingerprint(bound, grid)
    if library_files := LIBRARY_FILES.optional(bound):
        request = LibraryRequest(mark, float(tolerance), most, event_driven, worst_case)
        files, about = library_files(bound, name, grid, request)
    else:
        spec = make_step_spec(model, parameters, grid, float(tolerance), lengths)
        spec = replace(spec, worst_case=worst_case, ticking=bool(bound.blocks))
        if grid.drive is not None and grid.drive.moving:
            if worst_case:
                raise CodegenError(f"{WORST_CASE_NEEDS} and steps of known lengths; a block places edges of a pwm")
            spec = replace(spec, h=not_none(grid.requested_step), lengths=lengths[1:])
        source = write_source(spec, name, mark, most)
        if worst_case and not _solves_no_system(source):
            raise CodegenError(
                f"{WORST_CASE_NEEDS} and a law of at most {MAX_WORST_CASE_ROWS} rows, none of them of a curved set"
            )
        if {"RESTARTED", "FIXED"} <= source.flags and step_matrices(spec.problem, 0.0) is None:
            raise CodegenError(
                "after a jump of an input the reaction is found by a step of length 0, whose matrix is singular: take gamma=1"
            )
        files, about = step_library_files(spec, source, grid, mark), library_description(spec, source, mark)
        if event_driven:
            files |= event_driven_source.piece_library_files(spec.model, spec.parameters, name)
    folder = _check_folder(Path(out), name, files)
    for file, text in files.items():
        write_text(folder / file, text.rstrip())
    return Written(folder, list(files), about)


def _max_work(model: Model, tolerance: float, max_work: int | None, *, event_driven: bool) -> int:
    """The most work of a step; what does not go together is refused."""
    check_tolerance(tolerance)
    if not (max_work is None or (isinstance(max_work, int) and not isinstance(max_work, bool) and 1 <= max_work <= MAX_COUNT)):
        raise UsageError(f"max_work = {format_value(max_work)}; expected a whole number from 1 to {MAX_COUNT}")
    if model.blocks and event_driven:
        listed = ", ".join(block.name for block in model.blocks)
        raise CodegenError(
            f"event-driven integration in C does not take blocks ({listed}): write the model with what they set as inputs, and "
            "let the caller's loop tick"
        )
    return MAX_COUNT if max_work is None else max_work


def _solves_no_system(source: LibrarySource) -> bool:
    """Whether steps need no linear system that is not formed before."""
    has = source.flags
    return "FIXED" in has and ("LAW" not in has or ("WORST_CASE" in has and source.sizes["M"] <= MAX_WORST_CASE_ROWS))


def _step_lengths(step: float | Sequence[float] | None) -> tuple[float, ...]:
    """The lengths of steps that are given."""
    given: list[Any] = [] if step is None else list(step) if np.iterable(step) else [step]
    for length in given:
        check_times(step=length)
    if step is not None and not 1 <= len(given) <= MAX_STEP_SIZES:
        raise UsageError(f"step: {len(given)} lengths; expected 1 to {MAX_STEP_SIZES}")
    return tuple(map(float, given))


def _step_grid(model: Model, lengths: tuple[float, ...], *, any_step: bool) -> TimeGrid:
    """The grid of the model's own run, which ends steps where its signals jump, and at ticks, whatever the caller gives."""
    if model.blocks:
        model = with_inputs(
            model, {name: np.zeros(len(model.input_groups[name])) for name in model.inputs if model.inputs[name] is None}
        )
    driven = bool(model.inputs) and None not in model.inputs.values()
    step = lengths[0] if lengths else model.step
    t_end = step if step is not None and model.steps is None and step > model.t_end else None  # A library has no end.
    grid = make_grid(model, lengths[0] if lengths else None, None, t_end, driven=driven)
    return replace(grid, any_step=any_step or grid.any_step or len(set(lengths)) > 1)


def identifier(text: str) -> str:
    """A prefix for C made from a title or a file's name."""
    name = re.sub(r"\W+", "_", text.lower(), flags=re.ASCII).strip("_")
    name = f"model_{name}" if not name or name[0].isdigit() or name in _RESERVED else name
    return name[:40].rstrip("_")


def _check_name(name: str) -> str:
    if not (isinstance(name, str) and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,62}", name)) or name.lower() in _RESERVED:
        raise UsageError(
            f"name = {name!r}; expected up to 63 letters, digits and _, beginning with a letter, no keyword or header of C: "
            "it prefixes all names in C"
        )
    return name


def _check_folder(folder: Path, name: str, files: Iterable[str]) -> Path:
    """The folder, if it has none of the files, or those of a library of this name."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; expected a folder for the library")
    existing = [file for file in files if (folder / file).exists()]
    if existing and not is_library(folder / f"{name}.json"):
        raise UsageError(
            f"{folder} has {', '.join(existing)} already, which {'is' if len(existing) == 1 else 'are'} not of a library "
            f"'{name}'; name another folder"
        )
    return folder
