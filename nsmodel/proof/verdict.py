"""The four verdicts, and an answer to a question with its reason."""

from __future__ import annotations

from typing import Any, NamedTuple

HOLDS, SAMPLED, VIOLATED, UNKNOWN = "holds", "sampled", "violated", "unknown"
VERDICTS = (HOLDS, SAMPLED, VIOLATED, UNKNOWN)  # from proved to undecided


class HypothesisPart(NamedTuple):
    """One part of a hypothesis: verdict, reason, numbers, witness; ``local``: decided on the box looked at alone."""

    verdict: str
    how: str
    value: dict[str, float]
    witness: dict[str, Any]
    local: bool = False
