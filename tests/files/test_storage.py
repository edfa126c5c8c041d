"""Files are whole or absent, equal content gives equal bytes, and a killed run leaves a state to resume from."""

import hashlib
import io
import json
import os
import subprocess
import sys
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

import nsmodel.files.storage
from nsmodel.errors import StorageError
from nsmodel.files.archive import read_npz, write_npz
from nsmodel.files.metadata import settings_digest
from nsmodel.files.storage import dumps, loads, read_json, write_csv, write_json
from nsmodel.simulation.run_folder import ChunkStore

METADATA = {"title": "été", "values": [0.1, float("inf"), -float("inf"), 5e-324], "nested": {"none": None, "yes": True}}


def make_arrays(rows, start=0):
    """Rows start..start+rows of one fixed run, with the kinds of array a run has."""
    rng = np.random.default_rng(3)
    x, codes = rng.standard_normal((200, 3)), rng.integers(-1, 2, (200, 2)).astype(np.int8)
    part = slice(start, start + rows)
    return {
        "t": np.arange(200.0)[part] / 7,
        "x": x[part],
        "multipliers": np.zeros((200, 0))[part],
        "index_set": codes[part],
        "flag": (np.arange(200) % 3 == 0)[part],
        "cube": np.arange(1200.0).reshape(200, 2, 3)[part],
    }


def assert_same_arrays(got, expected):
    assert list(got) == list(expected)
    for name, array in expected.items():
        assert got[name].dtype == array.dtype
        np.testing.assert_array_equal(got[name], array)


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def fill(directory, cuts):
    """Append 200 rows in chunks that end at the cuts."""
    store = ChunkStore(directory)
    for start, end in zip([0, *cuts], [*cuts, 200], strict=True):
        store.append(make_arrays(end - start, start), {"row": end}, {"status": "running"})
    return store


# JSON


def test_json_round_trip_is_exact_also_for_non_finite_floats_and_their_look_alikes():
    data = {
        "a": [1, 0.1, 1e-300, -0.0, float("inf"), -float("inf")],
        "b": {"c": None, "d": "nan", "e": "\\inf", "f": "x"},
    }
    assert loads(dumps(data)) == data
    assert np.isnan(loads(dumps(float("nan"))))
    assert '"inf"' in dumps(data)
    assert dumps({"b": 1, "a": 2}) == '{"a": 2, "b": 1}'


def test_json_takes_numpy_values_as_lists_and_numbers():
    data = {"array": np.array([[1.5, np.inf]]), "number": np.float64(0.1), "code": np.int8(-1), "yes": np.bool_(True)}
    assert loads(dumps({**data, "pair": (1, 2)})) == {
        "array": [[1.5, float("inf")]],
        "number": 0.1,
        "code": -1,
        "yes": True,
        "pair": [1, 2],
    }


def test_json_refuses_what_it_cannot_give_back():
    with pytest.raises(StorageError, match=r"data\['a'\]\[1\] is a set; keep numbers"):
        dumps({"a": [1, {2}]})
    with pytest.raises(StorageError, match=r"data\['a'\] has the key 3; JSON keys are strings: use '3'"):
        dumps({"a": {3: 1}})


def test_json_file_errors(tmp_path):
    write_json(tmp_path / "a.json", METADATA)
    assert read_json(tmp_path / "a.json") == METADATA
    (tmp_path / "b.json").write_text('{"a": ')
    with pytest.raises(StorageError, match=r"b\.json is not a readable JSON file"):
        read_json(tmp_path / "b.json")
    with pytest.raises(StorageError, match=r"c\.json does not exist; check the path"):
        read_json(tmp_path / "c.json")


# CSV


def test_csv_reads_back_exactly(tmp_path):
    rng = np.random.default_rng(1)
    value = rng.standard_normal(10_000) * 10.0 ** rng.integers(-300, 300, 10_000)
    value[:3] = np.nan, np.inf, -np.inf
    write_csv(tmp_path / "a.csv", {"value, m": value, "code": np.arange(10_000, dtype=np.int16)})
    lines = (tmp_path / "a.csv").read_bytes().decode().splitlines()
    assert lines[0] == '"value, m",code'
    np.testing.assert_array_equal(np.array([float(line.split(",")[0]) for line in lines[1:]]), value)
    assert lines[-1].endswith(",9999")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"t": np.zeros(3), "x": np.zeros(4)}, r"1-D columns of one length, got t \(3,\), x \(4,\)"),
        ({"x": np.zeros((3, 2))}, r"1-D columns of one length, got x \(3, 2\)"),
        ({}, "1-D columns of one length, got no column"),
    ],
)
def test_csv_refuses_other_shapes(tmp_path, columns, message):
    with pytest.raises(StorageError, match=message):
        write_csv(tmp_path / "a.csv", columns)


