"""The shelf of cases: found, described, and each of a topic."""

from __future__ import annotations

import pytest
from conftest import REPOSITORY

from nsmodel.errors import UsageError
from nsmodel.modeling import model_files


def test_a_case_is_what_its_docstring_says(tmp_path):
    path = tmp_path / "mechanics" / "belt.py"
    path.parent.mkdir()
    path.write_text(
        '"""A block on a belt:\na line more.\n\n    m x\'\' = f\n\nTold here.\n\nWhat to see: stick\nand slip.\n\n'
        'A wrong answer: drift.\n\nSource: closed form.\n"""\nraise SystemExit\n'
    )
    case = model_files.read_case(path)
    assert (case.name, case.path, case.title) == ("belt", path, "A block on a belt: a line more.")
    assert case.story == "    m x'' = f\n\nTold here."
    assert (case.see, case.wrong, case.source, case.topic) == ("stick\nand slip.", "drift.", "closed form.", "mechanics")


def test_paragraphs_that_are_not_there_are_empty(tmp_path):
    (tmp_path / "bare.py").write_text("model = None\n")
    case = model_files.read_case(tmp_path / "bare.py")
    assert (case.title, case.story, case.see, case.wrong, case.source) == ("",) * 5


def test_all_cases_are_on_the_shelf():
    """Each in the folder of a topic, and no two of one name."""
    files = list((REPOSITORY / "cases").rglob("*.py"))
    assert sorted(case.path for case in model_files.all_cases()) == sorted(files)
    assert {case.path.parent for case in model_files.all_cases()} == {
        REPOSITORY / "cases" / topic for topic in model_files.TOPICS
    }
    assert model_files.find_case("diode_bridge").title.startswith("Diode bridge")


def test_a_name_that_is_none_is_told_the_nearest():
    with pytest.raises(UsageError, match="no case 'diode_brige'; did you mean diode_bridge"):
        model_files.find_case("diode_brige")


def test_an_installation_without_cases_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(model_files, "_CASE_FOLDERS", (tmp_path / "cases",))
    with pytest.raises(UsageError, match="no cases beside the package"):
        model_files.all_cases()
