"""Certificates of oscillators: theta, g, dom g; squares, a least point."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from nsmodel.certificate import verify
from nsmodel.certificate.data import Data, Subject, dense, numbers, program, steps
from nsmodel.certificate.graph import text
from nsmodel.certificate.hints import AT_LEAST, Grown, Stated, Unproved, convexity, inside, nowhere_negative, squares
from nsmodel.classes.oscillator.hypotheses.check import domain_of
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.hypotheses.domain import without_domain
from nsmodel.hypotheses.findings import Finding
from nsmodel.proof import exact

STATED = {"O-g": (Stated("lower bound of g", AT_LEAST),), "O-dry": (Stated("radius of A(0)", AT_LEAST),)}


def subject(model: FrictionOscillator, findings: Mapping[str, Finding]) -> Subject:
    """The model as data."""
    domain = domain_of(model)
    data = {
        "theta": [program(element.theta, model.s, ["s"]) for element in model.elements],
        "H": [dense(ca.SX(element.H)) for element in model.elements],
        "damping": [] if model.damping is None else dense(model.damping),
        "g": program(without_domain(model.potential, model.x, "potential"), model.x, model.names),
        "C": program(ca.vertcat(domain.rows, domain.equalities, -domain.equalities), model.x, model.names),
        "x0": numbers(model.x0),
        "steps": steps(model),
    }
    return Subject(model, data)


def proofs(
    model: FrictionOscillator,
    data: Data,
    finding: Finding,
    findings: Mapping[str, Finding],
    value: dict[str, str],
    room: Fraction,
) -> list[Any]:
    """Hints: squares or covers of theta''; of g convexity, and a lower bound in one of two ways."""
    if finding.id == "O-theta":
        return [{"theta": [_friction(program) for program in data["theta"]]}]
    if finding.id != "O-g":
        return [{}]
    atoms, n = verify.Atoms(), list(range(model.x.numel()))
    (p,) = atoms.read(data["g"])
    hint = inside(model, finding) | convexity(p, n, atoms)
    proofs = []
    if "lower bound of g" in value:
        bound = nowhere_negative(p + verify.constant(-Fraction(value["lower bound of g"])), atoms)
        proofs += [] if bound is None else [hint | {"bound": bound}]
    H = verify.hessian(verify.Poly({m: a for m, a in p.items() if all(v in n for v, _ in m)}), n, atoms)
    least = 0.0 if H is None else float(np.linalg.eigvalsh(exact.doubles(np.array(H, dtype=object)))[0])
    point, number = _least(model)
    if least > 0 and np.isfinite([*point, number]).all():
        value.setdefault("lower bound of g", text(number - 1e-6 * (1 + abs(number))))
        proofs.append(hint | {"mu": text(0.99 * least), "least": [text(x) for x in point]})
    if not proofs:
        raise Unproved("no lower bound of g that is shown by squares or by strong convexity")
    return proofs


def _least(model: FrictionOscillator) -> tuple[np.ndarray, float]:
    """Where the potential, without its domain, is least, in floating point."""
    g = without_domain(model.potential, model.x, "potential")
    f = ca.Function("g", [model.x], [g, ca.gradient(g, model.x)])
    found = minimize(
        lambda x: (float(f(x)[0]), np.array(f(x)[1]).ravel()), np.array(ca.DM(model.x0)).ravel(), jac=True, tol=1e-12
    )
    return found.x, float(found.fun)


def _friction(program: Any) -> dict[str, Any]:
    """What shows that one theta is convex: squares of the second derivative of what the rules leave, else a cover."""
    atoms = verify.Atoms()
    (p,), atoms.nonnegative = atoms.read(program), {0}
    rest = verify.leftover(p, atoms)
    polynomial = all(v == 0 for m in rest for v, _ in m)
    pair = _on_half_line(verify.slope(verify.slope(rest, 0, atoms), 0, atoms)) if polynomial else None
    return {"slope": Grown()} | ({"cover": Grown()} if pair is None else {"squares": pair})


def _on_half_line(p: verify.Poly) -> list[Any] | None:
    """Squares a and b with p = a + s b: p(u^2) is a sum of squares in u, whose products of odd powers, by u, are b."""
    doubled = verify.Poly({tuple((v, 2 * n) for v, n in m): a for m, a in p.items()})
    found = squares(doubled)
    if found is None:
        return None
    pair = []
    for odd in (0, 1):
        own = [k for k, m in enumerate(found["monomials"]) if (m[0][1] if m else 0) % 2 == odd]
        monomials = [[[0, m[0][1] // 2]] if m and m[0][1] > 1 else [] for m in (found["monomials"][k] for k in own)]
        pair.append({"monomials": monomials, "G": [[found["G"][i][j] for j in own] for i in own]})
    return pair
