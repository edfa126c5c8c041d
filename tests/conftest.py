"""Where case files and reference data are, and runs that several tests look at."""

from __future__ import annotations

import functools
import os
import pickle
import shutil
import signal
import sys
import zlib
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from fuzz_models import COUNT, FULL
from quick_compiler import quick_compiler
from subjects import files_to_edit

import nsmodel
from nsmodel.codegen import event_driven_runs, library
from nsmodel.codegen import library as cache
from nsmodel.modeling.model_files import case_files

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED = REPOSITORY / ".." / "shared"
QUICK = tuple("-O0" if flag == "-O2" else flag for flag in library.COMPILER_FLAGS)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # Workers inherit it: their threads would wait for each other's cores.
CASES = [*case_files().values()]


KINDS = {  # Marks of test files, by what their names begin with; what is in none of them is fast.
    "c": ("test_codegen", "test_compiled", "test_bodies_in_c", "test_batch", "test_lanes", "test_prepared"),
    "fuzz": ("test_fuzz", "test_codegen_fuzz"),
    "slow": (
        "test_adaptive", "test_agreement", "test_block", "test_bounded", "test_bridges", "test_cases", "test_certif",
        "test_check", "test_cli", "test_closed", "test_converters", "test_convex", "test_coulomb", "test_crowd",
        "test_docs", "test_events", "test_exact_roots", "test_exact_scenes", "test_exponentials", "test_extreme",
        "test_files", "test_forced", "test_further", "test_halving", "test_infinite", "test_input", "test_jumps",
        "test_kinds", "test_late", "test_laws", "test_lure_offset", "test_makefile", "test_many", "test_mechanical",
        "test_moving", "test_notebooks", "test_one_variable", "test_orders", "test_outputs", "test_package",
        "test_parameters", "test_parametric", "test_piece_batch", "test_pieces_in_c", "test_plot", "test_portable",
        "test_random_derivatives", "test_recipes", "test_repeated", "test_resume", "test_rich", "test_roots",
        "test_rounding", "test_runs_keep", "test_schemes", "test_search", "test_sensitivity", "test_site",
        "test_small", "test_solvers", "test_sparse", "test_statistics", "test_stepping", "test_stress",
        "test_stretches", "test_study", "test_sum_of_squares", "test_sums", "test_sweep", "test_switch_times",
        "test_view",
    ),
}  # fmt: skip


THIRDS = {  # Which thirds of the cases these files take where few random models are tried: steps, C and hypotheses see all three.
    "test_compiled_runs": "02", "test_codegen_cases": "1", "test_schemes": "2", "test_rich": "1", "test_pickle": "2",
    "test_check_cases": "0", "test_check_golden": "12", "test_check_report": "0",
}  # fmt: skip
LEFT_OUT = pytest.StashKey[int]()


def kinds_of(path):
    """The marks of a test file; none: it is fast."""
    return [kind for kind, starts in KINDS.items() if path.name.startswith(starts)]


def pytest_ignore_collect(collection_path, config):
    """Files that are not fast are not even read where fast tests are asked for; nor on Windows those that send signals."""
    signals = sys.platform == "win32" and collection_path.stem in ("test_lock", "test_lost")  # which end a process there
    return signals or (config.option.markexpr == "fast" and bool(kinds_of(collection_path))) or None


def in_other_third(item):
    """The test is of a case that its file leaves to `make test-long`."""
    case = item.callspec.params.get("case_file") if hasattr(item, "callspec") else None
    return case is not None and str(CASES.index(case) % 3) not in THIRDS.get(item.path.stem, "012")


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(config, items):
    """Mark each test by its file; those of tests/search/ are for the night.

    Where few random models are tried, long tests are left out, some files take a third of the cases, and of the parameters of
    other tests that are not fast one is taken. All pages are.
    """
    many, left = defaultdict(list), set()
    for item in items:
        kinds = kinds_of(item.path)
        for kind in ["nightly"] if item.path.parent.name == "search" else kinds or ["fast"]:
            item.add_marker(kind)
        if COUNT < FULL and (item.get_closest_marker("long") or in_other_third(item)):
            left.add(item)
        elif COUNT < FULL and kinds and not {"case_file", "block"} & set(getattr(item, "fixturenames", ())):
            many[item.nodeid.partition("[")[0]].append(item)
    for name, ones in many.items():
        ones.pop(zlib.crc32(name.encode()) % len(ones))  # Another one in each test, the same every time.
        left |= set(ones)
    if left:
        config.hook.pytest_deselected(items=list(left))
        items[:] = [item for item in items if item not in left]
    config.stash[LEFT_OUT] = len(left)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """The report of a failed test names the files to edit."""
    report = yield
    if report.failed and call.excinfo is not None and hasattr(item, "function"):
        function = getattr(getattr(item.function, "hypothesis", None), "inner_test", item.function)
        frames = [(Path(frame.path), frame.lineno + 1, frame.name) for frame in call.excinfo.traceback]
        found = files_to_edit(function, getattr(getattr(item, "callspec", None), "params", {}), frames)
        report.sections.append(("Files to edit", "\n".join(found)))
    return report


