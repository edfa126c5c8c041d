"""Files of runs and sweeps, damaged and forged: what is read is what was written, or it is refused as StorageError.

    python -m tests.search.files --count 2000 --json FILE   so many attempts on each kind of file, each in a process of its own

A file may be damaged in any way that keeps its digests as they were; then what is accepted must equal what was written. It may
also be forged: written anew, with right digests, and fields or arrays of other types; then what is accepted must be usable, all
of it, without an error of Python. A process that ends by a signal is counted as a crash.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import nsmodel
from nsmodel import FirstOrderSystem, LureSystem, Sweep, Trajectory, relay, simulate, sweep
from nsmodel.errors import NsmodelError, StorageError, UnverifiedWarning
from nsmodel.files.archive import read_npz, write_npz
from nsmodel.files.metadata import with_checksum
from nsmodel.files.storage import dumps, loads
from nsmodel.modeling.model_files import case_files
from nsmodel.simulation.run_folder import ChunkStore
from nsmodel.sweep.store import SweepStore

REFUSED, EQUAL, USABLE, WRONG, THREW = "refused", "equal", "usable", "WRONG", "THREW"
VALUES: tuple[Any, ...] = (
    None, True, 0, 3, -1, 10**30, 1.5, float("nan"), float("-inf"), "", "text", "nan", "\x1b[2J", [], [[1]], ["a", 1], [None],
    {}, {"a": 1}, {"a": [1]}, {"0": "x", "-1": "y"}, [1, 2, 3], {"a": {"b": None}},
)  # fmt: skip
SAMPLES = {"k": np.linspace(0.5, 1.5, 5), "a": np.array([1.0, 2.0, 3.0, 4.0, 5.0])}


# ---------------------------------------------------------------------------------------------- what is written


def relay_model() -> LureSystem:
    """Dry friction, with names and units."""
    return LureSystem(
        A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=2, step=0.1, units={"t": "s"}, title="Relay",
    )  # fmt: skip


def swept_model() -> FirstOrderSystem:
    """x' = -k x + a sin(k), of two parameters."""
    k, a, x = ca.SX.sym("k"), ca.SX.sym("a"), ca.SX.sym("x")
    return FirstOrderSystem(x=x, f=[-k * x + a], x0=[0], t_end=1.0, step=0.1, parameters={k: 1, a: 1}, title="line")


def run_in(folder: Path) -> None:
    """A run in a folder, done."""
    simulate(relay_model(), out=folder, compiled=False)


def events_in(folder: Path) -> None:
    """An event-driven run, with a derived quantity, in a file."""
    t = ca.SX.sym("t")
    run = simulate(relay_model(), rtol=1e-6, compiled=False).evaluate({"twice": 2 * t})
    run.save(folder / "trajectory.npz")


def bodies_in(folder: Path) -> None:
    """A run of many bodies."""
    path = case_files()["crowd"]
    simulate(nsmodel.load(path, n=3, seed=0), t_end=0.5, compiled=False).save(folder / "trajectory.npz")


def chunks_in(folder: Path) -> None:
    """A run that was cut off: chunks and a manifest."""
    store = ChunkStore(folder)
    done = simulate(relay_model(), compiled=False)
    simulate(relay_model(), out=folder / "whole", compiled=False, t_end=1.0)
    whole = ChunkStore.open(folder / "whole")
    about, checkpoint = whole.manifest["metadata"], whole.manifest["checkpoint"]
    arrays = {name: values[:11] for name, values in done.arrays.items()}
    for part in (slice(0, 4), slice(4, 11)):
        store.append({name: values[part] for name, values in arrays.items()}, checkpoint, about | {"status": "interrupted"})
    shutil.rmtree(folder / "whole")


def swept(folder: Path | None, **options: Any) -> Sweep:
    """The sweep that all of these are."""
    return sweep(
        swept_model(), samples=SAMPLES, keep="x", every=2, outputs={"end": "x[-1]"}, compiled=False, workers=1, out=folder,
        **options,
    )  # fmt: skip


def sweep_in(folder: Path) -> None:
    """A sweep that is done."""
    swept(folder)


