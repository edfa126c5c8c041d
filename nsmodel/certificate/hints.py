"""What helps to verify a finding: its numbers with a little room, and matrices, vectors and covers of boxes.

A cover is grown by asking ``verify`` itself: a part on which its inequality fails is halved, until all parts pass or there are
too many.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize

from nsmodel.certificate import verify
from nsmodel.certificate.data import Data, reach_of
from nsmodel.certificate.graph import NoProgram, graph, matrix, text
from nsmodel.classes.first_order.model import FirstOrderSystem
from nsmodel.classes.inclusion.model import MonotoneInclusion
from nsmodel.classes.lure.model import LureSystem
from nsmodel.classes.oscillator.model import FrictionOscillator
from nsmodel.classes.sweeping.hypotheses.forms import Affine
from nsmodel.classes.sweeping.hypotheses.geometry import mfcq_constant
from nsmodel.classes.sweeping.hypotheses.shapes import read_shapes
from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.hypotheses.domain import without_domain
from nsmodel.hypotheses.findings import Finding
from nsmodel.model.base import Model
from nsmodel.proof import exact, feasibility, sum_of_squares

# Numbers are stated with so much room, relative: they were rounded to doubles; more where a cover of the box would take too
# many parts, as a bound that is attained is told from its violation only by small ones.
ROOMS = ROOM, *_ = Fraction(1, 2**40), Fraction(1, 2**10), Fraction(1, 2**5)
MOST_PARTS, DEEP = 1000, 40  # Parts of a cover.
NAMES = {("A2", "b"): "speed", ("A3", "M"): "turn", ("4.1", "least eigenvalue"): "least"}
LEAST = {"a", "c", "least", "alpha", "radius of A(0)", "lower bound of g", "least eigenvalue"}  # The larger, the more is said.
STATED = {
    "A0": ("c",), "A1": ("a", "b"), "A2": ("b",), "A3": ("M",), "A4": ("M", "M_contact"), "A5": ("gamma", "rho"),
    "A5'": ("gamma",), "S-f": ("K_f", "L_f", "L_t"), "4.1": ("least eigenvalue",), "5.2": ("omega",), "M-A2": ("a_1", "a_2"),
    "M-A3": ("alpha", "beta"), "M-24": ("L",), "O-g": ("lower bound of g",), "O-dry": ("radius of A(0)",), "F-step": ("h",),
    "F-W": ("h",),
}  # fmt: skip


class Unproved(Exception):
    """No proof of a finding is known that ``verify`` can check; says why."""


class TooManyParts(Unproved):
    """A cover would take too many parts."""


def value_of(finding: Finding, room: Fraction = ROOM) -> dict[str, str]:
    """The numbers of a finding as the certificate states them: rounded in the direction in which they say less."""
    found = {}
    for name in STATED.get(finding.id, ()):
        if name in finding.value and np.isfinite(finding.value[name]):
            number = Fraction(finding.value[name])
            less = -1 if name in LEAST else 1
            more = 0 if name in ("rho", "h") else room * abs(number)
            found[NAMES.get((finding.id, name), name)] = text(number + less * more)
    return found


def proofs_of(
    model: Model, data: Data, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints for a finding, to be tried in turn; numbers that ``verify`` needs and the finding does not have enter ``value``.

    Raises:
        Unproved, NoProgram: there are none.
    """
    if isinstance(model, SweepingProcess):
        return [_sweeping(model, data, finding, findings, room)]
    if isinstance(model, LureSystem):
        return [_lure(model, data, finding)]
    if isinstance(model, FirstOrderSystem):
        return [_first_order(model, finding, value)]
    if isinstance(model, FrictionOscillator):
        return _oscillator(model, data, finding, value)
    return _inclusion(model, data, finding, value)


# -- covers ------------------------------------------------------------------------------------------------------------


class Grown:
    """A cover that is found while ``verify`` asks for it; ``hint`` says what shows a part, ``only`` which inputs are halved."""

    def __init__(self, hint: Callable[[list[Any]], Any] = lambda box: None, only: Sequence[int] | None = None) -> None:
        self.hint, self.only, self.tree = hint, only, None


