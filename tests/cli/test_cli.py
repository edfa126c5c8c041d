"""The command line: what it prints and where, what it saves, and its exit status."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tqdm

import nsmodel
from nsmodel._utils import INVISIBLE_CHARACTERS
from nsmodel.cli import main
from nsmodel.cli.export import without_machine
from nsmodel.files.storage import loads
from nsmodel.modeling.model_files import case_files

RELAY = """
from nsmodel import LureSystem, relay
model = LureSystem(
    A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=2, step=0.1,
    units={"t": "s"}, title="Relay",
)
"""
PARAMETERS = """
import casadi as ca
from nsmodel import LureSystem, relay
mu = ca.SX.sym("mu")
model = LureSystem(A=[[-1]], B=1, C=1, law=relay(1, -mu, mu), x0=1, t_end=1, step=0.1, parameters={mu: 0.5, "k": 1})
"""
FUNCTION = """
import casadi as ca
from nsmodel import LureSystem, relay
def model(n, rate=1.0):
    return LureSystem(
        A=-rate * ca.DM.eye(n), B=[1] * n, C=[[1] * n], law=relay(1, -1, "k" and ca.SX.sym("k")), x0=[1] * n,
        t_end=1, step=0.1, parameters={"k": 1},
    )
"""
ANY = """
from nsmodel import LureSystem, relay
def model(**given):
    return LureSystem(A=[[-given.get("rate", 1)]], B=1, C=1, law=relay(1), x0=1, t_end=1, step=0.1)
"""
NOT_MONOTONE = """
from nsmodel import LureSystem, relay
model = LureSystem(A=[[-1]], B=1, C=1, D=-0.01, law=relay(1), x0=1, t_end=1, step=0.1, title="Not monotone")
"""
WALLS = """
import casadi as ca
from nsmodel import SweepingProcess
t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
model = SweepingProcess(
    t=t, q=q, constraints={"left": 1 - t - q[0], "right": q[0] + 0.5 - t}, q0=[0, 0], t_end=1, step=0.1, title="Two walls"
)
"""


@pytest.fixture(name="run")
def make_run(tmp_path, monkeypatch, capfd):
    """Return run("a.py", text, *options) -> (status, stdout, stderr) with the file written into the working directory."""
    monkeypatch.chdir(tmp_path)

    def run(name, text, *options):
        if text is not None:
            (tmp_path / name).write_text(text)
        status = main(["run", name, *options])
        return status, *capfd.readouterr()

    return run


# a run that ends well


def test_a_run_prints_its_summary_and_nothing_on_stderr(run):
    status, out, err = run("relay.py", RELAY)
    assert (status, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "Relay"
    assert lines[1:6] == [
        "  model class     LureSystem",
        "  scheme          implicit Euler",
        "  status          done",
        "  steps           20, t = 0 to 2 s",
        "  step size       0.1 s",
    ]
    assert re.fullmatch(r"  run time        \S+ s \(\S+ (us|ms) a step, loading and set-up included\)", lines[-2])
    assert lines[-1] == "  hypotheses      9 proved (quick: global searches skipped); along the run: 1 of 1 met"
    assert not list(Path().glob("*-run"))


def test_options_reach_the_run(run):
    options = ["--step", "0.05", "--t-end", "1.02", "--solver", "lemke", "--tolerance", "1e-8", "--save-every", "4"]
    status, out, err = run("relay.py", RELAY, *options, "--out", "results", "--csv", "table/run.csv")
    assert (status, err) == (0, "")
    saved = nsmodel.Trajectory.load("results/trajectory.npz")
    np.testing.assert_allclose(saved.t, [0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.02])
    assert saved.metadata["tolerance"] == 1e-8
    assert set(saved.metadata["solver_counts"]) == {"lemke"}
    assert "steps           21 (1 row saved of 4), t = 0 to 1.02 s" in out
    assert "step size       0.02 to 0.05 s" in out
    assert "  saved           results/trajectory.npz" in out
    table = np.loadtxt("table/run.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:, 1:3], saved.x)
    assert sorted(path.name for path in Path("results").iterdir()) == ["manifest.json", "summary.json", "trajectory.npz"]


def test_json_is_the_text_in_other_words(run):
    _, text, _ = run("relay.py", RELAY, "--out", "results")
    status, out, err = run("relay.py", None, "--out", "results", "--force", "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert found["file"] == "relay.py"
    assert found["status"] == "done"
    assert (found["t"], found["steps"]) == ({"start": 0, "end": 2, "unit": "s"}, 20)
    for value in (found["title"], found["model_class"], found["scheme"], found["saved"]):
        assert value in text
    assert f"worst residual  {found['residual']['worst']:.3g}" in text
    assert f"changed at {found['index_set_changes']} step" in text
    for state in found["final_state"]:
        assert re.search(rf"{state['name']} +{state['value']:.6g}", text)
    for solver, count in found["solver_counts"].items():
        assert re.search(rf"{solver} +{count}\n", text)
    assert found["seconds"] > 0
    assert found["plan"]["used"]
    assert found["pictures"] == []
    saved = loads(Path("results/summary.json").read_text())
    assert saved == loads(out)


def test_quiet_prints_nothing(run):
    assert run("relay.py", RELAY, "--quiet", "--out", "results") == (0, "", "")
    assert Path("results/trajectory.npz").is_file()


def test_a_step_longer_than_the_run_is_refused(run):
    status, _, err = run("relay.py", RELAY, "--step", "100")
    assert status == 2
    assert err == "nsmodel: error: step = 100 is longer than the run, which ends at t_end = 2; choose a step of at most 2\n"
    assert run("relay.py", None, "--step", "2")[2] == ""


def test_explain_says_what_is_left_out_then_runs(run):
    status, out, err = run("relay.py", RELAY, "--explain")
    assert (status, err) == (0, "")
    plan, summary = out.split("\n\n")
    assert plan.startswith("scheme    implicit Euler\nused      2 unknowns, 1 multiplier, ")
    assert "W psd: a gap QP" in plan
    assert "left out  Newton iterations" in plan
    assert summary.startswith("Relay\n")
    _, out, _ = run("relay.py", None, "--explain", "--json")
    assert "left_out" in json.loads(out)["plan"]
    two = RELAY.replace("B=[0, 1], C=[0, 1], law=relay(1)", "B=[[1, 0], [0, 1]], C=[[1, 0], [0, 1]], law=relay(2)")
    _, out, _ = run("two.py", two, "--explain")
    assert "2 multipliers, 8 nonzeros of 16\n" in out
    assert "W psd, not known to be symmetric: a gap QP" in out


def test_codegen_counts_no_more_inverses_than_index_sets(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("relay.py").write_text(RELAY)
    assert main(["codegen", "relay.py"]) == 0
    assert "the inverses of 3 index sets are kept\n" in capsys.readouterr().out


def test_a_failed_run_writes_what_was_asked_for(run):
    """A jump that is no law: the steps stop where it is met; no page, no picture of less than two rows."""
    text = """