def parts_in(folder: Path) -> None:
    """A sweep that was interrupted: parts of one cell each."""
    put, count = SweepStore.put, [0]

    def some(self: SweepStore, cells: Any, found: Any) -> None:
        if count[0] < 3:
            put(self, cells, found)
        count[0] += 1

    SweepStore.put, join = some, SweepStore.join
    SweepStore.join = lambda self, *given: (_ for _ in ()).throw(KeyboardInterrupt)  # type: ignore[method-assign]
    try:
        swept(folder)
    except KeyboardInterrupt:
        pass
    finally:
        SweepStore.put, SweepStore.join = put, join


# ---------------------------------------------------------------------------------------------- what is read


def same(one: Any, other: Any) -> bool:
    """Whether two arrays, or metadata, are equal to the bit."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        one, other = np.asarray(one), np.asarray(other)
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return dumps(one) == dumps(other)


def contents(path: Path) -> Any:
    """All that a file of a run says."""
    run = Trajectory.load(path)
    return {**run.arrays, "metadata": run.metadata}


def of_a_sweep(found: Sweep) -> Any:
    """All that a sweep says."""
    about = {name: np.array(values) for name, values in found.cells.items()}
    about |= {f"of {name}": np.array(values) for name, (values, _) in found.varied.items()}
    about |= {f"along {dim}": np.array(found.coords[dim]) for dim in found.dims}
    messages = {str(cell): text for cell, text in found.messages.items()}
    return about | {"t": found.t, "metadata": dict(found.metadata), "messages": messages, "dims": list(found.dims)}


def use_run(run: Trajectory) -> None:
    """Ask a run for all that a user might."""
    repr(run), run.summary(), run.summary_text(), dir(run), run.at(0.5 * float(run.t[0] + run.t[-1])), run.smooth(20)
    for name in run.metadata.get("stems", {}):
        getattr(run, name)
    if run.is_event_driven:
        list(run.events)
    if "contact_row" in run.arrays:
        run.contacts(-1)
    for name in run.metadata.get("outputs", {}):
        run.mean(name)
    run.to_csv(os.devnull)
    run._repr_html_()


def use_sweep(found: Sweep) -> None:
    """Ask a sweep for all that a user might."""
    repr(found), found.summary(), found.summary_text(), dir(found), found.arrays, found.status, found.failures, found.plan
    for name in found.cells:
        repr(found[name])
    found.at(0)
    found.to_csv(os.devnull)
    found._repr_html_()


# ---------------------------------------------------------------------------------------------- damage


def flip(rng: random.Random, raw: bytes) -> bytes:
    """One bit, anywhere; as often in what is not the body."""
    place = rng.choice(
        [rng.randrange(len(raw)), rng.randrange(min(200, len(raw))), len(raw) - 1 - rng.randrange(min(900, len(raw)))]
    )
    return raw[:place] + bytes([raw[place] ^ 1 << rng.randrange(8)]) + raw[place + 1 :]


def several(rng: random.Random, raw: bytes) -> bytes:
    """Up to 64 bytes by others, in one place."""
    place, size = rng.randrange(len(raw)), rng.randrange(1, 65)
    return raw[:place] + rng.randbytes(min(size, len(raw) - place)) + raw[place + size :]


def cut(rng: random.Random, raw: bytes) -> bytes:
    """The end, the begin, or a piece in the middle is gone."""
    one, two = sorted((rng.randrange(len(raw)), rng.randrange(len(raw))))
    return rng.choice([raw[:one], raw[one:], raw[:one] + raw[two:]])


def more(rng: random.Random, raw: bytes) -> bytes:
    """Bytes before, behind or between; or the file twice."""
    place, added = rng.randrange(len(raw)), rng.randbytes(rng.randrange(1, 300))
    return rng.choice([added + raw, raw + added, raw[:place] + added + raw[place:], raw + raw])


def swap(rng: random.Random, raw: bytes) -> bytes:
    """Two pieces are exchanged."""
    size = rng.randrange(1, 64)
    one, two = sorted((rng.randrange(len(raw)), rng.randrange(len(raw))))
    if one + size > two or two + size > len(raw):
        return raw[::-1]
    return raw[:one] + raw[two : two + size] + raw[one + size : two] + raw[one : one + size] + raw[two + size :]


BYTES = (flip, flip, flip, several, cut, more, swap)


def members(raw: bytes) -> dict[str, bytes]:
    """What an archive holds."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(parts: list[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of these members."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names that come twice
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", compression) as archive:
            for name, data in parts:
                archive.writestr(zipfile.ZipInfo(name), data, compression)
    return stream.getvalue()


