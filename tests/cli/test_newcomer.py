"""What a newcomer types: cases listed, described and copied, a model to start from, completion in a shell; what is installed."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from conftest import REPOSITORY

from nsmodel import UsageError, load
from nsmodel.cli import main
from nsmodel.cli.completion import DESCRIPTION
from nsmodel.cli.export import without_machine
from nsmodel.modeling import model_files
from nsmodel.modeling.pickling import defined_in
from nsmodel.version import VERSION
from tests.package.test_package import in_a_fresh_process

SLEDGE = """
import casadi as ca
from nsmodel import MonotoneInclusion

def exact(t):
    return t

x = ca.SX.sym("x")
model = MonotoneInclusion(x=x, field=-x, x0=[1], t_end=1, step=0.1)
"""
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """An empty folder, and a terminal of 80 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path


def said(capsys, *arguments):
    """What a command that succeeds prints."""
    assert main(list(arguments)) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    return printed.out


def refused(capsys, *arguments):
    """What a command says that is refused."""
    assert main(list(arguments)) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("nsmodel: error: ")
    assert printed.err.count("\n") == 1
    return printed.err.removeprefix("nsmodel: error: ").strip()


# ---------------------------------------------------------------------------------------------- cases


def shelf_of(folder, monkeypatch, **topics):
    """A shelf of cases that say no more than their docstrings, by topic and name."""
    for topic, docstrings in topics.items():
        place = folder / "cases" / topic
        place.mkdir(parents=True)
        for name, text in docstrings.items():
            (place / f"{name}.py").write_text(f'"""{text}"""\n', encoding="utf-8")
    monkeypatch.setattr(model_files, "_CASE_FOLDERS", (folder / "cases",))


def test_cases_are_listed_by_topic_a_line_each(here, monkeypatch, capsys):
    bridge = "A bridge of four diodes, all ideal, feeds a resistor from a source."
    shelf_of(
        here,
        monkeypatch,
        biology={"a": "Last."},
        control={"zig": "A switch."},
        circuits={"b": bridge, "longer_name": "A ladder."},
    )
    lines = said(capsys, "cases").splitlines()
    assert lines[:10] == [
        "circuits",
        "  b            A bridge of four diodes, all ideal, feeds a resistor from a ...",
        "  longer_name  A ladder.",
        "",
        "control",
        "  zig          A switch.",
        "",
        "biology",
        "  a            Last.",
        "",
    ]
    assert max(map(len, lines)) <= 80
    monkeypatch.setenv("COLUMNS", "200")
    assert "all ideal, feeds a resistor from a source.\n" in said(capsys, "cases")


def test_a_case_is_described_in_its_own_words(here, monkeypatch, capsys):
    story = "It is told here,\nat length.\n\n    m x'' = f    as it stands\n\nWhat to see: it\nstops.\n\nSource: closed form."
    shelf_of(here, monkeypatch, mechanics={"belt": f"A block on a belt.\n\n{story}"})
    text = said(capsys, "cases", "belt")
    assert text.startswith(
        "belt: A block on a belt.\n\nIt is told here, at length.\n\n    m x'' = f    as it stands\n\nWhat to see: "
    )
    assert "it stops.\n\nSource: closed form.\n\n" in text
    assert "A wrong answer" not in text
    assert str(here / "cases" / "mechanics" / "belt.py") in text
    assert "Topic: mechanics\n" in text
    assert "nsmodel new my_belt --like belt" in text
    assert "no case 'bel'; did you mean belt?" in refused(capsys, "cases", "bel")


def test_a_topic_lists_its_cases(here, monkeypatch, capsys):
    shelf_of(here, monkeypatch, control={"zig": "A switch."}, circuits={"b": "A bridge."})
    assert said(capsys, "cases", "control").startswith("control\n  zig  A switch.\n\none of them")


