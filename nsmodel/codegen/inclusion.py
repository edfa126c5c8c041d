"""The functions and tables of catching-up with approximate projections (see ``c/inclusion.c``)."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.codegen.expression import c_function, c_number
from nsmodel.codegen.scene import INCLUSION, StepSpec
from nsmodel.codegen.tables import c_table
from nsmodel.errors import CodegenError
from nsmodel.laws import Law
from nsmodel.proof.sure import not_none
from nsmodel.scheme.problem import Prediction
from nsmodel.solve.certificate import NumericLaw, numeric_law
from nsmodel.solve.layout import RowLayout
from nsmodel.solve.projection import catching_up_layout, interior_point_search


def inclusion_flags(spec: StepSpec) -> dict[str, bool]:
    """What the step of an inclusion needs; nothing for other models."""
    if spec.path != INCLUSION:
        return {}
    given = _supported_prediction(spec)
    approximate = given.tolerances is not None
    cuts = approximate and given.box is None
    return {
        "SELECTION": given.l.numel() > 0,
        "SELECTION_CURVED": bool(selection_law(spec).curved),
        "BOX_C": given.box is not None,
        "MOVING_BOX": _moving_box(spec, given),
        "CONSTRAINED": given.c.numel() > 0,
        "APPROXIMATE": approximate,
        "CUTS": cuts,
        "GRAM": given.l.numel() > 0 or cuts,
        "TOLERANCE_OF_NUMBER": approximate and len(spec.allowed) > 1,
    }


def solves_projection(spec: StepSpec) -> bool:
    """Whether a step solves the projection problem exactly."""
    given = spec.problem.prediction
    return given is not None and given.box is None and (not spec.allowed or min(spec.allowed) == 0)


def is_step_fixed_by_tolerance(spec: StepSpec) -> bool:
    """Whether the step is that of the tolerance."""
    given = spec.problem.prediction
    return given is not None and callable(given.tolerances) and len(spec.allowed) == 1


def inclusion_sizes(spec: StepSpec, known: dict[str, int]) -> dict[str, int]:
    """The sizes of its arrays."""
    if spec.path != INCLUSION:
        return {}
    n, m, given, has = known["NX"], known["M"], _supported_prediction(spec), inclusion_flags(spec)
    cuts = min(60 * m, max(4 * m, 4 * n + 2 * m)) if has["CUTS"] else 0
    selected = given.l.numel() + m if has["SELECTION"] else 0
    rows = max(known["ROWS"], cuts, selected)
    finite = selection_law(spec)
    boxes = int((np.isfinite(finite.lower) & np.isfinite(finite.upper)).sum())
    return {
        "SELECTION": given.l.numel(),
        "CUTS": cuts,
        "ROWS": rows,
        "LEMKE": max(known["LEMKE"], rows + boxes),
        "CURVED": len(finite.curved) if has["SELECTION"] else known["CURVED"],
    }


def packed_layout(spec: StepSpec) -> RowLayout:
    """A packed row of a run."""
    return (
        RowLayout.of(spec.problem)
        if spec.problem.prediction is None
        else catching_up_layout(spec.problem, spec.problem.prediction)
    )


def inclusion_code(spec: StepSpec) -> str:
    """The C functions and tables."""
    given, problem, has = _supported_prediction(spec), spec.problem, inclusion_flags(spec)
    parameters = {"s->p": problem.p} if problem.p.numel() else {}
    known = {"s->t": problem.t, "s->x": given.x} | parameters
    A = ca.densify(ca.jacobian(given.velocity, given.l))
    at_zero = ca.substitute([given.velocity], [given.l], [ca.SX.zeros(given.l.shape)])[0]
    parts, tables = [], []
    if has["SELECTION"]:
        parts.append(
            c_function("velocity", known, {"v_0": at_zero, "A": A, "u": given.u}, "F - S = v_0 + A l, with -u in N_K(l)")
        )
        law = selection_law(spec)
        tables += [c_table("face_lower", law.lower, "MODEL_SELECTION"), c_table("face_upper", law.upper, "MODEL_SELECTION")]
    else:
        parts.append(c_function("velocity", known, {"v_0": at_zero}, "F - S"))
    if given.box is not None and has["MOVING_BOX"]:
        lower, upper = given.box
        box = {"lower": ca.densify(lower), "upper": ca.densify(upper)}
        parts.append(c_function("bounds", {"time": problem.t} | parameters, box, "C = [lower, upper]"))
        tables.append("#define X_LOWER s->inclusion.x_lower\n#define X_UPPER s->inclusion.x_upper\n")
    elif given.box is not None:
        bounds = (np.array(ca.DM(b)).ravel() for b in given.box)
        tables += [c_table(name, b, "MODEL_NX") for name, b in zip(("x_lower", "x_upper"), bounds, strict=True)]
        tables.append("#define X_LOWER x_lower\n#define X_UPPER x_upper\n")
    if has["CONSTRAINED"]:
        at = {"time": problem.t, "z": given.x} | parameters
        rows = {"c": given.c, "J": ca.jacobian(given.c, given.x)}
        parts.append(c_function("constraints", at, rows, "C = {c >= 0}, and the Jacobian"))
    if has["CUTS"]:
        numbers, x0 = spec.numeric_problem, np.array(ca.DM(spec.numbers.start)).ravel()
        tables.append(
            c_table("interior", interior_point_search(not_none(numbers.prediction), numbers.t)(0.0, x0, np.zeros(0)), "MODEL_NX")
        )
    if has["TOLERANCE_OF_NUMBER"]:
        tables.append(c_table("eps", spec.allowed, str(len(spec.allowed)), "eps_k"))
        last = len(spec.allowed) - 1
        parts.append(
            f"static double allowed(const model_solver *s) {{ return eps[s->number < {last} ? (long)s->number : {last}]; }}\n"
        )
    elif has["APPROXIMATE"]:
        parts.append(f"static double allowed(const model_solver *s) {{ (void)s; return {c_number(spec.allowed[0]).text}; }}\n")
    return "".join(tables) + "\n" + "\n".join(parts)


def _moving_box(spec: StepSpec, given: Prediction) -> bool:
    return given.box is not None and ca.depends_on(ca.vertcat(*given.box), spec.problem.t)


def _supported_prediction(spec: StepSpec) -> Prediction:
    """The prediction; refused where a parameter of the code moves what is written down as numbers, or time what is so in C."""
    given, model, t = not_none(spec.problem.prediction), spec.model, spec.problem.t
    faces = ca.vertcat(given.u, given.c)
    if given.l.numel() and ca.depends_on(faces, t):
        raise CodegenError("sign or another jump of S beside a set or a switching surface that moves has no counterpart in C")
    if given.tolerances is not None and given.box is None and ca.depends_on(given.c, t):
        raise CodegenError("tolerances of the projection on a set that moves have no counterpart in C; leave tolerances out")
    box = () if given.box is None else given.box
    fixed = ca.vertcat(ca.SX(0, 1), *box, given.law.numbers)
    if model.p.numel() and fixed.numel() and ca.depends_on(fixed, model.p):
        held = {str(s) for s in ca.symvar(fixed)}
        name = next(name for name in model.parameters if name in held)
        raise CodegenError(
            f"parameter '{name}' bounds the set or the operator, which are numbers in the code: give it with --set {name}=VALUE"
        )
    return given


def selection_law(spec: StepSpec) -> NumericLaw:
    """The law of the discontinuous part."""
    return numeric_law(not_none(spec.numeric_problem.prediction).law)


def curved_set_law(spec: StepSpec) -> Law:
    """The law that has the curved sets: that of the step, or of the selection."""
    own = spec.problem.law
    given = spec.numeric_problem.prediction
    return own if given is None or not own.is_box else given.law
