"""Files that were damaged, forged, or belong to others: what is read is what was written, or it is refused by name."""

import contextlib
import os
import shutil
import subprocess
import threading
import time
from zlib import crc32

import casadi as ca
import numpy as np
import pytest
from search import files
from sweep_models import friction

import nsmodel
from nsmodel import StorageError, Sweep, Trajectory, UsageError, simulate, sweep
from nsmodel.cli import main
from nsmodel.codegen import library
from nsmodel.files.archive import DIGEST_CHUNK_BYTES, map_archive, open_archive, read_npz, write_npz
from nsmodel.files.metadata import with_checksum
from nsmodel.files.storage import dumps, loads
from nsmodel.simulation.run_folder import ChunkStore
from nsmodel.sweep.store import read_sweep_manifest

SMALL = 30  # Attempts on each kind of file.


@pytest.mark.parametrize("kind", files.KINDS)
def test_damaged_and_forged_files_are_what_was_written_or_refused(kind, capsys):
    """A small share of the search; it is in a process of its own, which may not crash."""
    assert files.main(["--kinds", kind, "--count", str(SMALL), "--seed", str(crc32(kind.encode()))]) == 0, capsys.readouterr().out


# ---------------------------------------------------------------------------------------------- arrays


def large(path):
    """An archive with an array of three chunks and a bit, in rows of a third of a chunk."""
    rows = np.arange(11 * (DIGEST_CHUNK_BYTES // 24), dtype=float).reshape(11, -1)
    write_npz(path, {"x": rows, "small": np.arange(5)}, {"title": "large"})
    return rows


def change(path, at):
    with path.open("r+b") as file:
        file.seek(at)
        byte = file.read(1)
        file.seek(at)
        file.write(bytes([byte[0] ^ 4]))


def test_a_chunk_that_was_changed_is_found_when_it_is_looked_at_and_no_other_is_read(tmp_path):
    rows = large(tmp_path / "a.npz")
    where = open_archive(tmp_path / "a.npz").arrays["x"]
    assert len(where.digests) == 4
    change(tmp_path / "a.npz", where.begin + 2 * DIGEST_CHUNK_BYTES + 100)
    archive, arrays = map_archive(tmp_path / "a.npz")
    assert archive.metadata == {"title": "large"}
    np.testing.assert_array_equal(arrays["small"], np.arange(5))
    part = arrays.part("x")
    np.testing.assert_array_equal(part.take(0, 0).values, rows[0])
    np.testing.assert_array_equal(part.take(10, 0).values, rows[10])
    hurt = (2 * DIGEST_CHUNK_BYTES + 100) // (8 * rows.shape[1])
    for ask in (
        lambda: part.take(hurt, 0).values,
        lambda: part.take(3, 1).values,
        lambda: arrays["x"],
        lambda: read_npz(archive.path),
    ):
        with pytest.raises(
            StorageError,
            match=rf"array 'x', bytes {2 * DIGEST_CHUNK_BYTES} to {3 * DIGEST_CHUNK_BYTES} was changed after it was written",
        ):
            ask()


def test_values_of_a_sweep_are_read_where_they_are_asked_for(tmp_path):
    size = 4 * DIGEST_CHUNK_BYTES // 16
    found = sweep(friction(), grid={"k": [0.9, 1.0]}, keep="x_1", every=600, compiled=False, workers=1)
    cells = {name: np.resize(np.array(values), (size, *values.shape[1:])) for name, values in found.cells.items()}
    about = dict(found.metadata) | {"shape": [size], "dims": ["k"], "along": {}, "messages": {}}
    write_npz(tmp_path / "sweep.npz", {"dim:k": np.arange(float(size)), "t": found.t, **cells}, about)
    where = open_archive(tmp_path / "sweep.npz").arrays["x_1"]
    change(tmp_path / "sweep.npz", where.begin + where.size - 3)
    loaded = Sweep.load(tmp_path)
    assert loaded["x_1"].at(k=3).values.tolist() == found["x_1"].values[1].tolist()
    assert loaded["x_1"].sizes["k"] == size
    with pytest.raises(StorageError, match=r"array 'x_1', bytes .* was changed"):
        loaded["x_1"].values  # noqa: B018
    with pytest.raises(StorageError, match=r"array 'x_1', bytes .* was changed"):
        loaded["x_1"].at(k=size - 1).values  # noqa: B018


def test_what_is_no_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    answered = []

    def ask():
        with pytest.raises(StorageError, match="it is not a file"):
            read_npz(tmp_path / "pipe.npz")
        answered.append(True)

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(10)
    assert answered


def test_a_run_that_brings_code_with_it_is_refused(tmp_path):
    """A derived quantity is an expression; a function of CasADi that loads a library would run what is in that."""
    t = ca.SX.sym("t")
    run = simulate(nsmodel.load("relay_oscillator"), t_end=1.0, compiled=False).evaluate({"twice": 2 * t})
    if library.compiler() is None:
        pytest.skip("no C compiler")
    source = "int e(const double **a, double **r, long long *i, double *w, int m) { return 0; }"
    (tmp_path / "e.c").write_text(source)
    subprocess.run([library.compiler(), "-shared", "-fPIC", "-o", tmp_path / "e.so", tmp_path / "e.c"], check=True)
    run.metadata["outputs"]["twice"]["code"] = ca.external("e", str(tmp_path / "e.so")).serialize()
    run.save(tmp_path / "run.npz")
    with pytest.raises(StorageError, match="the quantity of t is not a CasADi expression"):
        Trajectory.load(tmp_path / "run.npz").mean("twice")


# ---------------------------------------------------------------------------------------------- bound to what was asked


def bytes_in(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def cut_off(folder, **options):
    """A sweep of which three cells are there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "swept", lambda place, **more: files_sweep(place, **(options | more)))
        files.parts_in(folder)


def files_sweep(folder, *, a=1.0, t_end=1.0, **options):
    k = np.linspace(0.5, 1.5, 5)
    return sweep(
        files.swept_model(), samples={"k": k, "a": a + np.arange(5.0)}, keep="x", every=2, outputs={"end": "x[-1]"},
        compiled=False, workers=1, out=folder, t_end=t_end, **options,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("other", "why"), [({"a": 2.0}, "of other values"), ({"t_end": 2.0}, "of another model or other settings")]
)
def test_parts_of_another_sweep_are_refused_by_name_and_nothing_of_either_is_lost(tmp_path, other, why):
    cut_off(tmp_path / "one")
    cut_off(tmp_path / "two", **other)
    shutil.copy(tmp_path / "two" / "part-000002.npz", tmp_path / "one" / "part-000002.npz")
    before = bytes_in(tmp_path / "one"), bytes_in(tmp_path / "two")
    with pytest.raises(StorageError, match=rf"part-000002\.npz belongs to another sweep, {why}; take it out of the folder"):
        files_sweep(tmp_path / "one", resume=True)
    assert before == (bytes_in(tmp_path / "one"), bytes_in(tmp_path / "two"))
    (tmp_path / "one" / "part-000002.npz").unlink()
    assert (files_sweep(tmp_path / "one", resume=True)["end"].values == files_sweep(None)["end"].values).all()


def test_a_finished_sweep_and_a_design_of_another_are_refused_by_name(tmp_path):
    for name, a in (("one", 1.0), ("two", 2.0)):
        files_sweep(tmp_path / name, a=a)
    for name, message in (("sweep.npz", "of other values"), ("design.npz", r"a\[0\] = 2\.0, 1\.0 now")):
        shutil.copytree(tmp_path / "one", tmp_path / name)
        shutil.copy(tmp_path / "two" / name, tmp_path / name / name)
        before = bytes_in(tmp_path / name)
        with pytest.raises(StorageError, match=message):
            files_sweep(tmp_path / name, resume=True)
        assert bytes_in(tmp_path / name) == before


def test_a_chunk_of_another_run_is_refused_by_name(tmp_path):
    files.chunks_in(tmp_path / "one")
    with pytest.MonkeyPatch.context() as patch:
        own = files.relay_model()
        patch.setattr(files, "relay_model", lambda: nsmodel.LureSystem(
            A=own.A, B=own.B, C=own.C, law=nsmodel.relay(1), x0=[2, 0], t_end=2, step=0.1, title="Relay",
        ))  # fmt: skip
        files.chunks_in(tmp_path / "two")
    shutil.copy(tmp_path / "two" / "chunk-000002.npz", tmp_path / "one")
    before = bytes_in(tmp_path / "one")
    with pytest.raises(
        StorageError, match=r"chunk-000002\.npz is not the file that manifest\.json lists: it belongs to another run"
    ):
        files.run_goes_on(tmp_path / "one")
    assert bytes_in(tmp_path / "one") == before


def test_a_run_does_not_take_the_place_of_a_sweep_nor_a_sweep_that_of_a_run(tmp_path):
    cut_off(tmp_path / "sweep")
    files.chunks_in(tmp_path / "run")
    before = bytes_in(tmp_path / "sweep"), bytes_in(tmp_path / "run")
    for resume in (False, True):
        with pytest.raises(StorageError, match=r"sweep; give another folder|was changed|format|missing"):
            simulate(files.relay_model(), out=tmp_path / "sweep", resume=resume, compiled=False)
        with pytest.raises(StorageError, match="is that of a run; give another folder"):
            files_sweep(tmp_path / "run", resume=resume)
    assert before == (bytes_in(tmp_path / "sweep"), bytes_in(tmp_path / "run"))


@pytest.mark.parametrize("name", ["trajectory.npz", "sweep.npz"])
def test_a_file_of_todays_format_that_lost_its_digest_is_refused(tmp_path, name):
    (files.run_in if name == "trajectory.npz" else files.sweep_in)(tmp_path)
    parts = files.members((tmp_path / name).read_bytes())
    about = loads(parts["metadata.json"].decode())
    for lost in ("digest", "arrays"):
        document = {key: value for key, value in about.items() if key != lost}
        (tmp_path / name).write_bytes(files.zipped([*list(parts.items())[:-1], ("metadata.json", dumps(document).encode())]))
        with pytest.raises(StorageError, match=r"json has no digest|json has not the digest"):
            (Trajectory if name == "trajectory.npz" else Sweep).load(tmp_path / name)


@pytest.mark.parametrize("text", ["3", "null", "true", "[]", '["chunks"]', '"chunks"', "1.5", '""'])
def test_a_manifest_that_is_no_table_is_refused_by_runs_and_sweeps(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text, encoding="utf-8")
    for ask in (read_sweep_manifest, ChunkStore.open):
        with pytest.raises(StorageError, match="manifest"):
            ask(tmp_path)


def test_samples_of_an_unsigned_type_are_read_again(tmp_path):
    values = np.array([1, 2], np.uint8)
    sweep(friction(), samples={"k": values}, keep="x_1", every=600, compiled=False, workers=1, out=tmp_path / "out")
    assert Sweep.load(tmp_path / "out" / "sweep.npz").shape == (2,)


# ---------------------------------------------------------------------------------------------- names


def test_a_manifest_that_names_a_file_elsewhere_is_refused_and_the_file_stays(tmp_path):
    outside = tmp_path / "outside.npz"
    for k, name in enumerate([str(outside), "../outside.npz", "link.npz", "chunk-000009.npz", "manifest.json", "", ".", ".."]):
        folder = tmp_path / str(k)
        files.chunks_in(folder)
        shutil.copy(folder / "chunk-000001.npz", outside)
        (folder / "link.npz").symlink_to(outside)
        (folder / "chunk-000009.npz").symlink_to(outside)
        manifest = loads((folder / "manifest.json").read_text(encoding="utf-8"))
        manifest.pop("checksum")
        manifest["chunks"][0]["file"] = name
        (folder / "manifest.json").write_text(dumps(with_checksum(manifest)), encoding="utf-8")
        before = outside.read_bytes()
        for ask in (lambda folder=folder: ChunkStore.open(folder).discard(), lambda folder=folder: files.run_goes_on(folder)):
            with pytest.raises(StorageError, match=r"which is not a chunk|is a link|expected a plain name"):
                ask()
        assert outside.read_bytes() == before


@pytest.mark.parametrize(
    "name", ["run.lock", "manifest.json", "trajectory.npz", "chunk-000001.npz", "sweep.npz", "part-000001.npz"]
)
def test_nothing_is_written_through_a_link(tmp_path, name):
    (tmp_path / "outside").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / name).symlink_to(tmp_path / "outside")
    for run in (
        lambda: simulate(files.relay_model(), out=tmp_path / "folder", compiled=False),
        lambda: files_sweep(tmp_path / "folder"),
    ):
        with contextlib.suppress(StorageError, UsageError):
            run()
        assert (tmp_path / "outside").read_text() == "mine"
        assert (tmp_path / "folder" / name).is_symlink() or name in ("chunk-000001.npz", "part-000001.npz")


# ---------------------------------------------------------------------------------------------- what is asked for


@pytest.mark.parametrize("command", ["run", "sweep", "check", "codegen", "study", "stress", "view"])
def test_an_empty_path_is_refused(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    option = "--certificate" if command == "check" else "--out"
    with pytest.raises(SystemExit) as stop:
        main([command, "friction_oscillator", option, ""])
    assert stop.value.code == 2
    assert f"argument {option}: it is empty; give a path, or leave the option out" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="out is empty"):
        simulate(files.relay_model(), out=" ")


def test_a_grid_larger_than_memory_is_refused_at_once(capsys):
    began = time.monotonic()
    assert main(["sweep", "two_masses", "--grid", "mu1=1:2:1000000000000", "--output", "e=x[-1]"]) == 2
    assert "1,000,000,000,000 cells" in (told := capsys.readouterr().err)
    assert "32 TB of memory, and there are" in told
    values = np.linspace(1, 2, 10**5)
    with pytest.raises(UsageError, match=r"10,000,000,000 cells \(m1 100,000 x m2 100,000\) take 320 GB of memory"):
        sweep("two_masses", grid={"m1": values, "m2": values}, outputs={"e": "x[-1]"})
    assert time.monotonic() - began < 20


def test_texts_show_what_is_not_seen_as_escapes(tmp_path):
    run = simulate(files.relay_model(), t_end=0.5, compiled=False)
    run.metadata.update(message="a\x1b[31mb", title="c\u202ed", units={"t": "s\x07"})
    found = files.swept(None)
    found.metadata.update(title="e\x1bf")
    for text in (run.summary_text(), found.summary_text(), nsmodel.statistics(found["end"], over=["sample"]).text):
        assert text.isprintable() or all(character.isprintable() or character == "\n" for character in text)
    assert "c\\u202ed" in run.summary_text()
    assert "e\\x1bf" in found.summary_text()