@pytest.mark.parametrize(
    ("words", "usage", "near"),
    [
        (["run", "x.py", "--plto"], "usage: nsmodel run ", r"unrecognized arguments: --plto; did you mean --plot\?"),
        (["run", "x.py", "--tend=3"], "usage: nsmodel run ", r"--tend=3; did you mean --t-end\?"),
        (["chek", "x.py"], "usage: nsmodel ", r"invalid choice: 'chek' .*; did you mean check\?"),
        (["run", "x.py", "--method", "qqq"], "usage: nsmodel run ", r"invalid choice: 'qqq' \(choose from .*\)$"),
    ],
)
def test_what_is_misspelt_is_answered_by_what_is_near(capsys, words, usage, near):
    with pytest.raises(SystemExit, match="2"):
        main(words)
    printed = capsys.readouterr().err
    assert printed.startswith(usage)
    assert re.search(near, printed)


def test_cases_as_json(capsys):
    listed = json.loads(said(capsys, "cases", "--json"))
    assert [case["name"] for case in listed] == sorted(model_files.case_files())
    one = json.loads(said(capsys, "cases", "diode_bridge", "--json"))
    assert one in listed
    assert one["path"].endswith("diode_bridge.py")
    assert set(one) == {"name", "path", "title", "story", "see", "wrong", "source", "topic"}


def test_a_case_runs_by_its_name_unless_a_file_has_it(here, capsys):
    assert "Diode bridge rectifier" in said(capsys, "run", "diode_bridge", "--t-end", "1e-4")
    (here / "diode_bridge").mkdir()  # such as nsmodel codegen makes
    said(capsys, "run", "diode_bridge", "--t-end", "1e-5", "--quiet")
    (here / "diode_bridge").rmdir()
    (here / "diode_bridge").write_text("")
    assert "'diode_bridge' is not a Python file" in refused(capsys, "run", "diode_bridge")
    assert refused(capsys, "run", "diode_brige") == "model file 'diode_brige' does not exist; did you mean diode_bridge?"


def test_a_case_is_loaded_by_its_name_in_python_too(here, capsys):
    assert load("diode_bridge").title == "Diode bridge rectifier"
    with pytest.raises(UsageError, match=r"'diode_brige' does not exist; did you mean diode_bridge\?"):
        load("diode_brige")
    (here / "mine.py").write_text("")
    for name in ("mine", "mne.py"):
        with pytest.raises(UsageError, match=r"did you mean mine\.py\?"):
            load(name)
    (here / "diode_bridge.py").write_text("")
    note = "diode_bridge is the case that comes with nsmodel; diode_bridge.py here is another file"
    with pytest.warns(UserWarning, match=note):
        load("diode_bridge")
    assert main(["run", "diode_bridge", "--t-end", "1e-5", "--quiet"]) == 0
    assert capsys.readouterr().err == f"nsmodel: note: {note}\n"


