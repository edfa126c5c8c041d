"""The functions and tables of a step by Newton's method (see ``c/newton.c``)."""

from __future__ import annotations

import casadi as ca

from nsmodel.codegen.expression import c_function
from nsmodel.codegen.scene import StepSpec
from nsmodel.codegen.tables import c_table, exact_tables
from nsmodel.solve.rounding import rounding_error_bound, uses_term_bound
from nsmodel.solve.structure import is_negative_transpose


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
