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

import nsmodel
from nsmodel import StorageError, Trajectory, UsageError, simulate, storage
from nsmodel.archive import read_npz, write_npz
from nsmodel.chunks import ChunkStore
from nsmodel.cli import main
from nsmodel.storage import read_json, write_json

FORMAT_1 = Path(__file__).parent / "fixtures" / "format-1"
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


def test_an_old_trajectory_is_read():
    run = Trajectory.load(FORMAT_1 / "done" / "trajectory.npz")
    assert str(run) == "Trajectory('Relay', LureSystem, 20 steps, t = 0 to 2, done)"
    assert run.x[-1].tolist() == [0.25746214083761365, -1.6513071819197416]
    assert list(run.arrays) == ["t", "x", "multipliers", "y", "index_set", "residual", "step"]
    assert run.metadata["versions"]["nsmodel"] == "0.1.0"
    assert not {"format", "version", "arrays"} & run.metadata.keys()
    assert "steps           20, t = 0 to 2 s" in run.summary_text()


def test_an_old_run_of_many_bodies_is_read():
    run = Trajectory.load(FORMAT_1 / "bodies" / "trajectory.npz")
    assert run.x[-1].tolist() == [-0.5496946988385348, -0.012954447507951161, 0.5496946988385348, 0.023691865747951162]
    assert [tuple(map(int, row)) for row in zip(*run.contacts(-1)[:3], strict=True)] == [(0, 0, 1)]


def test_chunks_of_an_old_run_are_read():
    parts = [Trajectory.load(path) for path in sorted((FORMAT_1 / "killed").glob("chunk-*.npz"))]
    t, x = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "x"))
    whole = Trajectory.load(FORMAT_1 / "done" / "trajectory.npz")
    np.testing.assert_array_equal(t, whole.t[: len(t)])
    np.testing.assert_array_equal(x, whole.x[: len(t)])
    assert len(t) == read_json(FORMAT_1 / "killed" / "manifest.json")["rows"] == 12


def test_an_old_summary_is_read():
    summary = read_json(FORMAT_1 / "done" / "summary.json")
    assert (summary["steps"], summary["status"]) == (20, "done")
    assert summary["final_state"][0] == {"name": "x_0", "unit": "", "value": 0.25746214083761365}


@pytest.mark.parametrize("folder", ["killed", "done", "bodies"])
def test_an_old_run_is_not_continued(old, relay_file, folder, capsys):
    before = {path: path.read_bytes() for path in (old / folder).iterdir()}
    assert main(["run", relay_file, "--out", f"old/{folder}", "--resume"]) == 2
    told = capsys.readouterr().err
    assert f"{folder}/manifest.json is of format 1, written by nsmodel 0.1.0: its files can be read" in told
    assert "go on with nsmodel 0.1.0, or remove the folder" in told
    assert {path: path.read_bytes() for path in (old / folder).iterdir()} == before


def test_an_old_unfinished_run_is_not_overwritten_and_a_finished_one_is(old, relay_file):
    model = nsmodel.load(relay_file)
    with pytest.raises(UsageError, match=r"killed holds an unfinished run of nsmodel 0\.1\.0, up to t = 1\.1; go on with"):
        simulate(model, out=old / "killed")
    assert simulate(model, out=old / "done").status == "done"
    np.testing.assert_array_equal(
        Trajectory.load(old / "done" / "trajectory.npz").x, Trajectory.load(FORMAT_1 / "done" / "trajectory.npz").x
    )


def test_every_file_says_its_format(tmp_path, relay_file):
    assert main(["run", relay_file, "--out", "run", "--quiet"]) == 0
    for name in ("manifest.json", "summary.json"):
        document = json.loads((tmp_path / "run" / name).read_text())
        assert (document["format"], document["version"]) == (storage.FORMAT, nsmodel.__version__)
    with zipfile.ZipFile(tmp_path / "run" / "trajectory.npz") as archive:
        document = json.loads(archive.read("metadata.json"))
    assert (document["format"], document["version"]) == (storage.FORMAT, nsmodel.__version__)
    assert document["arrays"] == list(Trajectory.load(tmp_path / "run" / "trajectory.npz").arrays)


def of_a_later_version(patch):
    for module in ("storage", "archive", "chunks"):
        patch.setattr(f"nsmodel.{module}.STAMP", {"format": 9, "version": "7.1.0"})


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
        words = "is of format 9, written by nsmodel 7.1.0; nsmodel {} knows formats up to 2: read it with nsmodel 7.1.0"
        with pytest.raises(StorageError, match="^" + re.escape(f"{path} {words.format(nsmodel.__version__)}")):
            read(path)


def test_an_unfinished_run_of_a_later_version_is_not_overwritten(tmp_path, monkeypatch, relay_file):
    with monkeypatch.context() as patch:
        of_a_later_version(patch)
        ChunkStore(tmp_path / "run").append({"t": np.zeros(2)}, {"t": 1.0}, {"status": "running"})
    with pytest.raises(StorageError, match=r"manifest\.json is of format 9, written by nsmodel 7\.1\.0"):
        simulate(nsmodel.load(relay_file), out=tmp_path / "run")
