"""The folder of compiled steps: who may have written it, how much it holds; what is unloaded; compilers that hang."""

from __future__ import annotations

import gc
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from nsmodel import LureSystem, relay, simulate
from nsmodel.codegen import library, write
from nsmodel.codegen import library as cache
from nsmodel.codegen.library import Library, MappedLibrary, compile_library, loaded_library_paths
from nsmodel.codegen.rollout import Rollout
from nsmodel.errors import CodegenError
from nsmodel.modeling.time_grid import make_grid

IS_KEPT = cache.has_cached_library  # the true one
compiles = pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no owners here")
QUICK = ("-std=c99", "-O0", "-fPIC", "-shared")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "COMPILER_FLAGS", QUICK)
    return tmp_path / "nsmodel"


def model(k=1.0):
    return LureSystem(A=[[-k]], B=[[1]], C=[[1]], law=relay(1), x0=[1.0], t_end=0.1, step=0.01)


def keep(number=0):
    """A library of one function that returns a number, kept."""
    return cache.cached_library(
        cache.library_key([number]), lambda: {"one.c": f"int number(void) {{ return {number}; }}\n"}, QUICK
    )


# ---------------------------------------------------------------------------------------------- whose it is


@compiles
@posix
def test_folder_and_libraries_are_the_users_alone(folder):
    before = os.umask(0o002)
    try:
        path = keep()
    finally:
        os.umask(before)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert path.stat().st_mode & 0o777 == 0o700
    assert keep() == path


def link(folder):
    elsewhere = folder.parent / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    folder.symlink_to(elsewhere)


def open_to_all(folder):
    folder.mkdir()
    folder.chmod(0o777)


def open_above(folder):
    folder.mkdir(mode=0o700)
    folder.parent.chmod(0o777)


@compiles
@posix
@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (link, "is a link, which may lead anywhere; remove it, or name another with XDG_CACHE_HOME"),
        (open_to_all, r"others may write to it \(mode 777\); empty it and chmod 700 .*nsmodel, or name another"),
        (open_above, "others may exchange it, as .* is theirs to write; name another"),
    ],
)
def test_a_folder_that_others_may_have_written_is_not_used(folder, prepare, message):
    prepare(folder)
    with pytest.raises(CodegenError, match=f"cache folder {folder} is not used, .*: .*{message}"):
        keep()
    assert not list(folder.glob("*"))
    run = simulate(model(), compiled=True)  # it runs all the same, and says why it is interpreted
    assert "not compiled, the steps are interpreted: the cache folder" in run.metadata["warnings"][-1]
    assert run.status == "done"


@compiles
@posix
def test_a_folder_of_another_user_is_not_used(folder, monkeypatch):
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    with pytest.raises(
        CodegenError, match=r"belongs to another user \(number \d+, you are \d+\); name another with XDG_CACHE_HOME"
    ):
        keep()


@compiles
@posix
def test_a_library_that_somebody_else_may_have_put_there_is_built_again(folder, tmp_path):
    path = keep(1)
    content = path.read_bytes()
    path.chmod(0o722)
    assert not IS_KEPT(cache.library_key([1]))
    assert keep(1) == path
    assert path.stat().st_mode & 0o022 == 0
    (tmp_path / "planted.so").write_bytes(content)
    path.unlink()
    path.symlink_to(tmp_path / "planted.so")  # even one of the right content
    assert not IS_KEPT(cache.library_key([1]))
    assert keep(1) == path
    assert not path.is_symlink()
    assert (tmp_path / "planted.so").exists()


# ---------------------------------------------------------------------------------------------- how much it holds


@compiles
def test_the_folder_keeps_so_many_libraries_those_used_last(folder, monkeypatch):
    monkeypatch.setattr(cache, "MAX_LIBRARIES", 4)
    paths = [keep(k) for k in range(4)]
    for age, path in enumerate(paths):
        os.utime(path, ns=(0, 10**9 * age))
    loaded = MappedLibrary(paths[1])
    assert keep(0) == paths[0]  # now used last
    paths += [keep(k) for k in (4, 5)]
    assert set(folder.glob("*.so")) == {paths[k] for k in (0, 1, 3, 4, 5)}  # 1 is loaded
    assert loaded["number"]() == 1
    assert all(IS_KEPT(cache.library_key([k])) == paths[k].exists() for k in range(6))


