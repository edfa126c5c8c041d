"""The tool that changes numbers at the top of modules finds what hangs on them."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import module_from_spec
from pathlib import Path

import numpy as np
import pytest
from conftest import REPOSITORY
from search.changed import Changed, numbers
from search.constants import Outcome, difference, main

MODULE = '''
"""A module."""
ONE = 2.0**-3  # A float.
COUNT, SHARE = 1, -0.5
TRIED = (1e-2, 1e-4)
HALF = ONE / 2
NAME, YES = "name", True

def of(x, factor=ONE):
    return factor * x
'''


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "small.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return Path("small.py")


def test_all_numbers_are_found(module):
    assert [one.name for one in numbers(module)] == [
        "small.ONE", "small.COUNT", "small.SHARE", "small.TRIED[0]", "small.TRIED[1]", "small.HALF",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "up", "values"),
    [
        ("small.ONE", True, (1.25, 1, -0.5, 1e-2, 1e-4, 0.625, 2.5)),
        ("small.ONE", False, (0.0125, 1, -0.5, 1e-2, 1e-4, 0.00625, 0.025)),
        ("small.COUNT", True, (0.125, 2, -0.5, 1e-2, 1e-4, 0.0625, 0.25)),
        ("small.COUNT", False, (0.125, 1, -0.5, 1e-2, 1e-4, 0.0625, 0.25)),
        ("small.SHARE", True, (0.125, 1, -5.0, 1e-2, 1e-4, 0.0625, 0.25)),
        ("small.TRIED[1]", False, (0.125, 1, -0.5, 1e-2, 1e-5, 0.0625, 0.25)),
    ],
)
def test_what_is_made_of_a_number_follows(module, name, up, values):
    number = next(one for one in numbers(module) if one.name == name)
    spec = Changed(number, up).find_spec("small")
    made = module_from_spec(spec)
    spec.loader.exec_module(made)
    found = made.ONE, made.COUNT, made.SHARE, *made.TRIED, made.HALF, made.of(2)
    assert found == pytest.approx(values)
    assert Changed(number, up).find_spec("other") is None


def test_differences_are_told():
    states = np.array([[1.0, 2.0], [3.0, -4.0]])
    before = {"a": Outcome(1e-6, "0", states), "b": Outcome(1e-6, stop="StepError: no")}
    assert difference(before, dict(before)) == "same bits"
    small = before | {"a": Outcome(1e-6, "1", states + 4e-8)}
    assert difference(before, small) == "1 of 2 differ, by up to 1e-08 of 1e-06 (a)"
    large = before | {"a": Outcome(1e-6, "1", states + 0.4)}
    assert difference(before, large).startswith("! 1 of 2 differ, by up to 1e-01 of 1e-06 (a)")
    assert difference(before, before | {"b": Outcome(1e-6, "2", states)}) == "b goes on"
    assert difference(before, before | {"a": Outcome(1e-6, stop="StepError: yes")}) == "a stops: StepError: yes"
    assert difference(before, {}).startswith("! it crashes")
    assert difference(before, {"import": Outcome(0.0, stop="SyntaxError: x")}) == "SyntaxError: x"


@pytest.mark.skipif(sys.platform == "win32", reason="it forks")
def test_a_number_that_matters_and_one_that_does_not():
    """Of the battery one run: its pieces are shorter at a tenth of LOCAL, and no piece is as long as LONGEST."""
    command = [sys.executable, "-m", "tests.search.constants", "nsmodel/event_driven/step_size.py", "--only", "LO"]
    done = subprocess.run([*command, "--cases", "friction_osc"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    first, *lines = done.stdout.splitlines()
    assert "1 runs, " in first
    assert first.endswith("once more: same bits")
    found = {line.partition(":")[0]: line.partition(": ")[2] for line in lines}
    assert set(found) == {f"step_size.{name} {way}" for name in ("LOCAL", "LONGEST") for way in ("up", "down")}
    assert found["step_size.LOCAL down"].startswith("1 of 1 differ, by up to ")
    assert found["step_size.LONGEST up"].startswith("same bits")


def test_what_compares_nothing_is_refused(capsys, monkeypatch):
    """Nor are numbers said to change nothing where no run looked at them."""
    monkeypatch.chdir(REPOSITORY)
    for given, words in (
        (["nsmodel/nosuch"], "nsmodel/nosuch is no module or package that is here; expected one as nsmodel/solvers"),
        (["tests/search"], "tests/search is no module or package"),
        (["nsmodel/plot", "--only", "ZZZ"], "nsmodel/plot has no number with 'ZZZ' in its name at the top of a module"),
        (["nsmodel/solvers/mlcp.py", "--cases", "zzz"], "with 'zzz' in its name came to an end: nothing can be compared"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(given)
        output = capsys.readouterr()
        assert words in output.err
        assert output.out == ""
