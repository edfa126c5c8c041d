"""The C of event-driven integration: a model's series, matrices and law beside the fragments `c/pieces*`.

The law and the matrices of event-driven integration as C: tables of numbers, or what is computed of the parameters.

The algorithms, scales, constants and their order are those of `event_driven`. Series of f, g and h are fused: sums are
expressions, and only what a recurrence reads is stored. Flags say what a model needs: numbers for B, D and C, with the matrices
of the last modes kept; a diagonal W without any matrix; slopes printed where they move; whether uniqueness is no work, because
every matrix of the law is a P-matrix or the model is monotone. The first orders of a mode that was just chosen are continued
where nothing is nonlinear in l (elsewhere their last bits would depend on where a run was resumed), and another unit of time, a
power of two, scales them. Lower bounds that cost less are asked before Bernstein's test and before the size of a row on the
piece; they decide nothing else. Pieces by collocation are made in C up to 32 states and rows, beyond that by the integrator:
complex pairs are real blocks of twice the size, inverted once a length; those of lengths that are powers of two are kept while
the slopes stay the same bits. One library serves every rtol, and work is bounded a piece and a call.

What C leaves out returns a status and the place as it was: a start that jumps, modes that go apart, accumulation, and every error
with its words. Where pivoting does not settle, modes are guessed by Laplace transforms of germs, in the units that there are, up
to 32 states and rows. Germs are judged without the running error analysis of `ModeSystem.rounding`. Friction blocks are refused:
they are interpreted.

Whether a model with values switches as the code of all values does: C and the integrator take over from each other.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import Any

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.codegen import laws, structs
from nsmodel.codegen.event_driven_spec import (
    PieceSpec,
    collocation_code,
    matrix_product,
    nonzero_pattern,
    piece_spec_of,
    tangent_code,
)
from nsmodel.codegen.expressions import c_function, c_table
from nsmodel.codegen.fragments import (
    BOX_CONSTANTS,
    C_FOLDER,
    PIECE_CONSTANTS,
    comment_text,
    compiler_guard,
    define_lines,
    prefix_names,
    prune_unused,
    read_fragment,
)
from nsmodel.codegen.recurrences import recurrence_kernels, switch_scales_code
from nsmodel.codegen.structs import PIECE_BATCH_CELLS, RUN_REQUEST
from nsmodel.event_driven.modes import FEW, LAPLACE_SHARES
from nsmodel.event_driven.multipliers import state_motion
from nsmodel.event_driven.problem import ContinuousProblem
from nsmodel.event_driven.radau import SlopeMatrix, fixed_branches
from nsmodel.event_driven.recurrences import independent_branches
from nsmodel.modeling.base import Model
from nsmodel.proof.verdict import not_none
from nsmodel.solvers.rounding_errors import rounding_error_bound
from nsmodel.solvers.step import UNKNOWN_INDEX

# Terms of a product that are written out, each on a line; longer ones are a loop, which is slower and shorter.
MAX_PRODUCT_TERMS = 24
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
    return f"static void {name}(const model_pieces *s, {arguments})\n{{\n    (void)s;\n{body}}}\n\n"


def _terms_or_loop(terms: list[str], loop: str) -> str:
    return "".join(terms) if len(terms) <= MAX_PRODUCT_TERMS else loop


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
        printers = sorted(spec.printers.values(), key=lambda made: made.offset)
        nested = [not own for one in printers for own in independent_branches(one.jets)]
        made.text += c_table("branch_nested", nested, "CHOICES", "whether it looks at what others choose, or an l", "int")
    if not m:
        return made
    for name, ends in zip(("lower", "upper"), spec.ends, strict=True):
        made.add(name, ends if isinstance(ends, ca.SX) else ends.ravel(), "M", "ends of the law" if name == "lower" else "")
    feeds = set(spec.slopes[1].sparsity().row())
    made.text += c_table("feeds", [i in feeds for i in range(m)], "M", "whether y_i depends on l directly", "int")
    if "GUESSED" in flags:
        made.add("laplace_shares", LAPLACE_SHARES, str(len(LAPLACE_SHARES)), "1/s in units of time")
    groups = [min(group) for group in spec.problem.row_groups]
    made.text += c_table("row_group", groups, "M", "the first of the rows that this one is tied to", "int")
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


def set_tables_code(settable: Mapping[str, ca.SX], p: ca.SX) -> str:
    """``set_tables(s)``, which computes them, and the names by which they are read; "" where there are none."""
    if not settable:
        return ""
    out = {f"of_{name}": ca.densify(values) for name, values in settable.items()}
    made = c_function("tables_of_parameters", {"s->p": p}, out).replace("model_solver", "model_pieces")
    places = ", ".join(f"s->set_{name}" for name in settable)
    made += f"\nstatic void set_tables(model_pieces *s) {{ tables_of_parameters(s, {places}); }}\n\n"
    return made + "".join(f"#define {name} s->set_{name}\n" for name in settable)


PIECE_FRAGMENTS = (
    "pieces_modes", "pieces_expand", "pieces_guess", "pieces_events", "pieces_discs", "pieces_schwarz", "pieces_roots",
    "pieces_cover", "pieces_radau", "pieces_stiff", "pieces",
)  # fmt: skip


def piece_library_files(model: Model, values: Mapping[str, float], name: str) -> dict[str, str]:
    """NAME_pieces.h and NAME_pieces.c, to be compiled beside a library."""
    spec, title = piece_spec_of(model, values), model.title or type(model).__name__
    return {
        f"{name}_pieces.h": piece_header(spec, name, title, f"{name}.h"),
        f"{name}_pieces.c": piece_code(spec, name, title, runs=False),
    }


def piece_header(spec: PieceSpec, name: str, title: str, shared: str | None) -> str:
    """NAME_pieces.h; ``shared``: the header that has the statuses, None where they stand here."""
    return read_fragment("pieces_header.h", spec.flags, _piece_replacements(spec, name, title, shared))


def piece_code(spec: PieceSpec, name: str, title: str, *, runs: bool) -> str:
    """NAME_pieces.c; ``runs``: with what whole runs need."""
    replacements = _piece_replacements(spec, name, title, None) | {"KINDS": spec.discs.kinds(), "TABLE": spec.discs.table()}
    own = prefix_names(_model_code(spec), name)
    own += prefix_names(_record_functions(spec), name) if runs else ""

    def part(fragment: str) -> str:
        text = read_fragment(f"{fragment}.c", spec.flags, replacements)
        return spec.discs.prune_interpreter(text) if fragment == "pieces_discs" else text

    boxes = [prefix_names(box_problem_code(spec), name)] if "GUESSED" in spec.flags else []
    tangents = ["pieces_tangents"] if "TANGENTS" in spec.flags else []
    more = ["pieces_api", *(["pieces_rollout", *tangents, "pieces_batch"] if runs else [])]
    return prune_unused("\n".join([part("pieces_prelude"), part("common"), *boxes, own, *map(part, [*PIECE_FRAGMENTS, *more])]))


BOX_FRAGMENTS = ("solvers", "linear", "affine", "lemke")
BOX_FLAGS = frozenset({"BOX_PROBLEM", "PIVOTING", "INVERSE", "AFFINE_PROBLEM"})
BOX_SIZES = {"MODEL_ROWS": "MODEL_PIECES_M", "MODEL_LEMKE": "MODEL_PIECES_LEMKE", "MODEL_LINEAR": "MODEL_PIECES_LEMKE"}


def box_problem_code(spec: PieceSpec) -> str:
    """``affine_solve`` of steps, on a `model_box`, with names of its own for what pieces have too."""
    flags = _box_flags(spec)
    given = {"SOLVERS": structs.solver_enum(), "ROW_RESIDUAL": laws.row_residual_code()}
    text = "\n".join([define_lines(BOX_CONSTANTS), *(read_fragment(f"{part}.c", flags, given) for part in BOX_FRAGMENTS)])
    shared = {name.rpartition(":")[2] for _, names in BOX_CONSTANTS for name in names.split()} | {"NONE", "codes"}
    return _renamed(text, {name: f"BOX_{name}" for name in shared})


def _box_flags(spec: PieceSpec) -> frozenset[str]:
    return BOX_FLAGS | ({"ENUMERATION", "INDEX_SETS"} if spec.sizes["M"] <= FEW else set())


def _renamed(text: str, names: Mapping[str, str]) -> str:
    names = {**names, **BOX_SIZES, "model_solver": "model_box"}
    return re.sub(r"\w+", lambda match: names.get(match[0], match[0]), text)


def _piece_replacements(spec: PieceSpec, name: str, title: str, shared: str | None) -> dict[str, str]:
    replacements = {key: str(value) for key, value in spec.sizes.items()}
    replacements |= {
        "NAME": name, "TITLE": comment_text(title) or name, "GUARD": compiler_guard(), "KNOWN_TIMES": str(len(spec.known)),
        "CONSTANTS": define_lines(PIECE_CONSTANTS),
        "STATUSES": prefix_names(structs.status_enum(), name) if shared is None else f'#include "{shared}"',
    }  # fmt: skip
    replacements |= {"ASKED": prefix_names(RUN_REQUEST.c(), name), "PIECE_CELLS": prefix_names(PIECE_BATCH_CELLS.c(), name)}
    box = _renamed(read_fragment("members_affine.h", _box_flags(spec), {}), {}) if "GUESSED" in spec.flags else ""
    replacements["BOX_MEMBERS"] = prefix_names(box, name)
    settable = law_tables(spec).settable  # What follows from the parameters, as members.
    replacements["SET"] = "".join(f"    double set_{name}[{values.numel()}];\n" for name, values in settable.items())
    replacements["STRUCT"] = read_fragment("pieces_struct.h", spec.flags, replacements)
    return replacements


def _record_functions(spec: PieceSpec) -> str:
    """The columns of a trajectory, for whole runs."""
    p = spec.problem
    all_of = ca.veccat(p.h, *p.columns.values())
    given = {"t": p.t, "x": p.x, "l": p.l} | ({"s->p": p.p} if p.p.numel() else {})
    own = ca.SX(0, 1) if p.multipliers is None else p.multipliers
    numbers = {"RECORDS": all_of.numel(), "SHOWN": own.numel(), "IMPULSES": int(p.impulses), "FEEDS": int("FEED" in spec.flags)}
    text = "".join(f"#define {name} {value}\n" for name, value in {**numbers, "NO_CODE": UNKNOWN_INDEX}.items())
    text += _piece_c_function("records", given, {"out": all_of})
    return text + (_piece_c_function("own_multipliers", given, {"out": own}) if own.numel() else "")


def _model_code(spec: PieceSpec) -> str:
    """The model's own tables and functions."""
    p, flags, n, m = spec.problem, spec.flags, spec.sizes["N"], spec.sizes["M"]
    listed = law_tables(spec)
    parts = [
        listed.text, set_tables_code(listed.settable, p.p), recurrence_kernels("COLUMNS"),
        (C_FOLDER / "pieces_series.c").read_text(encoding="utf-8"), product_functions(spec),
    ]  # fmt: skip
    plain = "B_NUMBERS" in flags or not m
    targets = {
        "f": [f"next[{i}] = factor*{{}};" if plain else f"s->f[{i}] = {{}};" for i in range(n)],
        "g": [f"s->value[{i}] = {{}};" for i in range(n)],
        "h": [f"c[{(spec.sizes['H'] if {'FEED', 'D_NUMBERS'} <= flags else n + m) + i}] = {{}};" for i in range(m)],
    }  # fmt: skip
    given = {"f": ", double factor, double *restrict next"}
    parts += [printer.text(targets[name], given.get(name, "")) for name, printer in spec.printers.items() if m or name == "f"]
    own = {"s->p": p.p} if p.p.numel() else {}
    given = {"t": p.t, "x": p.x, "l": p.l} | own
    parts.append(_piece_c_function("equations", given, {"rate": p.f + p.g, "y": p.h}))
    parts.append(
        _piece_c_function("rounding", given, {"bound": rounding_error_bound(ca.densify(p.f + p.g), ca.veccat(p.t, p.x, p.l))})
    )
    sizes, moved = state_motion(p)
    parts.append(_piece_c_function("moves", sizes | own, {"moved": moved}))
    parts += [collocation_code(spec, given)] if "STIFF" in flags else []
    parts += [tangent_code(spec, given)] if "TANGENTS" in flags else []
    if "SLOPES" in flags:
        parts.append(_piece_c_function("slopes", given, dict(zip("BDC", spec.slopes, strict=True))))
    parts += [_piece_c_function("start", own, {"x": ca.SX(p.x0)}), switch_scales_code(spec.printers)]
    numbers = [f"    s->c[0][{column}] = {value!r};\n" for column, value in spec.columns.numbers.items()]
    first = spec.sizes["N"] + 2 * m + 1
    numbers += [f"    s->c[0][{first + i}] = s->p[{i}];\n" for i in range(len(spec.values))]
    if spec.parameter_parts.parts.numel():
        parts.append(_piece_c_function("numbers_of_parameters", own, {"out": spec.parameter_parts.parts}))
        numbers.append(f"    numbers_of_parameters(s, s->c[0] + {first + len(spec.values)});\n")
    numbers += ["    set_tables(s);\n"] if listed.settable else []
    parts.append(f"static void numbers(model_pieces *s)\n{{\n{''.join(numbers) or '    (void)s;' + chr(10)}}}\n")
    return "\n".join(parts)