def npy(array: np.ndarray, **header: Any) -> bytes:
    """An array as a member, with a header that may say something else."""
    stream = io.BytesIO()
    given = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape} | header
    np.lib.format.write_array_header_1_0(stream, given)
    return stream.getvalue() + array.tobytes()


def rewritten(rng: random.Random, raw: bytes) -> bytes:
    """Members are compressed, doubled, lost, exchanged, renamed, foreign, or of another type, order or shape."""
    parts = list(members(raw).items())
    arrays = [i for i, (name, _) in enumerate(parts) if name.endswith(".npy")]
    i, j = rng.choice(arrays), rng.choice(arrays)
    name, data = parts[i]
    array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    of = rng.randrange(18)
    if of == 0:
        return zipped(parts, zipfile.ZIP_DEFLATED)
    if of == 1:
        return zipped([*parts, ("bomb.npy", bytes(10_000_000))], zipfile.ZIP_DEFLATED)
    if of == 2:
        return zipped([*parts, rng.choice(parts)])
    if of == 3:
        return zipped(parts[:i] + parts[i + 1 :])
    if of == 4:
        parts[i], parts[j] = (name, parts[j][1]), (parts[j][0], data)
    elif of == 5:
        parts[i] = (rng.choice(["x", "../x.npy", "/tmp/x.npy", f"{name}.npy", "", "t.npy", "\x00.npy"]), data)
    elif of == 6:
        parts.insert(rng.randrange(len(parts) + 1), (rng.choice(["other.npy", "readme.txt", "a/b.npy"]), npy(np.zeros(3))))
    elif of == 7:
        parts[i] = (name, npy(array, descr="|O"))
    elif of == 8:
        parts[i] = (
            name,
            npy(np.frombuffer(rng.randbytes(8 * max(array.size, 1)), "<u8"), descr="|O", shape=(max(array.size, 1),)),
        )
    elif of == 9:
        parts[i] = (name, npy(array, descr=[("a", "<f4"), ("b", "<f4")]))
    elif of == 10:
        parts[i] = (name, npy(array, fortran_order=True))
    elif of == 11:
        parts[i] = (name, npy(array, descr=np.lib.format.dtype_to_descr(array.dtype.newbyteorder(">"))))
    elif of == 12:
        parts[i] = (
            name,
            npy(array, shape=rng.choice([(10**12,), (array.size + 1,), (0, 10**18), (1,) * 40, (-1,), (2**62, 4), ()])),
        )
    elif of == 13:
        parts[i] = (
            name,
            npy(array, descr=rng.choice(["<f4", "<i8", "<c16", "<M8[s]", "<U2", "|S8", "|V8", "<f16", "|b1", "<f8"])),
        )
    elif of == 14:
        parts[i] = (name, npy(np.roll(array.reshape(-1), 1).reshape(array.shape) + (array.dtype.kind != "b")))
    elif of == 15:
        parts[i] = (name, npy(array[:0] if array.ndim else array))
    elif of == 16:
        parts[i] = (name, data[:8] + rng.randbytes(120) + data[128:])
    else:
        about = loads(dict(parts)["metadata.json"].decode())
        key = rng.choice(sorted(about))
        changed = (
            about | {key: rng.choice(VALUES)} if rng.random() < 0.7 else {name: of for name, of in about.items() if name != key}
        )
        parts = [(one, dumps(changed).encode() if one == "metadata.json" else of) for one, of in parts]
    return zipped(parts)


def forged(rng: random.Random, path: Path) -> None:
    """Write a file anew, with right digests, and something of another type or shape."""
    arrays, about = read_npz(path)
    if rng.random() < 0.65 and about:
        where, of = about, rng.choice(sorted(about))
        while isinstance(where[of], dict) and where[of] and rng.random() < 0.5:
            where = where[of]
            of = rng.choice(sorted(where))
        if rng.random() < 0.2:
            del where[of]
        else:
            where[of] = rng.choice(VALUES)
    else:
        name = rng.choice(sorted(arrays))
        array = arrays[name]
        makers: list[Callable[[], Any]] = [
            lambda: array[:-1], lambda: array[..., None], lambda: array.reshape(-1), lambda: np.zeros(0), lambda: np.array(3.0),
            lambda: array.astype(bool), lambda: array.astype(np.int8), lambda: array.astype(float) * np.nan,
            lambda: np.concatenate([array, array]), lambda: array[::-1], lambda: -array.astype(float), lambda: array.T,
            lambda: array.astype(np.uint64), lambda: array.astype(np.float16), lambda: array + 100,
        ]  # fmt: skip
        try:
            arrays[name] = rng.choice(makers)()
        except (TypeError, ValueError, IndexError):
            arrays.pop(name)
        if rng.random() < 0.15:
            arrays.pop(rng.choice(sorted(arrays)))
    write_npz(path, arrays, about)


