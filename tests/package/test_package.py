"""What the package promises as a whole: a light import, documented names, cases that explain themselves."""

import ast
import doctest
import functools
import importlib
import inspect
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from conftest import CASES, REPOSITORY

import nsmodel
from nsmodel.modeling import model_files

MODULES = sorted(module.name for module in pkgutil.walk_packages(nsmodel.__path__, "nsmodel."))


@functools.cache
def source_of(name):
    return Path(importlib.import_module(name).__file__).read_text()


HEAVY = ["matplotlib", "sympy", "scipy", "tqdm", "xarray", "pandas", "nsmodel.plot", "nsmodel.hypotheses.check", "nsmodel.crowd"]
HEAVY += [
    "nsmodel.stress",
    "nsmodel.study",
    "nsmodel.sweep",
    "nsmodel.codegen",
    "nsmodel.hypotheses.along_run",
    "nsmodel.proof.interval_bounds",
    "nsmodel.proof.exact",
]


def in_a_fresh_process(code, **more):
    """Return what a program prints; ``more`` are variables of its environment."""
    environment = os.environ | {"PYTHONPATH": str(Path(nsmodel.__file__).parents[1])} | more
    found = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert found.stderr == ""
    return found.stdout


def test_import_is_light():
    """What not every model needs is loaded by who uses it: runs, checks, plots, SymPy, SciPy, the progress bar."""
    heavy = [
        *HEAVY,
        "nsmodel.simulate",
        "nsmodel.solvers.one_step_problem",
        "nsmodel.solvers",
        "nsmodel.files.storage",
        "importlib.metadata",
    ]
    assert in_a_fresh_process(f"import sys, nsmodel; print([name for name in {heavy} if name in sys.modules])") == "[]\n"


def test_a_first_run_loads_what_it_uses(tmp_path):
    """Nothing is compiled yet: that building steps would not pay is known without the generator."""
    code = "import sys, nsmodel; nsmodel.simulate(nsmodel.load('friction_oscillator'))"
    code = f"{code}; print([name for name in {HEAVY} if name in sys.modules])"
    assert in_a_fresh_process(code, XDG_CACHE_HOME=str(tmp_path)) == "[]\n"


def test_a_function_keeps_its_name_where_a_module_has_it_too():
    code = (
        "import nsmodel, nsmodel.study.stress, nsmodel.study.lines\n"
        "from nsmodel.simulation.simulate import prepared_loop\n"
        "import nsmodel.simulation.simulate\n"
        "for name in ('simulate', 'study', 'stress'):\n"
        "    print(callable(getattr(nsmodel, name)), getattr(nsmodel, name).__module__)\n"
    )
    lines = ["True nsmodel.simulation.simulate", "True nsmodel.study.work_precision", "True nsmodel.study.stress"]
    assert in_a_fresh_process(code).splitlines() == lines


def test_names_that_wait_are_listed_imported_and_documented():
    code = (
        "import nsmodel, pydoc\n"
        "print(set(nsmodel.__all__) <= set(dir(nsmodel)), nsmodel.__version__ == nsmodel.version.VERSION)\n"
        "text = pydoc.render_doc(nsmodel, renderer=pydoc.plaintext)\n"
        "print('simulate(model' in ''.join(text.split()), 'Decide each hypothesis' in text)\n"
        "from nsmodel import *\n"
        "print(check.__name__, Study.__name__)\n"
        "print(hasattr(nsmodel, 'simulat'))\n"
    )
    assert in_a_fresh_process(code).split() == ["True", "True", "True", "True", "check", "Study", "False"]
    with pytest.raises(AttributeError, match="module 'nsmodel' has no attribute 'simulat'"):
        nsmodel.simulat  # noqa: B018


def test_a_run_without_pictures_stays_light(tmp_path):
    """A CasADi model is run, saved and summed up without any of them."""
    code = (
        "import sys\nfrom nsmodel.cli import main\n"
        f"main(['run', {str(CASES[0])!r}, '--out', 'results', '--csv', 'run.csv', '--json'])\n"
        "print([name for name in ('matplotlib', 'sympy', 'tqdm', 'xarray') if name in sys.modules], file=sys.stderr)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(nsmodel.__file__).parents[1])}
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert found.stderr == "[]\n"


def test_version_is_that_of_the_project():
    """Which may be another than the version that is installed."""
    where = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["hatch"]["version"]["path"]
    declared = re.search(r'^VERSION = "(\d+\.\d+\.\d+)"$', (REPOSITORY / where).read_text(), re.MULTILINE)[1]
    assert nsmodel.__version__ == declared
    run = nsmodel.simulate(nsmodel.load("sliding_relay"), t_end=0.1)
    assert run.metadata["versions"]["nsmodel"] == declared


def test_all_names_exist_and_are_sorted():
    assert nsmodel.__all__ == sorted(set(nsmodel.__all__))
    for name in nsmodel.__all__:
        assert getattr(nsmodel, name).__module__.startswith("nsmodel.")
    public = {
        name
        for name, value in vars(nsmodel).items()
        if not name.startswith("_") and not inspect.ismodule(value) and getattr(value, "__module__", "").startswith("nsmodel.")
    }
    assert public <= set(nsmodel.__all__)


@pytest.mark.parametrize("name", nsmodel.__all__)
def test_every_public_name_is_documented(name):
    value = getattr(nsmodel, name)
    text = inspect.getdoc(value)
    assert text
    assert text.splitlines()[0].endswith(".")
    for label, member in vars(value).items() if inspect.isclass(value) else ():
        if not label.startswith("_") and (inspect.isfunction(member) or isinstance(member, property | classmethod)):
            assert inspect.getdoc(getattr(value, label)), f"{name}.{label}"


@pytest.mark.parametrize("name", MODULES)
def test_every_module_says_what_it_is_for_and_its_examples_run(name):
    module = importlib.import_module(name)
    assert module.__doc__
    if ">>>" in source_of(name):
        failed, _ = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
        assert failed == 0


@pytest.mark.long  # `make lint` does it.
def test_structure_is_within_its_limits():
    """Packages, files, import circles, names: `python tests/house_check.py --list MEASURE` says what stands behind a number."""
    pytest.importorskip("grimp", reason="import-linter comes with the extra dev")
    import house_check

    found = house_check.measure()
    assert {name: found[name] for name, limit in house_check.LIMITS.items() if found[name][0] > limit} == {}


@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_every_case_explains_itself(path):
    text = path.read_text()
    doc = ast.get_docstring(ast.parse(text))
    assert doc.splitlines()[0].endswith(".")
    case = model_files.read_case(path)
    assert case.see
    assert case.wrong
    assert case.source
    assert case.topic in model_files.TOPICS
    assert not re.search(r"\b(assert|pytest|unittest)\b", text)
    model = nsmodel.load(path)
    assert model.title
    assert model.title != path.stem
    assert model.step is not None or model.steps is not None


def test_there_are_cases_of_every_class(load_case):
    classes = {type(load_case(path.stem)).__name__ for path in CASES}
    assert classes == {
        "SweepingProcess", "FrictionOscillator", "FirstOrderSystem", "LureSystem", "MonotoneInclusion", "ManyBodies",
        "MechanicalSystem",
    }  # fmt: skip
