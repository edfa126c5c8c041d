"""The C of event-driven integration: a model's series, matrices and law beside the fragments `c/pieces*`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import casadi as ca
import numpy as np

from nsmodel.classes.registry import class_of
from nsmodel.codegen import constants, statuses
from nsmodel.codegen.expression import c_function
from nsmodel.codegen.fragments import FOLDER, comment, fragment, guard, prefixed, pruned
from nsmodel.codegen.jets import kernels
from nsmodel.codegen.piece_collocation import MOST_UNKNOWN, collocation_code, kept_in, memory
from nsmodel.codegen.piece_jets import CURVED, Columns, Printer, sizes_of_switches
from nsmodel.codegen.tables import table
from nsmodel.errors import CodegenError
from nsmodel.model.base import Model
from nsmodel.model.driven import as_parameters, inputs_at_start
from nsmodel.pieces.jets import jets_of
from nsmodel.pieces.lengths import LARGEST_ORDER
from nsmodel.pieces.modes import ORDERS
from nsmodel.pieces.multipliers import SHORT, SINGULAR, is_monotone
from nsmodel.pieces.sizes import moves
from nsmodel.pieces.sliding import with_modes
from nsmodel.proof.sure import sure
from nsmodel.scheme.continuous import ContinuousProblem, NotEventDriven
from nsmodel.solve.rounding import error_bound

MOST_ROWS = 64  # Of a law whose matrices are kept dense.
TIMES = 64  # Events 1, 2, 4, ... whose times are kept.
WRITTEN_OUT = 24  # Terms of a product that are written out.
KINDS = ("side", "equal", "floor", "ceil", "toward zero", "nearest")  # As in c/pieces_events.c.
PARTS = ("common", "pieces_modes", "pieces_expand", "pieces_events", "pieces_radau", "pieces_stiff", "pieces")


@dataclass(frozen=True)
class PieceScene:
    """A problem of which code is written, its law's ends as numbers; ``values`` of p, the last of which are ``inputs``;
    ``known`` times that end a piece.
    """

    problem: ContinuousProblem
    values: Mapping[str, float]
    known: tuple[float, ...] = ()
    inputs: int = 0

    @cached_property
    def lower(self) -> np.ndarray:
        """The lower ends (m,)."""
        return np.array(ca.DM(self.problem.law.lower), float).ravel()

    @cached_property
    def upper(self) -> np.ndarray:
        """The upper ends (m,)."""
        return np.array(ca.DM(self.problem.law.upper), float).ravel()

    @cached_property
    def slopes(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """g_l, h_l, h_x."""
        return self.problem.slopes

    @cached_property
    def matrices(self) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """The same as numbers, None where they move."""
        p = self.problem
        moving = ca.veccat(p.t, p.x, p.l, p.p)
        return tuple(
            None if ca.depends_on(J, moving) else np.array(ca.DM(ca.densify(ca.cse(J)))).reshape(J.shape) for J in self.slopes
        )  # pyright: ignore[reportReturnType]

    @cached_property
    def flags(self) -> frozenset[str]:
        """What the code has."""
        p, (B, D, C) = self.problem, self.matrices
        law = p.l.numel() > 0
        feed = law and self.slopes[1].nnz() > 0 and not (D is not None and not D.any())
        known = B is not None and D is not None and C is not None
        D0, C0, W = (sure(D), sure(C), sure(C) @ sure(B)) if known else (np.zeros((1, 1)),) * 3
        orthogonal = law and known and not feed and _is_diagonal(C0 @ C0.T)
        diagonal = orthogonal and _is_diagonal(W)
        has = {
            "LAW": law, "FEED": feed, "B_NUMBERS": B is not None, "D_NUMBERS": D is not None,
            "LINEAR": not ca.depends_on(ca.veccat(*self.slopes[:2]), p.l),
            "SLOPES": law and not known, "DIAGONAL": diagonal, "MATRICES": law and not diagonal, "ORTHOGONAL": orthogonal,
            "GENERAL": law and not orthogonal, "STILL": diagonal and not self.curved_rows,
            "UNIQUE": law and known and (_is_always_p(D0, W) or is_monotone(sure(B), D0, C0)),
            "SWITCHED": bool(self.columns.branches), "PARAMETERS": bool(self.values), "INPUTS": self.inputs > 0,
            "OWN_PARAMETERS": len(self.values) > self.inputs, "KNOWN": bool(self.known),
            "HELD": self.problem.held > 0,
            "TIMED": bool(self.known or self.problem.held),
            "STIFF": 0 < p.x.numel() <= MOST_UNKNOWN - p.l.numel(),
        }  # fmt: skip
        return frozenset(name for name, holds in has.items() if holds)

    @cached_property
    def curved_rows(self) -> bool:
        """Whether h is made of more than sums of x, l and functions of t."""
        h = self.printers["h"]
        return any(h.degree[row] > 1 and row not in h.jets.inputs.values() for row in h.column) or any(
            which == 1 for which, _ in h.jets.inputs if any(line.kind not in _SUMS for line in h.jets.lines)
        )

    @cached_property
    def columns(self) -> Columns:
        """Where series are stored."""
        return self._made[0]

    @cached_property
    def printers(self) -> dict[str, Printer]:
        """The parts f, g and h; g where it is not B l."""
        return self._made[1]

    @cached_property
    def _made(self) -> tuple[Columns, dict[str, Printer]]:
        p, (B, D, _) = self.problem, self.matrices
        n, m = p.x.numel(), p.l.numel()
        inputs = {(1, i): i for i in range(n)} | {(2, i): n + i for i in range(m)} | {(0, 0): n + 2 * m}
        count = n + 2 * m + 1
        inputs |= {(3, i): count + i for i in range(p.p.numel())}
        count += p.p.numel()
        columns = Columns(inputs, count)
        h = p.h if D is None or not m else ca.substitute(p.h, p.l, ca.SX.zeros(m))
        exprs = {"f": p.f, "h": h} if B is not None else {"f": p.f, "h": h, "g": p.g}
        degrees = {0: 1, 1: CURVED, 2: CURVED, 3: 0}
        made = {name: Printer(jets_of(expr, [p.t, p.x, p.l, p.p], name), name, columns, degrees) for name, expr in exprs.items()}
        return columns, made

    @property
    def branches(self) -> dict[str, slice]:
        """The choices of f, g and h."""
        return {name: slice(made.offset, made.offset + len(made.jets.branches)) for name, made in self.printers.items()}

    @cached_property
    def sizes(self) -> dict[str, int]:
        """The constants of the header."""
        n, m = self.problem.x.numel(), self.problem.l.numel()
        columns = self.columns
        outputs = m if {"FEED", "D_NUMBERS"} <= self.flags else 0
        kept = 1 if not {"MATRICES"} <= self.flags or "SLOPES" in self.flags else kept_in(24 * m * m, 2, 16)
        return {
            "N": n, "M": m, "NP": len(self.values), "NU": self.inputs, "NOWN": len(self.values) - self.inputs,
            "CHOICES": columns.choices, "ORDERS": LARGEST_ORDER, "KEPT": kept, "GERM": ORDERS + 1, "TIMES": TIMES,
            "COLUMNS": columns.count + outputs, "T": n + 2 * m, "HELD": self.problem.held,
            "H": columns.count if outputs else n + m,
        } | memory(n + m)  # fmt: skip


_SUMS = frozenset("sum difference minus scaled over shifted".split())


def piece_scene(problem: ContinuousProblem, known: Sequence[float], values: Mapping[str, float] | None = None) -> PieceScene:
    """Return what code is written of; ``known`` times are increasing.

    Raises:
        CodegenError: l in slip is a series, ends of the law are no numbers, or it has too many rows that depend on each other.
    """
    if problem.sliding:
        raise CodegenError(f"while '{problem.sliding[0]}' slips, its l is a series of y, which only interpreted pieces have")
    ends = ca.veccat(ca.SX(problem.law.lower), ca.SX(problem.law.upper))
    if not ends.is_constant():
        raise CodegenError("event-driven integration in C needs numbers as ends of the law; give its parameters values")
    scene = PieceScene(problem, dict(values or {}), tuple(known))
    m = problem.l.numel()
    if m > MOST_ROWS and "MATRICES" in scene.flags:
        raise CodegenError(f"{m} rows that depend on each other are more than the {MOST_ROWS} that pieces in C have room for")
    return scene


def scene_of(model: Model, values: Mapping[str, float]) -> PieceScene:
    """The same of a model, whose parameters that stay symbols have ``values`` at first; its inputs are parameters too.

    Raises:
        CodegenError: the model has no event-driven form, or as above.
    """
    names, given, module = model.input_names, model, class_of(model).optional("continuous")
    u, model = inputs_at_start(model), as_parameters(model)
    try:
        problem = None if module is None else with_modes(module.continuous_problem(model))
        if problem is not None and (ends := sure(module).continuous_problem(given).ends):
            raise CodegenError(f"event-driven libraries have laws that stay; that of '{ends[0].name}' moves: no --event-driven")
    except NotEventDriven as error:
        raise CodegenError(f"event-driven integration does not take this model: {error}") from error
    if problem is None:
        raise CodegenError("event-driven integration in C does not take many bodies, whose contacts change at nearly every step")
    numbers = {**values, **dict(zip(names, u.tolist(), strict=True))}
    return replace(piece_scene(problem, model.switch_times, numbers), inputs=u.size)


def library_files(model: Model, values: Mapping[str, float], name: str) -> dict[str, str]:
    """NAME_pieces.h and NAME_pieces.c, to be compiled beside a library."""
    scene, title = scene_of(model, values), model.title or type(model).__name__
    return {f"{name}_pieces.h": header(scene, name, title, f"{name}.h"), f"{name}_pieces.c": code(scene, name, title, runs=False)}


def header(scene: PieceScene, name: str, title: str, shared: str | None) -> str:
    """NAME_pieces.h; ``shared``: the header that has the statuses, None where they stand here."""
    return fragment("pieces_header.h", scene.flags, _words(scene, name, title, shared))


def code(scene: PieceScene, name: str, title: str, *, runs: bool) -> str:
    """NAME_pieces.c; ``runs``: with what whole runs need."""
    words = _words(scene, name, title, None)
    own = prefixed(_own(scene), name)
    parts = [fragment(f"{part}.c", scene.flags, words) for part in PARTS]
    more = ["pieces_api", *(["pieces_rollout"] if runs else [])]
    own += prefixed(_records(scene), name) if runs else ""
    text = "\n".join(
        [
            fragment("pieces_prelude.c", scene.flags, words), parts[0], own, *parts[1:],
            *(fragment(f"{part}.c", scene.flags, words) for part in more),
        ]
    )  # fmt: skip
    return pruned(text)


def _words(scene: PieceScene, name: str, title: str, shared: str | None) -> dict[str, str]:
    words = {key: str(value) for key, value in scene.sizes.items()}
    words |= {
        "NAME": name, "TITLE": comment(title) or name, "GUARD": guard(), "KNOWN_TIMES": str(len(scene.known)),
        "CONSTANTS": constants.of_pieces(),
        "STATUSES": prefixed(statuses.enumeration(), name) if shared is None else f'#include "{shared}"',
    }  # fmt: skip
    words["STRUCT"] = fragment("pieces_struct.h", scene.flags, words)
    return words


def _records(scene: PieceScene) -> str:
    """The columns of a trajectory, for whole runs."""
    p = scene.problem
    all_of = ca.veccat(p.h, *p.columns.values())
    given = {"t": p.t, "x": p.x, "l": p.l}
    return f"#define RECORDS {all_of.numel()}\n" + _printed("records", given, {"out": all_of})


def _own(scene: PieceScene) -> str:
    """The model's own tables and functions."""
    p, flags, n, m = scene.problem, scene.flags, scene.sizes["N"], scene.sizes["M"]
    parts = [_tables(scene), kernels("COLUMNS"), (FOLDER / "pieces_series.c").read_text(encoding="utf-8"), _products(scene)]
    plain = "B_NUMBERS" in flags or not m
    targets = {
        "f": [f"next[{i}] = factor*{{}};" if plain else f"s->f[{i}] = {{}};" for i in range(n)],
        "g": [f"s->value[{i}] = {{}};" for i in range(n)],
        "h": [f"c[{(scene.sizes['H'] if {'FEED', 'D_NUMBERS'} <= flags else n + m) + i}] = {{}};" for i in range(m)],
    }  # fmt: skip
    given = {"f": ", double factor, double *restrict next"}
    parts += [printer.text(targets[name], given.get(name, "")) for name, printer in scene.printers.items() if m or name == "f"]
    own = {"s->p": p.p} if p.p.numel() else {}
    given = {"t": p.t, "x": p.x, "l": p.l} | own
    parts.append(_printed("equations", given, {"rate": p.f + p.g, "y": p.h}))
    parts.append(_printed("rounding", given, {"bound": error_bound(ca.densify(p.f + p.g), ca.veccat(p.t, p.x, p.l))}))
    sizes, moved = moves(p)
    parts.append(_printed("moves", sizes | own, {"moved": moved}))
    parts += [collocation_code(scene, given)] if "STIFF" in flags else []
    if "SLOPES" in flags:
        parts.append(_printed("slopes", given, dict(zip("BDC", scene.slopes, strict=True))))
    parts += [_printed("start", own, {"x": ca.SX(p.x0)}), sizes_of_switches(scene.printers)]
    numbers = [f"    s->c[0][{column}] = {value!r};\n" for column, value in scene.columns.numbers.items()]
    first = scene.sizes["N"] + 2 * m + 1
    numbers += [f"    s->c[0][{first + i}] = s->p[{i}];\n" for i in range(len(scene.values))]
    parts.append(f"static void numbers(model_pieces *s)\n{{\n{''.join(numbers) or '    (void)s;' + chr(10)}}}\n")
    return "\n".join(parts)


