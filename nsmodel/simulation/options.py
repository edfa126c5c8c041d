"""What a run is asked for, checked; `simulate` says what each option means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsmodel._utils import DEFAULT_TOLERANCE
from nsmodel.errors import UsageError
from nsmodel.modeling.inputs import Signals
from nsmodel.modeling.parameters import Values
from nsmodel.modeling.time_grid import check_tolerance, format_value, is_number

CERTIFY_CHOICES = ("estimate", "interval")
METHODS = ("auto", "event-driven", "time-stepping")


@dataclass(frozen=True)
class Options:
    """The options of `simulate`, but its progress bar.

    Raises:
        UsageError: a value that no model could be run with.
    """

    step: float | None = None
    steps: Sequence[float] | None = None
    t_end: float | None = None
    parameters: Values | None = None
    solver: str = "auto"
    tolerance: float = DEFAULT_TOLERANCE
    save_every: int = 1
    out: str | Path | None = None
    resume: bool = False
    compiled: bool | str = "auto"
    rtol: float | None = None
    atol: Any = None
    method: str = "auto"
    times: Any = None
    certify: str = "estimate"
    inputs: Signals | None = None

    def __post_init__(self) -> None:
        """Refuse what does not depend on the model; numbers become a float and an int."""
        check_tolerance(self.tolerance)
        if not (isinstance(self.compiled, bool) or (isinstance(self.compiled, str) and self.compiled == "auto")):
            raise UsageError(f"compiled = {self.compiled!r}; expected True, False or 'auto'")
        if self.compiled is True and self.solver != "auto":
            raise UsageError(
                f"solver '{self.solver}' and compiled=True are both given: compiled steps bring their own solvers; keep one"
            )
        if not (is_number(self.save_every) and self.save_every >= 1 and float(self.save_every).is_integer()):
            raise UsageError(f"save_every = {format_value(self.save_every)}; expected a whole number >= 1")
        if self.method not in METHODS:
            raise UsageError(f"method = {self.method!r}; expected one of {', '.join(METHODS)}")
        if self.method == METHODS[1] and self.rtol is None:
            raise UsageError(f"method '{self.method}' needs rtol (--rtol), the error that is allowed")
        if self.times is not None and (self.rtol is None or self.method == METHODS[2]):
            raise UsageError("times are rows of an event-driven run: give rtol, and leave method out; else take step or steps")
        if self.certify not in CERTIFY_CHOICES:
            raise UsageError(f"certify = {self.certify!r}; expected one of {', '.join(CERTIFY_CHOICES)}")
        if self.certified and (self.rtol is None or self.method == METHODS[2]):
            raise UsageError(
                "certify='interval' (--certify interval) proves the pieces of an event-driven run, and time steps have none: "
                "give rtol, and leave method out; of steps, run.residual is verified"
            )
        if self.certified and self.resume:
            raise UsageError("certify='interval' and resume are both given: whole runs are proved; leave one of them out")
        if self.out is not None and not str(self.out).strip():
            raise UsageError("out is empty; give the name of a folder, or leave it out")
        if self.resume and self.out is None:
            raise UsageError("resume needs out=, the folder of the run to continue")
        object.__setattr__(self, "tolerance", float(self.tolerance))
        object.__setattr__(self, "save_every", int(self.save_every))

    @property
    def certified(self) -> bool:
        """Whether pieces are to be proved."""
        return self.certify == CERTIFY_CHOICES[1]

    @property
    def folder(self) -> Path | None:
        """Where the run is kept."""
        return None if self.out is None else Path(self.out)
