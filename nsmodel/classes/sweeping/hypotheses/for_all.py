"""Hypotheses of a sweeping process for all values of parameters in a box.

Parameters enter a constraint as time does, but for the speeds of A2 and A3: shapes are those of all times and values, and what
is bounded over time is bounded over (t, p). Planes and distances are decided so, of other shapes those without parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.hypotheses.check import A5, A5_ACTIVE, HYPOTHESES, S_F, S_START, check, joined_finding
from nsmodel.classes.sweeping.hypotheses.consequences import sweeping_consequences
from nsmodel.classes.sweeping.hypotheses.constants import uniform_shape_answers
from nsmodel.classes.sweeping.hypotheses.constraint import SUP_ROUNDING_FACTOR, AnswersById, Constraint
from nsmodel.classes.sweeping.hypotheses.forms import ConstraintShape
from nsmodel.classes.sweeping.hypotheses.qualification import RHO_FRACTION, RHO_TRIES
from nsmodel.classes.sweeping.hypotheses.qualification_proofs import GammaProof, bound_gamma_everywhere
from nsmodel.classes.sweeping.hypotheses.shapes import read_shapes
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.findings import HOLDS, Consequence, Finding, Hypothesis, make_finding
from nsmodel.hypotheses.inputs import NO_INPUT_BOUNDS, InputBounds
from nsmodel.hypotheses.region import Region
from nsmodel.hypotheses.scope import IntervalBox
from nsmodel.hypotheses.uniform import ParameterValues, findings_for_box, unaffected_findings
from nsmodel.proof import extremum, interval_bounds
from nsmodel.proof.jumps import jump_nodes

READS = {hypothesis.id: ("g",) for hypothesis in HYPOTHESES} | {S_F.id: ("f", "g"), S_START.id: ("g", "q0")}


def special_values(model: SweepingProcess, box: IntervalBox) -> list[ParameterValues]:
    """No values are special."""
    return []


def uniform_findings(model: SweepingProcess, region: Region, quick: bool) -> list[Finding]:
    """What is decided for all values of the parameters, whose boxes are those of ``region``."""
    same = unaffected_findings(check, model, region, quick, READS)
    constraints = constraints_with_parameters(model, region)
    each = [uniform_shape_answers(constraint) if is_smooth_in_time(constraint) else None for constraint in constraints]
    own: list[Finding | None] = [uniform_velocity_finding(model, region), uniform_start_finding(model, region)]
    answers = [answer for answer in each if answer is not None]
    if len(answers) == len(each):
        own += [joined_finding(hypothesis, constraints, answers, region) for hypothesis in HYPOTHESES[:6]]
        own += _uniform_mfcq(constraints, answers, region)
    return findings_for_box((item for item in own if item is None or item.verdict == HOLDS), same, region)


def uniform_consequences(model: SweepingProcess, region: Region, own: Sequence[Finding]) -> list[Consequence]:
    """What follows for all values of the parameters; nothing where gamma is not known."""
    known = {finding.id: finding.value for finding in own}
    if not all("gamma" in known[id] for id in (A5.id, A5_ACTIVE.id)):
        return []
    return sweeping_consequences(model, own, (), model.g.numel())


def constraints_with_parameters(
    model: SweepingProcess, region: Region, motion: InputBounds = NO_INPUT_BOUNDS
) -> list[Constraint]:
    """The constraints, with (t, p) in the place of time, and u' behind it where inputs are among p."""
    slow, (low, high), (slowest, fastest) = ca.vertcat(model.t, model.p, motion.v), region.parameter_bounds(), motion.rates
    found = []
    for name, g, shape in zip(
        model.multiplier_names, ca.vertsplit(model.g), read_shapes(model.g, model.q), strict=True
    ) if model.multiplier_names else ():  # fmt: skip
        rows = list(shape.own)
        names = tuple(model.names[i] for i in rows)
        lower, upper = (
            np.concatenate([[t], p, v, x[rows]])
            for t, p, v, x in ((region.t0, low, slowest, region.lower), (region.t1, high, fastest, region.upper))
        )
        found.append(
            Constraint(name, g, _with_time_dependence(shape, g, model), slow, model.q[rows], names, lower, upper, motion)
        )
    return found


def is_smooth_in_time(c: Constraint) -> bool:
    """Whether neither g nor its gradient jumps with time or with parameters, where derivatives would not tell."""
    both = ca.vertcat(c.g, ca.gradient(c.g, c.q))
    return not jump_nodes(both, c.t) or interval_bounds.is_continuous(both, c.z, c.lower, c.upper)


