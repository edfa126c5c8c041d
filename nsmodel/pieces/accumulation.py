"""Whether switches accumulate: pieces that become too short, or events whose number grows exponentially in time."""

from __future__ import annotations

import itertools
from typing import Any

TINY_PIECES, TINY = 50, 1e-13  # So many pieces one after the other that are so short: switches accumulate.
MANY, FASTER = 4096, 0.6  # Events from which on they are asked whether they accumulate; see `ZenoDetector.grows`.
SPACINGS = 5  # Between events n and n/2, n/2 and n/4, ... that are compared.


class ZenoDetector:
    """What has been counted: ``events``; times of the events 1, 2, 4, 8, ...; pieces in a row that were too short."""

    def __init__(self) -> None:
        self.events, self._tiny = 0, 0
        self._times: list[float] = []

    def pieces_vanish(self, length: float, t: float, tau: float) -> bool:
        """Whether the piece that an event has ended is the last of many that are next to nothing."""
        self._tiny = self._tiny + 1 if length < TINY * max(abs(t), tau) else 0
        return self._tiny > TINY_PIECES

    def event_rate_grows(self, t: float) -> bool:
        """Whether event n = 2^k comes as fast again as event n/2, to a part, four times over: n grows exponentially in time.

        Of switches at a constant rate the ratio is 1, of a chirp's, n ~ t^2, it is 0.7.
        """
        self.events += 1
        n, times = self.events, self._times
        if n & (n - 1):
            return False
        times.append(t)
        if n < MANY:
            return False
        spacing = [2 * (times[-1 - k] - times[-2 - k]) / (n >> k) for k in range(SPACINGS)]
        return all(late < FASTER * early for late, early in itertools.pairwise(spacing))

    def checkpoint(self) -> dict[str, Any]:
        """What has been counted, as numbers."""
        return {"events": self.events, "times": list(self._times), "tiny": self._tiny}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take up what ``standing`` gave."""
        self.events, self._times, self._tiny = saved["events"], list(saved["times"]), saved["tiny"]
