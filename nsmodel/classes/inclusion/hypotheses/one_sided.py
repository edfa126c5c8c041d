"""The one-sided Lipschitz constant of G = F - S: <G(x) - G(y), x - y> <= L |x - y|^2 (24)."""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.hypotheses.growth import affine_field
from nsmodel.classes.inclusion.hypotheses.selected_field import SelectedField
from nsmodel.classes.inclusion.hypotheses.switches import monotone_part
from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED
from nsmodel.proof import exact, extremum, interval_bounds
from nsmodel.proof.convex.sets import ConvexSet, has_interior
from nsmodel.proof.verdict import HypothesisPart


def one_sided_lipschitz(
    field: SelectedField, region: tuple[np.ndarray, np.ndarray], *, quick: bool, alone: ca.SX | None = None
) -> HypothesisPart:
    """(24): L, on C where it can be had there, else on the box looked at.

    Args:
        field: G.
        region: lower, upper.
        quick: skip global searches.
        alone: F, where S is proved monotone on all of C: then L of F serves for G.
    """
    if field.jumps and alone is None:
        return _outward_jump(field)
    found = affine_field(field) if not field.jumps else None
    if found is not None and found.exact:
        A = exact.doubles(found.A)
        direction = np.linalg.eigh((A + A.T) / 2)[1][:, -1]
        how = "the largest eigenvalue of a constant matrix, rounded up (exact)"
        return HypothesisPart(HOLDS, how, {"L": exact.eigenvalue_upper_bound(found.A)}, {"direction": direction})
    hull, box = (
        field.C.bounding_box,
        (np.maximum(field.C.bounding_box[0], region[0]), np.minimum(field.C.bounding_box[1], region[1])),
    )
    whole = [] if field.jumps else [("", field.rest, hull, quick or not field.C.bounded), ("", field.rest, box, quick)]
    falling = monotone_part(-(field.rest if alone is None else alone), field.C)
    tries = whole[:1]
    if alone is not None:
        tries.append(("S being monotone, ", alone, hull, quick or not field.C.bounded))
    ridges = (
        []
        if not falling.ridges
        else [
            "beside nonincreasing functions of one direction, "
            if alone is None
            else "S and functions of one direction being monotone, "
        ]
    )
    tries += [(given, -falling.rest, hull, quick or not field.C.bounded) for given in ridges]
    tries += whole[1:] or ([("S being monotone, ", alone, box, quick)] if alone is not None else [])
    tries += [(given, -falling.rest, box, quick) for given in ridges]
    for given, G, (low, high), fast in tries:
        if (low > high).any() or not interval_bounds.is_continuous(G, field.x, low, high):
            continue
        J = ca.jacobian(G, field.x)
        sup = extremum.largest_eigenvalue((J + J.T) / 2, field.x, low, high, quick=fast)
        if np.isfinite(sup.bound):
            witness = {} if sup.at is None else {"attained near": sup.at}
            values = {"L": sup.bound + 0.0} | ({} if sup.at is None or G is not field.rest else {"attained": sup.value})
            how = f"{given}bounds of the eigenvalues of the symmetric Jacobian"
            return HypothesisPart(HOLDS, how, values, witness, low is box[0])
    if field.jumps:
        return _outward_jump(field)
    return HypothesisPart(UNKNOWN, "F - S is not proved continuous with a bounded Jacobian on the box looked at", {}, {})


def _outward_jump(field: SelectedField) -> HypothesisPart:
    """A jump that is no subdifferential: a point where it switches, and a direction along which G jumps outwards."""
    inner = np.asarray(
        has_interior(field.C, np.clip(np.zeros(field.C.n), *field.C.bounding_box)).witness.get(
            "interior point", np.zeros(field.C.n)
        )
    )
    places = ((jump, point) for jump in field.jumps for point in switching_points(field.C, jump.u, field.C.bounding_box, inner))
    for jump, point in places:
        f = ca.Function(
            "jump",
            [field.x],
            [ca.gradient(jump.u, field.x), ca.substitute(jump.B, field.l, ca.SX.zeros(field.l.shape)), jump.u],
        )
        a, B = (np.array(part).ravel() for part in f(point)[:2])
        if not (np.linalg.norm(a) > 0 and np.linalg.norm(B) > 0):
            continue  # Where u is flat its sign need not change.
        d = a / np.linalg.norm(a) - B / np.linalg.norm(B)
        if np.linalg.norm(d) < 1e-6:
            continue
        d = d / np.linalg.norm(d)
        rate = float((jump.lower - jump.upper) * (d @ B))
        step = 1e-6 * (1 + np.linalg.norm(point)) * d
        if rate > 0 and float(f(point + step)[2]) > 0 > float(f(point - step)[2]):
            how = "F - S jumps outwards across a switching surface: no L bounds the quotient (it grows like jump/distance)"
            return HypothesisPart(VIOLATED, how, {"jump along d": rate}, {"x": point, "direction": d, "switch": str(jump.u)})
    names = ", ".join(str(jump.u) for jump in field.jumps)
    how = f"the switches at {names} = 0 are no subdifferentials, and no point inside C was found where one jumps outwards"
    return HypothesisPart(UNKNOWN, how, {}, {})


def switching_point(C: ConvexSet, u: ca.SX, box: tuple[np.ndarray, np.ndarray], inner: np.ndarray) -> np.ndarray | None:
    """A point inside C with u = 0; None where none was found."""
    return next(switching_points(C, u, box, inner), None)


def switching_points(C: ConvexSet, u: ca.SX, box: tuple[np.ndarray, np.ndarray], inner: np.ndarray) -> Iterator[np.ndarray]:
    """Points inside C with u = 0, by Newton's method from points of a box and around a point inside."""
    f = ca.Function("u", [C.x], [u, ca.gradient(u, C.x)])
    low, high = (
        np.clip(end, -1e3, 1e3) for end in (np.maximum(C.bounding_box[0], box[0]), np.minimum(C.bounding_box[1], box[1]))
    )
    around_it = inner + np.random.default_rng(0).normal(size=(32, C.n)) * (1 + np.abs(inner))
    for start in np.vstack([extremum.samples(low, np.maximum(low, high), 32), inner, around_it]):
        x = _newton_zero(f, start)
        inside = np.isfinite(x).all() and C.interior_margin(x) is not None
        if inside and abs(float(f(x)[0])) <= 1e-9 * (1 + np.linalg.norm(x)):
            yield x


def _newton_zero(f: ca.Function, x: np.ndarray) -> np.ndarray:
    """Where Newton's method for u = 0 ends, from x; f: x -> u, its gradient."""
    with np.errstate(all="ignore"):  # It may run away.
        for _ in range(30):
            value, slope = float(f(x)[0]), np.array(f(x)[1]).ravel()
            if not (np.isfinite(value) and 0 < slope @ slope < np.inf and np.isfinite(x).all()):
                break
            x = x - value * slope / (slope @ slope)
    return x
