"""The C library of every case file: compiled as strictly as can be, run for the whole case, beside the Python stepper."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import optimised
from fuzz_models import COUNT, FULL

from nsmodel import ManyBodies, codegen, simulate
from nsmodel.modeling.time_grid import make_grid

STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
OPTIMISED = ("diode_bridge", "friction_oscillator", "gene_network", "inclusion_8_1", "two_discs", "two_masses")
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
SANITIZED = ["diode_bridge", "friction_chain", "gene_network", "two_discs", "inclusion_8_2", "cabot_4_1", "friction_oscillator"]
SMALLER = {"crowd_room": {"n": 12 if COUNT == FULL else 5}}  # thirty: half a megabyte of C, in 435 pairs

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")


@pytest.fixture(scope="module")
def library(tmp_path_factory, load_case):
    """Return library(stem) -> the folder of a case's C library."""
    base = tmp_path_factory.mktemp("cases")

    @cache
    def write(stem):
        if type(load_case(stem)) is ManyBodies:
            pytest.skip("libraries of many bodies: test_bodies_in_c.py")
        model = load_case(stem, **SMALLER.get(stem, {}))
        codegen.write(model, base / stem, name=stem)
        return base / stem

    return write


def build(folder: Path, compiler: str, *flags: str, name: str = "example") -> Path:
    sources = sorted(path.name for path in folder.glob("*.c"))
    command = [compiler, *STRICT, *flags, "-o", name, *sources, "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]
    return folder / name


def table(text: str) -> tuple[list[str], np.ndarray]:
    rows = list(csv.reader(text.splitlines()))
    return rows[0], np.array([[float(cell or "nan") for cell in row] for row in rows[1:]])


@pytest.mark.parametrize("compiler", COMPILERS)
def test_every_case_in_c_is_the_python_run(case_file, compiler, library, load_case, run_case):
    stem = case_file.stem
    example = build(library(stem), compiler, "-O2" if stem in OPTIMISED else optimised("-O2"))
    done = subprocess.run([example], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    names, rows = table(done.stdout)
    model = load_case(stem, **SMALLER.get(stem, {}))
    run = simulate(model) if stem in SMALLER else run_case(stem)
    n = len(model.names)
    assert names[: n + 1] == ["t", *model.names]
    first = len(run.t) - len(rows)  # a start with two positions: row 0 is not a state of the library
    assert first in (0, 1)
    np.testing.assert_allclose(rows[:, 0], run.t[first:], rtol=1e-12, atol=1e-15)
    scale = np.abs(run.x).max(axis=0) + 1e-300
    assert (np.abs(rows[:, 1 : n + 1] - run.x[first:]) / scale).max() <= 1e-10
    worst = float(re.search(r"largest residual (\S+)", done.stderr)[1])
    assert worst <= 1e-9
    assert f"{len(rows) - 1} steps" in done.stderr


@pytest.mark.parametrize("stem", SANITIZED)
def test_no_finding_of_the_sanitizers(stem, library, tmp_path):
    shutil.copytree(library(stem), tmp_path / stem)
    flags = (optimised("-O1"), "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    example = build(tmp_path / stem, COMPILERS[0], *flags)
    done = subprocess.run([example, "1000"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "runtime error" not in done.stderr


@pytest.mark.long
@pytest.mark.skipif(shutil.which("valgrind") is None, reason="no valgrind")
@pytest.mark.parametrize("stem", ["diode_bridge", "gene_network", "two_discs", "inclusion_8_2_full", "sliding_relay"])
def test_no_finding_of_valgrind(stem, library, tmp_path):
    """No read of what was not written, no leak: the whole case, the solver in allocated memory."""
    shutil.copytree(library(stem), tmp_path / stem)
    main = tmp_path / stem / "example_main.c"
    text = main.read_text()
    text = text.replace(f"static {stem}_solver solver;", f"{stem}_solver *solver = {stem}_create();").replace("&solver", "solver")
    main.write_text(text.replace("return 0;", f"{stem}_free(solver);\n    return 0;"))
    example = build(tmp_path / stem, "gcc", "-g", "-O1", "-Wno-declaration-after-statement")
    command = ["valgrind", "--quiet", "--error-exitcode=9", "--leak-check=full", "--track-origins=yes", example, "1000"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


def test_self_contained(case_file, library):
    """C99 headers of libc and libm only, no allocation outside create, nothing that is not constant outside functions."""
    stem = case_file.stem
    code = (library(stem) / f"{stem}.c").read_text()
    assert set(re.findall(r'#include [<"](\S+)[>"]', code)) == {f"{stem}.h", "float.h", "math.h", "stdlib.h", "string.h"}
    bare = re.sub(r"/\*.*?\*/", "", code, flags=re.DOTALL)
    assert len(re.findall(r"\b(?:malloc|calloc|realloc)\b", bare)) == 1
    outside = re.sub(r"^\{.*?^\}", "", bare, flags=re.DOTALL | re.MULTILINE)
    for line in outside.splitlines():
        if line.startswith("static ") and "(" not in line:
            assert line.startswith("static const "), line
    exported = re.findall(r"^(?!static|typedef|enum)[a-z][\w *]*?\b(\w+)\(", bare, re.MULTILINE)
    assert exported
    assert all(name.startswith(f"{stem}_") for name in exported)


@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
def test_only_prefixed_symbols_and_no_data(library):
    """What the object file shows to a linker: prefixed functions, libc's and libm's names, no writable data."""
    folder = library("gene_network")
    subprocess.run(["gcc", *STRICT, "-O2", "-c", "gene_network.c"], cwd=folder, check=True)
    lines = subprocess.run(["nm", "gene_network.o"], cwd=folder, capture_output=True, text=True, check=True).stdout.splitlines()
    kinds = [line.split()[-2:] for line in lines]
    assert {name for kind, name in kinds if kind == "T"} >= {"gene_network_step", "gene_network_init"}
    assert all(name.startswith("gene_network_") for kind, name in kinds if kind in "TDBC")
    assert not [name for kind, name in kinds if kind in "dDbBC"]
    allowed = {
        "malloc",
        "calloc",
        "free",
        "memcpy",
        "memset",
        "memcmp",
        "memmove",
        "sqrt",
        "frexp",
        "ldexp",
        "fabs",
        "__stack_chk_fail",
    }
    undefined = {name for kind, name in kinds if kind == "U"} - {"_GLOBAL_OFFSET_TABLE_"}
    assert undefined <= allowed, undefined - allowed


def test_the_bridge_is_small(library):
    """Without its comments; a quarter of it is the certificate and its rounding."""
    texts = ((library("diode_bridge") / f"diode_bridge.{end}").read_text() for end in "hc")
    assert sum(len(re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)) for text in texts) < 35_500


# ---------------------------------------------------------------------------------------------- what is left out


def functions(folder: Path) -> set[str]:
    """Names of the functions that a library defines."""
    code = next(path for path in folder.glob("*.c") if path.name != "example_main.c").read_text()
    return set(re.findall(r"^(?:static )?[a-z][\w *]*?\b(\w+)\([^;]*\)\n\{", code, re.MULTILINE))


SOLVERS = {"primal_dual", "lemke", "affine_solve", "nearest_index_set", "step_by_newton", "semismooth_newton"}


def test_a_linear_scene_with_constant_step_has_no_newton_and_no_factorisation_in_a_step(library):
    for stem in ("diode_bridge", "relay_oscillator", "friction_oscillator", "rlc_diode", "cabot_4_3"):
        names = functions(library(stem))
        assert {"find_map", "on_index_set", "nearest_index_set"} <= names, stem
        assert not {"step_by_newton", "linearise", "affine_solve", "lemke", "semismooth_newton"} & names, stem


def test_last_index_set_is_tried_first(library):
    code = (library("diode_bridge") / "diode_bridge.c").read_text()
    step = code[code.index("static int step_by_matrices") :]
    assert step.index("on_index_set(s, s->index)") < step.index("nearest_index_set(s)")


def test_many_index_sets_are_not_enumerated(library):
    names = functions(library("friction_chain"))
    assert {"find_map", "primal_dual", "lemke"} <= names
    assert "nearest_index_set" not in names


def test_a_scene_without_multipliers_carries_no_solver(tmp_path):
    import casadi as ca

    from nsmodel import FirstOrderSystem

    x = ca.SX.sym("x", 2)
    linear = FirstOrderSystem(x=x, f=[x[1], -x[0]], x0=[1, 0], t_end=1, step=0.01, theta=0.5)
    bent = FirstOrderSystem(x=x, f=[x[1], -ca.sin(x[0])], x0=[1, 0], t_end=1, step=0.01, theta=0.5)
    for model, extra in ((linear, set()), (bent, {"step_by_newton"})):
        codegen.write(model, tmp_path / "smooth", name="smooth")
        names = functions(tmp_path / "smooth")
        assert names & SOLVERS == extra
        assert not {name for name in names if "multiplier" in name or "index_set" in name}
        header = (tmp_path / "smooth" / "smooth.h").read_text()
        assert "multipliers" not in header.replace("NL 0 /* multipliers */", "")


def test_a_box_is_projected_on_by_a_clip(library):
    names = functions(library("inclusion_8_1"))
    assert "clip_to_box" in names
    assert not {"step_by_newton", "approximate"} & names


def test_parameters_are_left_out_when_they_are_numbers(tmp_path, load_case):
    model = load_case("two_masses")
    settable = codegen.write(model, tmp_path / "a", name="two")
    frozen = codegen.write(model, tmp_path / "b", name="two", parameters=dict(model.parameters))
    assert settable.about["sizes"]["NP"] == 5
    assert frozen.about["sizes"]["NP"] == 0
    assert "two_set_parameters" in functions(tmp_path / "a")
    assert "two_set_parameters" not in functions(tmp_path / "b")
    assert "step_by_newton" in functions(tmp_path / "a")
    assert "step_by_newton" not in functions(tmp_path / "b")


def test_grid_of_a_case_is_that_of_its_example(library, load_case, case_file):
    grid = make_grid(load_case(case_file.stem).bind(), None, None, None, driven=True)
    text = (library(case_file.stem) / "example_main.c").read_text()
    assert f"last = {grid.N};" in text


@pytest.mark.parametrize("stem", ["diode_bridge", "gene_network", "inclusion_8_2", "two_masses"])
def test_costs_on_the_page_are_those_of_the_code(stem, library):
    """docs/codegen.md: the size of the source and the bound of a step; docs/figures/codegen.py makes the table."""
    page = Path(__file__).resolve().parents[2] / "docs" / "codegen.md"
    cells = [cell.strip() for cell in re.search(rf"^\| {stem} \|(.*)\|$", page.read_text(), re.MULTILINE)[1].split("|")]
    folder = library(stem)
    source = sum((folder / f"{stem}.{end}").stat().st_size for end in "hc") / 1000
    assert float(cells[1]) == pytest.approx(source, rel=0.1)
    bound = json.loads((folder / f"{stem}.json").read_text())["max_work"]
    assert int(cells[4].replace(",", "")) == bound
