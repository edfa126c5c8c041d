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
    p, structure = scene.problem, scene.structure
    tables, functions = [], [_guess(scene, known), *_linearisation(scene, known)]
    if not structure.affine and p.explicit:
        tables.append(table("explicit_column", p.explicit, "MODEL_EXPLICIT", "unknowns that their own rows give", "int"))
    if not bounded_by_terms(scene):
        functions.append(_round_off(scene, known))
    if p.overreach is not None:
        functions.append(
            c_function("overreach", known | {"z": p.z}, {"ratio": p.overreach}, "how far Y is from what it linearises")
        )
    tables += [*(_sparsity_tables(scene) if scene.by_rows else []), exact_tables(structure)]
    if structure.unit_rows:
        rows = [row for row, *_ in structure.unit_rows]
        functions.append(c_function("unit_offsets", known, {"offset": _at_zero(scene, p.Y)[rows]}))
    return "".join(tables) + "\n" + "\n".join(functions)


def _guess(scene: Scene, known: dict[str, ca.SX]) -> str:
    p = scene.problem
    no_l = ca.SX.zeros(p.l.shape)
    guess_0 = _put(p.guess, [p.l], [no_l])
    E_guess = _put(p.E, [p.z, p.l], [guess_0, no_l])
    guesses = {"z": p.guess, "guess_0": guess_0, "E_guess": E_guess}
    return c_function("guess", known | _multiplier(scene), guesses, "the first z, with l and without; E there")


def _linearisation(scene: Scene, known: dict[str, ca.SX]) -> list[str]:
    """The functions of E, Y and their Jacobians."""
    p, structure, m = scene.problem, scene.structure, scene.structure.m
    E_z, E_l, Y_z, Y_l = scene.jacobians
    by_rows = {"Y_z": ca.SX(Y_z.T.nz[:]), "E_l": ca.SX(E_l.nz[:])} if scene.by_rows else {}
    entries = {"E_z": E_z, "Y_z": Y_z, "E_l": E_l, "Y_l": Y_l} | by_rows
    read = {name: entries[name] for name in matrices(scene)}
    if structure.affine:
        constant = {"E_0": _at_zero(scene, p.E)} | ({"Y_0": _at_zero(scene, p.Y)} if m else {})
        return [
            c_function("matrices", known, read, "the Jacobians of E and Y"),
            c_function("constant_part", known, constant, "E and Y at z = 0, l = 0"),
        ]
    settled, E = p.settled
    given = {"given": settled[list(p.explicit)]} if p.explicit else {}
    values = {"E": E} | ({"Y": p.Y} if m else {}) | given | read
    return [c_function("linearise", known | {"z": p.z} | _multiplier(scene), values, "E, Y and their Jacobians")]


def _round_off(scene: Scene, known: dict[str, ca.SX]) -> str:
    p, n = scene.problem, scene.problem.z.numel()
    rows = [p.E if scene.structure.affine else p.settled[1], *([p.Y] if scene.structure.m else [])]
    bound = error_bound(ca.vertcat(*rows), ca.vertcat(p.z, p.l))
    errors = {"error_E": bound[:n]} | ({"error_Y": bound[n:]} if scene.structure.m else {})
    return c_function("round_off", known | {"z": p.z} | _multiplier(scene), errors, "running error bounds of E and Y, in EPS/2")


def _sparsity_tables(scene: Scene) -> list[str]:
    """Where the entries of Jacobians that are kept by rows stand."""
    _, E_l, Y_z, _ = scene.jacobians
    return [
        table("Y_z_start", Y_z.T.sparsity().colind(), "MODEL_M + 1", "Y_z by rows", "int"),
        table("Y_z_column", Y_z.T.sparsity().row(), "MODEL_Y_Z", kind="int"),
        table("E_l_start", E_l.sparsity().colind(), "MODEL_M + 1", "E_l by columns", "int"),
        table("E_l_row", E_l.sparsity().row(), "MODEL_E_L", kind="int"),
    ]


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


def _multiplier(scene: Scene) -> dict[str, ca.SX]:
    return {"l": scene.problem.l} if scene.structure.m else {}


def _at_zero(scene: Scene, expression: ca.SX) -> ca.SX:
    """The expression at z = 0, l = 0."""
    z, l = scene.problem.z, scene.problem.l
    return _put(expression, [z, l], [ca.SX.zeros(z.shape), ca.SX.zeros(l.shape)])


def _put(expression: ca.SX, symbols: list[ca.SX], values: list[ca.SX]) -> ca.SX:
    """The expression with symbols replaced."""
    return ca.substitute([expression], symbols, values)[0] if expression.numel() else expression
