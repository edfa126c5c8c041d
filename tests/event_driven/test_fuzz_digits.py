"""Random event-driven runs, in Python and in C, beside their solutions in 64 digits; `tests.search.events` tries more of them."""

import pytest
from fuzz_models import COUNT, FULL

from tests.search import events

SEEDS = range(12 if COUNT >= FULL else 1)


@pytest.mark.parametrize("seed", SEEDS)
def test_runs_are_the_solution(seed):
    for name in list(events.CLASSES)[:: 1 if COUNT >= FULL else 3]:
        line = events.row(name, seed, 2.0, (1e-4, 1e-8), (1e-8,) if seed == 5 else ())
        assert not events.wrong(line)
        assert "apart" in line or "refused" in line, line