def pytest_sessionfinish(session):
    """A worker says how many tests it has left out: all of them the same."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left out"] = session.config.stash.get(LEFT_OUT, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    """Take up what a worker has said."""
    node.config.stash[LEFT_OUT] = getattr(node, "workeroutput", {}).get("left out", 0)


def pytest_terminal_summary(terminalreporter, config):
    """Say, before the closing line, what was left out, and how it is run."""
    if left := config.stash.get(LEFT_OUT, 0):
        tests = f"{left} tests (long ones; further cases, parameters and ways of others)"
        models = f"{FULL - COUNT} of {FULL} random models of each class"
        terminalreporter.write_line(f"left out: {tests}, {models}; `make test-long` runs them all")


def pytest_generate_tests(metafunc):
    """A test with the argument ``case_file`` runs for every case file; those of a file for one case run one after the other.

    Then one process makes what they share of it, its run and its report, and another need not make it again.
    """
    if "case_file" in metafunc.fixturenames:
        metafunc.parametrize("case_file", CASES, ids=[path.stem for path in CASES], scope="module")


@pytest.fixture(scope="module")
def own_cache(tmp_path_factory):
    """Build compiled steps without optimisation, and keep them in a folder of one module's tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(cache, "COMPILER_FLAGS", QUICK)
        patch.setattr(cache, "LANES_FLAGS", QUICK)
        yield


@pytest.fixture(scope="session", autouse=True)
def nothing_built_before():
    """What other tests, or the user, have built decides nowhere whether a run is compiled."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "has_cached_library", lambda key: False)
        yield


@pytest.fixture(scope="session", autouse=True)
def quickly_built(tmp_path_factory):
    """Where few random models are tried, what is compiled here is built in a thirtieth of the time, and computes the same."""
    with pytest.MonkeyPatch.context() as patch:
        if COUNT < FULL:
            if "CC" not in os.environ and library.compiler() and (program := quick_compiler(tmp_path_factory.mktemp("compiler"))):
                patch.setenv("CC", str(program))
            patch.setattr(cache, "COMPILER_FLAGS", QUICK)
            patch.setattr(cache, "LANES_FLAGS", QUICK)
            patch.setattr(event_driven_runs, "PIECE_FLAGS", QUICK)
            patch.setattr(library.compile_library, "__defaults__", (QUICK,))
        yield


@pytest.fixture
def system_compiler(monkeypatch):
    """What is compiled is built by the compiler that a user has."""
    monkeypatch.delenv("CC", raising=False)


def optimised(level: str) -> str:
    """A compiler's flag where tests do not ask what it does: where few random models are tried, the one that costs a third."""
    return "-O0" if COUNT < FULL else level


@pytest.fixture(scope="session")
def quick_programs(tmp_path_factory):
    """Variables for programs that compile C: where few random models are tried, without optimisation, as here."""
    if COUNT == FULL:
        return {}
    folder = tmp_path_factory.mktemp("compilers")
    for name in ("cc", "gcc", "clang", "g++", "clang++", "c++"):
        if path := shutil.which(name):
            (folder / name).write_text(f'#!/bin/sh\nexec {path} "$@" -O0\n')
            (folder / name).chmod(0o755)
    return {"PATH": os.pathsep.join([str(folder), os.environ["PATH"]])}


@pytest.fixture(scope="session")
def load_case():
    """Return load_case(stem, **parameters) -> Model."""
    known = functools.cache(nsmodel.load)  # Models do not change, and what is computed of one is kept with it.
    return lambda stem, **parameters: nsmodel.load(stem, **parameters) if parameters else known(stem)


@pytest.fixture(scope="session")
def cases_of(load_case):
    """Return cases_of(class) -> {stem: Model} of all case files of one model class."""
    models = {path.stem: load_case(path.stem) for path in CASES}
    return lambda kind: {stem: model for stem, model in models.items() if type(model) is kind}


@pytest.fixture(scope="session")
def run_case(load_case, tmp_path_factory):
    """Return run_case(stem) -> Trajectory of the case file as it stands, shared: do not change its arrays.

    It is interpreted; crowds run in C where there is a compiler, which takes less time. Of several processes that run tests the
    first one makes it.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "runs of cases"
    folder.mkdir(exist_ok=True)

    @functools.cache
    def run(stem):
        kept = folder / stem
        if not kept.exists():
            model = load_case(stem)
            made = nsmodel.simulate(model, compiled=isinstance(model, nsmodel.ManyBodies) and library.compiler() is not None)
            part = folder / f"{stem}-{os.getpid()}"
            part.write_bytes(pickle.dumps(made))
            part.replace(kept)
            return made
        return pickle.loads(kept.read_bytes())

    return run


@pytest.fixture(scope="session")
def quick_check(load_case):
    """Return quick_check(stem) -> Report of the quick check of the case file, shared."""
    from search.boxes import BOUNDS  # which loads what fast tests do without

    return functools.cache(lambda stem: nsmodel.check(load_case(stem), bounds=BOUNDS.get(stem), quick=True))


@pytest.fixture(scope="session")
def reference():
    """Return reference(name) -> array of a Siconos reference file, time first; the test is skipped where it is absent."""

    @functools.cache
    def read(name):
        path = SHARED / "data" / "siconos" / f"{name}.ref"
        if not path.is_file():
            pytest.skip(f"no reference data: {path}")
        with path.open() as file:
            shape = tuple(map(int, file.readline().split()))
            table = np.loadtxt(file)
        assert table.shape == shape
        return table

    return read


@pytest.fixture(autouse=True)
def own_interrupts():
    """A command that was interrupted ignores Ctrl-C from then on, as does what a script starts in the background: no test may."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, signal.default_int_handler)