def covered(model: dict[str, Any], statement: dict[str, Any]) -> str:
    """The verdict of ``verify``, with covers grown where the hints ask for them; they are then part of the statement."""
    plain = verify.cover

    def growing(tree: Any, box: list[Any], leaf: Callable[[list[Any], Any], bool]) -> bool:
        if isinstance(tree, Grown):
            tree.tree = _grow(tree, box, leaf)
            return True
        return plain(tree, box, leaf)

    try:
        verify.cover = growing
        answer = verify.verdict(model, statement)
    finally:
        verify.cover = plain
    statement["proof"] = _settled(statement["proof"])
    return answer


def _settled(item: Any) -> Any:
    if isinstance(item, Grown):
        return item.tree
    if isinstance(item, dict):
        return {name: _settled(part) for name, part in item.items()}
    return [_settled(part) for part in item] if isinstance(item, list) else item


def _grow(grown: Grown, box: list[Any], leaf: Callable[[list[Any], Any], bool]) -> Any:
    """The tree of a cover whose parts all pass."""
    count, most = 0, MOST_PARTS // (1 if all(np.isfinite(float(x.hi - x.lo)) for x in box) else 4)

    def passes(part: list[Any], hint: Any) -> bool:
        try:
            return bool(leaf(part, hint))
        except (verify.Undefined, AssertionError):
            return False

    def grow(part: list[Any], depth: int) -> Any:
        nonlocal count
        count += 1
        if count > most or depth > DEEP:
            raise TooManyParts(f"a cover takes more than {most} parts")
        hint = grown.hint(part)
        if passes(part, hint):
            return hint
        widths = [
            _width(x) / (_width(y) or 1.0) if grown.only is None or i in grown.only else 0.0
            for i, (x, y) in enumerate(zip(part, box, strict=True))
        ]
        if not any(widths):
            raise TooManyParts("a bound fails at a point")
        k = int(np.argmax(widths))
        middle = part[k].middle()
        sides = verify.Interval(part[k].lo, middle), verify.Interval(middle, part[k].hi)
        return [k, *(grow([*part[:k], side, *part[k + 1 :]], depth + 1) for side in sides)]

    return grow(list(box), 0)


def _width(x: verify.Interval) -> float:
    """The width; of an infinite interval that of its angles."""
    if np.isfinite([float(x.lo), float(x.hi)]).all():
        return float(x.hi - x.lo)
    return float(np.arctan(float(x.hi)) - np.arctan(float(x.lo)))


def _cover(expr: ca.SX, inputs: ca.SX) -> dict[str, Grown]:
    """A cover that halves the inputs that the Jacobian of an expression depends on; none where it is constant."""
    J = ca.jacobian(expr, inputs)
    curved = [k for k, symbol in enumerate(ca.vertsplit(inputs)) if ca.depends_on(J, symbol)]
    return {"cover": Grown(only=curved)} if curved else {}


# -- sums of squares -----------------------------------------------------------------------------------------------------


def _renamed(p: verify.Poly) -> tuple[dict[Any, Fraction], list[int]]:
    """A polynomial in the variables 0, 1, ..., and their names in ``p``."""
    names = sorted({v for monomial in p for v, _ in monomial})
    return {tuple((names.index(v), n) for v, n in monomial): number for monomial, number in p.items()}, names


def _hint(found: sum_of_squares.Certificate, names: Sequence[int]) -> dict[str, Any]:
    monomials = [[[v, n] for v, n in zip(names, power, strict=True) if n] for power in found.monomials]
    return {"monomials": monomials, "G": matrix(found.G) if monomials else []}


def squares(p: verify.Poly) -> dict[str, Any] | None:
    """A Gram matrix of p; None where none is found."""
    q, names = _renamed(p)
    found = sum_of_squares.certificate(q, len(names))
    return None if found is None else _hint(found, names)


def nowhere_negative(p: verify.Poly, atoms: verify.Atoms) -> dict[str, Any] | None:
    """A Gram matrix of p less terms that are >= 0 and no polynomials."""

    def of_atoms(m: Any, a: Fraction) -> bool:
        return bool(set(dict(m)) & set(atoms.meaning)) and verify.positive(verify.Poly({m: a}), atoms)

    return squares(verify.Poly({m: a for m, a in p.items() if not of_atoms(m, a)}))