def test_a_case_is_found_where_it_lay_before(here, capsys):
    """And its functions, by pickles."""
    (here / "cases" / "mechanics").mkdir(parents=True)
    (here / "cases" / "mechanics" / "sledge.py").write_text(SLEDGE, encoding="utf-8")
    note = f"{Path('cases/sledge.py')} is {Path('cases/mechanics/sledge.py')} now"
    with pytest.warns(UserWarning, match=re.escape(note)):
        model = load("cases/sledge.py")
    with pytest.warns(UserWarning, match=r"is \S+sledge\.py now"):
        assert load(here / "cases" / "sledge.py").title == model.title == "sledge"
    assert main(["run", "cases/sledge.py", "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["file"] == str(Path("cases/mechanics/sledge.py"))
    assert printed.err == f"nsmodel: note: {note}\n"
    exact = defined_in(str(here / "cases" / "sledge.py"), "exact")
    assert exact.__code__.co_filename == str(here / "cases" / "mechanics" / "sledge.py")
    (here / "cases" / "sledge.py").write_text(SLEDGE.replace("x0=[1]", "x0=[2]"), encoding="utf-8")  # one's own
    assert load("cases/sledge.py").x0[0] == 2
    assert "does not exist" in refused(capsys, "run", "cases/rope.py")
    assert "does not exist" in refused(capsys, "run", "others/sledge.py")


def test_view_of_no_run_says_how_runs_are_kept(here, capsys):
    (here / "mine.py").write_text("")
    assert "there is no run in 'belt-run': runs are saved by nsmodel run FILE --out DIR" in refused(capsys, "view", "belt-run")
    assert refused(capsys, "view", "mine.py").startswith("mine.py is a model file: run it first, nsmodel run mine.py --out DIR")
    assert refused(capsys, "view", "diode_bridge").startswith("diode_bridge is a model file")


# ---------------------------------------------------------------------------------------------- new


def test_the_template_runs_and_does_what_it_says(here, capsys):
    assert said(capsys, "new", "first").startswith(
        "first.py: a mass on a spring with dry friction\n\n    nsmodel run first.py --plot\n"
    )
    text = said(capsys, "run", "first.py")
    # Half swings lose 2 mu m g/k = 0.4905: from 1 to -0.5095 to 0.0190, where k x < mu m g holds it.
    assert 0 < float(re.search(r"position +(\S+) m", text)[1]) < 0.025
    assert re.search(r"velocity +0 m/s", text)
    doc = ast.get_docstring(ast.parse((here / "first.py").read_text(encoding="utf-8")))
    assert "A wrong answer:" in doc
    assert "nsmodel run first.py --set mu=0.2" in (here / "first.py").read_text(encoding="utf-8")
    assert load(here / "first.py", mu=0.2).title == "A mass on a spring with dry friction"


def test_a_copy_of_a_case_runs(here, capsys):
    assert "relay.py: a copy of sliding_relay" in said(capsys, "new", "relay.py", "--like", "sliding_relay")
    assert (here / "relay.py").read_bytes() == model_files.case_files()["sliding_relay"].read_bytes()
    said(capsys, "run", "relay.py", "--t-end", "0.1")


def test_a_file_that_is_there_stays_unless_it_is_to_go(here, capsys):
    (here / "mine.py").write_text("hours of work\n")
    assert refused(capsys, "new", "mine") == "mine.py exists already; take another name, or give --force to replace it"
    assert (here / "mine.py").read_text() == "hours of work\n"
    said(capsys, "new", "mine", "--force")
    assert "hours of work" not in (here / "mine.py").read_text()


@pytest.mark.parametrize("name", ["a/b", "../a", "9lives", "", "a b", ".py", "a.b", "ärger"])
def test_what_is_no_name_is_refused(here, capsys, name):
    assert f"'{name}' is not a valid name for a model file: expected letters, digits, _ and -" in refused(capsys, "new", name)
    assert not list(here.iterdir())


@pytest.mark.parametrize("name", ["random", "numpy"])
def test_a_name_that_would_hide_a_module_is_refused(here, capsys, name):
    """Modules beside a model file come first while it runs."""
    assert f"{name}.py would hide the Python module {name} from its neighbours" in refused(capsys, "new", name)
    assert not list(here.iterdir())


def test_a_copy_of_what_is_no_case_is_refused(here, capsys):
    text = refused(capsys, "new", "a", "--like", "nothing_like_it")
    assert text == f"no case 'nothing_like_it'; nsmodel cases lists the {len(model_files.case_files())} that there are"
    assert not list(here.iterdir())


# ---------------------------------------------------------------------------------------------- completion

LINES = {
    "nsmodel sw": ["sweep"],
    "nsmodel --v": ["--version"],
    "nsmodel run --me": ["--method"],
    "nsmodel run x.py --method e": ["event-driven"],
    "nsmodel new x --like diode": ["diode_bridge"],
    "nsmodel cases crowd_": ["crowd_room"],
    "nsmodel study moving_d": ["moving_disc"],
    "nsmodel run my": ["my model.py", "my_folder"],
    "nsmodel run --out my": [],  # the shell's own files
    "nsmodel run --html my": [],
    "nsmodel view --out my": [],
    "nsmodel run --solver le": ["lemke"],
    "nsmodel run --step 1": [],
    "nsmodel completion f": ["fish"],
}


@pytest.mark.skipif(shutil.which("bash") is None or sys.platform == "win32", reason="no bash")
def test_a_real_bash_completes(here, capsys):
    (here / "my model.py").write_text("")
    (here / "my notes.txt").write_text("")
    (here / "my_folder").mkdir()
    tries = "".join(
        f"COMP_WORDS=({line}); COMP_CWORD={line.count(' ')}; _nsmodel; printf '%s|' \"${{COMPREPLY[@]}}\"; echo\n"
        for line in LINES
    )
    script = said(capsys, "completion", "bash")
    done = subprocess.run(["bash", "--norc", "-c", f"{script}\n{tries}"], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    found = dict(zip(LINES, (sorted(filter(None, line.split("|"))) for line in done.stdout.splitlines()), strict=True))
    assert found == LINES


def test_scripts_of_other_shells(capsys):
    bash, zsh, fish = (said(capsys, "completion", shell) for shell in ("bash", "zsh", "fish"))
    assert zsh.splitlines()[1] == "autoload -U +X bashcompinit && bashcompinit"
    assert zsh.splitlines()[2:] == bash.splitlines()[1:]
    assert "complete -c nsmodel -n '__fish_seen_subcommand_from run' -l method -x -a \"auto event-driven time-stepping\"" in fish
    assert (
        "complete -c nsmodel -n __fish_use_subcommand -f -a stress -d 'stress test: vary a model\\'s step, units and parameters'"
        in fish
    )
    with pytest.raises(SystemExit, match="0"):
        main(["completion", "--help"])
    assert DESCRIPTION in capsys.readouterr().out


# ---------------------------------------------------------------------------------------------- what is installed


def test_the_package_is_a_program(here):
    code = "import runpy, sys; sys.argv = ['nsmodel', '--version']\ntry: runpy.run_module('nsmodel', run_name='__main__')\n"
    assert re.fullmatch(r"nsmodel \d+\.\d+\.\d+\n", in_a_fresh_process(f"{code}except SystemExit as end: assert not end.code"))


def test_a_wheel_holds_the_package_and_the_cases(tmp_path):
    """Built by hatchling where it is there; what lies in the tree and is no Python is easily forgotten."""
    wheel = pytest.importorskip("hatchling.builders.wheel")
    import zipfile

    path = next(iter(wheel.WheelBuilder(str(REPOSITORY)).build(directory=str(tmp_path), versions=["standard"])))
    held = set(zipfile.ZipFile(path).namelist())
    package = {str(file.relative_to(REPOSITORY)) for file in (REPOSITORY / "nsmodel").rglob("*") if file.is_file()}
    cases = {f"nsmodel/cases/{case.topic}/{case.path.name}" for case in model_files.all_cases()}
    expected = {name for name in package if "__pycache__" not in name} | cases
    assert {name for name in held if name.startswith("nsmodel/")} == {name.replace("\\", "/") for name in expected}
    assert {"nsmodel/py.typed", "nsmodel/cases/circuits/diode_bridge.py", "nsmodel/codegen/c/fixed.c"} <= held
    assert "nsmodel/modeling/laws/ball.c" in held


def test_the_version_to_cite_is_this_one():
    text = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.+)$", text, re.M)[1] == VERSION


def test_what_is_built_is_said():
    """The same where hatchling is not there: the package, with its cases inside, where the shelf looks first."""
    targets = PROJECT["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"]["only-include"] == ["nsmodel", "cases"]
    assert targets["wheel"]["sources"] == {"cases": "nsmodel/cases"}
    assert {"nsmodel", "cases", "README.md"} <= set(targets["sdist"]["include"])
    assert model_files._CASE_FOLDERS[0] == REPOSITORY / "nsmodel" / "cases"


@pytest.mark.parametrize("text", ["/home/jdoe", "C:\\Users\\jdoe", "C:/Users/jdoe/m.py", "~jdoe/m.py", "file:///home/jdoe/m.py"])
def test_homes_of_other_users_are_left_out_of_reports(text):
    assert "jdoe" not in without_machine(f"cannot read {text}, line 3")
    assert without_machine("A/home, ~mask, a ~ b") == "A/home, ~mask, a ~ b"