# npz


def test_npz_round_trip_and_numpy_reads_it(tmp_path):
    arrays = make_arrays(200) | {"scalar": np.array(2.5), "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3))}
    write_npz(tmp_path / "a.npz", arrays, METADATA)
    got, metadata = read_npz(tmp_path / "a.npz")
    assert_same_arrays(got, arrays)
    assert metadata == METADATA
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["x"], arrays["x"])


def test_npz_bytes_depend_on_the_content_alone(tmp_path, monkeypatch):
    write_npz(tmp_path / "a.npz", make_arrays(50), METADATA)
    monkeypatch.setattr("time.time", lambda: 2e9)
    write_npz(tmp_path / "b.npz", make_arrays(50), dict(reversed(METADATA.items())))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_npz_refuses_python_objects(tmp_path):
    with pytest.raises(StorageError, match=r"a\.npz: array 'x' holds Python objects; make it an array of numbers"):
        write_npz(tmp_path / "a.npz", {"x": np.array([object()])}, {})
    assert not list(tmp_path.iterdir())


def test_npz_missing_or_foreign(tmp_path):
    with pytest.raises(StorageError, match=r"none\.npz does not exist; check the path"):
        read_npz(tmp_path / "none.npz")
    np.savez(tmp_path / "plain.npz", t=np.zeros(2))
    with pytest.raises(StorageError, match=r"plain\.npz has no metadata\.json: nsmodel did not write it"):
        read_npz(tmp_path / "plain.npz")
    (tmp_path / "text.npz").write_text("t,x\n")
    with pytest.raises(StorageError, match=r"text\.npz is not a whole npz file \(File is not a zip file\): it was cut"):
        read_npz(tmp_path / "text.npz")
    with pytest.raises(StorageError, match=r"is a folder; give the file in it, .*trajectory\.npz"):
        read_npz(tmp_path)


def test_npz_too_large_for_memory(tmp_path, monkeypatch):
    def full(*arguments, **options):
        raise MemoryError("Unable to allocate 1 TiB")

    write_npz(tmp_path / "a.npz", make_arrays(5), {})
    monkeypatch.setattr("nsmodel.files.archive.ArchivedArray.made_of", full)
    with pytest.raises(StorageError, match=r"a\.npz does not fit in memory \(Unable to allocate 1 TiB\); read it with"):
        read_npz(tmp_path / "a.npz")


def test_npz_never_unpickles(tmp_path):
    member = io.BytesIO()
    np.save(member, np.array([{}], dtype=object), allow_pickle=True)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", member.getvalue())
        archive.writestr("metadata.json", "{}")
    with pytest.raises(
        StorageError, match=r"array 'x' is of type \|O8?; files hold numbers and booleans|array 'x' has no header"
    ):
        read_npz(tmp_path / "a.npz")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_npz_truncated(tmp_path, share):
    write_npz(tmp_path / "a.npz", make_arrays(200), METADATA)
    whole = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(StorageError, match=r"a\.npz is not a whole npz file .* run the model again"):
        read_npz(tmp_path / "a.npz")


def test_npz_every_damaged_bit_is_an_error_or_harmless(tmp_path):
    """One bit of each byte, another one from byte to byte; an array may not vanish, nor change, nor may metadata."""
    arrays = {name: array for name, array in make_arrays(4).items() if name in ("t", "x", "index_set")}
    path = tmp_path / "a.npz"
    write_npz(path, arrays, METADATA)
    whole, refused = path.read_bytes(), 0
    for place in range(len(whole)):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << (5 * place % 8)
        path.write_bytes(damaged)
        try:
            got, metadata = read_npz(path)
        except StorageError:
            refused += 1
        else:  # a bit of the zip's own records, which does not change what is read
            assert_same_arrays(got, arrays)
            assert metadata == METADATA
    assert refused > len(whole) / 2


@pytest.mark.parametrize("changed", ["x.npx", "x.npz", "x"])
def test_npz_an_array_cannot_hide_under_another_name(tmp_path, changed):
    """Nor in a file that carries no list of its arrays."""
    for listed in (True, False):
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            for name in ("t.npy", changed):
                member = io.BytesIO()
                np.save(member, np.zeros(3))
                archive.writestr(name, member.getvalue())
            archive.writestr("metadata.json", dumps({"format": 2, "arrays": ["t", "x"]} if listed else {}))
        with pytest.raises(StorageError, match=rf"a\.npz is not a whole npz file \(it holds t\.npy, {changed}, "):
            read_npz(tmp_path / "a.npz")


