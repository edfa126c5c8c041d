"""Event-driven runs that go on: to a later end, after being killed at any piece, in chunks; byte for byte as in one go."""

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
from fuzz_models import COUNT, FULL

import nsmodel
from nsmodel import RunInterrupted, StorageError, UsageError, simulate
from nsmodel.codegen.event_driven_runs import CompiledPieceIntegrator
from nsmodel.modeling.model_files import case_files
from nsmodel.simulation import loop, piece_sources

NAMES = ("diode_bridge", "inclusion_8_1", "relay_oscillator", "friction_oscillator", "two_discs", "gene_network")
KILLED = """
import os, sys
import nsmodel
from nsmodel.simulation import loop
from nsmodel.simulation.piece_sources import CompiledPieces, InterpretedPieces

loop.CHUNK_SECONDS = 0.0
case, out, pieces, compiled, more, *times = sys.argv[1:]
maker = CompiledPieces if compiled == "True" else InterpretedPieces
whole, left = maker.make_pieces, [int(pieces)]

def make(self, until, room):
    if not left[0]:
        os._exit(9)
    left[0] -= 1
    return whole(self, until, 0)

maker.make_pieces = make
model = nsmodel.load(case)
rows = {"times": [float(t) for t in times]} if times else {}
how = {"method": "event-driven", "compiled": compiled == "True"}
nsmodel.simulate(model, rtol=1e-8, out=out, resume=more == "more", **how, **rows)
"""


def files(folder):
    return (folder / "trajectory.npz").read_bytes()


def run(model, out, compiled=False, **more):
    return simulate(model, rtol=1e-8, method="event-driven", out=out, compiled=compiled, **more)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("every", [1, 3])
def test_a_later_end_gives_the_bytes_of_one_run(name, every, tmp_path):
    model, rng = nsmodel.load(name), np.random.default_rng(len(name) + every)
    run(model, tmp_path / "one", save_every=every)
    ends = np.sort(rng.uniform(0.02, 0.98, 3)) * model.t_end
    for i, end in enumerate([ends[0], *ends, None]):
        run(model, tmp_path / "parts", save_every=every, t_end=end, resume=i > 0)
    assert files(tmp_path / "one") == files(tmp_path / "parts")


@pytest.mark.parametrize(
    ("name", "asked", "compiled"),
    [
        (name, asked, compiled)
        for name, asked, compiled in itertools.product(["diode_bridge", "relay_oscillator"], [False, True], [False, True])
        if COUNT == FULL or (asked == compiled) == (name == "diode_bridge")  # All pairs of them.
    ],
)
def test_killed_at_any_piece_it_goes_on_to_the_same_bytes(name, asked, compiled, tmp_path, quick_programs):
    case = case_files()[name]
    model = nsmodel.load(case)
    times = np.linspace(0, model.t_end, 12)[1:].tolist() if asked else None
    whole = run(model, tmp_path / "one", compiled, times=times)
    pieces, more = whole.metadata["totals"]["pieces"], ["new"]
    for part in (pieces // 3 + 1, 1, pieces // 4):
        asks = [str(case), str(tmp_path / "parts"), str(part), str(compiled), *more, *map(repr, times or ())]
        killed = [sys.executable, "-c", KILLED, *asks]
        assert subprocess.run(killed, check=False, capture_output=True, env=os.environ | quick_programs).returncode == 9
        more = ["more"]
    run(model, tmp_path / "parts", compiled, times=times, resume=True)
    assert files(tmp_path / "one") == files(tmp_path / "parts")


def test_chunks_are_those_of_one_run(tmp_path, monkeypatch):
    model = nsmodel.load("relay_oscillator")
    whole = run(model, tmp_path / "one")
    monkeypatch.setattr(loop, "CHUNK_SECONDS", 0.0)
    parts = run(model, tmp_path / "parts")
    assert files(tmp_path / "one") == files(tmp_path / "parts")
    at = np.linspace(0, model.t_end, 101)
    np.testing.assert_array_equal(whole.at(at).x, parts.at(at).x)


def test_what_does_not_fit_is_refused(tmp_path):
    model = nsmodel.load("diode_bridge")
    run(model, tmp_path, times=[1e-3, 2e-3], t_end=2e-3)
    with pytest.raises(StorageError, match=r"times: the run there has a row at t = 0.00"):
        run(model, tmp_path, times=[1.5e-3, 2e-3, 3e-3], t_end=3e-3, resume=True)
    with pytest.raises(StorageError, match=r"another rtol \(1e-08 there, 1e-06 now\)"):
        simulate(model, rtol=1e-6, method="event-driven", out=tmp_path, resume=True, compiled=False)
    with pytest.raises(StorageError, match=r"past this run's end; give a later end"):
        run(model, tmp_path, times=[1e-4], t_end=1e-4, resume=True)
    with pytest.raises(UsageError, match="resume needs out="):
        simulate(model, rtol=1e-6, resume=True)


@pytest.mark.parametrize("name", NAMES)
def test_residuals_are_rounding_in_every_row(name):
    assert np.nanmax(run(nsmodel.load(name), None).residual) <= 1e-12


@pytest.mark.parametrize("flushed", [False, True])
def test_a_signal_between_pieces_and_their_rows_leaves_no_gap(flushed, tmp_path, monkeypatch):
    """Pieces that C has made, and nobody has taken: what is written goes on from before them, or not at all."""
    model = nsmodel.load("relay_oscillator")
    given = {"rtol": 1e-6, "method": "event-driven", "compiled": True}
    simulate(model, out=tmp_path / "whole", **given)
    usual, calls = CompiledPieceIntegrator.advance, []

    def interrupted(self, *args):
        calls.append(usual(self, *args))
        if len(calls) == 4:
            raise KeyboardInterrupt
        return calls[-1]

    monkeypatch.setattr(piece_sources, "PIECES_PER_REQUEST", 1)
    monkeypatch.setattr(loop, "CHUNK_SECONDS", 0.0 if flushed else 1e9)
    monkeypatch.setattr(CompiledPieceIntegrator, "advance", interrupted)
    with pytest.raises(RunInterrupted) as stopped:
        simulate(model, out=tmp_path / "part", **given)
    monkeypatch.setattr(CompiledPieceIntegrator, "advance", usual)
    assert 0 < stopped.value.trajectory.t[-1] < 100
    if flushed:
        simulate(model, out=tmp_path / "part", resume=True, **given)
        assert files(tmp_path / "part") == files(tmp_path / "whole")
        return
    kept = nsmodel.Trajectory.load(tmp_path / "part" / "trajectory.npz")
    np.testing.assert_array_equal(kept.x, stopped.value.trajectory.x)
    with pytest.raises(StorageError, match="nothing to resume"):
        simulate(model, out=tmp_path / "part", resume=True, **given)