@compiles
def test_what_killed_builds_left_goes_and_what_others_build_stays(folder):
    keep()
    old, fresh = folder / "building-old", folder / "building-fresh"
    for place in (old, fresh):
        place.mkdir()
        (place / "step.c").write_text("half")
    past = time.time() - 3 * library.TIMEOUT
    os.utime(old, (past, past))
    keep(2)
    assert not old.exists()
    assert fresh.exists()


# ---------------------------------------------------------------------------------------------- what is loaded


def mapped(folder):
    """The libraries of a folder that this process has in memory."""
    return {line.split()[-1] for line in Path("/proc/self/maps").read_text().splitlines() if str(folder) in line}


@compiles
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks at /proc")
def test_libraries_that_nobody_uses_are_unloaded(folder):
    for k in range(3):
        run = simulate(model(1.0 + k), compiled=True)
        assert run.status == "done"
    gc.collect()
    assert not mapped(folder)
    assert not {path for path in loaded_library_paths() if folder in path.parents}


@compiles
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks at /proc")
def test_a_library_stays_as_long_as_one_of_its_functions_is_held(folder):
    number = MappedLibrary(keep(7))["number"]
    again = MappedLibrary(keep(7))
    gc.collect()
    assert mapped(folder)
    assert number() == again["number"]() == 7
    del again
    gc.collect()
    assert number() == 7
    del number
    gc.collect()
    assert not mapped(folder)


@compiles
def test_a_step_outlives_the_file_and_the_library_object(folder):
    bound = model().bind(None)
    steps = Rollout(bound, make_grid(bound, None, None, None), 1e-9)
    for path in folder.glob("*.so"):
        path.unlink()
    gc.collect()
    again = Rollout(bound, make_grid(bound, None, None, None), 1e-9)
    assert np.array_equal(steps._memory, again._memory)
    del again
    gc.collect()
    assert loaded_library_paths()


@compiles
def test_garbage_in_a_circle_goes_in_any_order(folder, tmp_path):
    """A solver that is freed after its library is gone must not call it."""
    write(model(), tmp_path / "c", name="one")
    for _ in range(5):
        solver = library.load(tmp_path / "c").solver()
        circle = [solver, solver.library]
        circle.append(circle)
        solver.circle = solver.library.circle = solver.library.mapped.circle = circle
        assert solver.step() == 0
        del solver, circle
        gc.collect()
    assert isinstance(library.load(tmp_path / "c"), Library)


# ---------------------------------------------------------------------------------------------- compilers that hang


@posix
def test_a_compiler_that_hangs_is_stopped_with_all_that_it_started(folder, tmp_path, monkeypatch):
    child = tmp_path / "child"
    hanging = tmp_path / "hanging-cc"
    hanging.write_text(f"#!/bin/sh\nsleep 60 &\necho $! > {child}\nwait\n")
    hanging.chmod(0o755)
    monkeypatch.setenv("CC", f"{hanging} --ever")
    monkeypatch.setattr(library, "TIMEOUT", 0.5)
    (tmp_path / "a.c").write_text("int a;\n")
    start = time.monotonic()
    with pytest.raises(
        CodegenError, match=rf"the compiler did not end within 0.5 s and was stopped: {hanging} --ever -std=c99 .*a.c"
    ):
        compile_library(tmp_path / "a.c", tmp_path / "a.so")
    assert time.monotonic() - start < 30
    pid, end = int(child.read_text()), time.monotonic() + 10
    while alive(pid) and time.monotonic() < end:
        time.sleep(0.01)
    assert not alive(pid)
    assert not (tmp_path / "a.so").exists()


def alive(pid):
    """Whether a process runs; one that has ended and that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
