"""The functions and tables of a step by Newton's method (see ``c/newton.c``).

The functions and tables of catching-up with approximate projections (see ``c/inclusion.c``).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nsmodel.codegen.expressions import c_function, c_number, c_table, exact_tables
from nsmodel.codegen.step_spec import INCLUSION, StepSpec
from nsmodel.errors import CodegenError
from nsmodel.modeling.laws import Law
from nsmodel.proof.verdict import not_none
from nsmodel.solvers.catching_up import catching_up_layout, interior_point_search
from nsmodel.solvers.one_step_problem import Prediction
from nsmodel.solvers.residuals import NumericLaw, numeric_law
from nsmodel.solvers.rounding_errors import rounding_error_bound, uses_term_bound
from nsmodel.solvers.step import RowLayout
from nsmodel.solvers.structure import is_negative_transpose


def newton_code(spec: StepSpec, known: dict[str, ca.SX]) -> str:
    """The C functions and tables; ``known`` are t, h, the state and the parameters by their C names."""
    p, structure = spec.problem, spec.structure
    tables, functions = [], [_guess(spec, known), *_linearisation(spec, known)]
    if not structure.affine and p.explicit:
        tables.append(c_table("explicit_column", p.explicit, "MODEL_EXPLICIT", "unknowns that their own rows give", "int"))
    if not is_rounding_bounded_by_terms(spec):
        functions.append(_round_off(spec, known))
    if p.overreach is not None:
        functions.append(
            c_function("overreach", known | {"z": p.z}, {"ratio": p.overreach}, "how far Y is from what it linearises")
        )
    tables += [*(_sparsity_tables(spec) if spec.uses_working_set else []), exact_tables(structure)]
    if structure.unit_rows:
        rows = [row for row, *_ in structure.unit_rows]
        functions.append(c_function("unit_offsets", known, {"offset": _evaluate_at_zero(spec, p.Y)[rows]}))
    return "".join(tables) + "\n" + "\n".join(functions)


def _guess(spec: StepSpec, known: dict[str, ca.SX]) -> str:
    p = spec.problem
    no_l = ca.SX.zeros(p.l.shape)
    guess_0 = _substitute(p.guess, [p.l], [no_l])
    E_guess = _substitute(p.E, [p.z, p.l], [guess_0, no_l])
    guesses = {"z": p.guess, "guess_0": guess_0, "E_guess": E_guess}
    return c_function("guess", known | _multiplier_symbols(spec), guesses, "the first z, with l and without; E there")


def _linearisation(spec: StepSpec, known: dict[str, ca.SX]) -> list[str]:
    """The functions of E, Y and their Jacobians."""
    p, structure, m = spec.problem, spec.structure, spec.structure.m
    E_z, E_l, Y_z, Y_l = spec.jacobians
    by_rows = {"Y_z": ca.SX(Y_z.T.nz[:]), "E_l": ca.SX(E_l.nz[:])} if spec.uses_working_set else {}
    entries = {"E_z": E_z, "Y_z": Y_z, "E_l": E_l, "Y_l": Y_l} | by_rows
    read = {name: entries[name] for name in evaluated_jacobians(spec)}
    if structure.affine:
        constant = {"E_0": _evaluate_at_zero(spec, p.E)} | ({"Y_0": _evaluate_at_zero(spec, p.Y)} if m else {})
        return [
            c_function("matrices", known, read, "the Jacobians of E and Y"),
            c_function("constant_part", known, constant, "E and Y at z = 0, l = 0"),
        ]
    explicit_z, E = p.explicit_eliminated
    given = {"given": explicit_z[list(p.explicit)]} if p.explicit else {}
    values = {"E": E} | ({"Y": p.Y} if m else {}) | given | read
    return [c_function("linearise", known | {"z": p.z} | _multiplier_symbols(spec), values, "E, Y and their Jacobians")]


def _round_off(spec: StepSpec, known: dict[str, ca.SX]) -> str:
    p, n = spec.problem, spec.problem.z.numel()
    rows = [p.E if spec.structure.affine else p.explicit_eliminated[1], *([p.Y] if spec.structure.m else [])]
    bound = rounding_error_bound(ca.vertcat(*rows), ca.vertcat(p.z, p.l))
    errors = {"error_E": bound[:n]} | ({"error_Y": bound[n:]} if spec.structure.m else {})
    return c_function(
        "round_off", known | {"z": p.z} | _multiplier_symbols(spec), errors, "running error bounds of E and Y, in EPS/2"
    )


def _sparsity_tables(spec: StepSpec) -> list[str]:
    """Where the entries of Jacobians that are kept by rows stand."""
    _, E_l, Y_z, _ = spec.jacobians
    return [
        c_table("Y_z_start", Y_z.T.sparsity().colind(), "MODEL_M + 1", "Y_z by rows", "int"),
        c_table("Y_z_column", Y_z.T.sparsity().row(), "MODEL_Y_Z", kind="int"),
        c_table("E_l_start", E_l.sparsity().colind(), "MODEL_M + 1", "E_l by columns", "int"),
        c_table("E_l_row", E_l.sparsity().row(), "MODEL_E_L", kind="int"),
    ]


def evaluated_jacobians(spec: StepSpec) -> list[str]:
    """Names of the Jacobians that the code evaluates."""
    names = [] if spec.structure.identity else ["E_z"]
    if spec.structure.m:
        names += ["Y_z"] if is_jacobian_transposed(spec) else ["Y_z", "E_l"]
        names += ["Y_l"] if spec.jacobians[3].nnz() else []
    return names


def is_rounding_bounded_by_terms(spec: StepSpec) -> bool:
    """Whether the rounding of the rows is bounded by their terms: the matrices tell it."""
    p = spec.problem
    return uses_term_bound(ca.vertcat(p.E if spec.structure.affine else p.explicit_eliminated[1], p.Y))


def evaluated_outputs(spec: StepSpec) -> list[str]:
    """What the code evaluates beside E and Y: unknowns that their own rows give, and Jacobians."""
    return ["given"] * (not spec.structure.affine and bool(spec.problem.explicit)) + evaluated_jacobians(spec)


def is_jacobian_transposed(spec: StepSpec) -> bool:
    """Whether E_l = -Y_z' entry for entry."""
    _, E_l, Y_z, _ = spec.jacobians
    return bool(spec.structure.m) and is_negative_transpose(E_l, Y_z)


