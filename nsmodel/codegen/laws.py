"""The residual of a row of a law as C, written by the formula that Python evaluates.

The curved sets of a law as C: the file of each kind that occurs, and functions that ask a block's kind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.codegen.expressions import c_table
from nsmodel.errors import CodegenError
from nsmodel.modeling.laws import LAW_C_FOLDER, Law
from nsmodel.modeling.laws.base import LawFactor
from nsmodel.solvers.residuals import ResidualOperations, box_residual


@dataclass(frozen=True)
class CText:
    """An expression of C, with the operators that the formula has."""

    text: str

    def __sub__(self, other: CText) -> CText:
        """The text of the difference of two names."""
        return CText(f"{self.text} - {other.text}")

    def __lt__(self, other: float) -> CText:
        """A comparison of a name with a number."""
        return CText(f"{self.text} < {other:g}")

    def __gt__(self, other: float) -> CText:
        """A comparison of a name with a number."""
        return CText(f"{self.text} > {other:g}")

    def __str__(self) -> str:
        """The expression in C."""
        return self.text


class _BoundNames(NamedTuple):
    """The ends of a row by their names in C."""

    lower: CText
    upper: CText


def _c_call(name: str) -> Any:
    return lambda *given: CText(f"{name}({', '.join(map(str, given))})")


def _unsupported_operation(*given: Any) -> CText:
    raise NotImplementedError("the residual of a row needs no masks")


C_OPERATIONS = ResidualOperations(
    abs=_c_call("fabs"),
    max=_c_call("max_of"),
    min=_c_call("min_of"),
    where=lambda condition, a, b: CText(f"{condition} ? {a} : {b}"),
    choose=_unsupported_operation,
    largest=_unsupported_operation,
    lesser=lambda a, b, end: CText(f"min_of({a},\n                  is_finite({end}) ? {b} : INFINITY)"),
    ratio=_c_call("ratio"),
)


def row_residual_code() -> str:
    """The value of ``row_residual`` in `affine.c`."""
    lo, up, l, y, s_y, s_l = map(CText, ("lo", "up", "l", "y", "s_y", "s_l"))
    law: Any = _BoundNames(lo, up)
    return str(box_residual(law, l, y, s_y, s_l, C_OPERATIONS))


# What laws/NAME.c answers: NAME_question(m, numbers, ...).
SET_OPERATIONS = {
    "project": ("void", "double *u", "u = P_K(u)"),
    "jacobian": ("void", "const double *u, double *J", "J (m, m): an element of the generalised Jacobian of P_K at u"),
    "code": (
        "int",
        "const double *u",
        "where P_K(u) lies, u = l - c y: 0 where y = 0, -1 where l = 0, +1 on the boundary",
    ),
    "onto_boundary": ("void", "double *l", "the l near this one that lies on the curved boundary"),
    "selected": ("void", "const double *y, double *l", "the l in K with -y ∈ N_K(l), y not 0; 0 where K is not bounded"),
    "radius": ("double", "", "max |l| over K"),
    "valid": ("int", "", "whether the numbers are those of a set"),
    "shift": ("void", "double *y", "y = ŷ(y)"),
    "shift_jacobian": ("void", "const double *y, double *J", "J (m, m): an element of the generalised Jacobian of ŷ at y"),
    "boundary_ray": (
        "int",
        "const double *l, const double *y, double *ray",
        "whether l keeps to a ray of the boundary, where y_1 = 0 then; its first entry is 1",
    ),
    "block_solution": (
        "int",
        "const double *W, const double *b, double *l",
        "whether there is a direct way to the l of y = W l + b of this block alone",
    ),
}
# What a kind answers whose file does not have the question.
DEFAULT_ANSWERS = {
    "shift": "(void)y",
    "shift_jacobian": "unit_matrix(k->size, J)",
    "boundary_ray": "return 0",
    "block_solution": "return 0",
}


def curved_blocks(law: Law) -> list[tuple[slice, LawFactor]]:
    """The rows of the blocks that are no boxes."""
    return [(rows, block) for rows, block in law.parts() if not block.separable]


def curved_block_numbers(law: Law) -> ca.SX:
    """What the blocks' files read, one block after the other."""
    return ca.vertcat(ca.SX(0, 1), *(block.c_numbers() for _, block in curved_blocks(law)))


def curved_sets_code(law: Law, of_parameters: bool) -> str:
    """The blocks, their numbers where no parameters give them, and the questions."""
    blocks, kinds = curved_blocks(law), sorted({block.kind for _, block in curved_blocks(law)})
    sizes = [block.c_numbers().numel() for _, block in blocks]
    rows = [
        f"{{{kinds.index(block.kind)}, {rows.start}, {block.size}, {at}}}"
        for (rows, block), at in zip(blocks, np.cumsum([0, *sizes]), strict=False)
    ]
    lines = [
        "/* Curved blocks: kind, first row, rows, where their numbers begin. */\n",
        "typedef struct { int kind, start, size, numbers; } curved_block;\n",
        f"static const curved_block curved[MODEL_CURVED] = {{{', '.join(rows)}}};\n",
    ]
    if of_parameters:
        lines.append("#define NUMBERS(k) (s->curved_numbers + curved[k].numbers)\n")
    else:
        values = np.array(ca.DM(curved_block_numbers(law))).ravel().tolist()
        lines.append(c_table("curved_numbers", values or [0.0], "MODEL_NUMBERS"))
        lines.append("#define NUMBERS(k) (curved_numbers + curved[k].numbers)\n")
    lines += [_set_source(kind) for kind in ("norm", *kinds)]
    return "".join(lines) + "".join(_set_function(kinds, name) for name in SET_OPERATIONS)


def _set_source(kind: str) -> str:
    path = LAW_C_FOLDER / f"{kind}.c"
    if not path.exists():
        raise CodegenError(f"law: a set of kind '{kind}' has no C ({path.name} beside {kind}.py); run it interpreted")
    return path.read_text(encoding="utf-8")


def _set_function(kinds: Sequence[str], name: str) -> str:
    """A function that asks the kind of a block."""
    returns, arguments, what = SET_OPERATIONS[name]
    given = "".join(", " + part.split()[-1].lstrip("*") for part in arguments.split(",") if part)
    word = "" if returns == "void" else "return "
    calls = [
        f"{word}{kind}_{name}(k->size, numbers{given})"
        if name not in DEFAULT_ANSWERS or f" {kind}_{name}(" in _set_source(kind)
        else DEFAULT_ANSWERS[name]
        for kind in kinds
    ]
    body = "".join(
        f"    if (k->kind == {i}) {{\n        {call};\n" + ("        return;\n    }\n" if not word else "    }\n")
        for i, call in enumerate(calls[:-1])
    )
    head = f"static {returns} set_{name}(const curved_block *k, const double *numbers{', ' * bool(arguments)}{arguments})"
    return f"\n/* {what[0].upper()}{what[1:]}. */\n{head}\n{{\n{body}    {calls[-1]};\n}}\n"