def _with_time_dependence(shape: ConstraintShape, g: ca.SX, model: SweepingProcess) -> ConstraintShape:
    """The shape with whether it moves in time, of which parameters are none."""
    return replace(shape, time=bool(ca.depends_on(g, model.t)))


def _uniform_mfcq(constraints: Sequence[Constraint], each: Sequence[AnswersById], region: Region) -> list[Finding]:
    """A5 and A5' by the rules that hold for all states and need no point of the set."""
    reaches = [2 * answers["A0"].value.get("delta", np.inf) for answers in each]
    across = float(np.max(region.upper - region.lower, initial=0.0))
    reach = min([reach if np.isfinite(reach) else across / 2 for reach in reaches], default=1.0)
    proofs = [bound_gamma_everywhere(constraints, RHO_FRACTION * reach * 4.0**-k, moving=True) for k in range(RHO_TRIES)]
    near = next((proof for proof in proofs if proof is not None and np.isfinite(proof.gamma)), None)
    timed = any(constraint.shape.time for constraint in constraints)
    return (
        []
        if near is None
        else [_uniform_gamma_finding(A5, near, region, timed), _uniform_gamma_finding(A5_ACTIVE, near, region, timed)]
    )


def _uniform_gamma_finding(hypothesis: Hypothesis, proof: GammaProof, region: Region, timed: bool) -> Finding:
    value = {"gamma": max(proof.gamma, 1.0)} | ({"rho": proof.rho} if hypothesis is A5 and np.isfinite(proof.rho) else {})
    any_rho = "; for every rho" if hypothesis is A5 and "rho" not in value else ""
    return make_finding(hypothesis, HOLDS, proof.how + any_rho, value, scope=region.scope(timed=timed))


def uniform_velocity_finding(model: SweepingProcess, region: Region, motion: InputBounds = NO_INPUT_BOUNDS) -> Finding | None:
    """S-f by bounds of f and its derivative over (t, p) and all states, else over (t, p) and the box."""
    f, (low, high) = model.f, region.parameter_bounds()
    z, J = ca.vertcat(model.t, model.p, model.q), ca.jacobian(f, model.q)
    n, timed = model.q.numel(), bool(ca.depends_on(f, model.t))
    speed, (slowest, fastest) = ca.sumsqr(motion.velocity(f, model.t)), motion.rates
    wide = np.full(n, np.inf)
    for lower, upper, local in ((-wide, wide, False), (region.lower, region.upper, True)):
        ends = np.concatenate([[region.t0], low, lower]), np.concatenate([[region.t1], high, upper])
        if not interval_bounds.is_continuous(f, z, *ends):
            continue
        steep = extremum.spectral_norm(J, z, *ends, quick=not local).bound
        about = ca.substitute(f, model.q, ca.DM.zeros(n)) if not local else f
        size = extremum.supremum(ca.sumsqr(about), z, *ends, quick=not local).bound
        moving = np.append(ends[0], slowest), np.append(ends[1], fastest)
        rate = 0.0 if speed.is_zero() else extremum.supremum(speed, ca.vertcat(z, motion.v), *moving, quick=True).bound
        if np.isfinite(steep) and np.isfinite(size):
            K_f, at_0 = max(steep, 0.0) * SUP_ROUNDING_FACTOR, np.sqrt(max(size, 0.0)) * SUP_ROUNDING_FACTOR
            value = {"K_f": K_f, "L_f": at_0 if local else max(K_f, at_0)}
            value |= {"L_t": np.sqrt(rate) * SUP_ROUNDING_FACTOR} if np.isfinite(rate) else {}
            return make_finding(S_F, HOLDS, "bounds of f and of its derivative", value, scope=region.scope(local, timed))
    return None


def uniform_start_finding(model: SweepingProcess, region: Region) -> Finding | None:
    """S-start: g_i(0, q_0) >= 0 for all values, by bounds."""
    at_start = ca.substitute(model.g, ca.vertcat(model.t, model.q), ca.vertcat(0, model.q0))
    ends = region.parameter_bounds()
    tops = [extremum.supremum(-g, model.p, *ends, bound_to=0.0).bound for g in ca.vertsplit(at_start)] if at_start.numel() else []
    if not all(top <= 0 for top in tops):
        return None
    return make_finding(S_START, HOLDS, "bounds of g_i(0, q_0)", {"min g": min((-top for top in tops), default=0.0)})