def convexity(p: verify.Poly, own: Sequence[int], atoms: verify.Atoms) -> dict[str, Any]:
    """What shows that p is convex: nothing, by the rules; a Gram matrix of y'D2p y; else a cover."""
    if verify.convex(p, own, atoms):
        return {}
    q = {m: a for m, a in p.items() if m and all(v in own for v, _ in m)}
    found = sum_of_squares.convexity(q)
    if found is None:
        return {"cover": Grown()}
    parts = [_hint(part, [*names, *(-1 - v for v in names)]) for names, part in found]
    G = block_diag(*(part.G for _, part in found)) if parts else []
    one = {"monomials": [m for part in parts for m in part["monomials"]], "G": [[text(Fraction(x)) for x in row] for row in G]}
    return {"squares": one} if verify.convex(p, own, atoms, one) else {"cover": Grown()}


# -- sweeping processes --------------------------------------------------------------------------------------------------


def _sweeping(model: SweepingProcess, data: Data, finding: Finding, findings: Mapping[str, Finding], room: Fraction) -> Any:
    if finding.id == "S-f":
        graph(model.f, ca.vertcat(model.t, model.q), ["t", *(model.names or ())])  # it may not be written
    if finding.id in ("S-f", "S-start"):
        return {"time": Grown(), "cover": Grown()}
    if finding.id in ("A5", "A5'"):
        return {"cover": Grown(_escape(model))}
    shapes = read_shapes(model.g, model.q) if model.multiplier_names else []
    return {"constraints": [_constraint(model, data, k, shape, finding, findings, room) for k, shape in enumerate(shapes)]}


def _constraint(
    model: SweepingProcess, data: Data, k: int, shape: Any, finding: Finding, findings: Mapping[str, Finding], room: Fraction
) -> dict[str, Any]:
    """The form of one constraint: affine, a norm or the distance to a segment, else bounds over the box."""
    if shape.kind == "plane":
        return {"form": "affine", "time": Grown()}
    if shape.kind == "distance":
        hint = _norm(model, shape)
        if hint is not None:
            return hint
    local = finding.scope is not None and bool(finding.scope.states)
    if finding.id == "S-convex":
        program, atoms = data["constraints"][k]["graph"], verify.Atoms()
        hint = convexity(*atoms.read(program), range(1, len(program["inputs"])), atoms)
        return hint | {"form": "box" if "cover" in hint else "rules"}
    if not local and finding.id not in ("A2", "A3", "A4"):
        raise Unproved(f"constraint '{model.multiplier_names[k]}': a form that is not written down here")
    b = finding.value.get("b") if finding.id == "A1" else findings["A1"].value.get("b") if "A1" in findings else None
    if finding.id not in ("A0", "A1"):
        b = np.inf
    if b is None:
        raise Unproved("no bound of the gradients is known")
    b = text(Fraction(b) * (1 + room / 2)) if np.isfinite(b) else "inf"
    return {"form": "box", "b": b, "cover": Grown()}


def _norm(model: SweepingProcess, shape: Any) -> dict[str, Any] | None:
    """w |A q + c(t)| + offset(t), or the distance to a segment."""
    (weight, squares), offset = shape.form.norms[0], shape.form.affine.offset
    if any(w != 1 for w, _ in squares):
        return None
    place = {i: j for j, i in enumerate(shape.own)}
    A = exact.zeros(len(squares), len(place))
    for row, (_, a) in enumerate(squares):
        for i, number in a.row.items():
            if i >= 0:
                A[row, place[i]] = number
    hint: dict[str, Any] = {"form": "norm", "w": text(weight), "A": matrix(A), "time": Grown(),
                            "c": [_of_time(a, model) for _, a in squares], "offset": _of_time(offset, model)}  # fmt: skip
    if shape.clips:
        if any(a.row.get(i) != -1 for _, a in squares for i in a.row if i < 0):
            raise Unproved("the distance to a segment that is aslant: its projection is one up to rounding only")
        clips = [next(shape.clips[i] for i in a.row if i < 0) for _, a in squares]
        hint["box"] = [[text(clip.low), text(clip.high)] for clip in clips]
    gram = exact.doubles(exact.product(A, A.T))
    b = Fraction(float(weight) * float(np.sqrt(np.linalg.eigvalsh(gram)[-1]))) * (1 + ROOM / 4)
    return hint | {"reach": text(reach_of(shape, model)), "b": text(b)}


