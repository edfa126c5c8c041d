"""What the theory of mechanics with contact asks for: the mass matrix, what is linear, the start, restitution, theta.

Others are listed and not decided: the independence of contacts and joints, the matrices W and mu_c of all positions, energy and
penetration along runs.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED, Consequence, Finding, Hypothesis, make_consequence, make_finding
from nsmodel.hypotheses.region import Region
from nsmodel.models.mechanical_system.model import MechanicalSystem
from nsmodel.models.mechanical_system.schemes import start_values
from nsmodel.proof import exact, extremum
from nsmodel.proof.expression_graph import is_same_expression, rewrite_nodes
from nsmodel.simulation.trajectory import Trajectory

MOREAU, ACARY = "Moreau 1988, section 2", "Acary 2016 (ZAMM 96)"
C_M = Hypothesis("C-M", "M(q) is symmetric and positive definite", MOREAU)
C_LIN = Hypothesis("C-lin", "slip velocities are affine in v; gaps and joints are functions of t and q", MOREAU)
C_START = Hypothesis("C-start", "no contact overlaps at the start, joints are closed and do not move apart", MOREAU)
C_E = Hypothesis("C-e", "0 <= e <= 1, e the same for all contacts, and e = 0 where there is friction", f"{ACARY}; Kane 1984")
C_THETA = Hypothesis("C-theta", "1/2 <= theta <= 1/(1 + e)", f"{ACARY}, frictionless")
UNDECIDED = (
    Hypothesis("C-ind", "the rows of contacts that act and of joints are independent", MOREAU),
    Hypothesis("C-mfcq", "some velocity opens all contacts that act and keeps the joints", MOREAU),
    Hypothesis("C-W", "W of a step is positive definite", "Jean 1999"),
    Hypothesis("C-P", "mu < mu_c = W_NN/|W_NT| of each contact at all positions", "Génot and Brogliato 1999"),
    Hypothesis("C-F", "F is Lipschitz in (q, v) and grows at most linearly", "Monteiro Marques 1993"),
)
HYPOTHESES = (C_M, C_LIN, C_START, C_E, C_THETA, *UNDECIDED)
# Part of the size of positions and gaps that a gap may be below 0 by rounding: 4500 EPS, more than a formula loses.
GAP_ROUNDING = 1e-12
NOT_YET = "not decided yet: nothing here looks at it"


def check(
    model: MechanicalSystem, region: Region, runs: Sequence[Trajectory], quick: bool
) -> tuple[list[Finding], list[Consequence]]:
    """Decide the hypotheses of the class; the model is bound.

    Args:
        model: with numbers for its parameters.
        region: the box of positions and velocities.
        runs: finished runs of this model, of which nothing is asked.
        quick: no search for the worst position.
    """
    others = [make_finding(hypothesis, UNKNOWN, NOT_YET) for hypothesis in UNDECIDED]
    findings = [_check_mass(model, region, quick), _check_linear(model), _check_start(model), *_check_energy(model), *others]
    return findings, _consequences(model, findings)


def _consequences(model: MechanicalSystem, findings: Sequence[Finding]) -> list[Consequence]:
    """What follows of impacts alone, and of steps."""
    kept = "an impact does not raise the kinetic energy: T+ - T- = -(1 - e)/(2 (1 + e)) <P, W P>; for e = 0, <P, u+> - <P, W P>/2"
    one, paper = "each step has one velocity", "Moreau 1988; Génot and Brogliato 1999"
    found = [make_consequence("one answer", one, findings, ("C-M", "C-lin", "C-ind", "C-P"), paper)]
    if _has_one_restitution(model) and not _has_moving_contact(model):
        found.insert(0, make_consequence("impacts keep or lose energy", kept, findings, ("C-M", "C-e"), MOREAU))
    return found


def _has_one_restitution(model: MechanicalSystem) -> bool:
    """Whether e is the same for all that push: where it acts on approach alone, what separates and is pushed has e = 0."""
    restitution = any(float(one.e) for one in model.contact_rows)
    return not restitution or model.restitution == "newton" or len(model.contact_rows) == 1


def _has_moving_contact(model: MechanicalSystem) -> bool:
    """Whether a wall or a belt moves by itself: it may do work."""
    at_rest = [ca.substitute(one.slip, model.v, ca.SX.zeros(model.v.numel())) for one in model.contact_rows if one.slip.numel()]
    rates = [ca.jacobian(one.gap, model.t) for one in model.contact_rows]
    return not all(part.is_zero() for part in [*at_rest, *rates])


def _check_mass(model: MechanicalSystem, region: Region, quick: bool) -> Finding:
    if model.M.is_constant():
        M = np.array(ca.DM(model.M))
        found = exact.definiteness(M)
        if found.definite:
            how = "M is constant and positive definite (exact)."
            return make_finding(C_M, HOLDS, how, {"least eigenvalue": float(np.linalg.eigvalsh(M)[0])})
        witness = {"v": np.zeros(len(M)) if found.vector is None else found.vector}
        return make_finding(C_M, VIOLATED, "M is constant and not positive definite (exact).", {"v'M v": 0.0}, witness)
    relaxed, units = _replace_sines_and_cosines(model.M, model.q)
    if units.numel() and not ca.depends_on(relaxed, model.x):
        one = np.ones(units.numel())
        top = extremum.largest_eigenvalue(-relaxed, units, -one, one, quick=quick, bound_to=0.0)
        if top.bound < 0:
            how = "the least eigenvalue is bounded below for all values in [-1, 1] of the sines and cosines"
            return make_finding(C_M, HOLDS, how, {"least eigenvalue": -top.bound})
    low, high = region.bounds_with_time()
    z = ca.vertcat(model.t, model.x)
    top = extremum.largest_eigenvalue(-model.M, z, low, high, quick=quick, bound_to=0.0)
    if top.bound < 0:
        how = "the least eigenvalue is bounded below on the region"
        return make_finding(C_M, HOLDS, how, {"least eigenvalue": -top.bound}, scope=region.scope(local=True))
    if top.value >= 0 and top.at is not None:
        at = dict(zip(("t", *region.names), map(float, top.at), strict=True))
        return make_finding(C_M, VIOLATED, "an eigenvalue of M is not positive here", {"least eigenvalue": -top.value}, at)
    return make_finding(C_M, UNKNOWN, "the least eigenvalue is not bounded away from 0 on the region")


def _replace_sines_and_cosines(M: ca.SX, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """M with a symbol for each sine and cosine of positions, and these symbols: its values are among those of [-1, 1]."""
    known: list[tuple[int, ca.SX, ca.SX]] = []

    def rule(op: int, new: Sequence[ca.SX], old: ca.SX) -> ca.SX:
        for other, argument, unit in known:
            if other == op and is_same_expression(argument, old.dep(0)):
                return unit
        known.append((op, old.dep(0), ca.SX.sym(f"unit_{len(known)}")))
        return known[-1][2]

    relaxed = ca.reshape(rewrite_nodes(ca.vec(ca.densify(M)), rule, (ca.OP_SIN, ca.OP_COS), q, "M"), *M.shape)
    return relaxed, ca.vertcat(ca.SX(0, 1), *(unit for _, _, unit in known))


def _check_linear(model: MechanicalSystem) -> Finding:
    rows = sum(one.slip.numel() for one in model.contact_rows)
    how = "By the structure of the expressions; a model of another form is refused."
    return make_finding(C_LIN, HOLDS, how, {"slip rows": rows, "contacts": len(model.contact_rows)})


def _check_start(model: MechanicalSystem) -> Finding:
    """The gaps, and the contacts that the start closes: an impact at t = 0, which is allowed."""
    gaps, u_N, _ = (np.array(ca.DM(part)).ravel() for part in start_values(model))
    if not gaps.size:
        return make_finding(C_START, HOLDS, "There are no contacts; open joints are refused.", {"contacts": 0})
    names = [one.name for one in model.contact_rows]
    worst = int(np.argmin(gaps))
    if gaps[worst] < -GAP_ROUNDING * max(np.abs(np.array(ca.DM(model.x0))).max(initial=0.0), np.abs(gaps).max()):
        witness = {"contact": names[worst], "gap": gaps[worst]}
        return make_finding(C_START, VIOLATED, "A contact overlaps.", {"least gap": gaps[worst]}, witness)
    hits = [name for name, gap, speed in zip(names, gaps, u_N, strict=True) if gap == 0 and speed < 0]
    how = f"An impact at t = 0 at {', '.join(hits)}." if hits else "All gaps are >= 0."
    return make_finding(C_START, HOLDS, how, {"least gap": gaps[worst]})


def _check_energy(model: MechanicalSystem) -> list[Finding]:
    """C-e and C-theta, from the numbers."""
    e = {one.name: float(one.e) for one in model.contact_rows}
    most, least = max(e.values(), default=0.0), min(e.values(), default=0.0)
    rough = {one.name: float(one.e) for one in model.contact_rows if one.slip.numel()}
    values = {"largest e": most, "least e": least}
    bouncing = max(rough, key=lambda name: rough[name], default="")
    if most != least:
        ends = {"contacts": [max(e, key=lambda n: e[n]), min(e, key=lambda n: e[n])], "e": [most, least]}
        C_e = make_finding(C_E, VIOLATED, "Contacts that act together with different e may raise the energy.", values, ends)
    elif bouncing and rough[bouncing] > 0:
        witness = {"contact": bouncing, "e": rough[bouncing]}
        C_e = make_finding(C_E, VIOLATED, "Newton's e > 0 with friction may raise the energy (Kane).", values, witness)
    else:
        C_e = make_finding(C_E, HOLDS, "From the declared numbers.", values)
    bound = 1 / (1 + most)
    value = {"theta": model.theta, "1/(1 + e)": bound}
    if model.theta <= bound:
        return [C_e, make_finding(C_THETA, HOLDS, "From the declared numbers.", value)]
    return [C_e, make_finding(C_THETA, VIOLATED, "A step may raise the energy in an impact.", value, {"theta": model.theta})]
