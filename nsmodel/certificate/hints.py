"""What helps to verify a finding: its numbers with a little room, and matrices, vectors and covers of boxes.

A cover is grown by asking ``verify`` itself: a part on which its inequality fails is halved, until all parts pass or there are
too many.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.certificate import verify
from nsmodel.certificate.data import reach_of
from nsmodel.certificate.graph import NoProgram, graph, matrix, text
from nsmodel.hypotheses.findings import Finding
from nsmodel.hypotheses.lure import domains
from nsmodel.hypotheses.sweeping.forms import Affine
from nsmodel.hypotheses.sweeping.geometry import mfcq_constant
from nsmodel.hypotheses.sweeping.shapes import read_shapes
from nsmodel.model.base import Model
from nsmodel.model.first_order import FirstOrderSystem
from nsmodel.model.lure import LureSystem
from nsmodel.model.sweeping import SweepingProcess
from nsmodel.proof import exact, feasibility

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


def proof_of(model: Model, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction) -> Any:
    """The hints for a finding; numbers that ``verify`` needs and the finding does not have are added to ``value``.

    Raises:
        Unproved, NoProgram: there are none.
    """
    if isinstance(model, SweepingProcess):
        return _sweeping(model, finding, findings, room)
    if isinstance(model, LureSystem):
        return _lure(model, finding)
    if isinstance(model, FirstOrderSystem):
        return _first_order(model, finding, value)
    if finding.id in ("M-T", "M-A2", "M-A3", "M-24") and model.sign_symbols.numel():
        raise Unproved("the operator has switches")
    if finding.id == "O-g" and "lower bound of g" not in value:
        raise Unproved("no lower bound of g is stated")
    point = finding.witness.get("interior point", np.array(ca.DM(model.x0)).ravel())
    return {"interior": [text(entry) for entry in np.ravel(point)], "cover": Grown()}


# -- covers ------------------------------------------------------------------------------------------------------------


class Grown:
    """A cover that is found while ``verify`` asks for it; ``hint`` gives what a part is to be shown with."""

    def __init__(self, hint: Callable[[list[Any]], Any] = lambda box: None) -> None:
        self.hint, self.tree = hint, None


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
    count = 0

    def passes(part: list[Any], hint: Any) -> bool:
        try:
            return bool(leaf(part, hint))
        except (verify.Undefined, AssertionError):
            return False

    def grow(part: list[Any], depth: int) -> Any:
        nonlocal count
        count += 1
        if count > MOST_PARTS or depth > DEEP:
            raise TooManyParts(f"a cover of the box takes more than {MOST_PARTS} parts")
        hint = grown.hint(part)
        if passes(part, hint):
            return hint
        widths = [float(x.hi - x.lo) / (float(y.hi - y.lo) or 1.0) for x, y in zip(part, box, strict=True)]
        k = int(np.argmax(widths))
        middle = (part[k].lo + part[k].hi) / 2
        sides = verify.Interval(part[k].lo, middle), verify.Interval(middle, part[k].hi)
        return [k, *(grow([*part[:k], side, *part[k + 1 :]], depth + 1) for side in sides)]

    return grow(list(box), 0)


# -- sweeping processes --------------------------------------------------------------------------------------------------


def _sweeping(model: SweepingProcess, finding: Finding, findings: Mapping[str, Finding], room: Fraction) -> Any:
    if finding.id == "S-f":
        graph(model.f, ca.vertcat(model.t, model.q), ["t", *(model.names or ())])  # it may not be written
    if finding.id in ("S-f", "S-start"):
        return {"time": Grown(), "cover": Grown()}
    if finding.id in ("A5", "A5'"):
        if len(model.multiplier_names) > 1 and (finding.scope is None or not finding.scope.states):
            raise Unproved("gamma of several constraints, for all states")
        return {"cover": Grown(_escape(model))}
    shapes = read_shapes(model.g, model.q) if model.multiplier_names else []
    return {"constraints": [_constraint(model, k, shape, finding, findings, room) for k, shape in enumerate(shapes)]}


def _constraint(
    model: SweepingProcess, k: int, shape: Any, finding: Finding, findings: Mapping[str, Finding], room: Fraction
) -> dict[str, Any]:
    """The form of one constraint: affine, a norm or the distance to a segment, else bounds over the box."""
    if shape.kind == "plane":
        return {"form": "affine", "time": Grown()}
    if shape.kind == "distance":
        hint = _norm(model, shape)
        if hint is not None:
            return hint
    local = finding.scope is not None and bool(finding.scope.states)
    if finding.id == "S-convex" and not local:
        return {"form": "rules"}
    if not local and finding.id not in ("A2", "A3", "A4"):
        raise Unproved(f"constraint '{model.multiplier_names[k]}': a form that is not written down here")
    b = finding.value.get("b") if finding.id == "A1" else findings["A1"].value.get("b") if "A1" in findings else None
    if b is None:
        raise Unproved("no bound of the gradients is known")
    return {"form": "box", "b": text(Fraction(b) * (1 + room / 2)), "cover": Grown()}


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


def _lure(model: LureSystem, finding: Finding) -> Any:
    if finding.id in ("5.1", "5.2"):
        name = "P" if finding.id == "5.1" else "P_omega"
        P = finding.witness.get(f"{name} exactly") or finding.witness.get(name)
        if P is None:
            raise Unproved("too large a P to write down")
        return {"P": [[entry if isinstance(entry, str) else text(entry) for entry in row] for row in P]}
    if finding.id in ("5.4a", "5.4c", "5.x0", "7.1"):
        return _in_range(
            model, None if finding.id in ("5.4a", "5.4c") else np.array(ca.DM(model.x0)).ravel() * (finding.id == "5.x0")
        )
    return {}


def _in_range(model: LureSystem, x: np.ndarray | None) -> Any:
    """x, k, y, v with C x = D'k + y + S v, k and y inside, of a law of boxes; empty where nothing is asked.

    Columns of the homogeneous system: tau > 0, l - low tau > 0 (or high tau - l), where both ends are finite also their sum,
    y > 0 or < 0 where one end is, v, and x where it is not given.
    """
    if model.law is None or any(block.kind != "box" for block in model.law.blocks):
        raise Unproved("a law that is no box")
    m, n = model.law.size, model.x.numel()
    C, D = (exact.rational(np.array(ca.DM(part)).reshape(part.shape)) for part in (model.C, model.D))
    low, high = (np.concatenate(ends) for ends in zip(*(domains.ends(block) for block in model.law.blocks), strict=True))
    bounded = np.isfinite(low) & np.isfinite(high)
    if bounded.all() or exact.psd(D).definite:
        return {}
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
    if finding.id not in ("F-step", "F-W"):
        raise Unproved("no proof of this kind is written down here")
    steps = model.steps if model.steps is not None else [model.step]
    value["h"] = text(np.max(steps))
    inverse = exact.inverse(exact.rational(np.array(ca.DM(ca.densify(model.M)))))
    if inverse is None:
        raise Unproved("M is singular")
    return {"inverse": matrix(inverse), "cover": Grown()}


__all__ = ["NoProgram", "Unproved", "covered", "proof_of", "value_of"]
