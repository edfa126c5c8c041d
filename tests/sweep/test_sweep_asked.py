"""What is asked of a sweep wrongly is refused before it runs, and cells that fail take nothing from the others."""

import ast
import re

import casadi as ca
import numpy as np
import pytest
from conftest import REPOSITORY
from sweep_models import K, friction, with_stop

from nsmodel import LureSystem, PlotError, StepError, StorageError, Sweep, UsageError, relay, simulate, sweep
from nsmodel.cli import main
from nsmodel.cli.sweep import OPTION_SPELLINGS

END = {"outputs": {"end": "x_1[-1]"}, "t_end": 0.1, "workers": 1}


@pytest.mark.parametrize(
    ("message", "options"),
    [
        (r"'k' is a parameter of the model, a number; 'soft' is none", {"grid": {"k": [1, "soft"]}}),
        (r"'k' is a parameter of the model, a number; None is none", {"grid": {"k": [1, None]}}),
        (r"'k' is a parameter of the model, a number; True is none", {"grid": {"k": [True, False]}}),
        (r"'k' is varied, but parameters= also gives it 3; keep one", {"grid": {"k": [1, 2]}, "parameters": {"k": 3}}),
        (r"'k' is varied, but parameters= also gives it 3; keep one", {"grid": {"k": [1, 2]}, "parameters": {K: 3}}),
        (r"rtol = -1; expected a number between", {"grid": {"k": [1]}, "rtol": -1}),
        (r"atol = -1; expected a number >= 0", {"grid": {"k": [1]}, "rtol": 1e-6, "atol": -1}),
        (r"times\[1\] = 5 is outside the run", {"grid": {"k": [1]}, "rtol": 1e-6, "times": [0.0, 5.0]}),
        (r"times\[2\] = 0\.01 is not after", {"grid": {"k": [1]}, "rtol": 1e-6, "times": [0.0, 0.05, 0.01]}),
        (r"every counts steps, which runs with rtol", {"grid": {"k": [1]}, "rtol": 1e-6, "every": 3}),
        (r"step = 'short'; expected a finite number > 0", {"grid": {"k": [1]}, "step": "short"}),
        (r"keep = 3; expected names of columns", {"grid": {"k": [1]}, "keep": 3}),
        (r"'3' cannot be the name of a quantity", {"grid": {"k": [1]}, "keep": [3]}),
        (r"'a/b' cannot be the name of a quantity", {"grid": {"k": [1]}, "outputs": {"a/b": "x_1[-1]"}}),
        (r"'dim:k' cannot be the name of a quantity", {"grid": {"k": [1]}, "outputs": {"dim:k": "x_1[-1]"}}),
        (r"'k' is varied, so each cell has it already", {"grid": {"k": [1]}, "outputs": {"k": "x_1[-1]"}}),
        (r"start returned x_1 = nan; expected a finite", {"seeds": 2, "start": lambda rng: {"x_1": np.nan}}),
        (r"start returned x = array\(.*expected a finite", {"seeds": 2, "start": lambda rng: {"x": rng.uniform(size=2)}}),
        (r"start, called with a random generator: TypeError", {"seeds": 2, "start": lambda: {"x_1": 1}}),
    ],
)  # fmt: skip
def test_wrong_requests_are_refused_before_anything_is_written(message, options, tmp_path):
    with pytest.raises(UsageError, match=message):
        sweep(friction(x0=[5, 0]), **(END | options), out=tmp_path / "never")
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize("compiled", [True, False])
def test_a_row_that_no_run_has_is_named(compiled):
    with pytest.raises(UsageError, match=r"output 'x_1\[11\]': there is no row 11; runs of this sweep have 11 rows"):
        sweep(friction(), grid={"k": [1, 2]}, outputs={"late": "x_1[11]"}, t_end=0.1, compiled=compiled, workers=1)


@pytest.mark.parametrize("compiled", [True, False])
def test_an_output_may_be_a_vector(compiled):
    found = sweep(
        friction(), grid={"k": [0.9, 1.1]}, outputs={"end": "x[-1]", "high": "max(x)"}, t_end=1.0, compiled=compiled, workers=1
    )
    assert found["end"].dims == ("k", "end_entry")
    for i, k in enumerate([0.9, 1.1]):
        run = simulate(friction(), parameters={"k": k}, t_end=1.0, compiled=False)
        np.testing.assert_allclose(found["end"].values[i], run.x[-1], atol=1e-11)
        np.testing.assert_allclose(found["high"].values[i], run.x.max(axis=0), atol=1e-11)