def _of_time(a: Affine | Any, model: SweepingProcess) -> Any:
    offset = a.offset if isinstance(a, Affine) else a
    if isinstance(offset, Fraction):
        return {"inputs": ["t"], "steps": [["const", text(offset)]], "outputs": [0]}
    return graph(offset, model.t, ["t"])


def _escape(model: SweepingProcess) -> Callable[[list[Any]], Any]:
    """A direction of escape for the constraints near the middle of a part."""
    slopes = ca.Function("slopes", [model.t, model.q], [ca.densify(ca.jacobian(model.g, model.q)), ca.densify(model.g)])

    def direction(box: list[Any]) -> Any:
        middle = np.array([float(x.lo + x.hi) / 2 for x in box])
        reach = np.linalg.norm([float(x.hi - x.lo) for x in box])
        G, g = (np.array(item) for item in slopes(middle[0], middle[1:]))
        size = np.linalg.norm(G, axis=1)
        near = np.flatnonzero((g.ravel() <= reach * np.maximum(size, 1e-300)) & (size > 0))
        if len(near) < 2 or not np.isfinite(G[near]).all():
            return [text(x) for x in (G[near[0]] if len(near) and np.isfinite(G[near[0]]).all() else np.ones(len(middle) - 1))]
        normals = G[near] / size[near, None]
        return [text(x) for x in mfcq_constant(normals)[1] @ normals]

    return direction


# -- the other classes ------------------------------------------------------------------------------------------------------


def _lure(model: LureSystem, data: Data, finding: Finding) -> Any:
    if finding.id in ("5.1", "5.2"):
        name = "P" if finding.id == "5.1" else "P_omega"
        P = finding.witness.get(f"{name} exactly") or finding.witness.get(name)
        if P is None:
            raise Unproved("too large a P to write down")
        P = [[entry if isinstance(entry, str) else text(entry) for entry in row] for row in P]
        return {"P": P} | _cover(model.A, model.x)
    if finding.id in ("5.4a", "5.4c", "5.x0", "7.1") and not _everything(data):
        return _in_range(
            model, None if finding.id in ("5.4a", "5.4c") else np.array(ca.DM(model.x0)).ravel() * (finding.id == "5.x0")
        )
    return {}


def _everything(data: Data) -> bool:
    with suppress(verify.Undefined):
        return bool(verify.everything(data))
    return False


def _in_range(model: LureSystem, x: np.ndarray | None) -> Any:
    """x, k, y, v with C x = D'k + y + S v, k and y inside, of a law of boxes; empty where nothing is asked.

    Columns of the homogeneous system: tau > 0, l - low tau > 0 (or high tau - l), where both ends are finite also their sum,
    y > 0 or < 0 where one end is, v, and x where it is not given.
    """
    m, n = model.D.shape[0], model.x.numel()
    C, D = (exact.rational(np.array(ca.DM(part)).reshape(part.shape)) for part in (model.C, model.D))
    if model.law is None or not model.law.is_box:
        raise Unproved("a law that is no box")
    low, high = (np.concatenate(ends) for ends in zip(*(block.hull() for block in model.law.blocks), strict=True))
    bounded = np.isfinite(low) & np.isfinite(high)
    S, I = D + D.T, exact.eye(m)
    A = exact.zeros(m + int(bounded.sum()), 1 + 3 * m + m + (n if x is None else 0))
    positive, k = [0], []
    for i in range(m):
        sign = Fraction(1 if np.isfinite(low[i]) else -1)
        base = Fraction(low[i]) if np.isfinite(low[i]) else Fraction(high[i]) if np.isfinite(high[i]) else Fraction(0)
        k.append((base, sign))
        A[:m, 0] -= base * D[i]
        A[:m, 1 + i] = -sign * D[i]
        if np.isfinite([low[i], high[i]]).any():
            positive.append(1 + i)
        if bounded[i]:
            row = m + int(bounded[:i].sum())
            A[row, 1 + i], A[row, 1 + m + i], A[row, 0] = Fraction(1), Fraction(1), -Fraction(high[i] - low[i])
            positive.append(1 + m + i)
        if np.isfinite([low[i], high[i]]).any():
            A[:m, 1 + 2 * m + i] = -I[i] * sign
            positive += [] if bounded[i] else [1 + 2 * m + i]
    A[:m, 1 + 3 * m : 1 + 4 * m] = -S
    if x is None:
        A[:m, 1 + 4 * m :] = C
    else:
        A[:m, 0] += exact.product(C, exact.rational(x)[:, None]).ravel()
    found = feasibility.decide(feasibility.System(A, tuple(positive))).point
    if found is None:
        raise Unproved("no point was found")
    found = found / found[0]
    return {
        "x": [text(entry) for entry in (found[1 + 4 * m :] if x is None else exact.rational(x))],
        "k": [text(base + sign * found[1 + i]) for i, (base, sign) in enumerate(k)],
        "y": [text(k[i][1] * found[1 + 2 * m + i]) for i in range(m)],
        "v": [text(entry) for entry in found[1 + 3 * m : 1 + 4 * m]],
    }


