"""The options of a run: each is declared once, and known from there to Python, to the help and to the command line."""

import inspect
import json
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

import pytest
from conftest import REPOSITORY

import nsmodel
from nsmodel import UsageError
from nsmodel.cli import _parser
from nsmodel.simulation.options import (
    ExplainKeywords,
    OptionKeywords,
    Options,
    StepperKeywords,
    SweepKeywords,
    declaration,
    flagged_options,
    option_names,
    takes_options,
)

OPTIONS = {one.name: one for one in fields(Options)}
KEYWORDS = {
    nsmodel.simulate: OptionKeywords,
    nsmodel.explain: ExplainKeywords,
    nsmodel.stepper: StepperKeywords,
    nsmodel.sweep: SweepKeywords,
}
OF_COMMANDS = {  # Flags that stay, whatever is added.
    "run": "step t-end set input solver tolerance save-every out resume compiled rtol atol method halve certify",
    "sweep": "t-end set input solver tolerance compiled rtol atol method",
    "study": "t-end set input",
    "stress": "step set input",
    "codegen": "set tolerance",
    "check": "set",
    "view": "",
}


def own(function):
    """The entries of a docstring: {name: text}."""
    found, names = {}, []
    for line in inspect.getdoc(function).partition("Args:\n")[2].partition("\n\n")[0].splitlines():
        if not line.startswith(" " * 8):
            head, _, line = line.partition(": ")
            names = head.strip().split(", ")
        found |= {name: f"{found.get(name, '')} {line.strip()}".strip() for name in names}
    return found


# -- declared once -----------------------------------------------------------------------------------------------------


def test_every_option_has_a_text_and_a_default_that_is_accepted():
    for one in OPTIONS.values():
        doc = declaration(one).doc
        assert doc[0] not in " \n"
        assert doc.endswith(".")
        assert one.kw_only
    assert Options() == Options(**{one.name: one.default for one in OPTIONS.values()})
    with pytest.raises(TypeError, match="positional argument"):
        Options(0.1)


@pytest.mark.parametrize("keywords", KEYWORDS.values(), ids=lambda keywords: keywords.__name__)
def test_keywords_for_type_checkers_are_options_with_their_types(keywords):
    types = get_type_hints(Options)
    assert get_type_hints(keywords) == {name: types[name] for name in option_names(keywords)}
    assert keywords.__required_keys__ == frozenset()


def test_simulate_takes_all_options():
    assert set(option_names(OptionKeywords)) == OPTIONS.keys()
    assert list(inspect.signature(nsmodel.simulate).parameters) == ["model", *OPTIONS]


def test_a_value_is_checked_and_read():
    made = Options(tolerance=0.5, save_every=2.0)
    assert (type(made.tolerance), type(made.save_every), made.save_every) == (float, int, 2)
    for options, message in {
        ("tolerance", 1): "tolerance = 1; expected a number between 1e-14 and 1",
        ("save_every", 0): "save_every = 0; expected a whole number >= 1",
        ("compiled", "yes"): "compiled = 'yes'; expected True, False or 'auto'",
        ("method", "euler"): "method = 'euler'; expected one of auto, event-driven, time-stepping",
        ("certify", "all"): "certify = 'all'; expected one of estimate, interval",
        ("out", " "): "out is empty; give the name of a folder, or leave it out",
        ("resume", True): "resume needs out=, the folder of the run to continue",
    }.items():
        with pytest.raises(UsageError) as caught:
            Options(**dict([options]))
        assert str(caught.value).startswith(message)


# -- what functions show -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("function", "keywords"), KEYWORDS.items(), ids=lambda one: one.__name__)
def test_a_function_shows_the_options_that_it_takes(function, keywords):
    shown, types = inspect.signature(function).parameters, get_type_hints(Options)
    taken = [name for name in OPTIONS if name in option_names(keywords)]
    for name in taken:
        one = shown[name]
        assert (one.kind, one.default) == (one.KEYWORD_ONLY, OPTIONS[name].default)
        assert one.annotation == OPTIONS[name].type
        assert get_type_hints(function)[name] == types[name]
    assert [name for name in shown if name in taken] == taken
    assert not any(one.kind is one.VAR_KEYWORD for one in shown.values())
    assert "options" not in get_type_hints(function)
    assert not {"{entries}", "{names}"} & set(inspect.getdoc(function).split())
    assert max(map(len, inspect.getdoc(function).splitlines())) <= 126


