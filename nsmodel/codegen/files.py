"""The files around the C library: Makefile, example, description, README."""

from __future__ import annotations

import json
from collections.abc import Set
from typing import NamedTuple

import numpy as np

from nsmodel.codegen.about import left_out, used
from nsmodel.codegen.fragments import fragment
from nsmodel.codegen.scene import Scene
from nsmodel.codegen.source import Source, names
from nsmodel.grid import Grid
from nsmodel.identity import versions
from nsmodel.proof.sure import sure
from nsmodel.words import UNSEEN

STEPS_IN_EXAMPLE = 100_000  # A longer list of steps is not written into the example.
STRETCHES = 10_000  # Nor more stretches of steps between edges of inputs,
STRAIGHT = 1e-9  # which go on where an input bends by less than this part of its size.
WIDTH = 100  # Characters of the table's header in a line of the example,
LONGEST_STRING = 900  # and of one name: C99 asks for strings of 4095 bytes, escapes counted.


def all_files(scene: Scene, source: Source, grid: Grid, fingerprint: str) -> dict[str, str]:
    """Return every file of the library by name."""
    name = source.name
    return {
        f"{name}.h": source.header,
        f"{name}.c": source.code,
        "example_main.c": _example(scene, source, grid),
        "Makefile": fragment("Makefile", frozenset(), {"NAME": name}),
        f"{name}.json": json.dumps(description(scene, source, fingerprint), indent=2) + "\n",
        "README.md": _readme(scene, source),
    }


def description(scene: Scene, source: Source, fingerprint: str) -> dict:
    """What the library is, for programs."""
    model, problem, own = scene.model, scene.problem, scene.places.names(scene.model)
    return {
        "name": source.name,
        "title": model.title,
        "model_class": type(model).__name__,
        "scheme": problem.scheme,
        "paper": model.paper,
        "sizes": {key: source.sizes[key] for key in "NX NSTATE NP NL N M".split() + _of_inputs(source.flags)},
        "states": list(model.names),
        "parameters": scene.parameters,
        "inputs": own["u"],
        **({"blocks": {"memory": own["z"], "held": own["w"]}} if "BLOCKS" in source.flags else {}),
        "multipliers": list(problem.multiplier_names),
        "rows": list(problem.rows),
        "units": dict(model.units),
        "step": scene.h,
        "any_step": not {"ONE_STEP", "KNOWN_LENGTHS"} & source.flags,
        "lengths": list(scene.known_lengths) if "LENGTHS" in source.flags else [],
        "tolerance": scene.tolerance,
        "max_work": source.bound,
        "used": used(source.flags, source.sizes),
        "left_out": left_out(source.flags),
        "velocity": "VELOCITY" in source.flags,
        "force": "FORCE" in source.flags,
        "model_hash": fingerprint,
        "versions": versions(),
    }


def _of_inputs(flags: Set[str]) -> list[str]:
    """The sizes that a model with inputs has."""
    return ["NU"] * ("INPUTS" in flags) + ["NZ", "NW"] * ("BLOCKS" in flags)


def _example(scene: Scene, source: Source, grid: Grid) -> str:
    model, first = scene.model, 1 if scene.model.tied_to_step else 0
    whole = grid.N if grid.steps is not None or grid.last == grid.h else grid.N - 1
    stretches = _stretches(grid, first, whole, list(scene.places.given)) if grid.drive is not None else []
    if stretches:
        whole = first + sum(stretch.steps for stretch in stretches)
    given = np.zeros(0) if grid.steps is None else grid.steps[:STEPS_IN_EXAMPLE]
    steps = given.tolist()
    many = "STRETCHES" if stretches else "MANY_STEPS" if np.unique(given).size > 1 else ""
    flags = source.flags | {many}
    names = list(model.names or ())
    columns = ["t", *names]
    columns += [f"v_{name}" for name in names] if "VELOCITY" in flags else []
    columns += list(scene.problem.multiplier_names) if "LAW" in flags else []
    words = {
        "NAME": source.name,
        "VELOCITIES": ", velocities" if "VELOCITY" in flags else "",
        "MULTIPLIERS": ", multipliers" if "LAW" in flags else "",
        "STEPS": "\n".join("        " + ", ".join(map(repr, steps[i : i + 5])) + "," for i in range(0, len(steps), 5)),
        "STRETCHES": "\n".join(stretch.until if "PULSES" in flags else str(stretch) for stretch in stretches),
        "LAST": str(min(whole, len(steps)) if steps else whole),
        "FIRST": str(first),
        "COLUMNS": "\n".join(f'    fputs("{_c_string(line)}", stdout);' for line in _lines(columns)),
    }
    return fragment("example_main.c", flags, words)


