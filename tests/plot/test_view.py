"""Pages of results: what is in them, packed and escaped, and that they allow nothing but themselves."""

import base64
import hashlib
import re
import tracemalloc
import webbrowser

import casadi as ca
import numpy as np
import pytest
from view_pages import HOSTILE, a_study, by_hand, discs, parsed, unpacked

import nsmodel
from nsmodel.cli import main
from nsmodel.errors import PlotError, StorageError
from nsmodel.modeling.model_files import case_files
from nsmodel.plot.html import page
from nsmodel.plot.html.page import VIEW_FOLDER
from nsmodel.plot.html.run_page import run_document

ORIGINS = re.compile(r"https?://|//[a-z]", re.IGNORECASE)


@pytest.fixture(scope="module")
def bridge(run_case):
    return run_case("diode_bridge")


@pytest.fixture(scope="module")
def event_driven(load_case):
    return nsmodel.simulate(load_case("buck"), rtol=1e-6)


def columns_of(found):
    """{(title of the panel, name of the column): the column}."""
    return {(panel["title"], one["name"]): one for panel in found["panels"] for one in panel.get("columns", ())}


# -- numbers -----------------------------------------------------------------------------------------------------------


def test_numbers_in_double_precision_come_back_bit_for_bit():
    values = np.array([0.0, -0.0, 1 / 3, np.nan, np.inf, -np.inf, 5e-324, 1.7e308, -1e-300])
    assert unpacked(page.pack_numbers(values)).tobytes() == values.tobytes()
    assert unpacked(page.pack_numbers(values[:0])).size == 0


@pytest.mark.parametrize("scale", [1e-300, 1e-9, 1.0, 1e300])
def test_numbers_in_single_precision_err_by_rounding_alone(scale):
    values = scale * np.random.default_rng(1).standard_normal(1000)
    values[::50], values[7], values[8] = 0.0, np.nan, np.inf
    found = unpacked(page.pack_numbers(values, exact=False))
    assert (found[::50] == 0).all()
    assert np.isnan(found[7])
    assert np.isposinf(found[8])
    finite = np.isfinite(values)
    assert abs(found[finite] - values[finite]).max() <= 2**-24 * 2 * abs(values[finite]).max()


def test_what_lies_between_values_near_one_number_is_kept():
    values = 1 + 1e-9 * np.sin(np.arange(500.0))
    assert abs(unpacked(page.pack_numbers(values, exact=False)) - values).max() < 1e-15


