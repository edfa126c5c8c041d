"""Derivatives of random models of each class, through switches of all kinds, beside differences of runs."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import COUNT
from derivative_models import KINDS, extrapolated, largest_error, made

from nsmodel import sensitivity

NEAR = 1e-6
NARROW = 2e-6  # A width over which no further switch comes between; its differences err by 1e-4.


@pytest.mark.parametrize("seed", range(max(1, COUNT // 12)))
@pytest.mark.parametrize("kind", KINDS)
def test_they_are_those_of_differences(kind, seed):
    model, by = made(kind, seed)
    found = sensitivity(model, by=by, rtol=1e-11, compiled=False)
    error = largest_error(found, extrapolated(model, by))
    if error > NEAR:  # A switch comes or goes within the width.
        error = NEAR / 1e-4 * largest_error(found, extrapolated(model, by, width=NARROW))
    assert error <= NEAR or found.warnings
    assert np.isfinite(found.jacobian).all()
