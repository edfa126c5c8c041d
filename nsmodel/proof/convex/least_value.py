"""The least value of a potential on a convex set: exactly for a quadratic, else by IPOPT with kinks as constraints."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.proof import exact, extremum, polynomial
from nsmodel.proof.convex.convex_sets import ConvexSet
from nsmodel.proof.graph import rewrite_nodes, stack_column
from nsmodel.proof.quiet import suppress_output

BOUNDARY_SAMPLES = 512
MINIMISER_OPTIONS = {
    "print_time": False, "error_on_fail": False, "show_eval_warnings": False, "ipopt.print_level": 0, "ipopt.sb": "yes",
    "ipopt.max_iter": 200, "ipopt.tol": 1e-10, "ipopt.bound_relax_factor": 0.0,
}  # fmt: skip


def minimise_potential(g: ca.SX, C: ConvexSet, start: np.ndarray) -> tuple[np.ndarray, float]:
    """(a point of C, the least value of g met), in doubles: the exact minimum of a quadratic, else by IPOPT."""
    f = ca.Function("g", [C.x], [g])
    candidates = [start, np.zeros(C.n)]
    if C.rows.numel() > len(C.affine):  # Along a curved boundary IPOPT may run away; these show that g falls there.
        candidates += list(extremum.samples(*C.bounding_box, BOUNDARY_SAMPLES))
    P = polynomial.as_quadratic(polynomial.read_polynomials(g, C.x)[0], C.n)
    if P is not None:
        solved = exact.solve_linear_system(P.H, -P.q)
        candidates += [exact.doubles(solved).ravel()] if solved is not None else []
    if P is None or C.rows.numel():
        for point in _ipopt_candidates(g, C, start):
            candidates += [np.round(point, digits) for digits in (2, 4, 6, 8)] + [point]
    points = np.array(candidates)
    rows = C.values(points)
    inside = (rows >= -1e-12 * (1 + np.abs(points).max(axis=1, keepdims=True))).all(axis=1)
    values = np.array(f(points.T)).ravel()
    values = np.where(inside & np.isfinite(values), values, np.inf)
    k = int(np.argmin(values))
    return points[k], float(values[k])


def _ipopt_candidates(g: ca.SX, C: ConvexSet, start: np.ndarray) -> list[np.ndarray]:
    """Points of C where g may be least: |u| and max(u, v) replaced by levels above them, roots rounded off; and g as it is."""
    levels, rows = [], []
    softness = ca.SX.sym("softness")

    def rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX:
        if op == ca.OP_SQRT:
            return ca.sqrt(args[0] + softness)
        level = ca.SX.sym(f"level{len(levels)}")
        rows.extend([level - args[0], level - (-args[0] if op == ca.OP_FABS else args[1])])
        levels.append((level, old))
        return level

    def concave_rule(op: int, args: list[ca.SX], old: ca.SX) -> ca.SX:
        if op != ca.OP_FMIN:
            return rule(op, args, old)
        level = ca.SX.sym(f"level{len(levels)}")
        rows.extend([args[0] - level, args[1] - level])
        levels.append((level, old))
        return level

    smooth = rewrite_nodes(g, rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_SQRT), C.x, "potential")
    # Concave rows hold |u| and max with weights < 0, min with weights > 0; other points fail the test of the caller.
    domain = (
        rewrite_nodes(C.rows, concave_rule, (ca.OP_FABS, ca.OP_FMAX, ca.OP_FMIN), C.x, "domain") if C.rows.numel() else C.rows
    )
    symbols = stack_column(level for level, _ in levels)
    above = ca.Function("above", [C.x], [stack_column(old for _, old in levels)])
    problem = {"x": ca.vertcat(C.x, symbols), "f": smooth, "g": ca.vertcat(domain, *rows), "p": softness}
    point, found = start, []
    with suppress_output():
        solver = ca.nlpsol("least", "ipopt", problem, MINIMISER_OPTIONS)
        for soft in (1e-8, 1e-16) if ca.depends_on(smooth, softness) else (0.0,):
            answer = np.array(solver(x0=ca.vertcat(point, above(point)), lbg=0, p=soft)["x"]).ravel()[: C.n]
            point = answer if np.isfinite(answer).all() else point
        found.append(point)
        direct = ca.nlpsol("least", "ipopt", {"x": C.x, "f": g, "g": C.rows}, MINIMISER_OPTIONS)
        found.append(np.array(direct(x0=start, lbg=0)["x"]).ravel())
    return [point for point in found if np.isfinite(point).all()]
