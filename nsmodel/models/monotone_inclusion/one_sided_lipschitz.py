"""The one-sided Lipschitz constant of G = F - S: <G(x) - G(y), x - y> <= L |x - y|^2 (24).

(A1): is F continuous on C, and if not, where does it jump.
"""

from __future__ import annotations

from collections.abc import Iterator

import casadi as ca
import numpy as np

from nsmodel.hypotheses.findings import HOLDS, UNKNOWN, VIOLATED
from nsmodel.models.monotone_inclusion.field import SelectedField, boundary_jump, monotone_part, remove_continuous_terms
from nsmodel.models.monotone_inclusion.growth import affine_field
from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.proof import exact, extremum, interval_bounds
from nsmodel.proof.convex.sets import ConvexSet, has_interior
from nsmodel.proof.expression_graph import rewrite_nodes
from nsmodel.proof.jumps import SWITCH_OPERATIONS
from nsmodel.proof.verdict import HypothesisPart

ATTAINED_GAP = 1e-3  # A bound of L that is above an attained value by no more is not sought anew: no search can lower it further.


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
    falling = monotone_part(-(field.rest if alone is None else alone), field.C, signs_are_sets=False)
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
    best: HypothesisPart | None = None
    for given, G, (low, high), fast in tries:
        local = low is box[0]
        if best is not None and (local or best.value["L"] - best.value.get("attained", best.value["L"]) <= ATTAINED_GAP):
            break
        if (low > high).any() or not interval_bounds.is_continuous(G, field.x, low, high):
            continue
        J = ca.jacobian(G, field.x)
        sup = extremum.largest_eigenvalue((J + J.T) / 2, field.x, low, high, quick=fast)
        if np.isfinite(sup.bound) and (best is None or sup.bound < best.value["L"]):
            witness = {} if sup.at is None else {"attained near": sup.at}
            values = {"L": sup.bound + 0.0} | ({} if sup.at is None or G is not field.rest else {"attained": sup.value})
            how = f"{given}bounds of the eigenvalues of the symmetric Jacobian"
            best = HypothesisPart(HOLDS, how, values, witness, local)
    if best is not None:
        return best
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


FIELD_KINKS = {ca.OP_FABS: "fabs", ca.OP_FMAX: "fmax", ca.OP_FMIN: "fmin"}


def field_continuity(model: MonotoneInclusion, C: ConvexSet, box: tuple[np.ndarray, np.ndarray]) -> HypothesisPart:
    """(A1): F is continuous on C, or on a box of states."""
    F, x, x0 = model.field, model.x, np.array(ca.DM(model.x0)).ravel()
    kinks: list[str] = []
    rewrite_nodes(F, lambda op, args, old: kinks.append(FIELD_KINKS[op]), tuple(FIELD_KINKS), x, "field")
    note = f"; kinks: {', '.join(f'{kinks.count(name)} {name}' for name in dict.fromkeys(kinks))}" if kinks else ""
    value: dict[str, float] = {"kinks": len(kinks)}
    n = x.numel()
    F = remove_continuous_terms(F, C)
    for local, place, (low, high) in (
        (False, "", (np.full(n, -np.inf), np.full(n, np.inf))),
        (False, " on C", C.bounding_box),
        (True, "", (np.maximum(C.bounding_box[0], box[0]), np.minimum(C.bounding_box[1], box[1]))),
    ):
        if interval_bounds.is_continuous(F, x, low, high):
            return HypothesisPart(HOLDS, f"no operation of F jumps or has a pole{place}{note}", value, {}, local)
    jump = _find_field_jump(model.field, C, box, x0)
    if jump is not None:
        return jump
    edge = boundary_jump(model.field, C)
    if edge is not None:
        how = "F, as it is written, jumps from the boundary of C inwards: bounds of the two sides do not meet"
        return HypothesisPart(VIOLATED, how, {"jump": edge.size}, {"x": edge.at, "below": edge.below, "above": edge.above})
    return HypothesisPart(UNKNOWN, "an operation of F may jump or have a pole on the box; no jump was seen", {}, {})


def _find_field_jump(F: ca.SX, C: ConvexSet, box: tuple[np.ndarray, np.ndarray], x0: np.ndarray) -> HypothesisPart | None:
    """A point of C where F jumps: on both sides of the zero of a switching argument."""
    arguments: list[ca.SX] = []

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> None:
        arguments.append(args[0] if len(args) == 1 else args[0] - args[1])

    rewrite_nodes(F, rule, SWITCH_OPERATIONS, C.x, "field")
    for k, u in enumerate(arguments):
        point = switching_point(C, u, box, x0)
        if point is None:
            continue
        slope = np.array(ca.Function("slope", [C.x], [ca.gradient(u, C.x)])(point)).ravel()
        if not slope.any() or not np.isfinite(slope).all():
            continue
        below, above = (_one_sided_branch(F, C.x, k, side) for side in (-1, 1))
        for size in (1e-12, 1e-9, 1e-7):
            d = size * (1 + np.linalg.norm(point)) * slope / np.linalg.norm(slope)
            ends = point - d, point + d
            cell = np.minimum(*ends), np.maximum(*ends)
            signs = [interval_bounds.enclose(u, C.x, end, end) for end in ends]
            crosses = float(np.max(signs[0][1])) < 0 < float(np.min(signs[1][0]))
            if not crosses or any(C.interior_margin(end) is None for end in ends):
                continue
            left, right = (interval_bounds.enclose(part, C.x, *cell) for part in (below, above))
            gaps = np.maximum(np.maximum(left[0] - right[1], right[0] - left[1]), 0.0)
            if gaps.max() > 0 and np.isfinite([*left, *right]).all():
                how = "F jumps across a switching surface inside C: bounds of both sides around the point do not meet"
                middles = [((part[0] + part[1]) / 2).ravel() for part in (left, right)]
                values = {"jump": float(np.linalg.norm(gaps))}
                return HypothesisPart(
                    VIOLATED, how, values, {"x": point, "switch": str(u), "below": middles[0], "above": middles[1]}
                )
    return None


def _one_sided_branch(F: ca.SX, x: ca.SX, k: int, side: int) -> ca.SX:
    """F with its k-th switch put to what it is on one side of u = 0."""
    count = iter(range(10**6))

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX | None:
        if next(count) != k:
            return None
        up = side > 0
        values = {
            ca.OP_SIGN: side,
            ca.OP_FLOOR: up - 1,
            ca.OP_CEIL: up,
            ca.OP_LT: not up,
            ca.OP_LE: not up,
            ca.OP_EQ: 0,
            ca.OP_NE: 1,
        }
        return ca.SX(float(values[op]))

    return rewrite_nodes(F, rule, SWITCH_OPERATIONS, x, "field")