@pytest.mark.parametrize("length", [1, 2, 6, 7, 8, 1000])
@pytest.mark.parametrize("width", [2, 3, 7])
def test_extremes_are_those_of_each_few_rows(length, width):
    rng = np.random.default_rng(length)
    values = rng.standard_normal(length)
    values[rng.random(length) < 0.3] = np.nan
    values[rng.random(length) < 0.1] = np.inf
    values[rng.random(length) < 0.1] = -np.inf
    begin = rng.standard_normal(length)
    low, high = page.bucket_extremes(values, width)
    both = page.pack_column(values, begin, page.PackedRows(width, True))
    for k in range(0, length, width):
        some = [v for v in values[k : k + width] if v == v]
        expected = (min(some), max(some)) if some else (np.nan, np.nan)
        np.testing.assert_equal((low[k // width], high[k // width]), expected)
        some += list(begin[k : k + width])
        np.testing.assert_equal([unpacked(both[name])[k // width] for name in ("low", "high")], [min(some), max(some)])


@pytest.mark.parametrize("cells", [(10, 1), (25_000, 10), (25_001, 10), (300_000, 10), (300_001, 10), (10**6, 10), (10**7, 50)])
def test_columns_find_room_whatever_their_number(cells):
    rows, columns = cells
    width, exact = page.packing_for(rows, columns)
    held = (8 if exact else 4) * rows * columns if width == 1 else 8 * -(-rows // width) * columns
    assert held <= page.MAX_BYTES + 8 * columns
    assert width == 1 or 4 * rows * columns > page.MAX_BYTES


def test_a_page_of_noise_has_the_size_that_is_meant_and_copies_no_run(tmp_path, monkeypatch):
    """A tenth of what is allowed, 20 MB. Noise compresses worst."""
    monkeypatch.setattr(page, "MAX_BYTES", page.MAX_BYTES // 10)
    rng = np.random.default_rng(0)
    run = by_hand({f"x_{k}": rng.standard_normal(100_000) for k in range(10)})
    tracemalloc.start()
    run_document(run)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    size = run.view(tmp_path / "noise.html").stat().st_size
    assert 1e6 < size <= 2e6
    assert most < size + 0.4 * sum(array.nbytes for array in run.arrays.values())


# -- the frame ---------------------------------------------------------------------------------------------------------


def pages(folder, bridge):
    """A page of each kind."""
    report = nsmodel.check(nsmodel.load("sliding_relay"), quick=True)
    return [bridge.view(folder / "run.html"), report.view(folder / "report.html"), a_study().view(folder / "study.html")]


def test_a_page_allows_itself_alone(tmp_path, bridge):
    for path in pages(tmp_path, bridge):
        text, page = path.read_text(encoding="utf-8"), parsed(path)
        policy = page.policy
        assert policy["default-src"] == "'none'"
        assert policy["img-src"] == "data:"
        assert set(policy) == {"default-src", "script-src", "style-src", "img-src", "base-uri", "form-action"}
        for kind, pattern in (("script-src", r"<script>(.*?)</script>"), ("style-src", r"<style>(.*?)</style>")):
            (own,) = re.findall(pattern, text, re.DOTALL)
            assert policy[kind] == f"'sha256-{base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()}'"
        assert sum(tag == "script" for tag, _ in page.elements) == 2
        assert [attrs["href"] for _, attrs in page.elements if "href" in attrs] == ["data:,"]
        assert not any(key == "src" or key == "style" or key.startswith("on") for _, attrs in page.elements for key in attrs)


@pytest.mark.parametrize("name", sorted(path.name for path in VIEW_FOLDER.glob("*.*s")))
def test_scripts_and_styles_ask_for_nothing_and_make_no_elements_of_text(name):
    text = (VIEW_FOLDER / name).read_text(encoding="utf-8")
    code = re.sub(r"/\*.*?\*/|(?m:^\s*//.*$)", "", text, flags=re.DOTALL)
    assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|Function\(|import\(|fetch\(|XMLHttp", code)
    assert not ORIGINS.search(code)
    assert "</" not in code
    assert "url(" not in code
    assert "@import" not in code
    assert max(map(len, text.splitlines())) <= 130
    assert len(text.splitlines()) <= 350


def test_what_is_the_users_is_text(tmp_path):
    names, units = {HOSTILE: np.arange(5.0), "other <i>": np.ones(5)}, {"t": HOSTILE, HOSTILE: HOSTILE}
    run = by_hand(names, title=HOSTILE, status="failed", message=HOSTILE, units=units, warnings=[HOSTILE])
    model = nsmodel.LureSystem(A=[[-1]], B=1, C=1, law=nsmodel.relay(1), x0=1, t_end=1, step=0.1, title=HOSTILE)
    made = {"run": run, "report": nsmodel.check(model), "study": a_study()}
    shown = HOSTILE.replace("\u202e", r"\u202e").replace("\x1b", r"\x1b")
    for name, one in made.items():
        page = parsed(one.view(tmp_path / f"{name}.html"))
        assert not {"b", "img", "i"} & {tag for tag, _ in page.elements}
        expected = shown if name != "report" else model.title
        assert page.texts["title", None] == page.data["title"] == expected
        assert "</script><b>" in expected
        assert not re.search("[\u202e\x1b]", (tmp_path / f"{name}.html").read_text(encoding="utf-8"))
    data = parsed(tmp_path / "run.html").data
    assert data["time"]["unit"] == shown
    assert ("States", shown, shown) in [(one["title"], one["unit"], one["columns"][0]["name"]) for one in data["panels"]]
    assert dict(data["facts"])["warnings"] == [shown]


def test_equal_runs_have_equal_pages(tmp_path, bridge):
    one, two = (bridge.view(tmp_path / name) for name in ("one.html", "two.html"))
    assert one.read_bytes() == two.read_bytes()


def test_a_page_that_cannot_be_written(tmp_path, bridge):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot write .*file/run\.html"):
        bridge.view(tmp_path / "file" / "run.html")


def test_without_a_path_the_browser_is_asked(tmp_path, bridge, monkeypatch):
    asked = []
    monkeypatch.setattr(webbrowser, "open", asked.append)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = bridge.view()
    assert path.name == "Diode-bridge-rectifier.html"
    assert asked == [path.as_uri()]
    assert tmp_path in path.parents
    bridge.view(tmp_path / "given.html")
    assert len(asked) == 1


# -- what is shown of a run --------------------------------------------------------------------------------------------


def test_columns_of_one_unit_share_a_panel_and_hold_the_rows(bridge):
    found = run_document(bridge)
    columns = columns_of(found)
    by_unit = [(panel["title"], panel["unit"], len(panel["columns"])) for panel in found["panels"] if "columns" in panel]
    assert by_unit[:4] == [("States", "V", 1), ("States", "A", 1), ("Multipliers", "V", 2), ("Multipliers", "A", 2)]
    np.testing.assert_array_equal(unpacked(columns["States", "v_C"]["low"]), bridge.v_C)
    np.testing.assert_array_equal(unpacked(columns["Multipliers", "l_2"]["low"]), bridge.multipliers[:, 2])
    np.testing.assert_array_equal(unpacked(columns["Residual", "residual"]["low"]), bridge.residual)
    np.testing.assert_array_equal(unpacked(found["clocks"][0]["times"])[:-1], bridge.t)
    assert found["phase"] == [[0, 0], [1, 0]]
    assert found["scene"] is None
    assert found["events"] is None
    assert "5,001 rows, each of them" in found["note"]
    assert dict(found["facts"])["scheme"] == [bridge.metadata["scheme"]]


def test_the_index_set_says_which_codes_were_seen(bridge):
    strip = next(panel for panel in run_document(bridge)["panels"] if panel["look"] == "bands")
    for k, band in enumerate(strip["bands"]):
        np.testing.assert_array_equal(unpacked(band["seen"]), 2.0 ** (bridge.index_set[:, k] + 2))
    assert strip["words"] == {"complementarity": [[2, "nothing", "open (l = 0)"], [4, "zero", "contact (y = 0)"]]}


def test_kinds_of_laws_that_are_not_those_of_the_rows():
    run = by_hand({"a": np.ones(3)}, arrays={"index_set": np.zeros((3, 2), np.int8)}, law_kinds=["relay"])
    with pytest.raises(PlotError, match=r"law_kinds must name one of .* for each of 2 rows"):
        run_document(run)


def test_of_a_long_run_no_code_and_no_extreme_is_lost():
    rng = np.random.default_rng(2)
    codes = rng.integers(-1, 2, (1_100_000, 1)).astype(np.int8)
    columns = {f"x_{k}": np.zeros(len(codes)) for k in range(3)}
    columns["x_1"][765_432] = 1.0
    run = by_hand(columns, arrays={"index_set": codes}, law_kinds=["relay"])
    found = run_document(run)
    width = found["clocks"][0]["width"]
    assert width == 3
    assert f"least and the largest value of each {width} rows" in found["note"]
    strip = next(panel for panel in found["panels"] if panel["look"] == "bands")
    seen = unpacked(strip["bands"][0]["seen"])
    for code in (-1, 0, 1):
        some = np.add.reduceat(codes[:, 0] == code, np.arange(0, len(codes), width), dtype=int) > 0
        np.testing.assert_array_equal((seen >> (code + 2)) & 1, some)
    high, low = (unpacked(columns_of(found)["States", "x_1"][name]) for name in ("high", "low"))
    assert np.flatnonzero(high).tolist() == [765_432 // width]
    assert not low.any()
    assert unpacked(found["clocks"][0]["times"])[765_432 // width] == run.t[765_432 // width * width]


def test_sizes_far_apart_are_drawn_apart_but_rounding_is_not():
    wave = np.sin(np.arange(100.0))
    panels = {
        panel["title"]: panel for panel in run_document(by_hand({"a": wave, "b": 0.01 * wave, "c": 1e-16 * wave}))["panels"]
    }
    assert [one["name"] for one in panels["States"]["columns"]] == ["a", "c"]
    assert [one["name"] for one in panels["States, the small ones"]["columns"]] == ["b"]


def test_a_single_state_has_a_phase_plane_with_what_else_there_is(run_case, load_case):
    oscillator = nsmodel.simulate(load_case("friction_oscillator"), t_end=0.1)
    for run, up in ((run_case("moving_half_line"), "Multipliers"), (oscillator, "Velocities")):
        found = run_document(run)
        assert [found["panels"][p]["title"] for p, _ in found["phase"]] == ["States", up]
    assert run_document(by_hand({"a": np.ones(3)}))["phase"] is None


def test_many_columns_are_some_and_the_page_says_so():
    run = by_hand({f"x_{k}": np.arange(5.0) + k for k in range(100)})
    (panel,) = (one for one in run_document(run)["panels"] if one["title"] == "States")
    names = [one["name"] for one in panel["columns"]]
    assert (names[0], names[-1], len(names)) == ("x_0", "x_99", 24)
    assert sum(one["shown"] for one in panel["columns"]) == 8
    assert panel["note"] == "(24 of 100 shown, evenly spread)"


def test_inputs_and_outputs_jump_where_they_do():
    u = ca.SX.sym("u")
    model = nsmodel.LureSystem(
        A=[[-1]], B=1, C=1, f=[u], law=nsmodel.relay(1), x0=1, t_end=1, step=0.1, title="Steps",
        inputs={u: nsmodel.steps([1.0] * 5 + [3.0] * 5)}, outputs={"twice": 2 * u},
    )  # fmt: skip
    columns = columns_of(run_document(nsmodel.simulate(model)))
    for key, factor in ((("Inputs", "u"), 1), (("Outputs", "twice"), 2)):
        begin, end = unpacked(columns[key]["begin"]), unpacked(columns[key]["low"])
        assert end[5:7].tolist() == [factor, 3 * factor]
        assert begin[5:7].tolist() == [factor, 3 * factor]


def test_an_event_driven_run_has_points_rows_and_events(event_driven):
    run, found = event_driven, run_document(event_driven)
    assert len(found["clocks"]) == 2
    np.testing.assert_array_equal(unpacked(found["clocks"][1]["times"])[:-1], run.t)
    columns = columns_of(found)
    times = unpacked(found["clocks"][0]["times"])
    inside = np.setdiff1d(times[:-1], [event.t for event in run.events])
    at = np.isin(times[:-1], inside)
    np.testing.assert_allclose(unpacked(columns["States", "v"]["low"])[at], run.at(inside).x[:, 1], rtol=1e-12)
    assert {panel["title"]: panel["clock"] for panel in found["panels"]}["Residual"] == 1
    np.testing.assert_array_equal(unpacked(found["events"]["times"]), [event.t for event in run.events])
    changed = [event for event in run.events if (event.before != event.after).any()]
    assert sum(bool(words) for words in found["events"]["words"]) == len(changed)
    assert "diode: -1 to 0" in found["events"]["words"]
    assert "read off the polynomials" in found["note"]


def test_the_energy_of_an_event_driven_run_is_that_of_its_states_where_the_model_is_given():
    """Dry friction of 1, let go at 5.3: x = 1 + 4.3 cos t until it turns; its energy falls by the way."""
    x, s = ca.SX.sym("x"), ca.SX.sym("s")
    model = nsmodel.FrictionOscillator(x=x, potential=x**2 / 2, friction=s, s=s, x0=5.3, v0=0, t_end=3)
    run = nsmodel.simulate(model, rtol=1e-8)
    off, notes = [], []
    for given in (model, None):
        found = run_document(run, given)
        (panel,) = (one for one in found["panels"] if one["title"] == "Energy")
        times = unpacked(found["clocks"][0]["times"])[:-1]
        exact = 5.3**2 / 2 - 4.3 * (1 - np.cos(times))
        off.append(np.abs(unpacked(panel["columns"][0]["low"]) - exact).max())
        notes.append(panel["note"])
    assert off[0] <= 1e-6
    assert off[1] >= 1e-2
    assert notes == ["", "on lines between the ends of pieces"]


def test_discs_are_where_they_are():
    run = discs()
    scene = run_document(run)["scene"]
    places = unpacked(scene["places"]).reshape(18, 50)
    np.testing.assert_allclose(places, run.x.T, atol=1e-6)
    np.testing.assert_allclose(unpacked(scene["pressure"]).reshape(9, 50), run.arrays["pressure"].T, atol=1e-6)
    np.testing.assert_array_equal(unpacked(scene["times"]), run.t)
    x0, x1, y0, y1 = scene["window"]
    assert x0 < -1 < 6 < x1
    assert y0 < -1 < 3 < y1
    assert scene["walls"] == [[-1, -1, 6, -1], [-1, 3, 6, 3]]
    pressed = run.arrays["pressure"][run.arrays["pressure"] > 0]
    assert scene["top"] == pytest.approx(np.percentile(pressed, 99.5))
    titles = {panel["title"]: panel for panel in run_document(run)["panels"]}
    assert unpacked(titles["Bodies there"]["columns"][0]["low"]).tolist() == [9] * 25 + [8] * 25
    assert not titles["States"]["open"]


def test_reactions_make_pressures_where_constraints_know_their_bodies():
    run = discs(rows=3)
    reactions = np.array([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    del run.arrays["pressure"]
    run.arrays["reactions"] = run.arrays["multipliers"] = reactions
    run.metadata["constraint_bodies"] = [[0, 1], [1]]
    found = unpacked(run_document(run)["scene"]["pressure"]).reshape(9, 3)
    np.testing.assert_allclose(found[:2], [[1, 2, 3], [11, 22, 33]])
    assert not found[2:].any()


def test_of_a_long_film_some_rows_are_drawn():
    run = discs(rows=60_000)
    scene = run_document(run)["scene"]
    assert scene["of"] == 60_000
    assert scene["rows"][0] == 0
    assert scene["rows"][-1] == 59_999
    assert 4 * 18 * len(scene["rows"]) <= 4_000_000


def test_the_forbidden_set_is_where_a_constraint_is_negative(load_case):
    """A disc of radius 1 whose centre is carried along the first axis: as `cases/mathematics/moving_disc.py` says."""
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    disc = ca.norm_2(q - ca.vertcat(t, 0)) - 1
    model = nsmodel.SweepingProcess(t=t, q=q, constraints={"disc": disc}, q0=[1.5, 0.3], t_end=2, step=0.1, title="Pushed")
    run = nsmodel.simulate(model)
    found = run_document(run, model)["forbidden"]
    x0, x1, y0, y1 = found["window"]
    times, size = unpacked(found["times"]), found["size"]
    assert times.tolist() == run.t.tolist()
    across, up = np.meshgrid(np.linspace(x0, x1, size), np.linspace(y0, y1, size))
    inside = np.hypot(across - times[:, None, None], up) < 1
    np.testing.assert_array_equal(unpacked(found["inside"]).reshape(len(times), size, size), inside)
    assert 0.05 < inside.mean() < 0.95
    assert run_document(run)["forbidden"] is None
    one = load_case("moving_half_line")
    with pytest.raises(PlotError, match="the model has 1 states and the run 2"):
        run.view("never.html", one)
    line = run_document(nsmodel.simulate(one), one)["forbidden"]
    times, q = (np.linspace(*ends, size) for ends in (line["window"][:2], line["window"][2:]))
    edge = np.sin(times)[None] > q[:, None] + 1e-9
    assert (unpacked(line["inside"]).reshape(size, size) == edge).mean() > 0.999


def test_a_run_that_failed_says_so():
    t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
    walls = {"left": 1 - t - q[0], "right": q[0] + 0.5 - t}
    model = nsmodel.SweepingProcess(t=t, q=q, constraints=walls, q0=[0, 0], t_end=1, step=0.1, title="Two walls")
    with pytest.raises(nsmodel.StepError) as stopped:
        nsmodel.simulate(model)
    found = run_document(stopped.value.trajectory)
    assert found["status"] == "failed"
    assert dict(found["facts"])["status"][0].startswith("failed: step")


def test_a_run_of_one_row_has_a_page(tmp_path):
    one = by_hand({"a": np.ones(1)})
    assert run_document(one)["rows"] == 1
    assert one.view(tmp_path / "one.html").exists()


# -- reports, studies, the command line --------------------------------------------------------------------------------


def test_a_report_shows_every_finding_and_what_follows(tmp_path):
    report = nsmodel.check(nsmodel.load("sliding_relay"), quick=True)
    data = parsed(report.view(tmp_path / "report.html")).data
    assert [(one["name"], one["verdict"]) for one in data["findings"]] == [(one.id, one.verdict) for one in report.findings]
    assert [one["statement"] for one in data["consequences"]] == [one.statement for one in report.consequences]
    assert report.verdict in dict(data["facts"])["findings"]


def test_a_study_shows_points_and_failures(tmp_path):
    data = parsed(a_study().view(tmp_path / "study.html")).data
    drawn = [(point["error"], point["seconds"]) for line in data["lines"] for point in line["points"] if point["drawn"]]
    assert drawn == [(1e-2, 1e-3), (1e-4, 1e-2), (1e-5, 0.2)]
    assert data["lines"][1]["aside"] == "1 failed, 1 left out"
    assert [row[1] for row in data["rows"]] == ["h = 0.1", "h = 0.01", "h = 0.1", "h = 0.001"]


def test_the_command_writes_a_page_beside_the_run(tmp_path, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(webbrowser, "open", asked.append)
    folder = tmp_path / "run"
    assert main(["run", str(case_files()["sliding_relay"]), "--t-end", "0.1", "--out", str(folder), "--quiet"]) == 0
    assert main(["view", str(folder)]) == 0
    assert capsys.readouterr().out == f"page  {folder / 'view.html'}\n"
    assert parsed(folder / "view.html").data["title"] == nsmodel.Trajectory.load(folder / "trajectory.npz").title
    assert asked == []
    other = tmp_path / "other.html"
    assert main(["view", str(folder / "trajectory.npz"), "--out", str(other), "--open"]) == 0
    assert asked == [other.as_uri()]


@pytest.mark.parametrize(("name", "status"), [("nowhere", 2), ("text", 5)])
def test_the_command_refuses_what_is_no_run(tmp_path, capsys, name, status):
    (tmp_path / "text").write_text("no run")
    assert main(["view", str(tmp_path / name)]) == status
    assert re.search("error: (there is no run in|.*is not a whole npz)", capsys.readouterr().err)


def test_checks_and_studies_write_pages(tmp_path, capsys):
    case = str(case_files()["sliding_relay"])
    assert main(["check", case, "--quick", "--html", str(tmp_path / "check.html")]) == 0
    assert capsys.readouterr().out.endswith(f"\n\npage  {tmp_path / 'check.html'}\n")
    assert parsed(tmp_path / "check.html").data["kind"] == "report"
    command = ["study", case, "--t-end", "0.02", "--steps", "2e-3,1e-3", "--solvers", "", "--budget", "1"]
    assert main([*command, "--html", str(tmp_path / "study.html")]) == 0
    assert capsys.readouterr().out.endswith(f"\n\npage  {tmp_path / 'study.html'}\n")
    assert parsed(tmp_path / "study.html").data["kind"] == "study"
    assert main(["check", case, case, "--html", str(tmp_path / "both.html")]) == 2
    assert "--html takes one model file" in capsys.readouterr().err
