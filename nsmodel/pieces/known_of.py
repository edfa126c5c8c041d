"""The known times of a model, and what its signals are after each."""

from __future__ import annotations

from functools import partial

import numpy as np

from nsmodel.model.base import Model
from nsmodel.pieces.known import Known
from nsmodel.scheme.driven import data, moving
from nsmodel.signals.drive import as_one
from nsmodel.signals.signal import Signal

AHEAD = 2.0  # Times of the run up to which times of signals are known.


def known_of(model: Model, t_end: float) -> Known:
    """The known times of a model, and of the signals of a run also those beyond its end: pieces go beyond it."""
    if not model.inputs:
        return Known(model.switch_times)
    ahead = AHEAD * t_end
    joints = [signal.joints(ahead) for signal in model.inputs.values() if isinstance(signal, Signal)]
    ticks = [block.ticks(ahead) for block in model.blocks]
    times = as_one(np.concatenate([np.array(model.switch_times, float), *joints, *ticks]))
    moves = any(signal.moving for signal in model.inputs.values())
    return Known(tuple(times.tolist()), partial(data, model), partial(moving, model) if moves else None)
