"""The known times of a model, and what its signals are after each."""

from __future__ import annotations

from functools import partial

import numpy as np

from nsmodel.model.base import Model
from nsmodel.pieces.known import SwitchTimes
from nsmodel.scheme.driven import input_states, next_moving_edge
from nsmodel.signals.drive import merge_near_times
from nsmodel.signals.signal import Signal

AHEAD = 2.0  # Times of the run up to which times of signals are known.


def switch_times_of(model: Model, t_end: float) -> SwitchTimes:
    """The known times of a model, and of the signals of a run also those beyond its end: pieces go beyond it."""
    if not model.inputs:
        return SwitchTimes(model.switch_times)
    ahead = AHEAD * t_end
    joints = [signal.joints(ahead) for signal in model.inputs.values() if isinstance(signal, Signal)]
    ticks = [block.ticks(ahead) for block in model.blocks]
    times = merge_near_times(np.concatenate([np.array(model.switch_times, float), *joints, *ticks]))
    moves = any(signal.moving for signal in model.inputs.values())
    return SwitchTimes(tuple(times.tolist()), partial(input_states, model), partial(next_moving_edge, model) if moves else None)
