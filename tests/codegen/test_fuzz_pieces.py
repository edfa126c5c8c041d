"""Event-driven libraries and runs under random and hostile numbers: they come back, say how, and lose nothing."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import COUNT, FULL
from library_fuzz import COMPILER
from pieces_fuzz import build, commands, run

import nsmodel
from nsmodel.errors import NsmodelError
from nsmodel.modeling.variants import start_entries
from nsmodel.simulation import event_driven
from tests.codegen.test_pieces_in_c import MODELS, STIFF

NAMES = (
    "boost buck_light_load anti_windup bang_bang belt elastoplastic friction_chain full_wave_rectifier leash observer obstacle "
    "repressilator rlc_diode sandpile three_pulse_rectifier toggle_switch total_variation tumbler twisting two_surfaces "
    "voltage_doubler zener_limiter zhuravlev_ivanov"
).split()
SMALLER = {"obstacle": {"n": 7}}
SCENES = MODELS | STIFF | {name: (lambda name=name: nsmodel.load(name, **SMALLER.get(name, {}))) for name in NAMES}
SEEDS = range(20 if COUNT >= FULL else 2)
CALLS = 300
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler")
PIECES = 50  # That a run may have here.
SECONDS = 20  # That a call of a few hundred pieces does not take, whatever the machine.


@needs_compiler
@pytest.mark.parametrize("name", SCENES)
def test_libraries_come_back_and_lose_nothing(name, tmp_path):
    """Under AddressSanitizer and UndefinedBehaviorSanitizer."""
    model = SCENES[name]()
    program, sizes = build(model, tmp_path)
    for seed in SEEDS:
        said = run(program, commands(model, sizes, np.random.default_rng(seed), CALLS), tmp_path)
        assert float(said.split()[-2]) < SECONDS


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("name", SCENES)
def test_runs_come_back_within_their_budget(name, compiled, monkeypatch):
    """Finite rows up to the end, or an error by name; what was computed before it is kept, and finite."""
    monkeypatch.setattr(event_driven, "MAX_RUN_PIECES", PIECES)
    model = SCENES[name]()
    ready = nsmodel.prepare(model, rtol=1e-6, method="event-driven", compiled=compiled, t_end=1e-3 * model.t_end)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        sizes = 10 ** rng.uniform(-300, 300, 64) * rng.choice([-1, 0, 1], 64)
        starts = dict(zip(start_entries(model), sizes, strict=False)) if seed % 2 else None
        end = float(rng.choice([1e-300, 1e-9, 1.0, 1e9, 1e18, 1e300])) * (1 if seed % 3 else model.t_end)
        try:
            found = ready.run(x0=starts, t_end=end)
            assert found.t[-1] == end
        except NsmodelError as error:
            found = getattr(error, "trajectory", None)
        assert found is None or (np.isfinite(found.x).all() and np.isfinite(found.t).all())
