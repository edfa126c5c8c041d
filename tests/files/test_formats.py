"""Files of an earlier format are read with the numbers they had; those of a later one are refused by name.

`fixtures/format-N` was written by the last version of that format.
"""

import json
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
from sweep_models import friction

import nsmodel
from nsmodel import StorageError, Sweep, Trajectory, UnverifiedWarning, UsageError, simulate
from nsmodel.cli import main
from nsmodel.files import storage
from nsmodel.files.archive import read_npz, write_npz
from nsmodel.files.storage import read_json, write_json
from nsmodel.simulation.run_folder import ChunkStore

FIXTURES = Path(__file__).parents[1] / "fixtures"
FORMAT_1 = FIXTURES / "format-1"
RELAY = """
from nsmodel import LureSystem, relay
model = LureSystem(
    A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=2, step=0.1,
    units={"t": "s"}, title="Relay",
)
"""


@pytest.fixture(name="old")
def copy_of_old_files(tmp_path):
    return Path(shutil.copytree(FORMAT_1, tmp_path / "old"))


@pytest.fixture(name="relay_file")
def write_relay(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "relay.py").write_text(RELAY)
    return "relay.py"


def unverified(number):
    return pytest.warns(
        UnverifiedWarning, match=rf"is of format {number}, which has no digests: what it holds is read, not verified"
    )


@pytest.mark.parametrize("number", [1, 2])
def test_an_old_trajectory_is_read(number):
    with unverified(number) as told:
        run = Trajectory.load(FIXTURES / f"format-{number}" / "done" / "trajectory.npz")
    assert [Path(one.filename).name for one in told] == ["test_formats.py"]
    assert str(run) == "Trajectory('Relay', LureSystem, 20 steps, t = 0 to 2, done)"
    assert run.x[-1].tolist() == [0.25746214083761365, -1.6513071819197416]
    assert list(run.arrays) == ["t", "x", "multipliers", "y", "index_set", "residual", "step"]
    assert run.metadata["versions"]["nsmodel"] == f"0.{number}.0"
    assert not {"format", "version", "arrays"} & run.metadata.keys()
    assert "steps           20, t = 0 to 2 s" in run.summary_text()


@pytest.mark.parametrize("number", [1, 2])
def test_an_old_run_of_many_bodies_is_read(number):
    with unverified(number):
        run = Trajectory.load(FIXTURES / f"format-{number}" / "bodies" / "trajectory.npz")
    if number == 1:
        assert run.x[-1].tolist() == [-0.5496946988385348, -0.012954447507951161, 0.5496946988385348, 0.023691865747951162]
        assert [tuple(map(int, row)) for row in zip(*run.contacts(-1)[:3], strict=True)] == [(0, 0, 1)]
    assert run.summary()["bodies"]["count"] == 2


def test_an_old_event_driven_run_is_read():
    with unverified(2):
        run = Trajectory.load(FIXTURES / "format-2" / "events" / "trajectory.npz")
    assert run.x[-1].tolist() == [0.1677063270481729, -1.8185948538315986]
    assert run.at(2.0).x[0].tolist() == pytest.approx(run.x[-1].tolist(), rel=1e-6)


@pytest.mark.parametrize("number", [1, 2])
def test_chunks_of_an_old_run_are_read(number):
    folder = FIXTURES / f"format-{number}"
    with unverified(number):
        parts = [Trajectory.load(path) for path in sorted((folder / "killed").glob("chunk-*.npz"))]
        whole = Trajectory.load(folder / "done" / "trajectory.npz")
    t, x = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "x"))
    np.testing.assert_array_equal(t, whole.t[: len(t)])
    np.testing.assert_array_equal(x, whole.x[: len(t)])
    assert len(t) == read_json(folder / "killed" / "manifest.json")["rows"]


def test_an_old_sweep_is_read_and_what_was_changed_in_it_is_found(tmp_path):
    with unverified(2) as told:
        found = Sweep.load(FIXTURES / "format-2" / "sweep")
    assert [Path(one.filename).name for one in told] == ["test_formats.py"]
    assert found["end"].values.tolist() == [-1.0673216542901893, 0.39118575477714207, 1.023067721466388, 0.9363319606207207]
    assert found["x_1"].values[:, -1].tolist() == found["end"].values.tolist()
    assert found.at(1) == {"sample": 1, "a": 0.4, "k": 0.9}
    bytes_of = (FIXTURES / "format-2" / "sweep" / "sweep.npz").read_bytes()
    at = bytes_of.index(np.float64(-1.0673216542901893).tobytes())
    (tmp_path / "sweep.npz").write_bytes(bytes_of[:at] + b"\xff" + bytes_of[at + 1 :])
    with unverified(2):
        changed = Sweep.load(tmp_path)
    with pytest.raises(StorageError, match=r"array 'x_1' was changed after it was written"):
        changed["x_1"].values  # noqa: B018
    assert changed["k"].values.tolist() == [0.8, 0.9, 1.0, 1.1] if "k" in changed.cells else True


@pytest.mark.parametrize("folder", ["sweep", "parts"])
def test_an_old_sweep_is_not_gone_on_with(tmp_path, folder):
    shutil.copytree(FIXTURES / "format-2" / folder, tmp_path / "old")
    before = {path: path.read_bytes() for path in (tmp_path / "old").iterdir()}
    with pytest.raises(
        StorageError, match=r"manifest\.json is of format 2, written by nsmodel 0\.2\.0: .* go on with nsmodel 0\.2\.0, or"
    ):
        nsmodel.sweep(
            friction(), samples={"a": [0.3, 0.4, 0.5, 0.6], "k": [0.8, 0.9, 1.0, 1.1]}, keep="x_1", every=100,
            outputs={"end": "x_1[-1]"}, compiled=False, workers=1, out=tmp_path / "old", resume=True,
        )  # fmt: skip
    assert {path: path.read_bytes() for path in (tmp_path / "old").iterdir()} == before


