"""Long runs: constant memory, no drift, and nothing saved is lost when they are killed."""

from __future__ import annotations

import json
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from conftest import QUICK
from fuzz_models import share
from processes import environment, kill_when_there, start

from nsmodel import FrictionOscillator, SweepingProcess, Trajectory, simulate
from nsmodel.cli import main
from nsmodel.codegen import library
from nsmodel.codegen import library as cache
from nsmodel.simulation.run_folder import ChunkStore

T, Q2, S = ca.SX.sym("t"), ca.SX.sym("q", 2), ca.SX.sym("s")


def swinging_wall():
    """A point pressed on a wall that never moves back faster than it follows: q = (sin t, t)."""
    return SweepingProcess(t=T, q=Q2, f=[-1, 1], constraints={"wall": Q2[0] - ca.sin(T)}, q0=[0, 0], t_end=1, step=1e-2)


def test_a_long_run_keeps_few_rows_and_does_not_drift():
    """100 000 steps along a wall that swings: every 1000th row is kept, and each is exact, as are contact and release."""
    run = simulate(swinging_wall(), t_end=1000, step=1e-2, save_every=1000)
    assert len(run.t) == 101
    assert run.gap.min() >= -1e-13
    np.testing.assert_allclose(run.x[:, 0], np.sin(run.t), atol=1e-13)
    np.testing.assert_allclose(run.x[:, 1], run.t, rtol=1e-11)


LONG = """
import json, resource
import numpy as np
from tests.simulation.test_extreme_long import swinging_wall
from nsmodel import simulate
for steps in (1e5, 1e7):
    run = simulate(swinging_wall(), t_end=steps * 1e-3, step=1e-3, save_every=10_000, compiled=True)
    print(json.dumps({
        "rows": len(run.t), "steps": run.metadata["steps"], "used": run.metadata["used"][-1],
        "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, "gap": run.gap.min(),
        "x": np.abs(run.x[:, 0] - np.sin(run.t)).max(), "y": np.abs(run.x[1:, 1] / run.t[1:] - 1).max(),
    }))
"""


@pytest.mark.long
@pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
def test_ten_million_steps_take_no_more_memory_than_a_hundred_thousand(tmp_path):
    """In a process of its own: no drift of the contact, nor of the free direction beyond the rounding of a sum of 10^7 steps."""
    done = subprocess.run(
        [sys.executable, "-c", LONG], env=environment(XDG_CACHE_HOME=str(tmp_path)), capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    short, long = map(json.loads, done.stdout.splitlines())
    assert (long["rows"], long["steps"]) == (1001, 10_000_000)
    assert long["used"].startswith("steps in C")
    assert long["peak"] - short["peak"] < 2e3  # kB
    assert long["gap"] >= -1e-14
    assert long["x"] < 2e-12
    assert long["y"] < 10_000_000 * np.finfo(float).eps


def test_a_resting_oscillator_stays_where_it_is_for_ever():
    model = FrictionOscillator(x=Q2, potential=ca.dot(Q2, Q2), friction=S + S**3, s=S, x0=[2, 1], v0=[0, 0], t_end=10, step=1e-2)
    run = simulate(model)
    still = np.flatnonzero((run.v[1:] == 0).all(axis=1))[0] + 1
    assert still < 900
    assert len(np.unique(run.x[still:], axis=0)) == 1


# ---------------------------------------------------------------------------------------------- killed


SWINGING = """
import casadi as ca
from nsmodel import SweepingProcess
t, q = ca.SX.sym("t"), ca.SX.sym("q", 2)
walls = {"wall": q[0] - ca.sin(t), "disc": ca.norm_2(q - ca.vertcat(-1, 3)) - 1}
model = SweepingProcess(t=t, q=q, f=[-1, ca.cos(t / 7)], constraints=walls, q0=[0, 0], t_end=10, step=1e-2)
"""
COMMAND = """
import sys
import nsmodel.simulation.propagator
from nsmodel.cli import main
from nsmodel.codegen import library as cache
nsmodel.simulation.propagator.CHUNK_BYTES, cache.COMPILER_FLAGS = {bytes}, {flags}
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(name="swinging", scope="module", params=["interpreted", "compiled"])
def make_swinging(request, tmp_path_factory):
    """Return (folder with the model file and the whole run in ``whole``, the options of the command line)."""
    if request.param == "compiled" and library.compiler() is None:
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp(request.param)
    (folder / "swinging.py").write_text(SWINGING)
    way = ["--compiled", "--t-end", "100"] if request.param == "compiled" else ["--t-end", "20"]
    options = ["run", str(folder / "swinging.py"), "--quiet", *way]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        patch.setattr(cache, "COMPILER_FLAGS", QUICK)
        assert main([*options, "--out", str(folder / "whole")]) == 0
        yield folder, options


@pytest.mark.parametrize("seed", range(share(3)))
@pytest.mark.long
def test_kill_9_at_any_moment_leaves_rows_to_read_and_a_run_to_resume(swinging, seed, capfd):
    """Killed within a few ms of some chunk of 64 rows, long before its end."""
    folder, options = swinging
    rng, out = np.random.default_rng(seed), folder / f"killed {seed}"
    code = COMMAND.format(bytes=1, flags=QUICK)
    process = start(code, folder, *options, "--out", str(out))
    kill_when_there(process, out / f"chunk-{rng.integers(2, 13):06d}.npz", rng.uniform(0, 5e-3))
    whole, chunks = Trajectory.load(folder / "whole" / "trajectory.npz"), ChunkStore.open(out).manifest["chunks"]
    saved = [Trajectory.load(out / chunk["file"]) for chunk in chunks]
    assert len(saved) > 0
    for name, array in whole.arrays.items():
        part = np.concatenate([chunk.arrays[name] for chunk in saved])
        np.testing.assert_array_equal(part, array[: len(part)], err_msg=name)
    assert len(part) < len(whole.t)
    assert main([*options, "--out", str(out), "--resume"]) == 0
    assert (out / "trajectory.npz").read_bytes() == (folder / "whole" / "trajectory.npz").read_bytes()
    assert capfd.readouterr() == ("", "")