class _Stretch(NamedTuple):
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


def _stretches(grid: Grid, first: int, last: int, given: list[int]) -> list[_Stretch]:
    """Steps ``first`` up to ``last`` of a driven grid, at most STRETCHES stretches, with the inputs that are given."""
    t = grid.between(first, last)
    begin, end = (limits[:, given] for limits in np.hsplit(sure(grid.drive).limits(t, first), 2))
    h = np.array([grid.step(k) for k in range(first, last)])
    size = np.abs([begin, end]).max(axis=(0, 1), initial=0.0)
    slope = (end - begin) / h[:, None]
    bends = np.abs(np.diff(slope, axis=0)) * h[1:, None] > STRAIGHT * size
    goes_on = (h[1:] == h[:-1]) & (begin[1:] == end[:-1]).all(axis=1) & ~bends.any(axis=1)
    firsts = np.flatnonzero(np.append(True, ~goes_on))
    lasts = np.append(firsts[1:], last - first)
    return [
        _Stretch(t[a].item(), t[b].item(), int(b - a), h[a].item(), begin[a].tolist(), end[b - 1].tolist())
        for a, b in zip(firsts[:STRETCHES], lasts[:STRETCHES], strict=True)
    ]


def _lines(columns: list[str]) -> list[str]:
    """The header of the table in pieces that a C string may hold, names with CSV quotes where they need them."""
    pieces = [""]
    for column in columns:
        name = '"' + column.replace('"', '""') + '"' if set(column) & set(',"\r\n') else column
        for part in _cut(name + ",", LONGEST_STRING):
            if len(pieces[-1]) + len(part) > WIDTH:
                pieces.append("")
            pieces[-1] += part
    return [piece for piece in [*pieces[:-1], pieces[-1][:-1] + "\n"] if piece]


def _cut(text: str, size: int) -> list[str]:
    return [text[i : i + size] for i in range(0, len(text), size)]


def _c_string(text: str) -> str:
    """Text between the quotes of a C string; no two ? beside each other, which may begin a trigraph."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n").replace("??", "?\\?").replace("??", "?\\?")
    return UNSEEN.sub(lambda match: "".join(f"\\{byte:03o}" for byte in match[0].encode()), escaped)


def _readme(scene: Scene, source: Source) -> str:
    flags = source.flags | ({"LEFT_OUT"} if left_out(source.flags) else set())
    return fragment("README.md", flags, readme_words(scene, source))


def readme_words(scene: Scene, source: Source) -> dict[str, str]:
    """The words of the README."""
    listed = names(scene)
    return {
        "NAME": source.name,
        "UPPER": source.name.upper(),
        "TITLE": " ".join(scene.model.title.split()) or source.name,
        "SCHEME": scene.problem.scheme,
        "STATES": listed["x"],
        "PARAMETERS": listed["p"],
        "INPUTS": listed["u"],
        "MEMORY": listed["z"] or "none",
        "HELD": listed["w"] or "none",
        "KNOWN": ", ".join(f"{h:g}" for h in scene.known_lengths if h),
        "LENGTHS": str(source.sizes["LENGTHS"]),
        "MULTIPLIERS": listed["multipliers"],
        "STEP": f"{scene.h:g}",
        "TOLERANCE": f"{scene.tolerance:g}",
        "BOUND": str(source.bound),
        "USED": "\n".join(f"- {line[0].upper()}{line[1:]}." for line in used(source.flags, source.sizes)),
        "LEFT_OUT": "\n".join(f"- {line[0].upper()}{line[1:]}." for line in left_out(source.flags)),
    }
