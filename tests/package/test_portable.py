"""What other systems lack: simulated here by taking it away; what Windows and macOS really do is seen there alone."""

from __future__ import annotations

import ast
import errno
import functools
import multiprocessing
import os
import re
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import platformdirs
import pytest
from conftest import REPOSITORY

from nsmodel import LureSystem, StorageError, relay, simulate, sweep
from nsmodel.cli import common
from nsmodel.codegen import library
from nsmodel.codegen import library as cache
from nsmodel.files import storage
from nsmodel.files.archive import map_archive, write_npz
from nsmodel.files.cache_folder import cache_folder
from nsmodel.modeling.model_files import case_files
from nsmodel.simulation import run_folder
from nsmodel.sweep import executor

posix = pytest.importorskip("fcntl")


@functools.cache
def sources():
    """The text of the package's files and of the cases, by their paths."""
    paths = [*(REPOSITORY / "nsmodel").rglob("*.py"), *case_files().values()]
    return {path.relative_to(REPOSITORY).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def model(**other):
    return LureSystem(**({"A": [[-1]], "B": 1, "C": 1, "law": relay(1), "x0": 1, "t_end": 1, "step": 0.1} | other))


# ---------------------------------------------------------------------------------------------- what the source says


def names_no_encoding(call):
    """Whether a call reads or writes text in an encoding that the system chooses."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    given = {keyword.arg for keyword in call.keywords}
    if name == "open":
        owner = getattr(getattr(call.func, "value", None), "id", "")
        modes = [arg.value for arg in call.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)]
        opened = owner in ("os", "Image", "archive", "ChunkStore", "webbrowser")  # which have an open of their own
        other = opened or any("b" in mode and len(mode) < 5 for mode in modes)
        return not (other or "encoding" in given or any(isinstance(arg, ast.IfExp) for arg in call.args))
    return (name == "read_text" or (name == "write_text" and isinstance(call.func, ast.Attribute))) and "encoding" not in given


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("path.open()", True), ("open(path, 'w')", True), ("path.read_text()", True), ("path.write_text(x)", True),
        ("path.open('rb')", False), ("open(path, encoding='utf-8')", False), ("write_text(path, x)", False),
        ("os.open(path, 0)", False),
    ],
)  # fmt: skip
def test_the_search_for_encodings_finds_them(text, found):
    assert names_no_encoding(ast.parse(text).body[0].value) is found


def test_text_has_an_encoding_that_is_named():
    found = []
    for path, text in sources().items():
        if re.search(r"open\(|(read|write)_text\(", text):
            calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
            found += [(path, ast.unparse(call)) for call in calls if names_no_encoding(call)]
    assert found == []


ELSEWHERE = {  # What Windows lacks and is used all the same: where it is asked for first, or its lack is met.
    "geteuid": {"nsmodel/codegen/library.py"}, "killpg": {"nsmodel/codegen/library.py"},
    "SIGKILL": {"nsmodel/codegen/library.py"}, "setpgrp": {"nsmodel/sweep/executor.py"},
    "sched_getaffinity": {"nsmodel/sweep/executor.py"}, "flock": {"nsmodel/simulation/run_folder.py"},
    "register_at_fork": {"nsmodel/simulation/run_folder.py"},
}  # fmt: skip
NOWHERE = "fork getpgid pread pwrite setsid symlink symlink_to hardlink_to mkfifo rename SIGALRM O_NOFOLLOW getloadavg".split()


def test_what_other_systems_lack_is_used_in_one_place_each():
    used = {}
    for path, text in sources().items():
        for name in re.findall(rf"\.({'|'.join([*ELSEWHERE, *NOWHERE])})\b", text):
            used.setdefault(name, set()).add(path)
    assert used == ELSEWHERE


def test_a_system_without_them_runs_models(tmp_path):
    """Interpreted and in C, saved and resumed."""
    code = """
        import os, signal, sys
        sys.modules["fcntl"] = None
        for owner, names in ((os, "fork forkpty geteuid getpgid killpg pread pwrite setpgrp setsid sched_getaffinity symlink "
                              "link mkfifo register_at_fork"), (signal, "SIGKILL SIGALRM SIGHUP")):
            for name in names.split():
                delattr(owner, name)
        import nsmodel
        from nsmodel.codegen import library as cache, library
        cache.COMPILER_FLAGS = tuple(flag for flag in library.COMPILER_FLAGS if flag != "-O2")
        def model(t_end):
            return nsmodel.LureSystem(A=[[-1]], B=1, C=1, law=nsmodel.relay(1), x0=1, t_end=t_end, step=0.1)
        nsmodel.simulate(model(1), out="run", compiled=False)
        print(len(nsmodel.simulate(model(2), out="run", resume=True, compiled=False)))
        print(nsmodel.simulate(model(1), compiled=True if library.compiler() else False).status, sorted(os.listdir("run")))
    """
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", "if True:" + code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    assert done.stdout == "20\ndone ['manifest.json', 'trajectory.npz']\n"


# ---------------------------------------------------------------------------------------------- files


class Msvcrt:
    """Locks of one byte as Windows has them, made of those that are here; the byte must lie where nobody reads."""

    LK_NBLCK = 2

    @staticmethod
    def locking(descriptor, how, count):
        assert (how, count) == (2, 1)
        assert os.lseek(descriptor, 0, os.SEEK_CUR) > 4096
        try:
            posix.flock(descriptor, posix.LOCK_EX | posix.LOCK_NB)
        except BlockingIOError:
            raise PermissionError(errno.EACCES, "Permission denied") from None


@pytest.fixture
def windows(monkeypatch):
    """Locks as Windows has them, and no file that is open is removed."""
    monkeypatch.setattr(run_folder, "fcntl", None)
    monkeypatch.setattr(run_folder, "msvcrt", Msvcrt)
    unlink = Path.unlink

    def refusing(path, missing_ok=False):
        held = {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")}
        if str(path) in held:
            raise PermissionError(errno.EACCES, "in use")
        unlink(path, missing_ok)

    if Path("/proc/self/fd").exists():
        monkeypatch.setattr(Path, "unlink", refusing)


def test_a_folder_is_held_by_one_on_windows(windows, tmp_path):
    raised = []

    def hold():
        try:
            with run_folder.hold_folder(tmp_path):
                pass
        except StorageError as error:
            raised.append(str(error))

    with run_folder.hold_folder(tmp_path):
        thread = threading.Thread(target=hold)
        thread.start()
        thread.join()
    assert len(raised) == 1
    assert f"in use by another run, process {os.getpid()} on " in raised[0]
    assert "as far as can be told" not in raised[0]
    assert not list(tmp_path.iterdir())
    hold()
    assert len(raised) == 1


def test_what_a_killed_run_left_is_taken_over_on_windows(windows, tmp_path):
    (tmp_path / run_folder.LOCK_FILE).write_text('{"host": "' + run_folder._own_identity()["host"] + '", "pid": 1, "boot": ""}')
    assert simulate(model(), out=tmp_path).status == "done"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["manifest.json", "trajectory.npz"]


def test_a_file_that_is_being_read_is_replaced_when_it_is_free(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    replace, tries = Path.replace, []

    def busy(path, target):
        tries.append(target)
        if len(tries) < 3:
            raise PermissionError(errno.EACCES, "in use")
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", busy)
    storage.write_text(tmp_path / "a.txt", "new")
    assert (tmp_path / "a.txt").read_text() == "new\n"
    assert len(tries) == 3
    monkeypatch.setattr(Path, "replace", lambda path, target: (_ for _ in ()).throw(PermissionError(errno.EACCES, "in use")))
    monkeypatch.setattr(storage, "MAX_RENAME_TRIES", 2)
    with pytest.raises(StorageError, match=r"cannot write .*b\.txt: .*in use; take a folder that is writable"):
        storage.write_text(tmp_path / "b.txt", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_arrays_are_read_where_a_mapped_file_could_not_be_replaced(tmp_path, monkeypatch):
    write_npz(tmp_path / "a.npz", {"x": np.arange(3.0)}, {"k": 1})
    assert isinstance(map_archive(tmp_path / "a.npz")[1]["x"], np.memmap)
    monkeypatch.setattr(sys, "platform", "win32")
    archive, arrays = map_archive(tmp_path / "a.npz")
    assert not isinstance(arrays["x"], np.memmap)
    assert arrays["x"].tolist() == [0, 1, 2]
    assert archive.metadata["k"] == 1


def test_a_reader_that_has_gone_is_no_fault_on_windows_either(monkeypatch, capsys):
    gone, null = OSError(errno.EINVAL, "Invalid argument"), os.open(os.devnull, os.O_WRONLY)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", SimpleNamespace(fileno=lambda: null))
        assert common.close_stdout(gone) == 5
        patch.setattr(sys, "platform", "win32")
        assert common.close_stdout(gone) == 0
    os.close(null)
    assert capsys.readouterr().err.count("cannot write the output") == 1


# ---------------------------------------------------------------------------------------------- compiled steps


@pytest.mark.parametrize("named", ["", "relative/is/ignored", None])
def test_compiled_steps_are_kept_where_they_were(tmp_path, monkeypatch, named):
    if not sys.platform.startswith("linux"):
        pytest.skip("another place")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    if named is not None:
        monkeypatch.setenv("XDG_CACHE_HOME", named)
    assert cache_folder() == tmp_path / ".cache" / "nsmodel"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "x"))
    assert cache_folder() == tmp_path / "x" / "nsmodel"


def test_compiled_steps_are_kept_where_other_systems_have_a_place(tmp_path, monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(platformdirs, "user_cache_path", lambda name, appauthor: tmp_path / f"{name}-{appauthor}")
    assert cache_folder() == tmp_path / "nsmodel-False"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "x"))
    assert cache_folder() == tmp_path / "x" / "nsmodel"


@pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
def test_a_library_that_another_process_has_loaded_is_taken_as_it_is(tmp_path, monkeypatch):
    """Two build the same; where a loaded file cannot be replaced, the second takes the first's."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    replace, kept = Path.replace, []

    def build():
        kept.append(
            cache.cached_library(
                cache.library_key(["x"]), lambda: {"one.c": "int number(void) { return 7; }\n"}, library.COMPILER_FLAGS
            )
        )

    def second(path, target):
        if target.parent == tmp_path / "nsmodel":
            if not meanwhile.exists():
                raise PermissionError(errno.EACCES, "no right")
            raise PermissionError(errno.EACCES, "loaded")
        return replace(path, target)

    build()
    meanwhile = kept[0]
    content = meanwhile.read_bytes()
    hidden = meanwhile.rename(tmp_path / "hidden")
    monkeypatch.setattr(Path, "replace", second)
    with pytest.raises(library.CodegenError, match=r"cannot be used .*no right"):
        build()
    own_name = cache._library_name
    monkeypatch.setattr(cache, "_library_name", lambda key, path: (meanwhile.write_bytes(content), own_name(key, path))[1])
    build()
    assert kept == [meanwhile, meanwhile]
    assert library.MappedLibrary(meanwhile)["number"]() == 7
    assert hidden.exists()


def test_libraries_of_users_without_numbers_are_their_own(tmp_path, monkeypatch):
    (tmp_path / "a.so").write_bytes(b"")
    (tmp_path / "a.so").chmod(0o666)
    assert not cache._is_private_file(tmp_path / "a.so")
    monkeypatch.delattr(os, "geteuid")
    assert cache._is_private_file(tmp_path / "a.so")


# ---------------------------------------------------------------------------------------------- sweeps


def test_a_sweep_in_processes_that_begin_anew_is_the_same(monkeypatch):
    """The models are long enough for processes, and nothing is compiled."""
    grid = {"x": np.linspace(0.5, 2, 4)}
    asked = dict(start=grid, outputs={"end": "x[-1]"}, compiled=False)
    one = sweep(model(names=["x"], t_end=2), workers=1, **asked)
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["spawn"])
    many = sweep(model(names=["x"], t_end=2), workers=2, **asked)
    np.testing.assert_array_equal(one["end"].values, many["end"].values)
    assert (one.failures, many.failures) == ([], [])


def test_where_workers_are_copies(monkeypatch):
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["fork", "spawn"])
    monkeypatch.setattr(sys, "platform", "linux")
    assert executor.can_fork()
    monkeypatch.setattr(sys, "platform", "darwin")
    assert not executor.can_fork()
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: ["spawn"])
    assert not executor.can_fork()