def _piece_c_function(name: str, given: Mapping[str, ca.SX], out: Mapping[str, ca.SX]) -> str:
    return c_function(name, given, {key: ca.densify(e) for key, e in out.items()}).replace("model_solver", "model_pieces")


# Of t, x, l and choices, at which what switches look at is compared: formulas that differ do so at any such point.
COMPARED_POINTS = 3
SWITCH_TOLERANCE = 1e-8  # Part by which two such numbers may differ: formulas that are the same differ by rounding alone.


def has_same_switches(problem: ContinuousProblem, free: ContinuousProblem, values: Sequence[float]) -> bool:
    """Whether the switches of a problem are those of one whose parameters are symbols, one by one, and look at the same.

    An operation may be gone with values, or look at minus what it looked at: then a choice means something else.
    """
    kinds_of_all, watched_of_all = _switch_functions(free)
    if not kinds_of_all:
        return True
    kinds, watched = _switch_functions(problem)
    if kinds != kinds_of_all:
        return False
    rng = np.random.default_rng(0)
    for _ in range(COMPARED_POINTS):
        given = [rng.normal(size=watched.size1_in(i)) for i in range(3)] + [rng.choice([-1.0, 1.0], len(kinds))]
        one, other = (np.array(f(*given, p)).ravel() for f, p in ((watched, np.zeros(0)), (watched_of_all, np.array(values))))
        if not np.allclose(one, other, rtol=SWITCH_TOLERANCE, atol=0, equal_nan=True):
            return False
    return True


@cached_per_object
def _switch_functions(p: ContinuousProblem) -> tuple[list[tuple[str, str]], ca.Function]:
    """Part and kind of each switch; what it looks at, of t, x, l, choices and p."""
    spec = PieceSpec(p, {})
    whole = replace(p, p=ca.veccat(p.p, spec.parameter_parts.symbols))
    B, D, _ = spec.matrices
    of = fixed_branches(whole, {name: made.jets for name, made in spec.printers.items()}, B, D)
    (watched,) = spec.parameter_parts.back([of.values[2]])
    kinds = [(part, kind) for part, _, kind in spec.columns.branches]
    return kinds, ca.Function("watched", [p.t, p.x, p.l, of.choices, p.p], [ca.densify(watched)])