def test_failed_write_leaves_the_old_file_and_nothing_beside_it(tmp_path, monkeypatch):
    write_npz(tmp_path / "a.npz", make_arrays(5), {})
    old = (tmp_path / "a.npz").read_bytes()

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"cannot write .*a\.npz: .*No space left.*; take a folder that is writable"):
        write_npz(tmp_path / "a.npz", make_arrays(9), {})
    with pytest.raises(StorageError, match=r"cannot write .*a\.npz/b\.json"):
        write_json(tmp_path / "a.npz" / "b.json", {})
    assert (tmp_path / "a.npz").read_bytes() == old
    assert [file.name for file in tmp_path.iterdir()] == ["a.npz"]


def test_interrupt_while_writing_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(descriptor):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_json(tmp_path / "a.json", {})
    assert not list(tmp_path.iterdir())


# chunks


def test_chunks_and_manifest(tmp_path):
    store = ChunkStore(tmp_path / "run")
    assert store.manifest["rows"] == 0
    store.append(make_arrays(5), {"x": np.array([0.1, np.nan])}, METADATA)
    store.append(make_arrays(3, 5), {"x": np.array([0.1, np.inf])}, METADATA | {"status": "done"})
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "chunk-000001.npz",
        "chunk-000002.npz",
        "manifest.json",
    ]
    assert (
        ChunkStore.open(tmp_path / "run").manifest
        == store.manifest
        == {
            "format": nsmodel.files.storage.FILE_FORMAT,
            "version": nsmodel.__version__,
            "run": settings_digest(None),
            "chunks": [
                {"file": "chunk-000001.npz", "rows": 5, "sha256": sha256(tmp_path / "run" / "chunk-000001.npz")},
                {"file": "chunk-000002.npz", "rows": 3, "sha256": sha256(tmp_path / "run" / "chunk-000002.npz")},
            ],
            "rows": 8,
            "checkpoint": {"x": [0.1, float("inf")]},
            "metadata": METADATA | {"status": "done"},
            "status": "done",
        }
    )
    json.loads((tmp_path / "run" / "manifest.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)


@pytest.mark.parametrize("cuts", [[], [1], [199], [64, 65, 66], list(range(1, 200)), [0, 0, 100]])
def test_joined_file_is_the_file_written_at_once(tmp_path, cuts):
    write_npz(tmp_path / "whole.npz", make_arrays(200), METADATA)
    store = fill(tmp_path / "run", cuts)
    store.join(METADATA)
    assert (tmp_path / "run" / "trajectory.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()
    assert sorted(file.name for file in (tmp_path / "run").iterdir()) == ["manifest.json", "trajectory.npz"]
    whole = {"file": "trajectory.npz", "rows": 200, "sha256": sha256(tmp_path / "run" / "trajectory.npz")}
    assert store.manifest["chunks"] == [whole]
    assert store.manifest["checkpoint"] == {"row": 200}


def test_append_and_join_again_after_a_join(tmp_path):
    target = tmp_path / "run" / "trajectory.npz"
    write_npz(tmp_path / "whole.npz", make_arrays(200), METADATA)
    store = ChunkStore(tmp_path / "run")
    for start in (0, 50, 100, 150):
        store.append(make_arrays(20, start), {}, {})
        store.append(make_arrays(30, start + 20), {}, {})
        store.join(METADATA if start == 150 else {"status": "interrupted"})
        store = ChunkStore.open(tmp_path / "run")
    assert target.read_bytes() == (tmp_path / "whole.npz").read_bytes()
    store.join(METADATA)
    assert target.read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_join_takes_memory_independent_of_the_length(tmp_path):
    store, block = ChunkStore(tmp_path), np.zeros((1000, 125))
    for _ in range(32):
        store.append({"t": np.zeros(1000), "x": block}, {}, {})
    tracemalloc.start()
    store.join({})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (tmp_path / "trajectory.npz").stat().st_size > 32e6
    assert peak < 4e6


def test_chunk_outside_the_manifest_is_ignored_and_overwritten(tmp_path):
    fill(tmp_path / "run", [100])
    manifest = (tmp_path / "run" / "manifest.json").read_bytes()
    store = ChunkStore.open(tmp_path / "run")
    store.append(make_arrays(7), {}, {})
    (tmp_path / "run" / "manifest.json").write_bytes(manifest)  # as if killed before the manifest
    store = ChunkStore.open(tmp_path / "run")
    assert store.manifest["rows"] == 200
    store.append(make_arrays(9), {}, {})
    assert ChunkStore.open(tmp_path / "run").manifest["rows"] == 209


@pytest.mark.parametrize("reopened", [False, True])
@pytest.mark.parametrize("joined_before", [False, True])
@pytest.mark.parametrize("at", ["write_archive", "write_json", "replace", "second write_json", "unlink"])
def test_join_killed_anywhere_can_be_resumed(tmp_path, monkeypatch, reopened, joined_before, at):
    target = tmp_path / "run" / "trajectory.npz"
    write_npz(tmp_path / "whole.npz", make_arrays(200), METADATA)
    if not joined_before:
        store = fill(tmp_path / "run", [60, 120])
    else:
        store = ChunkStore(tmp_path / "run")
        store.append(make_arrays(60), {}, {})
        store.join({})
        store.append(make_arrays(60, 60), {}, {})
        store.append(make_arrays(80, 120), {"row": 200}, {})
    write, manifests = nsmodel.files.storage.write_json, []

    def kill(*arguments, **options):
        raise KeyboardInterrupt

    def second(path, data):
        manifests.append(path)
        (kill if len(manifests) == 2 else write)(path, data)

    with monkeypatch.context() as patch:
        if at in ("replace", "unlink"):
            # The manifests are written as ever, by a way of their own.
            patch.setattr("nsmodel.simulation.run_folder.write_json", lambda path, data: Path(path).write_text(dumps(data)))
            patch.setattr(Path, at, kill)
        else:
            patch.setattr(
                "nsmodel.simulation.run_folder." + at.removeprefix("second "), second if at.startswith("second") else kill
            )
        with pytest.raises(KeyboardInterrupt):
            store.join(METADATA)
    store = ChunkStore.open(tmp_path / "run") if reopened else store
    assert store.manifest["rows"] == 200
    assert store.manifest["checkpoint"] == {"row": 200}
    store.join(METADATA)
    assert target.read_bytes() == (tmp_path / "whole.npz").read_bytes()
    assert ChunkStore.open(tmp_path / "run").manifest == store.manifest


KILLED = """
import sys
import numpy as np
from nsmodel.simulation.run_folder import ChunkStore
store, start = ChunkStore(sys.argv[1]), 0
while True:
    rows = np.arange(start, start + 500.0)
    store.append({"t": rows, "x": np.outer(rows, np.ones(4))}, {"t": rows[-1]}, {})
    start += 500
    if start % 3000 == 0:
        store.join({})
    print(start, flush=True)
"""


@pytest.mark.parametrize("delay", range(6))
def test_killed_run_leaves_whole_chunks(tmp_path, delay):
    root = Path(nsmodel.files.storage.__file__).parents[1]
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=root)
    assert process.stdout
    seen = [int(process.stdout.readline()) for _ in range(3 + delay)][-1]
    process.kill()
    process.communicate()
    store = ChunkStore.open(tmp_path)
    rows = store.manifest["rows"]
    assert rows >= seen
    assert store.manifest["checkpoint"] == {"t": rows - 1}
    store.join({})
    arrays, _ = read_npz(tmp_path / "trajectory.npz")
    np.testing.assert_array_equal(arrays["t"], np.arange(float(rows)))
    np.testing.assert_array_equal(arrays["x"][:, 3], arrays["t"])


def test_new_store_replaces_an_older_run(tmp_path):
    fill(tmp_path, [100])
    store = ChunkStore(tmp_path)
    store.append(make_arrays(10), {}, {})
    assert ChunkStore.open(tmp_path).manifest["rows"] == 10
    store.join({})
    assert sorted(file.name for file in tmp_path.iterdir()) == ["manifest.json", "trajectory.npz"]


def test_append_after_a_join_whose_manifest_could_not_be_written(tmp_path, monkeypatch):
    write_npz(tmp_path / "whole.npz", make_arrays(200), METADATA)
    store, target = ChunkStore(tmp_path / "run"), tmp_path / "run" / "trajectory.npz"
    for start in (0, 50, 100):
        store.append(make_arrays(50, start), {}, {})
        with monkeypatch.context() as patch:
            patch.setattr("nsmodel.simulation.run_folder.write_json", lambda *arguments: 1 / 0)
            with pytest.raises(ZeroDivisionError):
                store.join({})
    store.append(make_arrays(50, 150), {}, {})
    store.join(METADATA)
    assert target.read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_nothing_to_resume(tmp_path):
    with pytest.raises(StorageError, match=r"nothing to resume in .*run: no manifest\.json; start the run without"):
        ChunkStore.open(tmp_path / "run")
    write_json(tmp_path / "manifest.json", [3])
    with pytest.raises(StorageError, match=r"manifest\.json is not a manifest; remove the folder, or give another, to start"):
        ChunkStore.open(tmp_path)
    write_json(tmp_path / "manifest.json", {"format": 2})
    with pytest.raises(StorageError, match=r"manifest\.json is of format 2, written by an older nsmodel: .* remove the folder"):
        ChunkStore.open(tmp_path)
    write_json(tmp_path / "manifest.json", {"format": 3})
    with pytest.raises(StorageError, match=r"manifest\.json was changed after it was written; remove the folder, or give"):
        ChunkStore.open(tmp_path)
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(StorageError, match=r"manifest\.json is not a readable JSON file"):
        ChunkStore.open(tmp_path)


def flip(path, place):
    damaged = bytearray(path.read_bytes())
    damaged[place] ^= 1
    path.write_bytes(damaged)


def exchange(one, other):
    bytes_of_one = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(bytes_of_one)


@pytest.mark.parametrize(
    ("damage", "found"),
    [
        (lambda one, two, three: flip(two, len(two.read_bytes()) // 2), "chunk-000002.npz"),
        (lambda one, two, three: flip(three, -1), "chunk-000003.npz"),
        (lambda one, two, three: exchange(one, two), "chunk-000001.npz"),
        (lambda one, two, three: exchange(two, three), "chunk-000002.npz"),
        (lambda one, two, three: write_npz(two, make_arrays(60, 60), {"other": 1}), "chunk-000002.npz"),
        (lambda one, two, three: write_npz(two, make_arrays(7), {}), "chunk-000002.npz"),
    ],
)
def test_open_finds_the_chunk_that_was_changed_and_touches_nothing(tmp_path, damage, found):
    fill(tmp_path, [60, 120])
    damage(*(tmp_path / f"chunk-00000{k}.npz" for k in (1, 2, 3)))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(StorageError, match=rf"{found} is not the file that manifest\.json lists: .* put it back from a copy, or"):
        ChunkStore.open(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_open_finds_a_missing_chunk(tmp_path):
    fill(tmp_path, [60, 120])
    (tmp_path / "chunk-000002.npz").unlink()
    with pytest.raises(StorageError, match=r"chunk-000002\.npz does not exist; put it back from a copy"):
        ChunkStore.open(tmp_path)
    (tmp_path / "chunk-000002.npz").mkdir()
    with pytest.raises(StorageError, match=r"chunk-000002\.npz cannot be read"):
        ChunkStore.open(tmp_path)


def test_a_manifest_of_exchanged_chunks_is_refused(tmp_path):
    fill(tmp_path, [60, 120])
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    manifest["chunks"] = manifest["chunks"][::-1]
    write_json(tmp_path / "manifest.json", manifest)
    with pytest.raises(StorageError, match=r"manifest\.json was changed after it was written"):
        ChunkStore.open(tmp_path)


def test_append_refuses_other_arrays(tmp_path):
    store = ChunkStore(tmp_path)
    with pytest.raises(StorageError, match="needs arrays of one number of rows, got no array"):
        store.append({}, {}, {})
    with pytest.raises(StorageError, match=r"needs arrays of one number of rows, got t \(3,\), x \(4, 1\)"):
        store.append({"t": np.zeros(3), "x": np.zeros((4, 1))}, {}, {})
    with pytest.raises(StorageError, match=r"needs arrays of one number of rows, got t \(\)"):
        store.append({"t": np.zeros(())}, {}, {})
    store.append({"t": np.zeros(3)}, {}, {})
    with pytest.raises(
        StorageError, match=r"array 't' in .* expected float64 rows of shape \(\), got int64 rows of shape \(2,\)"
    ):
        store.append({"t": np.zeros((3, 2), dtype=np.int64)}, {}, {})
    with pytest.raises(StorageError, match=r"data\['checkpoint'\]\['a'\] is a set"):
        store.append({"t": np.zeros(3)}, {"a": {1}}, {})
    assert store.manifest["rows"] == ChunkStore.open(tmp_path).manifest["rows"] == 3


def test_join_refuses_an_empty_run(tmp_path):
    with pytest.raises(StorageError, match=r"nothing to join in .*: no chunk was appended"):
        ChunkStore(tmp_path).join({})