def _multiplier_symbols(spec: StepSpec) -> dict[str, ca.SX]:
    return {"l": spec.problem.l} if spec.structure.m else {}


def _evaluate_at_zero(spec: StepSpec, expression: ca.SX) -> ca.SX:
    """The expression at z = 0, l = 0."""
    z, l = spec.problem.z, spec.problem.l
    return _substitute(expression, [z, l], [ca.SX.zeros(z.shape), ca.SX.zeros(l.shape)])


def _substitute(expression: ca.SX, symbols: list[ca.SX], values: list[ca.SX]) -> ca.SX:
    """The expression with symbols replaced."""
    return ca.substitute([expression], symbols, values)[0] if expression.numel() else expression


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
        "MOVING_BOX": given.box is not None and ca.depends_on(ca.vertcat(*given.box), spec.problem.t),
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


def _supported_prediction(spec: StepSpec) -> Prediction:
    """The prediction; refused where a parameter of the code moves what is written down as numbers, or time what is so in C."""
    given, model, t = not_none(spec.problem.prediction), spec.model, spec.problem.t
    faces = ca.vertcat(given.u, given.c)
    if given.l.numel() and ca.depends_on(faces, t):
        raise CodegenError("sign or another jump of S together with a moving set or switching surface has no counterpart in C")
    if given.tolerances is not None and given.box is None and ca.depends_on(given.c, t):
        raise CodegenError("tolerances of the projection on a moving set have no counterpart in C; leave tolerances out")
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
