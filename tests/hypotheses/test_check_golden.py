"""What checks say of all cases and of random models is what the files in ``tests/fixtures/checks`` have.

Where a change is meant, ``python -m tests.search.golden --write`` writes them anew, and the difference is looked at.
"""

from __future__ import annotations

import pytest
from conftest import CASES, REPOSITORY
from search import golden
from search.checked import MAKERS

import nsmodel

CLASS_NAMES = {kind: name for name, (kind, _) in MAKERS.items()}


@pytest.fixture(scope="module")
def kept():
    """Return the files, read: {class: {check: document}}."""
    return {name: golden.read(name) for name in MAKERS}


def assert_kept(class_name, kept, checks):
    """What checks say is what the file of the class has; else say which file that is, and how it is written anew."""
    __tracebackhide__ = True
    differences = [
        f"{name}: {line}"
        for name, report in checks
        for line in golden.differences(kept[class_name][name], golden.kept_of(name, report))
    ]
    if differences:
        path = (golden.FILES / f"{class_name}.json").relative_to(REPOSITORY)
        renew = f"where the change is meant: python -m tests.search.golden --class {class_name} --write"
        pytest.fail("\n".join([f"{path} has something else ({renew}):", *differences]))


def test_the_files_have_every_check(kept, load_case):
    cases = {name for file in kept.values() for name in file if not name.startswith("model ")}
    stems = {path.stem for path in CASES if type(load_case(path.stem)) in CLASS_NAMES}
    assert cases == {f"{stem} quick" for stem in stems} | (stems - golden.DEAR)
    models = {name: [check for check in file if check.startswith("model ")] for name, file in kept.items()}
    at_points = {name: [check for check in checks if not check.endswith(golden.OVER_A_BOX)] for name, checks in models.items()}
    assert {name: len(checks) for name, checks in at_points.items()} == dict.fromkeys(MAKERS, golden.MODELS)
    assert all(len(checks) - len(at_points[name]) <= golden.MODELS for name, checks in models.items())


def test_a_quick_check_of_a_case_says_what_it_said(case_file, kept, quick_check, load_case):
    stem = case_file.stem
    if class_name := CLASS_NAMES.get(type(load_case(stem))):
        assert_kept(class_name, kept, [(f"{stem} quick", quick_check(stem))])


@pytest.mark.long
def test_a_check_of_a_case_says_what_it_said(case_file, kept):
    stem = case_file.stem
    if class_name := CLASS_NAMES.get(type(nsmodel.load(stem))):
        assert_kept(class_name, kept, golden.case_checks(stem))


@pytest.mark.long
@pytest.mark.parametrize("class_name", MAKERS)
def test_checks_of_random_models_say_what_they_said(class_name, kept):
    checks = ((f"model {seed}", golden.model_check(class_name, seed)) for seed in range(golden.MODELS))
    assert_kept(class_name, kept, checks)


@pytest.mark.long
@pytest.mark.parametrize("class_name", MAKERS)
def test_checks_over_boxes_say_what_they_said(class_name, kept):
    checks = (item for item in golden.box_checks(class_name) if item[0] in kept[class_name])
    assert_kept(class_name, kept, checks)


# -- the comparison ----------------------------------------------------------------------------------------------------

REPORT = {
    "findings": {"A1": {"verdict": "holds", "value": {"a": 1.0, "b": 2.0}, "witness": {"x": [0.5, 0.25], "of": "wall"}}},
    "consequences": {"well posed": {"verdict": "holds", "on": "A1"}},
}


def changed(**entries):
    """Return the report with other entries in A1."""
    return {**REPORT, "findings": {"A1": {**REPORT["findings"]["A1"], **entries}}}


@pytest.mark.parametrize(
    ("other", "seen"),
    [
        (changed(value={"a": 1.0 + 1e-9, "b": 2.0}), ""),
        (changed(value={"a": 1.0 + 1e-5, "b": 2.0}), "value"),
        (changed(value={"a": 1.0}), "value"),
        (changed(value={"a": 1.0, "b": "inf"}), "value"),
        (changed(verdict="sampled"), "verdict"),
        (changed(scope={"states": {"x": [0, 1]}}), "scope"),
        (changed(witness={"x": [0.5], "of": "wall"}), "witness"),
        (changed(witness={"x": [0.5, 0.25], "of": "floor"}), "witness"),
        ({**REPORT, "consequences": {}}, "gone"),
        ({**REPORT, "consequences": {"well posed": {"verdict": "holds", "on": "A1 A2"}}}, "on"),
    ],
)
def test_a_difference_is_seen(other, seen):
    lines = golden.differences(REPORT, other)
    assert bool(lines) == bool(seen)
    assert all(seen in line for line in lines)


def test_what_two_computations_do_not_agree_on_is_kept_by_its_kind():
    other = changed(witness={"x": [0.5, 0.26], "of": "floor"})
    both = golden.stable(REPORT, other)
    assert both["findings"]["A1"]["witness"] == {"x": "~list of 2", "of": "~text"}
    assert both["findings"]["A1"]["verdict"] == "holds"
    assert not golden.differences(both, REPORT)
    assert not golden.differences(both, other)
    assert golden.differences(both, changed(witness={"x": [0.5], "of": "wall"}))
    assert golden.differences(both, changed(witness={"x": [0.5, 0.25]}))