def test_help_of_simulate_has_the_text_of_each_option():
    entries = own(nsmodel.simulate)
    assert list(entries) == ["model", *OPTIONS]
    assert {name: entries[name] for name in OPTIONS} == {name: declaration(one).doc for name, one in OPTIONS.items()}
    assert "    step, steps, t_end: override the model's own grid.\n" in inspect.getdoc(nsmodel.simulate)


def test_what_has_an_entry_of_its_own_is_told_there():
    entries = own(nsmodel.stepper)
    assert entries["step"] == "the time step; left out: the model's."
    assert entries["solver"] == entries["tolerance"] == "as in `simulate`."
    assert list(entries) == ["model", "step", "parameters", "inputs", "solver", "tolerance", "compiled", "record"]
    assert list(inspect.signature(nsmodel.stepper).parameters) == list(entries)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: nsmodel.simulate(None, rtl=1e-8), "simulate() got an unexpected keyword argument 'rtl'"),
        (lambda: nsmodel.explain(None, resume=True), "explain() got an unexpected keyword argument 'resume'"),
        (lambda: nsmodel.stepper(None, atol=1), "stepper() got an unexpected keyword argument 'atol'"),
        (lambda: nsmodel.sweep(None, save_every=2), "sweep() got an unexpected keyword argument 'save_every'"),
        (lambda: nsmodel.simulate(), "simulate() missing 1 required positional argument: 'model'"),
        (lambda: nsmodel.simulate(None, 0.1), "simulate() takes 1 positional argument but 2 were given"),
    ],
)
def test_python_refuses_what_a_function_does_not_take(call, name):
    with pytest.raises(TypeError) as caught:
        call()
    assert str(caught.value).partition(". Did you mean")[0] == name


def test_own_parameters_may_stand_around_the_options():
    @takes_options(StepperKeywords, before="last")
    def function(model, *, first=1, last=2, **options):
        """Return the options.

        Args:
            model, first, last: three.
            solver: another.
            {entries}

        Those of others: {names}.
        """
        return options

    names = list(option_names(StepperKeywords))
    assert list(inspect.signature(function).parameters) == ["model", "first", *names, "last"]
    assert "solver" not in inspect.getdoc(function).partition("Those")[2]
    assert own(function)["solver"] == "another."
    assert own(function)["tolerance"] == declaration(OPTIONS["tolerance"]).doc
    assert function(None, tolerance=1e-3, last=3) == {"tolerance": 1e-3}


def test_type_checkers_report_an_option_that_is_none(tmp_path):
    checker = shutil.which("pyrefly", path=str(Path(sys.executable).parent))
    if checker is None:
        pytest.skip("pyrefly is not installed")
    program = tmp_path / "program.py"
    program.write_text(
        "from nsmodel import explain, simulate, stepper, sweep\n"
        "def program(model):\n"
        "    simulate(model, rtol=1e-8, resume=True)\n"
        "    simulate(model, rtl=1e-8)\n"
        "    simulate(model, rtol='1e-8')\n"
        "    explain(model, resume=True)\n"
        "    stepper(model, atol=1.0)\n"
        "    sweep(model, save_every=2)\n"
    )
    options = ["--config", "pyproject.toml", "--python-interpreter-path", sys.executable, "--output-format", "json"]
    found = subprocess.run([checker, "check", *options, str(program)], cwd=REPOSITORY, capture_output=True, text=True)
    assert [error["line"] for error in json.loads(found.stdout)["errors"]] == [4, 5, 6, 7, 8], found.stderr


# -- the command line --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "flags"), OF_COMMANDS.items())
def test_commands_have_the_flags_of_the_options(command, flags):
    parser = next(action.choices for action in _parser()._actions if isinstance(action.choices, dict))[command]
    actions = {text: action for action in parser._actions for text in action.option_strings}
    assert {flag.name for _, flag, _ in flagged_options(command)} >= {f"--{name}" for name in flags.split()}
    for option, flag, text in flagged_options(command):
        action = actions[flag.name]
        assert (action.help, action.dest) == (text, flag.dest)
        assert text
        if flag.dest == option.name:
            assert action.default == option.default
        else:
            assert (option.name, action.default) in (("parameters", []), ("inputs", []))