def _first_order(model: FirstOrderSystem, finding: Finding, value: dict[str, str]) -> Any:
    if finding.id == "F-jacobians":
        return {"cover": Grown()}
    if finding.id in ("F-mlcp", "F-unique"):
        return _complementarity(model)
    steps = model.steps if model.steps is not None else [model.step]
    value["h"] = text(np.max(steps))
    inverse = exact.inverse(exact.rational(np.array(ca.DM(ca.densify(model.M)))))
    if inverse is None:
        raise Unproved("M is singular")
    return {"inverse": matrix(inverse), "cover": Grown()}


def _complementarity(model: FirstOrderSystem) -> Any:
    """W^-1 at each step, and T with T (W_mlcp + W_mlcp') = B where there is one."""
    z = ca.vertcat(model.t, model.x, model.lam)
    J = [ca.jacobian(getattr(model, name), u) for name in "fgh" for u in (model.x, model.lam)]
    if any(ca.depends_on(part, z) for part in J):
        raise Unproved("f, g or h is not affine")
    A, _, K, B, C, D = (exact.rational(np.array(ca.DM(ca.densify(part))).reshape(part.shape)) for part in J)
    M, theta, gamma = exact.rational(np.array(ca.DM(ca.densify(model.M)))), Fraction(model.theta), Fraction(model.gamma)
    found: dict[str, list[Any]] = {"inverses": [], "T": []}
    for h in np.unique(model.step if model.steps is None else model.steps):
        inverse = exact.inverse(M - Fraction(h) * (theta * A + gamma * K))
        if inverse is None:
            raise Unproved("W is singular")
        W = D + Fraction(h) * gamma * exact.product(C, inverse, B)
        T = exact.solve(W + W.T, B.T)
        found["inverses"].append(matrix(inverse))
        found["T"].append(None if T is None else matrix(T.T))
    return found


# -- oscillators and inclusions ---------------------------------------------------------------------------------------------


def _inside(model: Any, finding: Finding) -> dict[str, Any]:
    point = finding.witness.get("interior point", np.array(ca.DM(model.x0)).ravel())
    return {"interior": [text(entry) for entry in np.ravel(point)]}


def _oscillator(model: FrictionOscillator, data: Data, finding: Finding, value: dict[str, str]) -> list[Any]:
    if finding.id == "O-theta":
        return [{"theta": [_friction(program) for program in data["theta"]]}]
    if finding.id != "O-g":
        return [{}]
    atoms, n = verify.Atoms(), list(range(model.x.numel()))
    (p,) = atoms.read(data["g"])
    hint = _inside(model, finding) | convexity(p, n, atoms)
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


def _inclusion(model: MonotoneInclusion, data: Data, finding: Finding, value: dict[str, str]) -> list[Any]:
    if finding.id == "M-C":
        return [_inside(model, finding)]
    V = model.field - (model.operator if model.phi is None else ca.gradient(without_domain(model.phi, model.x, "phi"), model.x))
    if finding.id == "M-T":
        if model.phi is None:
            return [_cover(model.operator, model.x)]
        atoms = verify.Atoms()
        return [convexity(*atoms.read(data["phi"]), range(model.x.numel()), atoms)]
    if finding.id == "M-A2":
        return [{}]
    if finding.id == "M-A3":
        atoms = verify.Atoms()
        found = nowhere_negative(verify.dissipation(data, {"value": value}, atoms), atoms)
        if found is None:
            raise Unproved("the dissipation is not shown to be >= 0 by squares")
        return [_inside(model, finding) | found]
    return [_cover(V, model.x) if finding.id == "M-24" else {"cover": Grown()}]


__all__ = ["NoProgram", "Unproved", "covered", "proofs_of", "value_of"]
