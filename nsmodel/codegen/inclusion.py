"""The functions and tables of catching-up with approximate projections (see ``c/inclusion.c``)."""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.codegen.expression import c_function, number
from nsmodel.codegen.scene import INCLUSION, Scene
from nsmodel.codegen.tables import table
from nsmodel.errors import CodegenError
from nsmodel.laws import Law
from nsmodel.proof.sure import sure
from nsmodel.scheme.problem import Prediction
from nsmodel.solve.certificate import NumericLaw, numeric_law
from nsmodel.solve.layout import Layout
from nsmodel.solve.projection import interior_point, row_layout


def flags(scene: Scene) -> dict[str, bool]:
    """What the step of an inclusion needs; nothing for other models."""
    if scene.path != INCLUSION:
        return {}
    given = _given(scene)
    approximate = given.tolerances is not None
    cuts = approximate and given.box is None
    return {
        "SELECTION": given.l.numel() > 0,
        "SELECTION_CURVED": bool(selection_law(scene).curved),
        "BOX_C": given.box is not None,
        "MOVING_BOX": _moving_box(scene, given),
        "CONSTRAINED": given.c.numel() > 0,
        "APPROXIMATE": approximate,
        "CUTS": cuts,
        "GRAM": given.l.numel() > 0 or cuts,
        "TOLERANCE_OF_NUMBER": approximate and len(scene.allowed) > 1,
    }


def projects(scene: Scene) -> bool:
    """Whether a step solves the projection problem exactly."""
    given = scene.problem.prediction
    return given is not None and given.box is None and (not scene.allowed or min(scene.allowed) == 0)


def one_step(scene: Scene) -> bool:
    """Whether the step is that of the tolerance."""
    given = scene.problem.prediction
    return given is not None and callable(given.tolerances) and len(scene.allowed) == 1


def sizes(scene: Scene, known: dict[str, int]) -> dict[str, int]:
    """The sizes of its arrays."""
    if scene.path != INCLUSION:
        return {}
    n, m, given, has = known["NX"], known["M"], _given(scene), flags(scene)
    cuts = min(60 * m, max(4 * m, 4 * n + 2 * m)) if has["CUTS"] else 0
    selected = given.l.numel() + m if has["SELECTION"] else 0
    rows = max(known["ROWS"], cuts, selected)
    finite = selection_law(scene)
    boxes = int((np.isfinite(finite.lower) & np.isfinite(finite.upper)).sum())
    return {
        "SELECTION": given.l.numel(),
        "CUTS": cuts,
        "ROWS": rows,
        "LEMKE": max(known["LEMKE"], rows + boxes),
        "CURVED": len(finite.curved) if has["SELECTION"] else known["CURVED"],
    }


def layout(scene: Scene) -> Layout:
    """A packed row of a run."""
    return Layout.of(scene.problem) if scene.problem.prediction is None else row_layout(scene.problem, scene.problem.prediction)


def text(scene: Scene) -> str:
    """The C functions and tables."""
    given, problem, has = _given(scene), scene.problem, flags(scene)
    parameters = {"s->p": problem.p} if problem.p.numel() else {}
    known = {"s->t": problem.t, "s->x": given.x} | parameters
    A = ca.densify(ca.jacobian(given.velocity, given.l))
    at_zero = ca.substitute([given.velocity], [given.l], [ca.SX.zeros(given.l.shape)])[0]
    parts, tables = [], []
    if has["SELECTION"]:
        parts.append(
            c_function("velocity", known, {"v_0": at_zero, "A": A, "u": given.u}, "F - S = v_0 + A l, with -u in N_K(l)")
        )
        law = selection_law(scene)
        tables += [table("face_lower", law.lower, "MODEL_SELECTION"), table("face_upper", law.upper, "MODEL_SELECTION")]
    else:
        parts.append(c_function("velocity", known, {"v_0": at_zero}, "F - S"))
    if given.box is not None and has["MOVING_BOX"]:
        lower, upper = given.box
        box = {"lower": ca.densify(lower), "upper": ca.densify(upper)}
        parts.append(c_function("bounds", {"time": problem.t} | parameters, box, "C = [lower, upper]"))
        tables.append("#define X_LOWER s->inclusion.x_lower\n#define X_UPPER s->inclusion.x_upper\n")
    elif given.box is not None:
        bounds = (np.array(ca.DM(b)).ravel() for b in given.box)
        tables += [table(name, b, "MODEL_NX") for name, b in zip(("x_lower", "x_upper"), bounds, strict=True)]
        tables.append("#define X_LOWER x_lower\n#define X_UPPER x_upper\n")
    if has["CONSTRAINED"]:
        at = {"time": problem.t, "z": given.x} | parameters
        rows = {"c": given.c, "J": ca.jacobian(given.c, given.x)}
        parts.append(c_function("constraints", at, rows, "C = {c >= 0}, and the Jacobian"))
    if has["CUTS"]:
        numbers, x0 = scene.problem_of_numbers, np.array(ca.DM(scene.numbers.start)).ravel()
        tables.append(table("interior", interior_point(sure(numbers.prediction), numbers.t)(0.0, x0, np.zeros(0)), "MODEL_NX"))
    if has["TOLERANCE_OF_NUMBER"]:
        tables.append(table("eps", scene.allowed, str(len(scene.allowed)), "eps_k"))
        last = len(scene.allowed) - 1
        parts.append(
            f"static double allowed(const model_solver *s) {{ return eps[s->number < {last} ? (long)s->number : {last}]; }}\n"
        )
    elif has["APPROXIMATE"]:
        parts.append(f"static double allowed(const model_solver *s) {{ (void)s; return {number(scene.allowed[0]).text}; }}\n")
    return "".join(tables) + "\n" + "\n".join(parts)


def _moving_box(scene: Scene, given: Prediction) -> bool:
    return given.box is not None and ca.depends_on(ca.vertcat(*given.box), scene.problem.t)


def _given(scene: Scene) -> Prediction:
    """The prediction; refused where a parameter of the code moves what is written down as numbers, or time what is so in C."""
    given, model, t = sure(scene.problem.prediction), scene.model, scene.problem.t
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


def selection_law(scene: Scene) -> NumericLaw:
    """The law of the discontinuous part."""
    return numeric_law(sure(scene.problem_of_numbers.prediction).law)


def law_of_sets(scene: Scene) -> Law:
    """The law that has the curved sets: that of the step, or of the selection."""
    own = scene.problem.law
    given = scene.problem_of_numbers.prediction
    return own if given is None or not own.is_box else given.law