import casadi as ca
from nsmodel import FirstOrderSystem
s, w = ca.SX.sym("s"), ca.SX.sym("w")
model = FirstOrderSystem(x=[s, w], f=[w, -400 * s - 4 * ca.sign(w)], x0=[0.053, 0], t_end=0.6, step=5e-4)
"""
    status, out, err = run("fail.py", text, "--html", "fail.html", "--csv", "fail.csv")
    assert status == 3
    assert "  page            fail.html\n" in out
    assert "</html>" in Path("fail.html").read_text(encoding="utf-8")
    assert len(Path("fail.csv").read_text().splitlines()) == 2 + int(re.search(r"(\d+) verified steps are saved", err)[1])
    status, out, err = run("fail.py", None, "--plot", "--window", "0.5:")
    assert status == 3
    assert "picture" not in out
    assert re.search(r"--plot: not all was written \(.*0\.5.*\); nsmodel view fail-run shows what there is\n$", err)


def test_a_film_of_no_discs_is_refused_before_the_run(run):
    status, out, err = run("relay.py", RELAY, "--film", "f.gif", "--out", "results")
    assert (status, out) == (2, "")
    assert "--film shows bodies in the plane, and this model has no scene of discs; --plot writes pictures" in err
    assert not Path("results/trajectory.npz").exists()


def test_plot_writes_pictures_beside_the_run(run):
    status, out, _ = run("relay.py", RELAY, "--plot")
    assert status == 0
    pictures = re.findall(r"  picture         (\S+)", out)
    assert {str(path) for path in Path("relay-run").glob("*.png")} == set(pictures)
    assert "relay-run/overview.png" in pictures
    assert Path("relay-run/trajectory.npz").is_file()
    assert all(Path(path).read_bytes().startswith(b"\x89PNG") for path in pictures)


def test_a_run_is_resumed(run):
    run("relay.py", RELAY, "--out", "whole")
    run("relay.py", None, "--out", "part", "--t-end", "1")
    status, out, err = run("relay.py", None, "--out", "part", "--resume")
    assert (status, err) == (0, "")
    assert "steps           20, t = 0 to 2 s" in out
    assert Path("part/trajectory.npz").read_bytes() == Path("whole/trajectory.npz").read_bytes()


def test_a_file_without_a_title_lends_its_name(run):
    _, out, _ = run("parameters.py", PARAMETERS)
    assert out.startswith("parameters\n")


# --set


@pytest.mark.parametrize(
    ("text", "settings", "parameters", "states"),
    [
        (PARAMETERS, ["mu=0.25"], {"mu": 0.25, "k": 1}, 1),
        (PARAMETERS, ["mu=1e-1", "k = 2"], {"mu": 0.1, "k": 2}, 1),
        (FUNCTION, ["n=3"], {"k": 1}, 3),
        (FUNCTION, ["n=2", "rate=2.5", "k=2"], {"k": 2}, 2),
        (ANY, ["rate=2", "other=1"], {}, 1),
    ],
)
def test_set_gives_parameters_and_arguments(run, text, settings, parameters, states):
    options = [word for setting in settings for word in ("--set", setting)]
    assert run("m.py", text, *options, "--out", "results", "--quiet") == (0, "", "")
    saved = nsmodel.Trajectory.load("results/trajectory.npz")
    assert saved.metadata["parameters"] == parameters
    assert saved.x.shape[1] == states


@pytest.mark.parametrize(
    ("text", "setting", "message"),
    [
        (PARAMETERS, "mu", "--set mu: expected NAME=VALUE, for example --set mu=0.3"),
        (PARAMETERS, "=1", "--set =1: expected NAME=VALUE"),
        (PARAMETERS, "mu=one", "--set mu=one: 'one' is not a number"),
        (PARAMETERS, "mu=nan", "parameter 'mu' = nan; expected a finite number"),
        (
            PARAMETERS,
            "mmu=1",
            "m.py takes no 'mmu': arguments of model() are none, parameters of the model mu, k. Did you mean 'mu'?",
        ),
        (PARAMETERS, "mu=-1", "law: relay has lower[0] = 1 above upper[0] = -1 with mu = -1"),
        (FUNCTION, "k=1", "m.py: model() needs a value for 'n'; give it with --set n=VALUE, or a default"),
        (RELAY, "n=1", "m.py takes no 'n': arguments of model() are none, parameters of the model none"),
    ],
)
def test_wrong_settings_are_refused(run, text, setting, message):
    status, out, err = run("m.py", text, "--set", setting)
    assert (status, out) == (2, "")
    assert message in err
    assert err.startswith("nsmodel: ")


# what is refused: status 2, one line on standard error


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = (1,\nfrom\n", "model error: m.py:1: SyntaxError: '(' was never closed"),
        ("import math\n\nmath.nothing\n", "model error: m.py:3: AttributeError: module 'math' has no attribute 'nothing'"),
        ("def f(x):\n    return 1 / x\n\n\nf(0)\n", "model error: m.py:2: ZeroDivisionError: division by zero"),
        ("def model():\n    return {}['a']\n", "model error: m.py:2: KeyError: 'a'"),
        ("import sys\nsys.exit(4)\n", "model error: m.py:2: SystemExit: 4"),
        ("x = 1\n", "model error: m.py defines no 'model'; end the file with model = LureSystem(...) or def model(): ..."),
        ("model = 5\n", "model error: m.py: model is of type int; expected one of nsmodel's model classes"),
        ("def model():\n    return 5\n", "model error: m.py: model is of type int; expected one of"),
        (
            "from nsmodel import LureSystem as model\n",
            "model error: m.py: model is the class LureSystem itself; write model = LureSystem(...)",
        ),
        (RELAY.replace("B=[0, 1]", "B=[0, 1, 2]"), "model error: m.py:3: B: shape (3, 1); expected (2, 1)"),
        (RELAY.replace("x0=[3, 0]", "x0=[3, k]"), "model error: m.py:4: NameError: name 'k' is not defined"),
    ],
)
def test_a_wrong_model_file_is_named_with_its_line(run, text, message):
    status, out, err = run("m.py", text)
    assert (status, out) == (2, "")
    assert err.startswith(f"nsmodel: {message}")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--step", "-1"], "step = -1; expected a finite number > 0"),
        (["--t-end", "0"], "t_end = 0; expected a finite number > 0"),
        (["--tolerance", "2"], "tolerance = 2; expected a number between 1e-14 and 1"),
        (["--tolerance", "nan"], "tolerance = nan; expected a number between 1e-14 and 1"),
        (["--save-every", "0"], "save_every = 0; expected a whole number >= 1"),
        (["--solver", "simplex"], "solver 'simplex' is unknown; choose one of auto, qpoases, qrqp"),
        (["--resume"], "--resume needs --out DIR, the folder of the run to continue"),
        (["--resume", "--out", "nothing"], "storage error: nothing to resume in nothing: no manifest.json"),
        (["--out", "m.py/results"], "storage error: cannot write into m.py/results"),
        (["--csv", "m.py/run.csv"], "storage error: cannot write m.py/run.csv"),
        (["m.py", "--out", "results"], "two files are called 'm': their results would go to one folder"),
        (["other.py", "--csv", "run.csv"], "--csv takes one model file; for several give --out DIR"),
    ],
)
def test_wrong_options_are_refused(run, options, message):
    status, out, err = run("m.py", RELAY, *options)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


def test_a_forced_solver_that_does_not_apply_is_refused_with_the_reason(run):
    for solver, message in (
        ("qpoases", "the step is not a convex QP (least eigenvalue of W + W' -1); use active-set, lemke, enumeration or ipopt"),
        ("qrqp", "solver 'qrqp' does not apply"),
    ):
        status, out, err = run("m.py", RELAY.replace("x0=", "D=-5, x0="), "--solver", solver)
        assert (status, out) == (2, "")
        assert message in err


def test_missing_files_and_folders(run, tmp_path):
    for name, message in (
        ("absent.py", "model file 'absent.py' does not exist; give the path of a Python file that defines model = ..."),
        (str(tmp_path), f"model file '{tmp_path}' is a folder; give the path of a Python file"),
        ("notes.txt", "'notes.txt' is not a Python file (.py)"),
    ):
        (tmp_path / "notes.txt").write_text("model = 1")
        status, out, err = run(name, None)
        assert (status, out) == (2, "")
        assert err.startswith(f"nsmodel: error: {message}")


def test_load_says_what_a_file_takes(tmp_path):
    (tmp_path / "f.py").write_text(FUNCTION)
    (tmp_path / "m.py").write_text(RELAY)
    assert nsmodel.load(tmp_path / "f.py", n=2).x.numel() == 2
    with pytest.raises(nsmodel.UsageError, match=r"f\.py: model\(\) takes no 'm'; it takes n, rate"):
        nsmodel.load(tmp_path / "f.py", m=2)
    with pytest.raises(nsmodel.UsageError, match=r"f\.py: model\(\) needs a value for 'n'"):
        nsmodel.load(tmp_path / "f.py")
    with pytest.raises(nsmodel.UsageError, match=r"m\.py defines a model, not a function: it takes no n"):
        nsmodel.load(tmp_path / "m.py", n=2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["run"], "the following arguments are required: FILE"),
        (["run", "m.py", "--step", "a"], "argument --step: invalid float value: 'a'"),
        (["run", "m.py", "--save-every", "1.5"], "argument --save-every: invalid int value: '1.5'"),
    ],
)
def test_what_the_parser_refuses_has_status_2(capsys, arguments, message):
    with pytest.raises(SystemExit, match=r"^2$") as caught:
        main(arguments)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err


# warnings


def test_warnings_go_to_stderr_once(run):
    for options in ([], ["--quiet"], ["--json"]):
        status, out, err = run("m.py", NOT_MONOTONE, *options)
        assert status == 0
        lines = err.splitlines()
        assert len(lines) == len(set(lines)) == len(nsmodel.simulate(nsmodel.load("m.py")).metadata["warnings"])
        assert all(line.startswith("nsmodel: warning: ") for line in lines)
        assert lines[0] == "nsmodel: warning: D is not positive semidefinite (least eigenvalue of its symmetric part -0.01)"
        assert "warning" not in out or options == ["--json"]
    assert json.loads(out)["warnings"] == [line.removeprefix("nsmodel: warning: ") for line in lines]


# several files


def test_several_files_end_in_a_table(run, tmp_path):
    (tmp_path / "b.py").write_text(NOT_MONOTONE)
    status, out, err = run("a.py", RELAY, "b.py", "absent.py", "--out", "results")
    assert status == 2
    head, *rows = (re.split(r"  +", line) for line in out.splitlines())
    assert head == ["model", "status", "steps", "t", "worst residual", "index set changes", "run time", "picture"]
    assert [row[:4] for row in rows[:2]] == [["a", "done", "20", "2"], ["b", "done", "10", "1"]]
    assert rows[2] == ["absent", "refused"]
    assert "nsmodel: b.py: warning: D is not positive semidefinite" in err
    assert "model file 'absent.py' does not exist" in err
    assert sorted(path.name for path in Path("results").iterdir()) == ["a", "b"]
    status, out, _ = run("a.py", None, "b.py", "absent.py", "--json")
    assert status == 2
    assert [one["file"] for one in json.loads(out)] == ["a.py", "b.py", "absent.py"]
    assert json.loads(out)[2] == {
        "file": "absent.py",
        "status": "refused",
        "message": "model file 'absent.py' does not exist; give the path of a Python file that defines model = ... "
        "(nsmodel cases lists some)",
    }
    status, out, _ = run("a.py", None, "b.py", "--quiet")
    assert (status, out) == (0, "")


def test_a_table_names_the_overview_pictures(run, tmp_path):
    (tmp_path / "b.py").write_text(NOT_MONOTONE)
    _, out, _ = run("a.py", RELAY, "b.py", "--plot", "--out", "results")
    assert "results/a/overview.png" in out
    assert Path("results/b/overview.png").is_file()


# a step that fails: status 3


def test_a_failing_step_is_named_and_the_rest_is_saved(run):
    status, out, err = run("walls.py", WALLS)
    assert status == 3
    first, second = err.splitlines()
    assert first.startswith(
        "nsmodel: error: step 7: no verified step from t = 0.7 to 0.8: the constraints leave no point: "
        "'left' (weight 0.5) and 'right' (weight 0.5) oppose each other. Best residual "
    )
    assert "(tolerance 1e-09)" in first
    assert second == "nsmodel: 7 verified steps are saved in walls-run/trajectory.npz"
    assert "  status          failed\n  steps           7, t = 0 to 0.7\n" in out
    saved = nsmodel.Trajectory.load("walls-run/trajectory.npz")
    assert (saved.status, len(saved)) == ("failed", 7)
    assert saved.metadata["message"] in first
    assert json.loads(Path("walls-run/summary.json").read_text())["status"] == "failed"


def test_a_failing_step_with_out_json_and_quiet(run):
    status, out, err = run("walls.py", WALLS, "--out", "results", "--json")
    assert status == 3
    assert json.loads(out)["status"] == "failed"
    assert json.loads(out)["message"] in err
    assert json.loads(out)["saved"] == "results/trajectory.npz"
    assert len(nsmodel.Trajectory.load("results/trajectory.npz")) == 7
    status, out, err = run("walls.py", None, "--out", "results", "--force", "--quiet")
    assert (status, out) == (3, "")
    assert err.count("\n") == 2


def test_a_failing_step_among_several_files(run, tmp_path):
    (tmp_path / "a.py").write_text(RELAY)
    status, out, err = run("walls.py", WALLS, "a.py")
    assert status == 3
    assert re.search(r"walls +failed +7 +0\.7 ", out)
    assert re.search(r"a +done +20 +2 ", out)
    assert err.startswith("nsmodel: walls.py: error: step 7: ")


# progress and interrupts


class Terminal:
    """A standard error that says it is a terminal."""

    def isatty(self):
        return True

    def write(self, text):
        return len(text)

    def flush(self):
        pass


def test_the_progress_bar_is_for_terminals(run, monkeypatch):
    bars = []

    class Bar(tqdm.tqdm):
        def __init__(self, **options):
            super().__init__(**options)
            bars.append(self)

    monkeypatch.setattr(tqdm, "tqdm", Bar)
    run("relay.py", RELAY, "--step", "0.01")
    assert not bars
    monkeypatch.setattr(sys, "stderr", Terminal())
    run("relay.py", None, "--step", "0.01", "--quiet")
    run("relay.py", None, "--step", "0.01", "--json")
    assert not bars
    run("relay.py", None, "--step", "0.01")
    assert [(bar.total, bar.n) for bar in bars] == [(200, 200)]


def test_a_signal_saves_what_was_computed(tmp_path):
    """The model steps smoothly, so that no solver is at work when the signal comes."""
    (tmp_path / "long.py").write_text(
        "from nsmodel import LureSystem, relay\n"
        "model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 0], D=1, law=relay(1), x0=[1, 0], t_end=900, step=1e-3)\n"
        "print('loaded', flush=True)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(nsmodel.__file__).parents[1]), "CC": "none"}  # nothing is built
    command, begun = [sys.executable, "-m", "nsmodel", "run", "long.py"], []
    for out, number, status in (("", signal.SIGINT, 130), ("results", signal.SIGTERM, 143)):
        process = subprocess.Popen(
            [*command, *(["--out", out] if out else [])], cwd=tmp_path, env=environment, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        begun.append((process, out, number, status))
    for process, *_ in begun:
        assert process.stdout.readline() == "loaded\n"
    time.sleep(2.0)  # set-up takes a part of it
    for process, out, number, status in begun:
        process.send_signal(number)
        printed, errors = process.communicate(timeout=60)
        assert process.returncode == status
        folder = tmp_path / (out or "long-run")
        saved = nsmodel.Trajectory.load(folder / "trajectory.npz")
        assert saved.status == "interrupted"
        assert len(saved) > 100
        np.testing.assert_allclose(np.diff(saved.t), 1e-3, rtol=1e-6)
        first, second = errors.splitlines()
        assert first == f"nsmodel: interrupted at t = {saved.t[-1]:.10g}"
        assert second.startswith(f"nsmodel: {len(saved)} verified steps are saved in {folder.name}/trajectory.npz")
        assert ("--resume" in second) is bool(out)
        assert "  status          interrupted\n" in printed


def test_ctrl_c_stops_the_files_that_follow(run, monkeypatch, tmp_path):
    def interrupted(*args, **options):
        raise nsmodel.RunInterrupted(nsmodel.simulate(nsmodel.load("a.py")))

    (tmp_path / "b.py").write_text(NOT_MONOTONE)
    (tmp_path / "a.py").write_text(RELAY)
    monkeypatch.setattr("nsmodel.cli.run.simulate", interrupted)
    status, out, _ = run("a.py", None, "b.py")
    assert status == 130
    assert "b " not in out
    (tmp_path / "c.py").write_text("raise KeyboardInterrupt\n")
    assert run("c.py", None) == (130, "", "nsmodel: interrupted\n")


# the summary of every class is for people to read


@pytest.mark.parametrize("path", [*case_files().values()], ids=lambda path: path.stem)
def test_no_case_prints_a_nan_or_an_inf(run, path):
    step = nsmodel.load(path).step
    status, out, _ = run(str(path), None, "--t-end", str(7 * step))
    assert status == 0
    assert not re.search(r"\b(nan|inf|None)\b", out), out
    assert max(map(len, out.splitlines())) <= 100
    assert "steps           7, " in out


def test_a_start_of_two_positions_has_no_step_for_the_second(run):
    _, out, _ = run(str(case_files()["cabot_4_1"]), None)
    assert "  step size       1\n" in out
    assert "  energy          0.2 at the start, 0.00155968 at the end\n" in out
    assert re.search(r"  worst residual  \d\.\d+e-1[4-9] at t = \d+\n", out)
    assert "  convergence     in finite time: at rest from t = 33 on, step 33\n" in out


def test_a_residual_of_zero_has_no_time(run):
    _, out, _ = run(str(case_files()["inclusion_8_1"]), None)
    assert "  worst residual  0\n" in out


def test_a_run_with_an_exact_solution_shows_its_largest_error(run):
    _, out, _ = run(str(case_files()["sliding_relay"]), None)
    assert re.search(r"  largest error   0\.00\d+ from the exact state\n", out)


def test_the_smallest_gap_has_the_name_of_its_constraint(run):
    _, out, _ = run(str(case_files()["point_past_disc"]), None)
    assert re.search(r"  smallest gap    \d\S* of 'disc' at t = \d\S* s\n", out)
    assert "  newton          1 iteration at every step\n" in out


# what a model file prints


PRINTS = """
from nsmodel import MonotoneInclusion
print("loading")
def fine(mu):
    print("asked")
    return mu**3