def test_numbers_among_texts_stay_numbers():
    def make(n):
        return friction(x0=[3 + (0 if n == "none" else n), 0])

    found = sweep(make, grid={"n": ["none", 2]}, outputs={"begin": "x_1[0]"}, t_end=0.1, workers=1)
    np.testing.assert_array_equal(found["begin"].values, [3, 5])


def test_an_output_may_say_that_a_run_has_no_result():
    def swing(run):
        if run.x[-1, 0] > 3:
            raise StepError(f"x = {run.x[-1, 0]:.2f}: not down yet")
        return run.x[-1, 0]

    found = sweep(friction(), grid={"x0": [3, 6]}, keep="x_1", outputs={"swing": swing}, t_end=1.0, workers=1)
    assert found.status.tolist() == [0, 1]
    assert found.messages[1].endswith(": not down yet")
    assert np.isnan(found["swing"].values[1])
    assert np.isfinite(found["x_1"].values).all()


def both_ends(run):
    return run.q[[0, -1]]


@pytest.mark.parametrize("values", [[0.8, 0.5], [0.5, 0.8], [0.8, 0.9]])
@pytest.mark.parametrize("stored", [True, False])
def test_a_failed_cell_has_no_shape(values, stored, tmp_path):
    """Wherever it stands, and even if there are no others."""
    found = sweep(
        with_stop(), grid={"a": values}, outputs={"ends": both_ends}, keep="q", step=0.01, workers=1,
        out=tmp_path / "a" if stored else None,
    )  # fmt: skip
    done = np.array(values) < 0.7
    np.testing.assert_array_equal(found.status, np.where(done, 0, 1))
    ends = found["ends"].values
    assert ends.shape == ((2, 2) if done.any() else (2,))
    assert np.isnan(ends[~done]).all()
    if done.any():
        np.testing.assert_allclose(ends[done][0], [0, 0.5], atol=1e-6)
    assert found["q"].values.shape == (2, len(found.t))
    found.to_csv(tmp_path / "cells.csv")


def test_a_sweep_without_any_model_still_has_its_quantities(tmp_path):
    radius = ca.SX.sym("radius")
    model = LureSystem(
        names=["x_1"], A=[[-1]], B=[[1]], C=[[1]], D=0, law=relay(1, -radius, radius), x0=[1],
        parameters={radius: 1}, t_end=0.1, step=0.01,
    )  # fmt: skip
    for out in (None, tmp_path / "a"):
        found = sweep(model, grid={"radius": [-1, -2]}, keep="x_1", outputs={"end": "x_1[-1]"}, workers=1, out=out)
        assert found.status.tolist() == [3, 3]
        assert np.isnan(found["end"].values).all()
        assert found["x_1"].values.shape == (2, len(found.t))
    np.testing.assert_array_equal(Sweep.load(tmp_path / "a")["end"].values, [np.nan, np.nan])


def test_outputs_of_other_shapes_are_refused(tmp_path):
    def ragged(run):
        return run.x[: int(run.metadata["parameters"]["k"]), 0]

    for out in (None, tmp_path / "a"):
        with pytest.raises(UsageError, match=r"'end' has shape \(2,\) in one cell and \(1,\) in another"):
            sweep(friction(), grid={"k": [1, 2]}, outputs={"end": ragged}, t_end=0.1, workers=1, out=out)


def test_the_folder_of_a_run_is_no_sweep(tmp_path):
    simulate(friction(), t_end=0.1, out=tmp_path / "run")
    for resume in (True, False):
        with pytest.raises(StorageError, match=r"holds no sweep: its manifest\.json is that of a run"):
            sweep(friction(), grid={"k": [1, 2]}, **END, out=tmp_path / "run", resume=resume)


def test_pictures_over_what_is_asked_for(tmp_path):
    found = sweep(
        friction(), grid={"k": [0.9, 1.1], "a": [0.8, 1.0, 1.2]}, outputs={"end": "x_1[-1]"}, t_end=0.1, workers=1
    )  # fmt: skip
    assert found.plot("end").get_xlabel().startswith("a")
    shaded = found.end.plot()  # of two parameters a map
    assert (shaded.get_xlabel()[0], shaded.get_ylabel()[0]) == ("a", "k")
    np.testing.assert_array_equal(shaded.collections[0].get_array(), found["end"].values)
    line = found.end.at(k=1.1).plot()
    np.testing.assert_array_equal(line.get_lines()[0].get_ydata(), found["end"].values[1])
    np.testing.assert_array_equal(line.get_lines()[0].get_xdata(), [0.8, 1.0, 1.2])
    with pytest.raises(AttributeError, match=r"a variable has no 'plt'\. Did you mean 'plot'"):
        found.end.plt()
    assert found.plot("end", x="k", y="a").get_xlabel().startswith("k")
    ax = found.plot("end", x="a", hue="k")
    drawn = {tuple(line.get_ydata()) for line in ax.get_lines()}
    assert {tuple(values) for values in found["end"].values.tolist()} <= drawn
    with pytest.raises(PlotError, match="'b'"):
        found.plot("end", x="b")
    blocked = tmp_path / "file"
    blocked.write_text("")
    pytest.importorskip("zarr")
    with pytest.raises(StorageError, match="cannot write"):
        found.to_zarr(blocked / "cells.zarr")


