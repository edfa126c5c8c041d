"""The law and the matrices of event-driven integration as C: tables of numbers, or what is computed of the parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import casadi as ca
import numpy as np

from nsmodel.codegen.expression import c_function
from nsmodel.codegen.piece_scene import PieceSpec, matrix_product, nonzero_pattern
from nsmodel.codegen.tables import c_table
from nsmodel.pieces.sides import SlopeMatrix
from nsmodel.proof.sure import not_none

MAX_WRITTEN_TERMS = 24  # Terms of a product that are written out.
CHOICE_KINDS = ("side", "equal", "floor", "ceil", "toward zero", "nearest")  # As in c/pieces_events.c.


def product_functions(spec: PieceSpec) -> str:
    """B l and D l: written out where they have few entries."""
    (B, D, _), text = spec.matrices, ""
    if B is not None:
        places = np.argwhere(nonzero_pattern(B).T)
        terms = [f"    next[{i}] += factor*({_entry_text('B', B, k, (i, j))}*l[{j}]);\n" for k, (j, i) in enumerate(places)]
        terms = [terms[k] for k in np.lexsort(places.T)]
        loop = "    for (int j = 0; j < M; j++)\n        if (l[j] != 0)\n"
        loop += "            for (int e = B_start[j]; e < B_start[j + 1]; e++)\n"
        loop += "                next[B_row[e]] += factor*(B_value[e]*l[j]);\n"
        text += _solver_function("add_B", "double *restrict next, const double *l, double factor", _terms_or_loop(terms, loop))
    if D is not None and "FEED" in spec.flags:
        entries: list[list[str]] = [[f"h[{i}]"] for i in range(len(nonzero_pattern(D)))]
        for k, (i, j) in enumerate(np.argwhere(nonzero_pattern(D))):
            entries[i].append(f"{_entry_text('D', D, k, (i, j))}*l[{j}]")
        terms = [f"    y[{i}] = {' + '.join(row)};\n" for i, row in enumerate(entries)]
        loop = "    for (int i = 0; i < M; i++) {\n        y[i] = h[i];\n"
        loop += (
            "        for (int e = D_start[i]; e < D_start[i + 1]; e++)\n            y[i] += D_value[e]*l[D_column[e]];\n    }\n"
        )
        text += _solver_function("add_D", "double *restrict y, const double *h, const double *l", _terms_or_loop(terms, loop))
    return text


def _entry_text(name: str, A: SlopeMatrix, number: int, place: tuple[int, int]) -> str:
    """An entry of A, which is the one of this number among those that are stored."""
    return repr(float(A[place])) if isinstance(A, np.ndarray) else f"{name}_value[{number}]"


def _solver_function(name: str, arguments: str, body: str) -> str:
    unused = "" if "_value" in body else "    (void)s;\n"
    return f"static void {name}(const model_pieces *s, {arguments})\n{{\n{unused}{body}}}\n\n"


def _terms_or_loop(terms: list[str], loop: str) -> str:
    return "".join(terms) if len(terms) <= MAX_WRITTEN_TERMS else loop


@dataclass
class PieceTables:
    """Text of tables; columns that follow from the parameters, by the names of the tables in their place."""

    text: str = ""
    settable: dict[str, ca.SX] = field(default_factory=dict)

    def add(self, name: str, values: Any, size: str, comment: str = "") -> None:
        """A table of numbers, or of expressions of the parameters."""
        if isinstance(values, ca.SX):
            self.settable[name] = values
        else:
            self.text += c_table(name, values, size, comment)

    def sparse(self, name: str, A: SlopeMatrix, index: str) -> None:
        """The entries of each row of A."""
        nonzero = nonzero_pattern(A)
        rows, columns = np.nonzero(nonzero)
        starts, size = np.array([0, *accumulate(nonzero.sum(axis=1).tolist())]), str(max(len(rows), 1))
        self.text += c_table(f"{name}_start", starts, f"{len(nonzero)} + 1", kind="int")
        self.text += c_table(f"{name}_{index}", columns if len(columns) else np.zeros(1), size, kind="int")
        if isinstance(A, ca.SX):
            self.settable[f"{name}_value"] = ca.vertcat(*(A[i, j] for i, j in zip(rows.tolist(), columns.tolist(), strict=True)))
        else:
            self.text += c_table(f"{name}_value", A[rows, columns] if len(columns) else np.zeros(1), size)


def law_tables(spec: PieceSpec) -> PieceTables:
    """Those of the law and the matrices, and of what ends pieces."""
    flags, m, (B, D, C) = spec.flags, spec.sizes["M"], spec.matrices
    made = PieceTables()
    if spec.values:
        made.add("default_p", list(spec.values.values()), "MODEL_PIECES_NP")
    if spec.known:
        made.add("known_times", spec.known, "KNOWN_TIMES", "switch_times")
    if spec.columns.branches:
        _, columns, kinds = zip(*spec.columns.branches, strict=True)
        made.text += c_table("branch_column", columns, "CHOICES", kind="int")
        made.text += c_table("branch_kind", [CHOICE_KINDS.index(kind) for kind in kinds], "CHOICES", kind="int")
    if not m:
        return made
    for name, ends in zip(("lower", "upper"), spec.ends, strict=True):
        made.add(name, ends if isinstance(ends, ca.SX) else ends.ravel(), "M", "ends of the law" if name == "lower" else "")
    feeds = set(spec.slopes[1].sparsity().row())
    made.text += c_table("feeds", [i in feeds for i in range(m)], "M", "whether y_i depends on l directly", "int")
    if "LINEAR" not in flags:
        made.text += c_table("coupled", spec.problem.coupled.ravel(), "M*M", "whether g or h has a product of l_i and l_j", "int")
    if B is not None:
        made.sparse("B", B.T, "row")
    if D is not None and "FEED" in flags:
        made.sparse("D", D, "column")
    if C is not None and "SLOPES" not in flags:
        made.sparse("C", C, "column")
        made.sparse("W", matrix_product(_absolute(C), _absolute(not_none(B))), "column")
    if B is not None and D is not None and C is not None:
        W = matrix_product(C, B)
        if "DIAGONAL" in flags:
            made.add("W_inverse", 1 / (np.diag(W) if isinstance(W, np.ndarray) else ca.diag(W)), "M", "1/W_ii")
        else:
            made.add("D_dense", _flat_by_rows(D), "M*M")
            made.add("W_dense", _flat_by_rows(W), "M*M")
        if "GENERAL" in flags:
            made.add("C_dense", _flat_by_rows(C), "M*N")
            made.text += "#define C_AT(i, j) C_dense[(i)*N + (j)]\n"
    return made


def _absolute(A: SlopeMatrix) -> SlopeMatrix:
    return np.abs(A) if isinstance(A, np.ndarray) else ca.fabs(A)


def _flat_by_rows(A: SlopeMatrix) -> Any:
    return A.ravel() if isinstance(A, np.ndarray) else ca.vec(A.T)


def struct_members(settable: Mapping[str, ca.SX]) -> str:
    """The tables that follow from the parameters, as members."""
    return "".join(f"    double set_{name}[{values.numel()}];\n" for name, values in settable.items())


def set_tables_code(settable: Mapping[str, ca.SX], p: ca.SX) -> str:
    """``set_tables(s)``, which computes them, and the names by which they are read; "" where there are none."""
    if not settable:
        return ""
    out = {f"of_{name}": ca.densify(values) for name, values in settable.items()}
    made = c_function("tables_of_parameters", {"s->p": p}, out).replace("model_solver", "model_pieces")
    places = ", ".join(f"s->set_{name}" for name in settable)
    made += f"\nstatic void set_tables(model_pieces *s) {{ tables_of_parameters(s, {places}); }}\n\n"
    return made + "".join(f"#define {name} s->set_{name}\n" for name in settable)
