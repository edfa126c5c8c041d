"""The commands of the Makefile run, in their short form, and change nothing that is committed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="no make")
PARTS = ("Makefile", "pyproject.toml", "README.md", "LICENSE", "cases", "docs", "nsmodel", "tests")
SAYS = {
    "help": "make demo",
    "demo": "Diode bridge rectifier",
    "bench": "seconds of a whole check",
    "bench-large": "parts of an interpreted step",
    "bench-events": "SciPy, events by hand",
    "bench-sweeps": "Random oscillators with friction",
    "study": "",
    "nightly": "lure",
}


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of what is committed."""
    folder = tmp_path_factory.mktemp("tree")
    for part in PARTS:
        path = REPOSITORY / part
        if path.is_dir():
            shutil.copytree(path, folder / part, ignore=shutil.ignore_patterns("__pycache__", "gallery"))
        else:
            shutil.copy(path, folder / part)
    return folder


def files_of(tree):
    """What is in the tree but results and caches."""
    own = (path for part in PARTS for path in [tree / part, *(tree / part).rglob("*")] if path.is_file())
    return {path: path.read_bytes() for path in own if "__pycache__" not in path.parts}


def make(tree, *arguments, **variables):
    """Run make in the tree with the Python of this run."""
    environment = os.environ | {"PYTHONPATH": str(tree), "XDG_CACHE_HOME": str(tree / "results" / "cache"), "NSMODEL_SHORT": "1"}
    command = ["make", *arguments, f"BIN={Path(sys.executable).parent}", "-o", ".venv/.installed", "-o", ".venv/.runs"]
    return subprocess.run(command, cwd=tree, env=environment | variables, capture_output=True, text=True, check=False)


LONG = {"bench", "bench-large", "bench-sweeps", "nightly"}  # Tens of seconds: `make test-long` runs them.


@pytest.mark.parametrize("target", [pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name in SAYS])
def test_a_command_runs_and_changes_nothing_that_is_committed(tree, target, quick_programs):
    before = files_of(tree)
    done = make(tree, target, **quick_programs)
    assert done.returncode == 0, done.stdout + done.stderr
    assert SAYS[target] in done.stdout
    assert files_of(tree) == before


def test_every_command_is_known_and_clean_leaves_the_committed_files(tree):
    targets = set(re.findall(r"^([a-z-]+):.*## ", (REPOSITORY / "Makefile").read_text(), flags=re.M))
    assert targets == {
        *SAYS,
        "test",
        "test-long",
        "quick",
        "lint",
        "docs",
        "clean",
    }
    before = files_of(tree)
    (tree / "results").mkdir(exist_ok=True)
    (tree / ".venv").mkdir(exist_ok=True)
    assert make(tree, "clean").returncode == 0
    assert files_of(tree) == before
    assert not (tree / "results").exists()
    assert not (tree / ".venv").exists()
    assert not list(tree.rglob("__pycache__"))


@pytest.mark.parametrize(
    ("target", "words"),
    [("quick", "-m fast"), ("test", "pytest"), ("test-long", "NSMODEL_FUZZ=400"), ("lint", "ruff"), ("docs", "sphinx")],
)
def test_what_a_command_would_run(tree, target, words):
    done = make(tree, target, "--dry-run")
    assert done.returncode == 0
    assert words in done.stdout
