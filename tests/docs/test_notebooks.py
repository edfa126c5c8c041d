"""Notebooks: figures that show themselves once, bars, tables for pandas and xarray; a kernel where one is installed."""

import ast
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

import nsmodel
from nsmodel import MissingExtraError, plot
from nsmodel._utils import in_notebook
from nsmodel.simulation import loop

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "docs" / "notebooks").glob("*.md"))
PNG = b"\x89PNG"


@pytest.fixture
def kernel(monkeypatch):
    """IPython as a kernel has it."""
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=object())))


# -- figures -----------------------------------------------------------------------------------------------------------


def test_figures_and_axes_of_their_own_show_themselves(run_case):
    run = run_case("sliding_relay")
    assert run.plot()._repr_png_().startswith(PNG)
    for draw in (plot.states, plot.index_strip):
        assert draw(run)._repr_png_().startswith(PNG)


def test_axes_that_were_given_do_not(run_case):
    from matplotlib.figure import Figure

    ax = plot.states(run_case("sliding_relay"), ax=Figure().add_subplot())
    assert not hasattr(ax, "_repr_png_")


def test_the_formatter_of_a_notebook_shows_a_figure_once(run_case):
    """IPython's own, with and without what its inline backend registers."""
    core = pytest.importorskip("IPython.core.formatters")
    from matplotlib.figure import Figure

    run = run_case("sliding_relay")
    for registered in (False, True):
        shown = core.DisplayFormatter(active_types=["text/plain", "text/html", "image/png", "image/svg+xml", "text/latex"])
        printed = Mock(return_value=PNG)
        if registered:
            shown.formatters["image/png"].for_type(Figure, printed)
        for one in (run.plot(), plot.states(run)):
            data, _ = shown.format(one)
            assert set(data) == {"text/plain", "image/png"}
        assert printed.call_count == registered
        data, _ = shown.format(run)
        assert set(data) == {"text/plain", "text/html"}


def test_cells_of_a_kernel_show_once():
    """Each result has one output, also where nothing has told the kernel of matplotlib."""
    nbformat, client = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    law = "law=nsmodel.relay(1), x0=[1], t_end=1, step=0.1"
    cells = [f"import nsmodel\nmodel = nsmodel.LureSystem(A=[[-1]], B=[1], C=[1], {law})", "model"]
    cells += ["run = nsmodel.simulate(model)\nrun", "run.plot()", "nsmodel.plot.states(run)"]
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    client.NotebookClient(notebook, timeout=60, kernel_name="python3").execute()
    shown = [[sorted(output.data) for output in cell.outputs] for cell in notebook.cells]
    html, png = ["text/html", "text/plain"], ["image/png", "text/plain"]
    assert shown == [[], [html], [html], [png], [png]]


# -- bars --------------------------------------------------------------------------------------------------------------


def test_there_is_a_notebook_where_a_kernel_is(kernel):
    assert in_notebook()


def test_there_is_none_at_a_prompt(monkeypatch):
    assert not in_notebook()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace()))
    assert not in_notebook()


def test_a_bar_of_a_notebook_is_text_without_widgets(kernel, monkeypatch, capsys):
    """And no warning says that widgets are missing."""
    monkeypatch.setattr(loop, "find_spec", lambda name: None)
    bar = loop.progress_bar(total=3)
    assert type(bar).__module__ == "tqdm.std"
    bar.close()


def test_it_is_a_widget_where_there_are_some(kernel, monkeypatch):
    made = []
    monkeypatch.setattr(loop, "find_spec", lambda name: name)
    monkeypatch.setitem(sys.modules, "tqdm.notebook", SimpleNamespace(tqdm=lambda **options: made.append(options)))
    loop.progress_bar(total=3)
    assert made[0]["total"] == 3


def test_without_a_notebook_or_a_terminal_there_is_no_bar():
    assert loop.progress_bar(total=3) is None


# -- tables ------------------------------------------------------------------------------------------------------------


def test_a_run_as_a_table_of_pandas(run_case, tmp_path):
    pandas = pytest.importorskip("pandas")
    run = run_case("diode_bridge")
    table = run.to_pandas()
    assert table.index.name == "t"
    assert list(table)[:4] == ["v_C", "i_L", "multiplier:l_0", "multiplier:l_1"]
    np.testing.assert_array_equal(table["v_C"], run.v_C)
    np.testing.assert_array_equal(table["y:l_2"], run.y[:, 2])
    units = {name: table.attrs["units"][name] for name in ("t", "v_C", "multiplier:l_3", "y:l_3")}
    assert units == {"t": "s", "v_C": "V", "multiplier:l_3": "A", "y:l_3": "A"}
    run.to_csv(tmp_path / "run.csv")
    pandas.testing.assert_frame_equal(pandas.read_csv(tmp_path / "run.csv", index_col="t"), table, check_dtype=False)


def test_dimensions_of_xarray_have_names(run_case):
    pytest.importorskip("xarray")
    run = run_case("inclusion_8_2")
    data = run.to_xarray()
    assert data["v"].dims == data["selection"].dims == ("time", "state")
    assert data["v"].coords["state"].values.tolist() == ["x_0", "x_1", "x_2"]
    np.testing.assert_array_equal(data["v"].sel(state="x_1"), run.v[:, 1])
    data = run_case("two_discs").to_xarray()
    assert data["gap"].dims == data["reactions"].dims == ("time", "multiplier")
    assert "state" not in data.coords


def test_a_sweep_as_tables(load_case):
    pandas, xarray = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    grid = {"alpha": [0.01, 0.02], "beta": [0.1, 0.2, 0.3]}
    sweep = nsmodel.sweep(load_case("cabot_4_1"), grid=grid, outputs={"last": "x[-1]"}, workers=1, compiled=False)
    table = sweep.to_pandas()
    assert isinstance(table, pandas.DataFrame)
    assert table.index.name == "cell"
    assert table["beta"].tolist() == [0.1, 0.2, 0.3] * 2
    alone = nsmodel.simulate(load_case("cabot_4_1"), parameters={"alpha": 0.02, "beta": 0.3}, compiled=False)
    assert table["last"][5] == alone.x[-1, 0]
    data = sweep.to_xarray()
    assert isinstance(data, xarray.Dataset)
    assert data["last"].sel(alpha=0.02, beta=0.3) == table["last"][5]
    assert data.equals(sweep.data)


def test_pandas_missing(run_case, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"pandas is not installed; pip install 'nsmodel\[pandas\]'"):
        run_case("two_discs").to_pandas()


# -- pages -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebooks_of_the_site_are_notebooks(path):
    """Front matter for jupytext, cells of Python without outputs; the site runs them."""
    text = path.read_text(encoding="utf-8")
    head, title = re.match(r"---\n((?:.+\n)*?)---\n\n# (.+)\n", text).groups()
    assert "format_name: myst" in head
    assert "kernelspec:" in head
    assert len(title) < 60
    fences = re.findall(r"^```.*$", text, re.MULTILINE)
    assert fences == ["```{code-cell} ipython3", "```"] * (len(fences) // 2)
    cells = re.findall(r"^```\{code-cell\} ipython3\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert cells
    for cell in cells:
        ast.parse(cell)
        assert max(map(len, cell.splitlines())) <= 100


def test_there_are_four_of_them():
    assert {path.stem for path in NOTEBOOKS} >= {"accuracy", "first_model", "hypotheses", "sweep"}