def _printed(name: str, given: Mapping[str, ca.SX], out: Mapping[str, ca.SX]) -> str:
    return c_function(name, given, {key: ca.densify(e) for key, e in out.items()}).replace("model_solver", "model_pieces")


def _products(scene: PieceScene) -> str:
    """B l and D l: written out where they have few entries."""
    (B, D, _), text = scene.matrices, ""
    if B is not None:
        terms = [f"    next[{i}] += factor*({float(B[i, j])!r}*l[{j}]);\n" for i, j in zip(*np.nonzero(B), strict=True)]
        loop = "    for (int j = 0; j < M; j++)\n        if (l[j] != 0)\n"
        loop += "            for (int e = B_start[j]; e < B_start[j + 1]; e++)\n"
        loop += "                next[B_row[e]] += factor*(B_value[e]*l[j]);\n"
        text += f"static void add_B(double *restrict next, const double *l, double factor)\n{{\n{_few(terms, loop)}}}\n\n"
    if D is not None and "FEED" in scene.flags:
        terms = [
            f"    y[{i}] = {' + '.join([f'h[{i}]', *(f'{float(D[i, j])!r}*l[{j}]' for j in np.flatnonzero(D[i]))])};\n"
            for i in range(len(D))
        ]
        loop = "    for (int i = 0; i < M; i++) {\n        y[i] = h[i];\n"
        loop += (
            "        for (int e = D_start[i]; e < D_start[i + 1]; e++)\n            y[i] += D_value[e]*l[D_column[e]];\n    }\n"
        )
        text += f"static void add_D(double *restrict y, const double *h, const double *l)\n{{\n{_few(terms, loop)}}}\n\n"
    return text


