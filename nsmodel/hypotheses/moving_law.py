"""Laws whose ends move, as a check takes them.

That they make a set at all times is a hypothesis of its own, ``ends``. A class's checks of driven models say by ``freeze_law``
in what form its hypotheses are looked at: with time in the law as an input of rate 1 (`law_time_as_input`), so that at each time
the law has numbers, or with the ends elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, Scope, make_finding
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS
from nsmodel.hypotheses.inputs import InputBounds, unknown_consequence
from nsmodel.hypotheses.region import Region
from nsmodel.modeling.base import Model
from nsmodel.modeling.laws import Law
from nsmodel.modeling.signals.function import Expression
from nsmodel.proof import extremum, interval_bounds
from nsmodel.simulation.trajectory import Trajectory

LAW_BOUNDS_HYPOTHESIS = Hypothesis(
    "ends", "the law is a set at all times: lower <= upper for all inputs that are meant", "definition of the law"
)
LAW_TIME = "t of the law"
EMPTY_LAW_REASON = "the ends of the law are not seen to make a set at all times"


def freeze_law(model: Model) -> Model:
    """The model in the form in which its hypotheses are looked at: itself, where nothing of its law moves."""
    driven = HYPOTHESIS_CHECKS.of(model).driven
    freeze = None if driven is None else driven.freeze_law
    return model if freeze is None else freeze(model)


def runs_of_frozen_law(model: Model, runs: Sequence[Trajectory]) -> list[Trajectory]:
    """Runs of the model in that form."""
    driven = HYPOTHESIS_CHECKS.of(model).driven
    seen = None if driven is None else driven.run_of_frozen_law
    return list(runs) if seen is None else [seen(model, run) for run in runs]


def time_as_input(model: Any, put: Callable[[ca.SX], dict[str, Any]]) -> Any:
    """The model with time in its law as a further input, ``put`` of whose symbol gives the fields that have it in place of t."""
    tau = ca.SX.sym(LAW_TIME)
    other, signal = copy(model), Expression((), LAW_TIME, time=model.t, column=ca.SX(model.t))
    other._set(
        u=ca.vertcat(model.u, tau), inputs=MappingProxyType({**model.inputs, LAW_TIME: signal}),
        input_groups=MappingProxyType({**model.input_groups, LAW_TIME: (LAW_TIME,)}), **put(tau),
    )  # fmt: skip
    return other


def law_time_as_input(model: Any) -> Any:
    """The model with time in its law, where it is there, as an input."""
    law: Law | None = model.law
    if law is None or not any(law.moves(model.t)):
        return model
    return time_as_input(model, lambda tau: {"law": law.put(model.t, tau)})


def check_law_bounds(model: Any, region: Region, quick: bool) -> Finding:
    """Whether each row of the law has lower <= upper for all t and parameters, inputs among them, by bounds over the box."""
    z, (low, high) = ca.vertcat(model.t, model.p), region.parameter_bounds()
    lower, upper = np.append(region.t0, low), np.append(max(region.t1, float(model.t_end or 0.0)), high)
    names, least, moved = ("t", *region.parameters), np.inf, model.law.ends(model.multiplier_names, z)
    scope = Scope(time=(lower[0], upper[0]), parameters=region.parameters)
    unsure = ""
    for end in moved:
        for side in (end.lower, end.upper):
            if not (side.is_constant() or np.isfinite(interval_bounds.enclose(side, z, lower, upper)).all()):
                unsure = unsure or f"an end of '{end.name}' is not seen to be finite"
        if end.has_infinite_end:
            continue
        gap = end.lower - end.upper
        top = extremum.supremum(gap, z, lower, upper, quick=quick, bound_to=0.0)
        if top.value > 0 and top.at is not None:
            a, b = (float(ca.Function("end", [z], [side])(top.at)) for side in (end.lower, end.upper))
            at = dict(zip(names, np.ravel(top.at).tolist(), strict=True))
            at["t"] = at.pop(LAW_TIME, at["t"])
            witness = {"row": end.name, **at, "lower": a, "upper": b}
            how = f"the lower end of '{end.name}' is above its upper end: its law is empty there, and no step passes"
            return make_finding(LAW_BOUNDS_HYPOTHESIS, VIOLATED, how, {"lower - upper": a - b}, witness, scope)
        least = min(least, -top.bound)
        if not top.bound <= 0:
            unsure = unsure or f"that the lower end of '{end.name}' stays below its upper end is not proved"
    if unsure:
        return make_finding(LAW_BOUNDS_HYPOTHESIS, UNKNOWN, unsure)
    return make_finding(
        LAW_BOUNDS_HYPOTHESIS,
        HOLDS,
        "bounds of the ends over all times and inputs",
        {"width": least, "rows": len(moved)},
        scope=scope,
    )


def decide_with_law_bounds(
    model: Any, region: Region, motion: InputBounds, quick: bool, hypotheses: Sequence[Hypothesis],
    decide: Callable[[], tuple[list[Finding], list[Consequence]]],
) -> tuple[list[Finding], list[Consequence]]:  # fmt: skip
    """What ``decide`` finds and what follows, with ENDS where the law moves; where it is empty nothing else is looked at.

    Args:
        model: its inputs are parameters, those of ``region``; its law as declared.
        region, motion, quick: as of the check.
        hypotheses: those of the class.
        decide: looks at them.
    """
    law: Law | None = getattr(model, "law", None)
    if law is None or not any(law.moves(ca.vertcat(model.t, motion.u))):
        return decide()
    own = check_law_bounds(model, region, quick)
    if own.verdict == VIOLATED:
        return [*(make_finding(one, UNKNOWN, f"not looked at: {EMPTY_LAW_REASON}") for one in hypotheses), own], []
    findings, made = decide()
    return [*findings, own], [item if own.verdict == HOLDS else unknown_consequence(item, EMPTY_LAW_REASON) for item in made]
