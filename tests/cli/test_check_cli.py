"""``nsmodel check``: what it prints, its files and exit status; the verdict line of ``nsmodel run``."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from nsmodel.cli import main
from nsmodel.files.storage import loads

RELAY = """
from nsmodel import LureSystem, relay
model = LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=2, step=0.1, title="Relay")
"""
ANTI = """
from nsmodel import LureSystem, relay
model = LureSystem(A=[[-1]], B=-1, C=1, law=relay(1), x0=1, t_end=1, step=0.1, title="Anti-relay")
"""
PARAMETERS = """
import casadi as ca
from nsmodel import LureSystem, relay
m = ca.SX.sym("m")
model = LureSystem(A=[[-1]], B=1 / m, C=1, law=relay(1), x0=1, t_end=1, step=0.1, parameters={m: None}, title="A mass")
"""
DISC = """
import casadi as ca
from nsmodel import SweepingProcess
q = ca.SX.sym("q", 2)
model = SweepingProcess(q=q, f=[1, 0], constraints={"disc": ca.norm_2(q) - 1}, q0=[-2, 0.1], t_end=1, step=0.1)
"""


@pytest.fixture(name="nsmodel")
def make_nsmodel(tmp_path, monkeypatch, capfd):
    """Return nsmodel("check", "a.py", ...) -> (status, stdout, stderr); model files are written where it runs."""
    monkeypatch.chdir(tmp_path)
    for name, text in {"relay": RELAY, "anti": ANTI, "mass": PARAMETERS, "disc": DISC}.items():
        (tmp_path / f"{name}.py").write_text(text)

    def run(*arguments):
        status = main(list(arguments))
        return status, *capfd.readouterr()

    return run


def test_a_report_is_printed(nsmodel):
    status, out, err = nsmodel("check", "relay.py")
    assert (status, err) == (0, "")
    assert out.startswith("Relay\n")
    lines = out.splitlines()
    assert max(map(len, lines)) <= 100
    for id in ("3.1", "4.1", "5.1", "5.2", "5.4a", "5.4b", "5.4c", "5.x0", "7.1", "run-residual"):
        assert any(line.startswith(f"{id} ") for line in lines), id
    assert any(line.startswith("Lyapunov stable") for line in lines)


def test_strict_exits_with_1_where_a_hypothesis_is_violated(nsmodel):
    assert nsmodel("check", "anti.py", "--quick")[0] == 0
    status, out, _ = nsmodel("check", "anti.py", "--quick", "--strict")
    assert status == 1
    assert "5.1" in out
    assert "violated" in out
    assert nsmodel("check", "relay.py", "--quick", "--strict")[0] == 0


def test_json_has_the_same_content(nsmodel):
    status, out, err = nsmodel("check", "anti.py", "--json", "--quick")
    assert (status, err) == (0, "")
    document = loads(out)
    assert json.loads(out)["file"] == "anti.py"
    verdicts = {finding["id"]: finding["verdict"] for finding in document["findings"]}
    assert verdicts["4.1"] == "holds"
    assert verdicts["5.1"] == "violated"
    found = next(finding for finding in document["findings"] if finding["id"] == "5.1")
    assert found["witness"]
    assert found["source"]
    assert document["quick"] is True


def test_markdown_is_written_beside(nsmodel, tmp_path):
    status, _, _ = nsmodel("check", "relay.py", "--quick", "--markdown", "report/relay.md")
    assert status == 0
    page = (tmp_path / "report" / "relay.md").read_text()
    assert page.startswith("# Relay\n")
    assert "$$" in page
    assert "| **5.1** |" in page


def test_several_files_end_in_a_line_each_and_a_refused_one_does_not_stop_the_others(nsmodel):
    status, out, err = nsmodel("check", "relay.py", "missing.py", "disc.py", "--quick")
    assert status == 2
    assert "missing.py" in err
    last = out.splitlines()[-3:]
    assert [line.split()[0] for line in last] == ["relay", "missing", "disc"]
    assert "proved" in last[0]
    assert last[1].split() == ["missing", "refused"]


def test_parameters_without_value_give_conditions_and_with_value_numbers(nsmodel):
    status, out, _ = nsmodel("check", "mass.py")
    assert status == 0
    assert "1/m > 0" in out
    assert "parameters without value: m" in out
    status, out, _ = nsmodel("check", "mass.py", "--set", "m=2", "--quick", "--json")
    assert status == 0
    assert loads(out)["parameters"] == {"m": 2.0}


def test_a_region_is_taken(nsmodel):
    status, out, _ = nsmodel("check", "disc.py", "--quick", "--region", "q=-3:3")
    assert status == 0
    assert "q_0 in [-3, 3], q_1 in [-3, 3]" in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["relay.py", "--region", "x_0"], "--region x_0: expected NAME=LOW:HIGH, for example --region q_0=-2:2"),
        (["relay.py", "--region", "z=0:1"], "region: 'z' is not a state; the model has x_0, x_1"),
        (["relay.py", "--region", "x_0=1:0"], "region: x_0 = (1.0, 0.0); expected a pair (low, high)"),
        (["relay.py", "anti.py", "--markdown", "a.md"], "--markdown takes one model file; check them one by one"),
        (["relay.py", "--set", "k=1"], "k"),
        (["nowhere.py"], "nowhere.py"),
    ],
)
def test_wrong_input_is_a_usage_error(nsmodel, arguments, message):
    status, out, err = nsmodel("check", *arguments)
    assert status == 2
    assert message in err
    assert "Traceback" not in out + err


def test_a_run_shows_the_verdict_in_one_line_and_loads_no_sympy(nsmodel, tmp_path):
    status, out, _ = nsmodel("run", "relay.py")
    assert status == 0
    line = next(line for line in out.splitlines() if line.startswith("  hypotheses "))
    assert "proved" in line
    code = "import sys; from nsmodel.cli import main; [main(['run', f'{name}.py']) for name in ('relay', 'disc')]"
    code += "; print('sympy' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert result.stdout.count("  hypotheses  ") == 2
    assert result.stdout.splitlines()[-1] == "False"


def test_json_of_a_run_has_the_verdict(nsmodel):
    _, out, _ = nsmodel("run", "anti.py", "--json")
    assert "violated (5.1" in loads(out)["hypotheses"]


CALL = """
import casadi as ca
from nsmodel import MonotoneInclusion
u, x = ca.SX.sym("u"), ca.SX.sym("x")
drag = ca.Function("drag", [u], [u**3], {"never_inline": True})
model = MonotoneInclusion(x=x, field=-ca.fmax(drag(x), x), x0=1, t_end=1, step=0.1)
"""


def test_a_run_that_is_done_is_not_refused_for_what_cannot_be_checked(nsmodel, tmp_path):
    (tmp_path / "call.py").write_text(CALL)
    status, out, err = nsmodel("run", "call.py", "--out", "results")
    assert (status, err) == (0, "")
    assert "  status          done" in out
    assert "not checked: field calls a Function whose code cannot be read" in " ".join(out.split())
    assert loads((tmp_path / "results" / "summary.json").read_text())["hypotheses"].startswith("not checked: ")
    status, _, err = nsmodel("check", "call.py", "--quick")
    assert status == 2
    assert "field calls a Function whose code cannot be read" in err


def test_a_quiet_run_is_not_checked_for_nothing(nsmodel, monkeypatch):
    monkeypatch.setattr("nsmodel.hypotheses.check.check", None)
    assert nsmodel("run", "relay.py", "--quiet")[0] == 0