def _few(terms: list[str], loop: str) -> str:
    return "".join(terms) if len(terms) <= WRITTEN_OUT else loop


def _tables(scene: PieceScene) -> str:
    flags, m, (B, D, C) = scene.flags, scene.sizes["M"], scene.matrices
    lines = [table("default_p", list(scene.values.values()), "MODEL_PIECES_NP")] if scene.values else []
    lines += [table("known_times", scene.known, "KNOWN_TIMES", "switch_times")] if scene.known else []
    if scene.columns.branches:
        _, columns, kinds = zip(*scene.columns.branches, strict=True)
        lines += [table("branch_column", columns, "CHOICES", kind="int")]
        lines += [table("branch_kind", [KINDS.index(kind) for kind in kinds], "CHOICES", kind="int")]
    if not m:
        return "".join(lines)
    lines += [table("lower", scene.lower, "M", "ends of the law"), table("upper", scene.upper, "M")]
    feeds = set(scene.slopes[1].sparsity().row())
    lines += [table("feeds", [i in feeds for i in range(m)], "M", "whether y_i depends on l directly", "int")]
    if B is not None:
        lines.append(_sparse("B", B.T, "row"))
    if D is not None and "FEED" in flags:
        lines.append(_sparse("D", D, "column"))
    if C is not None and "SLOPES" not in flags:
        lines.append(_sparse("C", C, "column"))
        lines.append(_sparse("W", np.abs(C) @ np.abs(sure(B)), "column"))
    if B is not None and D is not None and C is not None:
        if "DIAGONAL" in flags:
            lines.append(table("inverse", 1 / np.diag(C @ B), "M", "1/W_ii"))
        else:
            lines += [table("D_dense", D.ravel(), "M*M"), table("W_dense", (C @ B).ravel(), "M*M")]
        if "GENERAL" in flags:
            lines += [table("C_dense", C.ravel(), "M*N"), "#define C_AT(i, j) C_dense[(i)*N + (j)]\n"]
    return "".join(lines)


