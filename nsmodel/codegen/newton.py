"""The functions and tables of a step by Newton's method (see ``c/newton.c``)."""

from __future__ import annotations

import casadi as ca

from nsmodel.codegen.expression import c_function
from nsmodel.codegen.scene import Scene
from nsmodel.codegen.tables import exact_tables, table
from nsmodel.solve.rounding import error_bound, is_bounded_by_terms
from nsmodel.solve.structure import is_transposed


def text(scene: Scene, known: dict[str, ca.SX]) -> str:
    """The C functions and tables; ``known`` are t, h, the state and the parameters by their C names."""
    p, structure, sparse, m = scene.problem, scene.structure, scene.by_rows, scene.structure.m
    E_z, E_l, Y_z, Y_l = scene.jacobians
    multiplier = {"l": p.l} if m else {}
    no_l, no_z = ca.SX.zeros(p.l.shape), ca.SX.zeros(p.z.shape)
    guess_0 = _put(p.guess, [p.l], [no_l])
    E_guess = _put(p.E, [p.z, p.l], [guess_0, no_l])
    values = {"E": p.E} | ({"Y": p.Y} if m else {})
    entries = {"E_z": E_z, "Y_z": ca.SX(Y_z.T.nz[:]) if sparse else Y_z, "E_l": ca.SX(E_l.nz[:]) if sparse else E_l, "Y_l": Y_l}
    read = {name: entries[name] for name in matrices(scene)}
    guesses = {"z": p.guess, "guess_0": guess_0, "E_guess": E_guess}
    tables, functions = [], [c_function("guess", known | multiplier, guesses, "the first z, with l and without; E there")]
    if structure.affine:
        constant = {f"{key}_0": _put(e, [p.z, p.l], [no_z, no_l]) for key, e in values.items()}
        functions += [
            c_function("matrices", known, read, "the Jacobians of E and Y"),
            c_function("constant_part", known, constant, "E and Y at z = 0, l = 0"),
        ]
    else:
        at = known | {"z": p.z} | multiplier
        settled, values["E"] = p.settled
        if p.explicit:
            read = {"given": settled[list(p.explicit)]} | read
            tables.append(table("explicit_column", p.explicit, "MODEL_EXPLICIT", "unknowns that their own rows give", "int"))
        functions.append(c_function("linearise", at, values | read, "E, Y and their Jacobians"))
    if not bounded_by_terms(scene):
        bound = error_bound(ca.vertcat(*values.values()), ca.vertcat(p.z, p.l))
        errors = {"error_E": bound[: p.z.numel()]} | ({"error_Y": bound[p.z.numel() :]} if m else {})
        functions.append(
            c_function("round_off", known | {"z": p.z} | multiplier, errors, "running error bounds of E and Y, in EPS/2")
        )
    if p.overreach is not None:
        functions.append(
            c_function("overreach", known | {"z": p.z}, {"ratio": p.overreach}, "how far Y is from what it linearises")
        )
    if sparse:
        tables += [
            table("Y_z_start", Y_z.T.sparsity().colind(), "MODEL_M + 1", "Y_z by rows", "int"),
            table("Y_z_column", Y_z.T.sparsity().row(), "MODEL_Y_Z", kind="int"),
            table("E_l_start", E_l.sparsity().colind(), "MODEL_M + 1", "E_l by columns", "int"),
            table("E_l_row", E_l.sparsity().row(), "MODEL_E_L", kind="int"),
        ]
    tables.append(exact_tables(structure))
    if structure.unit_rows:
        rows = [row for row, *_ in structure.unit_rows]
        functions.append(c_function("unit_offsets", known, {"offset": _put(p.Y, [p.z, p.l], [no_z, no_l])[rows]}))
    return "".join(tables) + "\n" + "\n".join(functions)


def matrices(scene: Scene) -> list[str]:
    """Names of the Jacobians that the code evaluates."""
    names = [] if scene.structure.identity else ["E_z"]
    if scene.structure.m:
        names += ["Y_z"] if transposed(scene) else ["Y_z", "E_l"]
        names += ["Y_l"] if scene.jacobians[3].nnz() else []
    return names


def bounded_by_terms(scene: Scene) -> bool:
    """Whether the rounding of the rows is bounded by their terms: the matrices tell it."""
    p = scene.problem
    return is_bounded_by_terms(ca.vertcat(p.E if scene.structure.affine else p.settled[1], p.Y))


def outputs(scene: Scene) -> list[str]:
    """What the code evaluates beside E and Y: unknowns that their own rows give, and Jacobians."""
    return ["given"] * (not scene.structure.affine and bool(scene.problem.explicit)) + matrices(scene)


def transposed(scene: Scene) -> bool:
    """Whether E_l = -Y_z' entry for entry."""
    _, E_l, Y_z, _ = scene.jacobians
    return bool(scene.structure.m) and is_transposed(E_l, Y_z)


def _put(expression: ca.SX, symbols: list[ca.SX], values: list[ca.SX]) -> ca.SX:
    """The expression with symbols replaced."""
    return ca.substitute([expression], symbols, values)[0] if expression.numel() else expression
