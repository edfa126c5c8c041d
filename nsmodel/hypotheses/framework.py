"""What a class of models brings to a check: the functions that decide its hypotheses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from nsmodel.hypotheses.findings import Consequence, Finding, Hypothesis, IntervalBox
from nsmodel.hypotheses.inputs import InputBounds
from nsmodel.hypotheses.region import ParameterValues, Region
from nsmodel.hypotheses.staying import StayTime
from nsmodel.modeling.parts import Part
from nsmodel.simulation.trajectory import Trajectory


class SpeedBound(NamedTuple):
    """Bounds on the box: how fast the state moves, and how far a predictor reaches ahead of it."""

    speed: float
    ahead: float


@dataclass(frozen=True, kw_only=True)
class UniformChecks:
    """What a class proves for all values of parameters in a box.

    Attributes:
        findings: (model, region, quick), those that are proved for all values.
        consequences: (model, region, findings).
        special_values: (model, box), values of the parameters at which the model is special.
    """

    findings: Callable[[Any, Region, bool], list[Finding]]
    consequences: Callable[[Any, Region, Sequence[Finding]], list[Consequence]]
    special_values: Callable[[Any, IntervalBox], list[ParameterValues]] = lambda model, box: []


@dataclass(frozen=True, kw_only=True)
class DrivenChecks:
    """What a class decides of a model whose inputs move.

    Attributes:
        fields: {a part of the model, in a word for people: the fields in which inputs may stand}.
        findings: (model, region, bounds of the inputs, findings for constant inputs, runs, quick); left out: those.
        consequences: (model, region, bounds of the inputs, findings, runs).
        freeze_law: the model in the form in which hypotheses are looked at, where its law moves.
        run_of_frozen_law: (model, run), the run as one of that form.
        parametric_form: (model, region, runs), model and region in the form in which inputs are parameters.
    """

    fields: Mapping[str, Sequence[str]]
    consequences: Callable[[Any, Region, InputBounds, Sequence[Finding], Sequence[Trajectory]], list[Consequence]]
    findings: Callable[[Any, Region, InputBounds, Sequence[Finding], Sequence[Trajectory], bool], list[Finding]] | None = None
    freeze_law: Callable[[Any], Any] | None = None
    run_of_frozen_law: Callable[[Any, Trajectory], Trajectory] | None = None
    parametric_form: Callable[[Any, Region, Sequence[Trajectory]], tuple[Any, Region]] | None = None


class CheckEffort(Protocol):
    """How much a check computes, for a class whose steps are all dear."""

    def most_steps(self, model: Any) -> int:
        """Return how many steps a run that is made for a check has at most."""
        ...

    def is_refined(self, model: Any, steps: int) -> bool:
        """Return whether a run of so many steps is made with the steps 2h and 4h too."""
        ...

    def effort_notes(self, model: Any, runs: Sequence[Trajectory]) -> list[str]:
        """Return what the reader of a report should know of that."""
        ...


@dataclass(frozen=True, kw_only=True)
class HypothesisChecks:
    """The hypotheses of a class of models, and the functions that decide them.

    Attributes:
        hypotheses: in the order of the report.
        decide: (model, region, runs, quick), a finding for each hypothesis, and what follows.
        along_run: (model, run, findings by id, second run, quick), the inequalities that the class promises along a run.
        uniform: proofs for all values of parameters in a box.
        driven: what is decided where inputs move.
        symbolic: the conditions on parameters without value.
        compares_solutions: whether a check makes a second run, from another start.
        compare_runs: (model, findings, runs), two runs of a model whose inputs move; without it ``decide`` compares them.
        speed_bound: (model, region, findings, consequences by name, step), for how long solutions, and what a scheme computes,
            provably stay in the region.
        stay_times: (model, region, findings, bounds of the start), for how long solutions do, without such a speed.
        refined_runs: (step, runs), what runs with the steps h, 2h, 4h show beside the observed order.
        effort: of a class whose steps are all dear.
    """

    hypotheses: tuple[Hypothesis, ...]
    decide: Callable[[Any, Region, Sequence[Trajectory], bool], tuple[list[Finding], list[Consequence]]]
    along_run: Callable[[Any, Trajectory, Mapping[str, Finding], Trajectory | None, bool], list[Finding]] | None = None
    uniform: UniformChecks | None = None
    driven: DrivenChecks | None = None
    symbolic: Callable[[Any], list[Finding]] | None = None
    compares_solutions: bool = False
    compare_runs: Callable[[Any, Sequence[Finding], Sequence[Trajectory]], list[Finding]] | None = None
    speed_bound: Callable[[Any, Region, Sequence[Finding], Mapping[str, Consequence], float], SpeedBound | None] | None = None
    stay_times: Callable[[Any, Region, Sequence[Finding], tuple[np.ndarray, np.ndarray]], list[StayTime]] | None = None
    refined_runs: Callable[[float, Sequence[Trajectory]], list[Consequence]] | None = None
    effort: CheckEffort | None = None


HYPOTHESIS_CHECKS = Part[HypothesisChecks]("hypothesis_checks")