def model(n=1):
    print("building")
    return MonotoneInclusion(x="x", field=0, x0=1, upper=2, t_end=1, step=0.5, tolerances=fine)
"""


@pytest.mark.parametrize(
    ("command", "options"),
    [("run", []), ("check", []), ("study", ["--budget", "0.5", "--steps", "0.5"]), ("stress", ["--budget", "0.01"])],
)
def test_json_stands_alone_whatever_a_model_file_prints(tmp_path, capsys, command, options):
    (tmp_path / "m.py").write_text(PRINTS)
    main([command, str(tmp_path / "m.py"), *options, "--json"])
    out, err = capsys.readouterr()
    assert json.loads(out)["file"] == str(tmp_path / "m.py")
    assert {"loading", "building", "asked"} <= set(err.split())


def test_without_json_a_model_file_prints_where_it_likes(run):
    status, out, _ = run("m.py", PRINTS)
    assert status == 0
    assert out.startswith("loading\nbuilding\n")


def test_a_model_file_imports_its_neighbour_from_anywhere(run, tmp_path):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "springs.py").write_text("STIFFNESS = 4\n")
    text = RELAY.replace("-1, 0", "-STIFFNESS, 0") + "from springs import STIFFNESS as again\n"
    status, out, err = run("models/m.py", "from springs import STIFFNESS\n" + text)
    assert (status, err) == (0, "")
    assert out.startswith("Relay\n")
    assert "springs" not in sys.modules


@pytest.mark.parametrize("command", ["run", "check", "codegen"])
def test_what_moves_a_cursor_or_turns_the_direction_is_not_printed(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = "names=['q' + chr(0x202E)], title='a' + chr(27) + '[31m'"
    model = f"nsmodel.FirstOrderSystem(x=x, f=[-x[0]], x0=[1], t_end=1, step=0.5, {words})"
    Path("odd.py").write_text(f"import casadi as ca, nsmodel\nx = ca.SX.sym('x', 1)\nmodel = {model}\n")
    assert main([command, "odd.py"]) == 0
    printed = capsys.readouterr()
    assert not INVISIBLE_CHARACTERS.search((printed.out + printed.err).replace("\n", ""))


# ---------------------------------------------------------------------------------------------- finished results

FINISHED = {  # Commands, and the file that is theirs when all is done.
    "run": (["run", "m.py", "--quiet"], "trajectory.npz"),
    "study": (["study", "m.py", "--steps", "0.1,0.05", "--budget", "0.2"], "study.json"),
    "stress": (["stress", "m.py", "--budget", "1e-3"], "stress.json"),
    "sensitivity": (["sensitivity", "m.py", "--by", "x(0)", "--rtol", "1e-6"], "sensitivity.json"),
}
DECAY = """
from nsmodel import LureSystem, relay
model = LureSystem(x=["x"], A=[[-1]], B=1, C=1, law=relay(1), x0=1, t_end=0.2, step=0.1, title="TITLE")
"""


@pytest.mark.parametrize("command", FINISHED)
def test_what_is_finished_is_replaced_by_force_alone(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words, result = FINISHED[command]
    Path("m.py").write_text(DECAY)
    assert main([*words, "--out", "kept"]) == 0
    before = {path: path.read_bytes() for path in Path("kept").iterdir()}
    Path("m.py").write_text(DECAY.replace("TITLE", "another").replace("x0=1", "x0=2"))
    capsys.readouterr()
    assert main([*words, "--out", "kept"]) == 2
    assert f"kept holds a result ({result}); give --force to replace it, or another folder" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in Path("kept").iterdir()} == before
    assert main([*words, "--out", "kept", "--force"]) == 0
    assert Path("kept", result).read_bytes() != before[Path("kept", result)]


@pytest.mark.parametrize("command", ["study", "stress", "sensitivity"])
def test_a_file_is_no_folder_to_write_into(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("m.py").write_text(DECAY)
    Path("kept").write_text("mine")
    assert main([*FINISHED[command][0], "--out", "kept"]) == 2
    assert "--out kept is a file; give a folder" in capsys.readouterr().err
    assert Path("kept").read_text() == "mine"


def test_a_finished_run_is_gone_on_with_and_each_of_several_files_has_its_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("m.py", "n.py"):
        Path(name).write_text(DECAY)
    assert main(["run", "m.py", "--out", "one", "--quiet"]) == 0
    assert main(["run", "m.py", "--out", "one", "--resume", "--t-end", "0.4", "--quiet"]) == 0
    assert nsmodel.Trajectory.load("one/trajectory.npz").t[-1] == 0.4
    assert main(["run", "m.py", "--out", "both", "--quiet"]) == 0
    assert main(["run", "m.py", "n.py", "--out", "both", "--quiet"]) == 0
    assert main(["run", "m.py", "n.py", "--out", "both", "--quiet"]) == 2
    told = capsys.readouterr().err
    assert "both/m holds a result" in told
    assert "both/n holds a result" in told
    assert main(["run", "m.py", "--plot", "--quiet"]) == main(["run", "m.py", "--plot", "--quiet"]) == 0


# ---------------------------------------------------------------------------------------------- reports


@pytest.fixture(name="somewhere")
def make_somewhere(tmp_path, monkeypatch):
    """A folder whose path, user and host are names that no text has by chance."""
    home = tmp_path / "zelda_home"
    (home / "secret work").mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("LOGNAME", "zelda")
    monkeypatch.setattr("socket.gethostname", lambda: "hyrule")
    monkeypatch.chdir(home / "secret work")
    return home / "secret work"


def names_of_the_machine(text, folder):
    """What of a text tells where it was made."""
    known = ["zelda", "hyrule", "secret", str(folder), *folder.parts[1:-2], str(Path(nsmodel.__file__).parent), sys.prefix]
    return [name for name in known if name in text]


REPORTED = """
import casadi as ca
from nsmodel import FirstOrderSystem, complementarity
x, l, k = ca.SX.sym("x"), ca.SX.sym("l"), ca.SX.sym("k")
# made by zelda on hyrule, see PATH
model = FirstOrderSystem(x=x, lam=l, f=-k, g=SIGN*l, h=x, law=complementarity(1), x0=[0.5], t_end=1, step=0.1,
                         parameters={k: (1 + 2)/3/1}, title="A floor")
