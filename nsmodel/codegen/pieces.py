"""The C of event-driven integration: a model's series, matrices and law beside the fragments `c/pieces*`."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from nsmodel.codegen import constants, statuses
from nsmodel.codegen.expression import c_function
from nsmodel.codegen.fragments import FOLDER, comment, fragment, guard, prefixed, pruned
from nsmodel.codegen.jets import kernels
from nsmodel.codegen.piece_collocation import collocation_code
from nsmodel.codegen.piece_jets import sizes_of_switches
from nsmodel.codegen.piece_scene import PieceScene, scene_of
from nsmodel.codegen.piece_tables import in_struct, products, set_tables, tables
from nsmodel.codegen.structs import ASKED, PIECE_CELLS
from nsmodel.dense import UNKNOWN
from nsmodel.model.base import Model
from nsmodel.pieces.sizes import moves
from nsmodel.solve.rounding import error_bound

PARTS = (
    "common", "pieces_modes", "pieces_expand", "pieces_events", "pieces_discs", "pieces_schwarz", "pieces_roots", "pieces_cover",
    "pieces_radau", "pieces_stiff", "pieces",
)  # fmt: skip


def library_files(model: Model, values: Mapping[str, float], name: str) -> dict[str, str]:
    """NAME_pieces.h and NAME_pieces.c, to be compiled beside a library."""
    scene, title = scene_of(model, values), model.title or type(model).__name__
    return {f"{name}_pieces.h": header(scene, name, title, f"{name}.h"), f"{name}_pieces.c": code(scene, name, title, runs=False)}


def header(scene: PieceScene, name: str, title: str, shared: str | None) -> str:
    """NAME_pieces.h; ``shared``: the header that has the statuses, None where they stand here."""
    return fragment("pieces_header.h", scene.flags, _words(scene, name, title, shared))


def code(scene: PieceScene, name: str, title: str, *, runs: bool) -> str:
    """NAME_pieces.c; ``runs``: with what whole runs need."""
    words = _words(scene, name, title, None) | {"KINDS": scene.discs.kinds(), "TABLE": scene.discs.table()}
    own = prefixed(_own(scene), name)
    parts = [fragment(f"{part}.c", scene.flags, words) for part in PARTS]
    more = ["pieces_api", *(["pieces_rollout", "pieces_batch"] if runs else [])]
    own += prefixed(_records(scene), name) if runs else ""
    text = "\n".join(
        [
            fragment("pieces_prelude.c", scene.flags, words), parts[0], own, *parts[1:4],
            scene.discs.interpreter(parts[4]), *parts[5:],
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
    words |= {"ASKED": prefixed(ASKED.c(), name), "PIECE_CELLS": prefixed(PIECE_CELLS.c(), name)}
    words["SET"] = in_struct(tables(scene).settable)
    words["STRUCT"] = fragment("pieces_struct.h", scene.flags, words)
    return words


def _records(scene: PieceScene) -> str:
    """The columns of a trajectory, for whole runs."""
    p = scene.problem
    all_of = ca.veccat(p.h, *p.columns.values())
    given = {"t": p.t, "x": p.x, "l": p.l} | ({"s->p": p.p} if p.p.numel() else {})
    own = ca.SX(0, 1) if p.multipliers is None else p.multipliers
    numbers = {"RECORDS": all_of.numel(), "SHOWN": own.numel(), "IMPULSES": int(p.impulses), "FEEDS": int("FEED" in scene.flags)}
    text = "".join(f"#define {name} {value}\n" for name, value in {**numbers, "NO_CODE": UNKNOWN}.items())
    text += _printed("records", given, {"out": all_of})
    return text + (_printed("own_multipliers", given, {"out": own}) if own.numel() else "")


def _own(scene: PieceScene) -> str:
    """The model's own tables and functions."""
    p, flags, n, m = scene.problem, scene.flags, scene.sizes["N"], scene.sizes["M"]
    listed = tables(scene)
    parts = [
        listed.text, set_tables(listed.settable, p.p), kernels("COLUMNS"),
        (FOLDER / "pieces_series.c").read_text(encoding="utf-8"), products(scene),
    ]  # fmt: skip
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
    if scene.derived.parts.numel():
        parts.append(_printed("numbers_of_parameters", own, {"out": scene.derived.parts}))
        numbers.append(f"    numbers_of_parameters(s, s->c[0] + {first + len(scene.values)});\n")
    numbers += ["    set_tables(s);\n"] if listed.settable else []
    parts.append(f"static void numbers(model_pieces *s)\n{{\n{''.join(numbers) or '    (void)s;' + chr(10)}}}\n")
    return "\n".join(parts)


def _printed(name: str, given: Mapping[str, ca.SX], out: Mapping[str, ca.SX]) -> str:
    return c_function(name, given, {key: ca.densify(e) for key, e in out.items()}).replace("model_solver", "model_pieces")