def manifest_forged(rng: random.Random, path: Path) -> None:
    """Write a manifest anew, with the right checksum, and something of another type, or a file elsewhere."""
    about = loads(path.read_text(encoding="utf-8"))
    about.pop("checksum")
    where, of = about, rng.choice(sorted(about))
    while isinstance(where[of], dict | list) and where[of] and rng.random() < 0.75:
        where = where[of]
        of = rng.choice(sorted(where)) if isinstance(where, dict) else rng.randrange(len(where))
    if rng.random() < 0.15 and isinstance(where, dict):
        del where[of]
    else:
        names = (
            "/etc/hostname",
            "../outside.npz",
            "outside.npz",
            "a/b.npz",
            ".",
            "",
            "chunk-000001.npz",
            "link.npz",
            "C:\\x.npz",
        )
        where[of] = rng.choice((*VALUES, *names))
    path.write_text(dumps(with_checksum(about)), encoding="utf-8")


# ---------------------------------------------------------------------------------------------- attempts


def attempt_file(make: Callable[[Path], None], name: str, read: Callable[[Path], Any], use: Callable[[Path], None]) -> Any:
    """What tries a file that is read alone."""

    def attempts(rng: random.Random, folder: Path) -> Callable[[], tuple[str, str]]:
        (folder / "right").mkdir()
        make(folder / "right")
        raw, right, path = (folder / "right" / name).read_bytes(), read(folder / "right" / name), folder / name

        def one() -> tuple[str, str]:
            kind = rng.random()
            if kind < 0.25:
                path.write_bytes(raw)
                forged(rng, path)
                use(path)
                return USABLE, "forged"
            damage = rewritten if kind < 0.55 else rng.choice(BYTES)
            path.write_bytes(damage(rng, raw))
            found = read(path)
            return (
                EQUAL if found.keys() == right.keys() and all(same(found[k], right[k]) for k in right) else WRONG
            ), damage.__name__

        return one

    return attempts


def attempt_folder(make: Callable[[Path], None], names: tuple[str, ...], go_on: Callable[[Path], Any]) -> Any:
    """What tries to go on in a folder with a damaged file; nothing outside is touched, nothing lost where it is refused."""

    def attempts(rng: random.Random, folder: Path) -> Callable[[], tuple[str, str]]:
        right, place, outside = folder / "right", folder / "place", folder / "outside.npz"
        right.mkdir()
        make(right)
        outside.write_bytes(b"outside")
        shutil.copytree(right, place)
        whole = go_on(place)

        def one() -> tuple[str, str]:
            shutil.rmtree(place)
            shutil.copytree(right, place)
            (place / "link.npz").symlink_to(outside)
            path = place / rng.choice(names)
            kind, how = rng.random(), "forged"
            if path.suffix == ".json" and kind < 0.6:
                manifest_forged(rng, path)
            elif path.suffix == ".npz" and kind < 0.2:
                forged(rng, path)
            elif path.suffix == ".npz" and kind < 0.5:
                path.write_bytes(rewritten(rng, path.read_bytes()))
                how = "rewritten"
            elif kind > 0.95:
                path.unlink()
                path.symlink_to(outside)
                how = "link"
            else:
                damage = rng.choice(BYTES)
                path.write_bytes(damage(rng, path.read_bytes()))
                how = damage.__name__
            before = {file.name: file.read_bytes() for file in place.iterdir()}
            try:
                found = go_on(place)
                fit = found.keys() == whole.keys() and all(same(found[k], whole[k]) for k in whole)
                return (EQUAL if fit else USABLE if how == "forged" else WRONG), f"{path.name} {how}"
            except NsmodelError:
                after = {file.name: file.read_bytes() for file in place.iterdir() if file.exists()}
                gone = [name for name in before if before[name] != after.get(name) and name != path.name]
                lost = [] if "trajectory.npz" in after.keys() - before.keys() else gone  # Or joined.
                if lost:
                    return WRONG, f"{path.name} {how}: lost {lost}"
                raise
            finally:
                assert outside.read_bytes() == b"outside", f"{path.name} {how}: a file outside was changed"

        return one

    return attempts


