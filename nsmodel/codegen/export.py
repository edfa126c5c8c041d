"""The files around the C library: Makefile, example, description, README."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from nsmodel._utils import INVISIBLE_CHARACTERS
from nsmodel.codegen.features import describe_left_out, describe_used
from nsmodel.codegen.fragments import read_fragment
from nsmodel.codegen.source import LibrarySource, array_names
from nsmodel.codegen.step_spec import StepSpec
from nsmodel.modeling.fingerprint import versions
from nsmodel.modeling.parts import Part
from nsmodel.modeling.time_grid import WHOLE_STEPS, TimeGrid
from nsmodel.proof.verdict import not_none

STEPS_IN_EXAMPLE = 100_000  # A longer list of steps is not written into the example: some 2 MB of source.
MAX_SEGMENTS = 10_000  # Nor more stretches of steps between edges of inputs,
BEND_TOLERANCE = 1e-9  # which go on where an input bends by less than this part of its size: rounding of its values.
HEADER_WIDTH = 100  # Characters of the table's header in a line of the example, short enough to be read,
MAX_STRING_LENGTH = 900  # and of one name: C99 asks for strings of 4095 bytes, escapes counted.


WORST_CASE_NEEDS = "worst_case (--worst-case) needs matrices that are numbers (none that move, parameters given with --set)"


class LibraryRequest(NamedTuple):
    """What is asked of a library beside its model: see `write`; ``fingerprint`` is that of the model."""

    fingerprint: str
    tolerance: float
    max_work: int
    event_driven: bool
    worst_case: bool


LibraryFiles: TypeAlias = Callable[[Any, str, TimeGrid, LibraryRequest], tuple[dict[str, str], dict[str, Any]]]
LIBRARY_FILES = Part[LibraryFiles]("step_library.library_files")  # Of a class whose steps are not those of a one-step problem.


def step_library_files(spec: StepSpec, source: LibrarySource, grid: TimeGrid, fingerprint: str) -> dict[str, str]:
    """Return every file of the library by name."""
    name, left_out = source.name, {"LEFT_OUT"} if describe_left_out(source.flags) else set()
    return {
        f"{name}.h": source.header,
        f"{name}.c": source.code,
        "example_main.c": _example_main(spec, source, grid),
        "Makefile": read_fragment("Makefile", frozenset(), {"NAME": name}),
        f"{name}.json": json.dumps(library_description(spec, source, fingerprint), indent=2) + "\n",
        "README.md": read_fragment("README.md", source.flags | left_out, readme_replacements(spec, source)),
    }


def library_description(spec: StepSpec, source: LibrarySource, fingerprint: str) -> dict:
    """What the library is, for programs."""
    model, problem, own = spec.model, spec.problem, spec.places.names(spec.model)
    sizes = "NX NSTATE NP NL N M".split() + ["NU"] * ("INPUTS" in source.flags) + ["NZ", "NW"] * ("BLOCKS" in source.flags)
    return {
        "name": source.name,
        "title": model.title,
        "model_class": type(model).__name__,
        "scheme": problem.scheme,
        "paper": model.paper,
        "sizes": {key: source.sizes[key] for key in sizes},
        "states": list(model.names),
        "parameters": spec.parameters,
        "inputs": own["u"],
        **({"blocks": {"memory": own["z"], "held": own["w"]}} if "BLOCKS" in source.flags else {}),
        "multipliers": list(problem.multiplier_names),
        "rows": list(problem.rows),
        "units": dict(model.units),
        "step": spec.h,
        "any_step": not {"ONE_STEP", "KNOWN_LENGTHS"} & source.flags,
        "lengths": list(spec.known_lengths) if "LENGTHS" in source.flags else [],
        "tolerance": spec.tolerance,
        "max_work": source.bound,
        "used": describe_used(source.flags, source.sizes),
        "left_out": describe_left_out(source.flags),
        "velocity": "VELOCITY" in source.flags,
        "force": "FORCE" in source.flags,
        "model_hash": fingerprint,
        "versions": versions(),
    }


def _example_main(spec: StepSpec, source: LibrarySource, grid: TimeGrid) -> str:
    model, first = spec.model, 1 if spec.model.tied_to_step else 0
    whole = grid.N if grid.steps is not None or grid.last == grid.h else grid.N - 1
    segments = _input_segments(grid, first, whole, list(spec.places.given)) if grid.drive is not None else []
    if segments:
        whole = first + sum(segment.steps for segment in segments)
    given = np.zeros(0) if grid.steps is None else grid.steps[:STEPS_IN_EXAMPLE]
    steps = given.tolist()
    many = "STRETCHES" if segments else "MANY_STEPS" if np.unique(given).size > 1 else ""
    flags = source.flags | {many}
    names = list(model.names or ())
    columns = ["t", *names]
    columns += [f"v_{name}" for name in names] if "VELOCITY" in flags else []
    columns += list(spec.problem.multiplier_names) if "LAW" in flags else []
    replacements = {
        "NAME": source.name,
        "WHOLE_STEPS": repr(WHOLE_STEPS),
        "VELOCITIES": ", velocities" if "VELOCITY" in flags else "",
        "MULTIPLIERS": ", multipliers" if "LAW" in flags else "",
        "STEPS": "\n".join("        " + ", ".join(map(repr, steps[i : i + 5])) + "," for i in range(0, len(steps), 5)),
        "STRETCHES": "\n".join(segment.until if "PULSES" in flags else str(segment) for segment in segments),
        "LAST": str(min(whole, len(steps)) if steps else whole),
        "FIRST": str(first),
        "COLUMNS": "\n".join(f'    fputs("{_c_string(line)}", stdout);' for line in _header_chunks(columns)),
    }
    return read_fragment("example_main.c", flags, replacements)


class _InputSegment(NamedTuple):
    """Steps of one length between two edges: the inputs (nu,) at its begin and end, with straight lines between them."""

    t: float
    t_end: float
    steps: int
    h: float
    begin: list[float]
    end: list[float]

    def __str__(self) -> str:
        """As an initialiser of C."""
        return self._initialiser(self.t, self.steps, self.h)

    @property
    def until(self) -> str:
        """The same without steps, where blocks place edges: the caller finds them on its way."""
        return self._initialiser(self.t, self.t_end)

    def _initialiser(self, *numbers: float) -> str:
        limits = [f"{{{', '.join(map(repr, values))}}}" for values in (self.begin, self.end) if values]
        return f"    {{{', '.join([*map(repr, numbers), *limits])}}},"


def _input_segments(grid: TimeGrid, first: int, last: int, given: list[int]) -> list[_InputSegment]:
    """Steps ``first`` up to ``last`` of a driven grid, at most MAX_SEGMENTS stretches, with the inputs that are given."""
    t = grid.between(first, last)
    begin, end = (limits[:, given] for limits in np.hsplit(not_none(grid.drive).limits(t, first), 2))
    h = np.array([grid.step(k) for k in range(first, last)])
    size = np.abs([begin, end]).max(axis=(0, 1), initial=0.0)
    slope = (end - begin) / h[:, None]
    bends = np.abs(np.diff(slope, axis=0)) * h[1:, None] > BEND_TOLERANCE * size
    goes_on = (h[1:] == h[:-1]) & (begin[1:] == end[:-1]).all(axis=1) & ~bends.any(axis=1)
    firsts = np.flatnonzero(np.append(True, ~goes_on))
    lasts = np.append(firsts[1:], last - first)
    return [
        _InputSegment(t[a].item(), t[b].item(), int(b - a), h[a].item(), begin[a].tolist(), end[b - 1].tolist())
        for a, b in zip(firsts[:MAX_SEGMENTS], lasts[:MAX_SEGMENTS], strict=True)
    ]


def _header_chunks(columns: list[str]) -> list[str]:
    """The header of the table in pieces that a C string may hold, names with CSV quotes where they need them."""
    pieces = [""]
    for column in columns:
        name = '"' + column.replace('"', '""') + '"' if set(column) & set(',"\r\n') else column
        for part in _text_chunks(name + ",", MAX_STRING_LENGTH):
            if len(pieces[-1]) + len(part) > HEADER_WIDTH:
                pieces.append("")
            pieces[-1] += part
    return [piece for piece in [*pieces[:-1], pieces[-1][:-1] + "\n"] if piece]


def _text_chunks(text: str, size: int) -> list[str]:
    return [text[i : i + size] for i in range(0, len(text), size)]


def _c_string(text: str) -> str:
    """Text between the quotes of a C string; no two ? beside each other, which may begin a trigraph."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").replace("??", "?\\?").replace("??", "?\\?")
    return INVISIBLE_CHARACTERS.sub(lambda match: "".join(f"\\{byte:03o}" for byte in match[0].encode()), escaped)


def readme_replacements(spec: StepSpec, source: LibrarySource) -> dict[str, str]:
    """The words of the README."""
    listed = array_names(spec)
    return {
        "NAME": source.name,
        "UPPER": source.name.upper(),
        "TITLE": " ".join(spec.model.title.split()) or source.name,
        "SCHEME": spec.problem.scheme,
        "STATES": listed["x"],
        "PARAMETERS": listed["p"],
        "INPUTS": listed["u"],
        "MEMORY": listed["z"] or "none",
        "HELD": listed["w"] or "none",
        "KNOWN": ", ".join(f"{h:g}" for h in spec.known_lengths if h),
        "LENGTHS": str(source.sizes["LENGTHS"]),
        "MULTIPLIERS": listed["multipliers"],
        "STEP": f"{spec.h:g}",
        "TOLERANCE": f"{spec.tolerance:g}",
        "BOUND": str(source.bound),
        "USED": "\n".join(f"- {line[0].upper()}{line[1:]}." for line in describe_used(source.flags, source.sizes)),
        "LEFT_OUT": "\n".join(f"- {line[0].upper()}{line[1:]}." for line in describe_left_out(source.flags)),
    }