def _sparse(name: str, A: np.ndarray, index: str) -> str:
    """The entries of each row of A."""
    rows, columns = np.nonzero(A)
    starts = np.array([0, *accumulate(np.count_nonzero(A, axis=1).tolist())])
    size = max(len(rows), 1)
    return (
        table(f"{name}_start", starts, f"{len(A)} + 1", kind="int")
        + table(f"{name}_{index}", columns if len(columns) else np.zeros(1), str(size), kind="int")
        + table(f"{name}_value", A[rows, columns] if len(columns) else np.zeros(1), str(size))
    )


def _is_diagonal(A: np.ndarray) -> bool:
    return bool(np.diag(A).all() and not (A - np.diag(np.diag(A))).any())


def _is_always_p(D: np.ndarray, W: np.ndarray) -> bool:
    """Whether D + a little W is so far from having a negative direction that all its Schur complements pass `is_p`."""
    d, w = np.abs(D).max(initial=0.0), np.abs(W).max(initial=0.0)
    K = D + W * (SHORT * d / w if d and w else 1.0)
    least, most = np.linalg.eigvalsh((K + K.T) / 2).min(initial=1.0), np.linalg.norm(K, 2) if K.size else 1.0
    return bool(least > 1e3 * np.sqrt(SINGULAR) * most)