def run_goes_on(folder: Path) -> Any:
    """The run to its end."""
    run = simulate(relay_model(), out=folder, resume=True, compiled=False)
    return {**run.arrays, "status": run.status}


def sweep_goes_on(folder: Path) -> Any:
    """The sweep to its end."""
    return of_a_sweep(swept(folder, resume=True))


def read_sweep(path: Path) -> Any:
    """A sweep's file."""
    return of_a_sweep(Sweep.load(path))


KINDS = {
    "run": attempt_file(run_in, "trajectory.npz", contents, lambda path: use_run(Trajectory.load(path))),
    "event-driven run": attempt_file(events_in, "trajectory.npz", contents, lambda path: use_run(Trajectory.load(path))),
    "bodies": attempt_file(bodies_in, "trajectory.npz", contents, lambda path: use_run(Trajectory.load(path))),
    "sweep": attempt_file(sweep_in, "sweep.npz", read_sweep, lambda path: use_sweep(Sweep.load(path))),
    "chunks": attempt_folder(chunks_in, ("chunk-000001.npz", "chunk-000002.npz"), run_goes_on),
    "manifest of a run": attempt_folder(chunks_in, ("manifest.json",), run_goes_on),
    "run that is done": attempt_folder(run_in, ("trajectory.npz", "manifest.json"), run_goes_on),
    "parts": attempt_folder(parts_in, ("part-000001.npz", "part-000002.npz"), sweep_goes_on),
    "manifest of a sweep": attempt_folder(parts_in, ("manifest.json", "design.npz"), sweep_goes_on),
    "sweep that is done": attempt_folder(sweep_in, ("sweep.npz", "manifest.json", "design.npz"), sweep_goes_on),
}


def attempt(kind: str, count: int, seed: int) -> dict[str, Any]:
    """Try a kind of file so often, in this process."""
    counts: Counter[str] = Counter()
    told: list[str] = []
    warnings.simplefilter("ignore", UnverifiedWarning)
    with tempfile.TemporaryDirectory() as place:
        one = KINDS[kind](random.Random(seed), Path(place))
        for i in range(count):
            rng_state = f"{kind}, seed {seed}, attempt {i}"
            print(rng_state, file=sys.stderr, flush=True) if os.environ.get("NSMODEL_FILES_TELL") else None
            try:
                found, how = one()
            except StorageError:
                found, how = REFUSED, ""
            except NsmodelError as error:  # of another kind: a part that a user may have put there, which is no damage
                found, how = REFUSED, str(error)
            except Exception:
                found, how = THREW, traceback.format_exc(limit=-6)
            counts[found] += 1
            if found in (WRONG, THREW):
                told.append(f"{rng_state}: {how}")
    return {"kind": kind, "seed": seed, "counts": dict(counts), "told": told}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.search.files", description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="attempts on each kind of file")
    parser.add_argument("--seed", type=int, default=0, help="of the first")
    parser.add_argument("--kinds", default=",".join(KINDS), help="kinds, with commas between")
    parser.add_argument("--json", type=Path, help="write what was found to this file")
    parser.add_argument("--one", help="a kind, tried in this process: what the others are started with")
    chosen = parser.parse_args(arguments)
    if chosen.one:
        print(json.dumps(attempt(chosen.one, chosen.count, chosen.seed)))
        return 0
    found, bad = [], 0
    for kind in chosen.kinds.split(","):
        command = [
            sys.executable,
            "-m",
            "tests.search.files",
            "--one",
            kind,
            "--count",
            str(chosen.count),
            "--seed",
            str(chosen.seed),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(nsmodel.__file__).parents[1])
        one = (
            json.loads(done.stdout.splitlines()[-1])
            if done.returncode == 0 and done.stdout
            else {"kind": kind, "counts": {}, "told": []}
        )
        if done.returncode != 0:
            one["told"].append(f"ended with {done.returncode}: {done.stderr[-2000:]}")
        bad += len(one["told"])
        found.append(one)
        print(f"{kind:20} " + ", ".join(f"{number} {word}" for word, number in sorted(one["counts"].items())), flush=True)
        for text in one["told"][:6]:
            print(f"    {text}", flush=True)
    if chosen.json:
        chosen.json.write_text(json.dumps(found, indent=1), encoding="utf-8")
    print(f"{bad} of {chosen.count * len(found)} attempts were wrong, threw or crashed")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
