"""A failed test names the page, the case and the module of nsmodel that it is about."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from subjects import PACKAGE, REPOSITORY, files_to_edit

import nsmodel
from nsmodel.errors import UsageError


def of_a_case(load_case):
    helper(load_case("diode_bridge"))


def helper(model):
    return [nsmodel.simulate(model) for _ in range(1)]


def without_modules():
    assert len("diode") == 6


def frames_of(error):
    return [(frame.path, frame.lineno + 1, frame.name) for frame in error.traceback]


def test_a_comparison_that_fails_names_what_the_test_calls_and_its_case():
    assert files_to_edit(of_a_case, {}, []) == ["cases/circuits/diode_bridge.py", "nsmodel/simulation/simulate.py"]
    assert files_to_edit(without_modules, {}, []) == []


def test_an_error_names_its_line():
    with pytest.raises(UsageError) as error:
        nsmodel.load("no_such_case")
    [found] = files_to_edit(of_a_case, {"case": "crowd"}, frames_of(error))[2:]
    path, line = found.split(" in ")[0].split(":")
    assert (REPOSITORY / path).read_text().splitlines()[int(line) - 1].lstrip().startswith("raise UsageError")


def test_parameters_name_pages_and_cases():
    block = SimpleNamespace(page=REPOSITORY / "docs" / "guide.md", line=12)
    assert files_to_edit(without_modules, {"block": block}, []) == ["docs/guide.md:12"]
    assert files_to_edit(without_modules, {"page": REPOSITORY / "README.md", "n": 3}, []) == ["README.md"]
    assert files_to_edit(without_modules, {"stem": "crowd"}, []) == ["cases/crowds/crowd.py"]
    assert files_to_edit(without_modules, {}, [(PACKAGE / "crowd.py", 7, "f"), (REPOSITORY / "tests" / "a.py", 1, "g")]) == [
        "nsmodel/crowd.py:7 in f"
    ]


def test_the_files_that_are_named_are_there():
    for function in (of_a_case, test_an_error_names_its_line):
        assert all((REPOSITORY / name).is_file() for name in files_to_edit(function, {}, []))