"""


@pytest.mark.parametrize(("sign", "status"), [("+", "done"), ("-", "failed")])
@pytest.mark.parametrize("absolute", [False, True])
def test_a_report_holds_what_a_bug_needs_and_nothing_of_the_machine(somewhere, capsys, sign, status, absolute):
    file = (somewhere if absolute else Path()) / "floor.py"
    file.write_text(REPORTED.replace("SIGN", sign + "1").replace("PATH", str(somewhere / "notes.txt")))
    assert main(["run", str(file), "--out", "kept", "--quiet"]) == (0 if status == "done" else 3)
    assert main(["report", "kept"]) == 0
    assert capsys.readouterr().out == f"report  {Path('kept', 'report.md')}\n"
    text = Path("kept/report.md").read_text()
    assert names_of_the_machine(text, somewhere) == []
    for expected in (
        f"- nsmodel: {nsmodel.__version__}", f"- numpy: {np.__version__}", "- casadi: ", "- sympy: ", "- C compiler: ",
        f"  status          {status}", "# made by USER on HOST, see .../notes.txt", "parameters={k: (1 + 2)/3/1}",
        "- Python: CPython ", "- k: 1.0",
    ):  # fmt: skip
        assert expected in text
    assert ("step has no solution" in text) is (status == "failed")
    assert ("hypothesis 5.1 is violated" in text) is (status == "failed")


def test_a_report_names_the_model_that_is_given(somewhere, capsys):
    Path("floor.py").write_text(REPORTED.replace("SIGN", "1"))
    nsmodel.simulate(nsmodel.load("floor.py"), out="kept")
    assert main(["report", "kept", "--out", "a.md"]) == 0
    assert "the run's folder does not say which file its model is in: give --model FILE" in Path("a.md").read_text()
    assert main(["report", "kept/trajectory.npz", "--model", "floor.py", "--out", "b.md"]) == 0
    assert "law=complementarity(1)" in Path("b.md").read_text()
    assert main(["report", "kept", "--model", "nowhere.py"]) == 2
    assert main(["report", "nowhere"]) == 2
    assert "there is no run in 'nowhere'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "left"),
    [
        ('  File "/usr/lib/zelda/x.py", line 3', '  File ".../x.py", line 3'),
        ("cannot write /mnt/a/run/chunk-000001.npz: No space", "cannot write .../chunk-000001.npz: No space"),
        ("file:///mnt/a/b.html", ".../b.html"),
        (r"C:\Users\zelda\run\m.py does not exist", ".../m.py does not exist"),
        ("process 7 on hyrule, of zelda.", "process 7 on HOST, of USER."),
        ("x' = (a + b)/c/d, 1/2/3, N m/s/kg, a / b / c", "x' = (a + b)/c/d, 1/2/3, N m/s/kg, a / b / c"),
        ("https://example.org/a/b", "https://example.org/a/b"),
        ("cases/mechanics/belt.py", "cases/mechanics/belt.py"),
        ("zeldas hyrules", "zeldas hyrules"),
    ],
)
def test_what_is_left_out_of_a_report(somewhere, given, left):
    assert without_machine(given) == left
    assert without_machine(f"{somewhere}/deep/m.py") == ".../m.py"
    assert without_machine(f"in {somewhere.parent}") == "in ~"
