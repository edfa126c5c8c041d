"""What Python and C both know stands once: constants and structs."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest

from nsmodel import load
from nsmodel.codegen import fragments, structs
from nsmodel.codegen.fragments import C_FOLDER, prefix_names
from nsmodel.codegen.source import write_source
from nsmodel.codegen.step_spec import make_step_spec
from nsmodel.modeling.laws import LAW_C_FOLDER as LAWS
from nsmodel.modeling.time_grid import make_grid
from nsmodel.models.many_bodies import step_library
from nsmodel.models.many_bodies.step_library import BODIES_CONSTANTS

FRAGMENTS = {path.name: path.read_text(encoding="utf-8") for path in (*C_FOLDER.glob("*.[ch]"), *LAWS.glob("*.c"))}
OF_BODIES = {"block_ldl.c", "group.c", "bodies.c"}
LITERAL = re.compile(r"(?<![\w.])(?:0x[0-9a-fA-F]+|(?:\d+\.\d*|\.\d+|\d+)(?:[eE][-+]?\d+)?)[uUlL]*(?!\w)")
ALLOWED = {"0", "1", "2", "0.0", "1.0", "2.0", "0.5"}
OTHERS = {  # by file, with the reason
    "adaptive.c": {"4": "a step of twice the length begins where both halves of two steps end"},
    "affine.c": {"3": "codes of a row: 0, -1, 1"},
    "block_ldl.c": {"3": "tiles of 4 x 4, written out", "4": "the same", "3.0": "the sum of squares up to n is n^3/3"},
    "bodies.c": {"3": "dimensions of a grid of cells", "3.0": "so many cells below the first one no neighbour is in one"},
    "bodies_main.c": {"10": "decimal"},
    "coulomb.c": {"3": "rows of a contact in space", "4": "a matrix of 2 x 2", "9": "a matrix of 3 x 3", "10": "decades"},
    "curved.c": {
        "3": "choices of a contact",
        "4": "two starts, twice each",
        "5": "five starts, by their places",
        "10": "decades",
    },
    "example_main.c": {"10": "decimal"},
    "guard.c": {"1e-25": "lost beside 1"},
    "pieces_api.c": {"3": "four times side by side, written out", "4": "the same"},
    "pieces_expand.c": {"3": "four times side by side, written out"},
    "pieces_roots.c": {"4": "half of an interval twice, and part of a coefficient"},
    "pieces_tangents.c": {"3": "rows are as long as a multiple of four numbers", "4": "the same"},
    "rounding.c": {"13": "shifts of the hash", "15": "the same", "16": "the same", "0xFFFFFFFFUL": "32 bits"},
}


def code_of(text: str) -> str:
    """C without comments, strings and includes."""
    text = re.sub(r"/\*.*?\*/", " ", text, flags=re.DOTALL)
    return re.sub(r'"(?:\\.|[^"\\\n])*"|^#include.*$', " ", text, flags=re.MULTILINE)


@pytest.mark.parametrize("name", sorted(FRAGMENTS))
def test_a_number_in_c_has_a_name(name):
    """It stands in the table of `constants`, or, where only the C has it, in a #define."""
    lines = [line for line in code_of(FRAGMENTS[name]).splitlines() if not re.match(r"#define \w+ ", line)]
    found = {literal for line in lines for literal in LITERAL.findall(line)} - ALLOWED
    assert found == set(OTHERS.get(name, ()))


@pytest.mark.parametrize("name", sorted(FRAGMENTS))
def test_a_number_that_the_c_alone_has_is_none_of_python(name):
    own = re.findall(r"^#define (\w+) \S*\d", FRAGMENTS[name], re.MULTILINE)
    tables = [BODIES_CONSTANTS] if name in OF_BODIES else [fragments.STEP_CONSTANTS, fragments.PIECE_CONSTANTS]
    modules = dict.fromkeys(module for table in tables for module, _ in table)
    assert [(key, module) for key in own for module in modules if hasattr(import_module(f"nsmodel.{module}"), key)] == []


@pytest.mark.parametrize(
    ("table", "files"),
    [
        (fragments.STEP_CONSTANTS, FRAGMENTS.keys() - OF_BODIES),
        (fragments.PIECE_CONSTANTS, FRAGMENTS.keys() - OF_BODIES),
        (BODIES_CONSTANTS, OF_BODIES | {"bodies_api.c"}),
    ],
    ids=["steps", "pieces", "bodies"],
)
def test_the_c_has_the_constants_of_python(table, files):
    used = set(re.findall(r"\w+", " ".join(code_of(FRAGMENTS[name]) for name in files)))
    for module, names in table:
        for constant in names.split():
            name, _, in_c = constant.partition(":")
            line = fragments.define_line(module, constant)
            define, same, text = line.split()[:3]
            assert (define, same, line.count("\n")) == ("#define", in_c or name, 1)
            assert float(text.removesuffix("UL")) == getattr(import_module(f"nsmodel.{module}"), name)
            assert line.count("/*") == line.count("*/") == 1, f"{module}.{name} needs a comment"
            assert (in_c or name) in used


def layout(program: str, prefix: str, folder: Path, structure: structs.CStruct, **sizes: int) -> tuple[list[int], list[int]]:
    """Size and offsets in C, where ``program`` has the struct, and in Python."""
    own = structure.ctypes_structure(**sizes)
    name = prefix_names(structure.name, prefix)
    asked = [f"sizeof({name})", *(f"offsetof({name}, {field})" for field, _ in own._fields_)]
    prints = "\n".join(f'    printf("%zu\\n", {text});' for text in asked)
    headers = "#include <stddef.h>\n#include <stdio.h>\n"
    (folder / "main.c").write_text(f"{headers}{program}\nint main(void)\n{{\n{prints}\n    return 0;\n}}\n")
    subprocess.run(["gcc", "-std=gnu99", "-o", "main", "main.c", "-lm"], cwd=folder, check=True)
    in_c = subprocess.run(["./main"], cwd=folder, check=True, capture_output=True, text=True).stdout.split()
    return [int(number) for number in in_c], [ctypes.sizeof(own), *(getattr(own, field).offset for field, _ in own._fields_)]


needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")


@needs_gcc
@pytest.mark.parametrize("case", ["diode_bridge", "friction_oscillator"])
def test_the_structs_of_a_run_are_those_of_the_c(case, tmp_path):
    source = source_of(load(case))
    for name, text in {"step.h": source.header, "step.c": source.code, "rollout.c": source.rollout}.items():
        (tmp_path / name).write_text(text)
    watched = (2 if "VELOCITY" in source.flags else 1) * source.sizes["NX"]
    sizes = {"STATES": source.sizes["NSTATE"], "ROWS": max(source.sizes["M"], 1), "WATCHED": watched}
    for structure in (structs.STEP_TOTALS, structs.ADAPTIVE_CONTROL):
        in_c, in_python = layout('#include "rollout.c"', "step", tmp_path, structure, **sizes)
        assert in_c == in_python


@needs_gcc
@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_structs_of_many_bodies_are_those_of_the_c(d, tmp_path):
    for structure in (structs.BODIES_MOTION, structs.TIMED_BODIES_REPORT):
        in_c, in_python = layout(step_library.solver_source(d), "model", tmp_path, structure)
        assert in_c == in_python


def source_of(model):
    grid = replace(make_grid(model.bind(None), None, None, None), any_step=True)
    return write_source(make_step_spec(model, None, grid, 1e-9), "step", "")
