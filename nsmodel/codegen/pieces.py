"""The C of event-driven integration: a model's series, matrices and law beside the fragments `c/pieces*`."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from nsmodel.codegen import constants, statuses
from nsmodel.codegen.expression import c_function
from nsmodel.codegen.fragments import C_FOLDER, comment_text, compiler_guard, prefix_names, prune_unused, read_fragment
from nsmodel.codegen.jets import recurrence_kernels
from nsmodel.codegen.piece_collocation import collocation_code
from nsmodel.codegen.piece_jets import switch_scales_code
from nsmodel.codegen.piece_scene import PieceSpec, piece_spec_of
from nsmodel.codegen.piece_tables import law_tables, product_functions, set_tables_code, struct_members
from nsmodel.codegen.structs import PIECE_BATCH_CELLS, RUN_REQUEST
from nsmodel.dense import UNKNOWN_INDEX
from nsmodel.model.base import Model
from nsmodel.pieces.sizes import state_motion
from nsmodel.solve.rounding import rounding_error_bound

PIECE_FRAGMENTS = (
    "common", "pieces_modes", "pieces_expand", "pieces_events", "pieces_discs", "pieces_schwarz", "pieces_roots", "pieces_cover",
    "pieces_radau", "pieces_stiff", "pieces",
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
    parts = [read_fragment(f"{part}.c", spec.flags, replacements) for part in PIECE_FRAGMENTS]
    more = ["pieces_api", *(["pieces_rollout", "pieces_batch"] if runs else [])]
    own += prefix_names(_record_functions(spec), name) if runs else ""
    text = "\n".join(
        [
            read_fragment("pieces_prelude.c", spec.flags, replacements), parts[0], own, *parts[1:4],
            spec.discs.prune_interpreter(parts[4]), *parts[5:],
            *(read_fragment(f"{part}.c", spec.flags, replacements) for part in more),
        ]
    )  # fmt: skip
    return prune_unused(text)


def _piece_replacements(spec: PieceSpec, name: str, title: str, shared: str | None) -> dict[str, str]:
    replacements = {key: str(value) for key, value in spec.sizes.items()}
    replacements |= {
        "NAME": name, "TITLE": comment_text(title) or name, "GUARD": compiler_guard(), "KNOWN_TIMES": str(len(spec.known)),
        "CONSTANTS": constants.piece_defines(),
        "STATUSES": prefix_names(statuses.status_enum(), name) if shared is None else f'#include "{shared}"',
    }  # fmt: skip
    replacements |= {"ASKED": prefix_names(RUN_REQUEST.c(), name), "PIECE_CELLS": prefix_names(PIECE_BATCH_CELLS.c(), name)}
    replacements["SET"] = struct_members(law_tables(spec).settable)
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
