"""The exceptions of nsmodel, one family: each says what is wrong, where, the value and shape, and the fix."""

from __future__ import annotations

from typing import Any


class NsmodelError(Exception):
    """Base of every error that nsmodel raises on purpose."""


class ModelError(NsmodelError, ValueError):
    """A model was declared wrongly: shapes, undeclared symbols, NaN, lower > upper, a file without a model."""


class UsageError(NsmodelError, ValueError):
    """An argument of a run is wrong: a negative step, an unknown solver, a solver that does not apply."""


class StepError(NsmodelError, RuntimeError):
    """A step could not be verified; the run stopped there.

    Attributes:
        step: index k of the step t_k -> t_{k+1} that failed.
        time: t_{k+1}.
        component: the user's name of the constraint or row with the worst residual, or None.
        residual: the best residual that any solver reached (inf if none gave an answer).
        trajectory: the Trajectory computed before the failure; None until the time loop has attached it.
    """

    def __init__(self, message: str, *, residual: float = float("inf"), component: str | None = None) -> None:
        super().__init__(message)
        self.step: int | None = None
        self.time: float | None = None
        self.component = component
        self.residual = residual
        self.trajectory: Any = None


class UnrecoverableStepError(StepError):
    """What no other way of stepping, and no shorter step, goes beyond."""


class BlockError(UnrecoverableStepError):
    """A block sets what it must not."""


class EmptyLawError(UnrecoverableStepError):
    """The ends of a law that move leave it no value at a time."""


class CodegenError(NsmodelError, RuntimeError):
    """A model has no C step function, or the one written could not be compiled or loaded."""


class StorageError(NsmodelError, OSError):
    """A result file is missing, damaged, or belongs to another model, or cannot be written.

    Attributes:
        trajectory: the Trajectory of the run whose rows could not be written; None where there is none.
    """

    trajectory: Any = None


class NewerFormatError(StorageError):
    """A file of a format that only a later version knows."""


class UnverifiedWarning(UserWarning):
    """A file of an older version has no digests: what it holds is read, not verified."""


class PlotError(NsmodelError, ValueError):
    """A picture was asked for that this run cannot give."""


class MissingExtraError(NsmodelError, ImportError):
    """An optional package is needed and not installed."""


FinalError, LaterFormatError = UnrecoverableStepError, NewerFormatError  # As versions before this one call them.