def test_the_first_chunk_leaves_work_for_others():
    found = sweep(friction(), grid={"k": np.linspace(1, 2, 40)}, outputs={"end": "x_1[-1]"}, t_end=0.1, compiled=True, workers=2)
    assert "2 threads" in found.plan


def test_what_is_shown_of_a_quantity_is_short():
    found = sweep(with_stop(), grid={"a": [0.4, 0.8]}, keep="q", step=0.01, workers=1)
    assert repr(found["q"]).startswith("Variable('q', a 2 x t 201, 0 to 0.6")
    assert repr(found["q"]).endswith(", 1 failed)")


BELT = """
from nsmodel import LureSystem, relay
F = 3
def model(mu=0.1):
    return LureSystem(A=[[-1]], B=1, C=1, law=relay(1, -mu, mu), x0=1, t_end=0.1, step=0.1, names=["position"])
"""


@pytest.fixture(name="belt")
def make_belt(tmp_path, monkeypatch, capsys):
    """belt(*words) -> what the command says of a file: (status, out, err)."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "belt.py").write_text(BELT)

    def belt(*words):
        status = main(["sweep", "belt.py", *words])
        return status, *capsys.readouterr()

    return belt


def test_the_command_prints_the_first_numbers_where_none_are_kept(belt):
    """Implicit Euler: x1 = (1 - 0.1 mu)/1.1."""
    words = ["--grid", "mu=0:1:13", "--output", "end=position[-1]", "--workers", "1"]
    status, out, err = belt(*words)
    assert (status, err) == (0, "")
    lines = out.partition("\n\n")[2].splitlines()
    assert lines[0].split() == ["mu", "end"]
    table = np.array([line.split() for line in lines[1:13]], float)
    np.testing.assert_allclose(table[:, 1], (1 - 0.1 * np.arange(12) / 12) / 1.1, rtol=1e-5)
    assert lines[13:] == ["... 1 more; --out DIR or --csv FILE keeps them all"]
    assert "0.9" not in belt(*words, "--csv", "belt.csv")[1]
    assert "\n\n" not in belt("--grid", "mu=0,1", "--keep", "position", "--workers", "1")[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--grid mu=1,2", 'nothing is kept of the cells: give --keep x1, columns .*, or --output "end=x1[-1]"'),
        ("--grid m=1,2", "belt.py takes no 'm': .*Did you mean 'mu'?"),
        ("--grid F=1,2", "belt.py: F = 3 is a number in this file and no parameter; .*def model(F=3)"),
        ("--grid mu=1 --set mu=2 --keep position", "'mu' is varied, but --set also gives it 2"),
        ("--grid mu=1,2 --keep positon", "keep: 'positon' is not there; there are t, position, .*. Did you mean 'position'?"),
        ("--grid mu=1,2 --output end=positon[-1]", "output 'end': 'positon' is not there; .*. Did you mean 'position'?"),
        ("--keep position", "nothing varies: give --grid NAME=LOW:HIGH:COUNT, --samples TABLE.csv, --start STATE=V1,V2, --seeds"),
    ],
)
def test_the_command_speaks_of_its_options(belt, words, message):
    status, out, err = belt(*words.split())
    assert (status, out) == (2, "")
    assert re.search(re.escape(message).replace(r"\.\*", ".*"), err)


def test_a_number_of_the_file_is_no_parameter_of_a_run(belt, capsys):
    assert main(["run", "belt.py", "--set", "F=3"]) == 2
    assert "belt.py: F = 3 is a number in this file and no parameter; declare it as a parameter" in capsys.readouterr().err


def test_what_the_command_says_otherwise_stands_in_messages():
    """A message that is changed takes its line of the table with it."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in (REPOSITORY / "nsmodel" / "sweep").glob("*.py")]
    texts = [
        node.value for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    assert [words for words in OPTION_SPELLINGS if not any(words in text for text in texts)] == []
