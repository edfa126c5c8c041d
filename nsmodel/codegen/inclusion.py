"""The functions and tables of catching-up with approximate projections (see ``c/inclusion.c``)."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nsmodel.classes.inclusion.schemes import catching_up
from nsmodel.codegen.expression import c_function, number
from nsmodel.codegen.scene import INCLUSION, Scene
from nsmodel.codegen.tables import table
from nsmodel.errors import CodegenError
from nsmodel.laws import Law
from nsmodel.solve.certificate import NumericLaw, numeric_law
from nsmodel.solve.layout import Layout
from nsmodel.solve.projection import interior_point, row_layout


def flags(scene: Scene) -> dict[str, bool]:
    """What the step of an inclusion needs; nothing for other models."""
    if scene.path != INCLUSION:
        return {}
    model, chosen = _model(scene), _selection(scene)
    constrained = catching_up.constraints(model)[0].numel() > 0
    approximate = model.tolerances is not None
    cuts = approximate and bool(model.constraints)
    return {
        "SELECTION": chosen.l.numel() > 0,
        "SELECTION_CURVED": bool(selection_law(scene).curved),
        "BOX_C": not model.constraints,
        "CONSTRAINED": constrained,
        "APPROXIMATE": approximate,
        "CUTS": cuts,
        "GRAM": chosen.l.numel() > 0 or cuts,
        "TOLERANCE_OF_NUMBER": approximate and len(scene.allowed) > 1,
    }


def projects(scene: Scene) -> bool:
    """Whether a step solves the projection problem exactly."""
    return scene.path == INCLUSION and bool(scene.model.constraints) and (not scene.allowed or min(scene.allowed) == 0)


def one_step(scene: Scene) -> bool:
    """Whether the step is that of the tolerance."""
    return scene.path == INCLUSION and callable(scene.model.tolerances) and len(scene.allowed) == 1


def sizes(scene: Scene, known: dict[str, int]) -> dict[str, int]:
    """The sizes of its arrays."""
    if scene.path != INCLUSION:
        return {}
    n, m, chosen, has = known["NX"], known["M"], _selection(scene), flags(scene)
    cuts = min(60 * m, max(4 * m, 4 * n + 2 * m)) if has["CUTS"] else 0
    selected = chosen.l.numel() + m if has["SELECTION"] else 0
    rows = max(known["ROWS"], cuts, selected)
    finite = selection_law(scene)
    boxes = int((np.isfinite(finite.lower) & np.isfinite(finite.upper)).sum())
    return {
        "SELECTION": chosen.l.numel(),
        "CUTS": cuts,
        "ROWS": rows,
        "LEMKE": max(known["LEMKE"], rows + boxes),
        "CURVED": len(finite.curved) if has["SELECTION"] else known["CURVED"],
    }


def layout(scene: Scene) -> Layout:
    """A packed row of a run."""
    return row_layout(scene.problem, _selection(scene)) if scene.path == INCLUSION else Layout.of(scene.problem)


def text(scene: Scene) -> str:
    """The C functions and tables."""
    model, chosen, has = _model(scene), _selection(scene), flags(scene)
    known = {"s->x": model.x, "s->p": model.p} if model.p.numel() else {"s->x": model.x}
    A = ca.densify(ca.jacobian(chosen.velocity, chosen.l))
    at_zero = ca.substitute([chosen.velocity], [chosen.l], [ca.SX.zeros(chosen.l.shape)])[0]
    parts, tables = [], []
    if has["SELECTION"]:
        parts.append(
            c_function("velocity", known, {"v_0": at_zero, "A": A, "u": chosen.u}, "F - S = v_0 + A l, with -u in N_K(l)")
        )
        law = selection_law(scene)
        tables += [table("face_lower", law.lower, "MODEL_SELECTION"), table("face_upper", law.upper, "MODEL_SELECTION")]
    else:
        parts.append(c_function("velocity", known, {"v_0": at_zero}, "F - S"))
    if has["BOX_C"]:
        bounds = (np.array(ca.DM(b)).ravel() for b in (model.lower, model.upper))
        tables += [table(name, b, "MODEL_NX") for name, b in zip(("x_lower", "x_upper"), bounds, strict=True)]
    c, _ = catching_up.constraints(model)
    if has["CONSTRAINED"]:
        at = {"z" if key == "s->x" else key: symbol for key, symbol in known.items()}
        parts.append(c_function("constraints", at, {"c": c, "J": ca.jacobian(c, model.x)}, "C = {c >= 0}, and the Jacobian"))
    if has["CUTS"]:
        numbers: Any = scene.numbers
        x0 = np.array(ca.DM(numbers.x0)).ravel()
        tables.append(table("interior", interior_point(numbers, catching_up.constraints(numbers)[0], x0), "MODEL_NX"))
    if has["TOLERANCE_OF_NUMBER"]:
        tables.append(table("eps", scene.allowed, str(len(scene.allowed)), "eps_k"))
        last = len(scene.allowed) - 1
        parts.append(
            f"static double allowed(const model_solver *s) {{ return eps[s->number < {last} ? (long)s->number : {last}]; }}\n"
        )
    elif has["APPROXIMATE"]:
        parts.append(f"static double allowed(const model_solver *s) {{ (void)s; return {number(scene.allowed[0]).text}; }}\n")
    return "".join(tables) + "\n" + "\n".join(parts)


def _model(scene: Scene) -> Any:
    """The model; refused where a parameter of the code moves what is written down as numbers."""
    model = scene.model
    fixed = ca.vertcat(ca.SX(0, 1), model.lower, model.upper, _selection(scene).law.numbers)
    if model.p.numel() and fixed.numel() and ca.depends_on(fixed, model.p):
        held = {str(s) for s in ca.symvar(fixed)}
        name = next(name for name in model.parameters if name in held)
        raise CodegenError(
            f"parameter '{name}' bounds the set or the operator, which are numbers in the code: give it with --set {name}=VALUE"
        )
    return model


def selection_law(scene: Scene) -> NumericLaw:
    """The law of the discontinuous part."""
    return numeric_law(catching_up.selection(scene.numbers).law)


def law_of_sets(scene: Scene) -> Law:
    """The law that has the curved sets: that of the step, or of the selection."""
    own = scene.problem.law
    return own if not own.is_box or scene.path != INCLUSION else catching_up.selection(scene.numbers).law


def _selection(scene: Scene) -> catching_up.Selection:
    return catching_up.selection(scene.model)