def test_parts_of_an_old_sweep_are_not_taken(tmp_path):
    given = {
        "samples": {"a": [0.3, 0.4, 0.5, 0.6], "k": [0.8, 0.9, 1.0, 1.1]}, "keep": "x_1", "every": 100,
        "outputs": {"end": "x_1[-1]"}, "compiled": False, "workers": 1, "out": tmp_path / "new",
    }  # fmt: skip
    nsmodel.sweep(friction(), **given)
    shutil.copy(FIXTURES / "format-2" / "parts" / "part-000001.npz", tmp_path / "new")
    with pytest.raises(StorageError, match=r"part-000001\.npz is of format 2, .* cannot be continued; take it out of the folder"):
        nsmodel.sweep(friction(), **given, resume=True)


def test_a_page_of_an_old_run_is_written_and_a_line_says_that_it_is_not_verified(tmp_path, capsys):
    assert main(["view", str(FIXTURES / "format-2" / "done"), "--out", str(tmp_path / "page.html")]) == 0
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert "nsmodel: note: " in told.err
    assert "is of format 2, which has no digests: what it holds is read, not verified" in told.err
    assert (tmp_path / "page.html").stat().st_size > 10_000


def test_an_old_summary_is_read():
    summary = read_json(FORMAT_1 / "done" / "summary.json")
    assert (summary["steps"], summary["status"]) == (20, "done")
    assert summary["final_state"][0] == {"name": "x_0", "unit": "", "value": 0.25746214083761365}


@pytest.mark.parametrize("folder", ["killed", "done", "bodies"])
def test_an_old_run_is_not_continued(old, relay_file, folder, capsys):
    before = {path: path.read_bytes() for path in (old / folder).iterdir()}
    assert main(["run", relay_file, "--out", f"old/{folder}", "--resume"]) == 5
    told = capsys.readouterr().err
    assert f"{folder}/manifest.json is of format 1, written by nsmodel 0.1.0: its files can be read" in told
    assert "go on with nsmodel 0.1.0, or remove the folder" in told
    assert {path: path.read_bytes() for path in (old / folder).iterdir()} == before


def test_an_old_unfinished_run_is_not_overwritten_and_a_finished_one_is(old, relay_file):
    model = nsmodel.load(relay_file)
    with pytest.raises(UsageError, match=r"killed holds an unfinished run of nsmodel 0\.1\.0, up to t = 1\.1; go on with"):
        simulate(model, out=old / "killed")
    assert simulate(model, out=old / "done").status == "done"
    with unverified(1):
        was = Trajectory.load(FORMAT_1 / "done" / "trajectory.npz")
    np.testing.assert_array_equal(Trajectory.load(old / "done" / "trajectory.npz").x, was.x)


def test_every_file_says_its_format(tmp_path, relay_file):
    assert main(["run", relay_file, "--out", "run", "--quiet"]) == 0
    for name in ("manifest.json", "summary.json"):
        document = json.loads((tmp_path / "run" / name).read_text())
        assert (document["format"], document["version"]) == (storage.FILE_FORMAT, nsmodel.__version__)
    with zipfile.ZipFile(tmp_path / "run" / "trajectory.npz") as archive:
        document = json.loads(archive.read("metadata.json"))
    assert (document["format"], document["version"]) == (storage.FILE_FORMAT, nsmodel.__version__)
    assert [one["name"] for one in document["arrays"]] == list(Trajectory.load(tmp_path / "run" / "trajectory.npz").arrays)


def of_a_later_version(patch):
    for module in ("files.archive", "simulation.run_folder"):
        patch.setattr(f"nsmodel.{module}.FORMAT_STAMP", {"format": 9, "version": "7.1.0"})


def test_a_later_format_is_refused_by_the_version_that_wrote_it(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        of_a_later_version(patch)
        write_npz(tmp_path / "run.npz", {"t": np.zeros(2), "x": np.zeros((2, 1))}, {})
        write_json(tmp_path / "summary.json", {"format": 9, "version": "7.1.0"})
        store = ChunkStore(tmp_path / "run")
        store.append({"t": np.zeros(2)}, {"t": 1.0}, {"status": "running"})
    for read, path in (
        (Trajectory.load, tmp_path / "run.npz"),
        (read_npz, tmp_path / "run" / "chunk-000001.npz"),
        (read_json, tmp_path / "summary.json"),
        (lambda path: ChunkStore.open(path.parent), tmp_path / "run" / "manifest.json"),
    ):
        words = "is of format 9, written by nsmodel 7.1.0; nsmodel {} knows formats up to 3: read it with nsmodel 7.1.0"
        with pytest.raises(StorageError, match="^" + re.escape(f"{path} {words.format(nsmodel.__version__)}")):
            read(path)


def test_an_unfinished_run_of_a_later_version_is_not_overwritten(tmp_path, monkeypatch, relay_file):
    with monkeypatch.context() as patch:
        of_a_later_version(patch)
        ChunkStore(tmp_path / "run").append({"t": np.zeros(2)}, {"t": 1.0}, {"status": "running"})
    with pytest.raises(StorageError, match=r"manifest\.json is of format 9, written by nsmodel 7\.1\.0"):
        simulate(nsmodel.load(relay_file), out=tmp_path / "run")
