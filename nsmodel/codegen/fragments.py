"""The parts of the C library that are the same for all models: files in ``c/``, written for a model called "model".

The numbers that Python and C share: each stands in the module whose algorithm it belongs to, and is printed from there.
"""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from functools import cache
from importlib import import_module
from pathlib import Path

from nsmodel._utils import one_line
from nsmodel.codegen.expressions import c_number

C_FOLDER = Path(__file__).with_name("c")


def read_fragment(name: str, flags: Set[str], replacements: Mapping[str, str]) -> str:
    """Return the file ``name`` with its ``#if FLAG`` resolved, the model's name in its names and its ``@WORD@`` filled."""
    text = prefix_names(
        resolve_conditions((C_FOLDER / name).read_text(encoding="utf-8"), flags), replacements.get("NAME", "model")
    )
    return re.sub(r"@([A-Z_]+)@", lambda match: replacements[match[1]], text)


def compiler_guard() -> str:
    """C that refuses compiler options under which a certificate means nothing."""
    return (C_FOLDER / "guard.c").read_text(encoding="utf-8")


def resolve_conditions(text: str, flags: Set[str]) -> str:
    """Keep the lines of ``#if FLAG``, ``#if !FLAG``, ``#else``, ``#endif`` that hold for ``flags``; other conditions stay."""
    kept: list[str] = []
    conditions: list[tuple[bool, bool]] = []  # (is it one of ours, are its lines kept)
    for line in text.splitlines(keepends=True):
        word = line.split(maxsplit=1)[0] if line.strip() else ""
        ours = re.fullmatch(r"#if (!?)([A-Z_]+)", line.strip())
        if ours:
            conditions.append((True, (ours[2] in flags) != bool(ours[1])))
            continue
        if word in ("#if", "#ifdef", "#ifndef"):
            conditions.append((False, True))
        elif word == "#else" and conditions[-1][0]:
            conditions[-1] = (True, not conditions[-1][1])
            continue
        elif word == "#endif" and conditions.pop()[0]:
            continue
        if all(keep for _, keep in conditions):
            kept.append(line)
    return re.sub(r"\n{3,}", "\n\n", "".join(kept))


def prefix_names(text: str, prefix: str) -> str:
    """Put the model's name into names that begin with model_ or MODEL_."""
    return re.sub(r"\bMODEL_", prefix.upper() + "_", re.sub(r"\bmodel_", prefix + "_", text))


def comment_text(text: str) -> str:
    """The user's words as they may stand in a comment of C: on one line, and without its ends."""
    return one_line(text).replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ?/")


_COMMENT = r"(?:/\*(?:(?!\*/).)*\*/\n)?"
LONG_TABLE = re.compile(r"\{[-+.,e\d\s]{1000,}\};")  # Numbers alone: nothing to look for.
DEFINE_PATTERN = re.compile(r"^#define (\w+) [^\n]*\n", re.MULTILINE)
DECLARATION_PATTERN = re.compile(_COMMENT + r"^static [^;{}=\n]*?\b(\w+)\([^;{}]*\);\n", re.MULTILINE | re.DOTALL)
FUNCTION_PATTERN = re.compile(
    _COMMENT + r"^static [^;{}=]*?\b(\w+)\([^;{}]*\)(?:\n\{\n.*?^\}\n| \{[^\n]*\}\n)", re.MULTILINE | re.DOTALL
)


def prune_unused(text: str) -> str:
    """Leave out the static functions that nothing calls, their declarations, and the constants that nothing uses."""
    numbers: list[str] = []

    def put_aside(match: re.Match[str]) -> str:
        numbers.append(match[0])
        return f"{{@{len(numbers) - 1}@}};"

    text = _prune_definitions(re.sub(LONG_TABLE, put_aside, text))
    return re.sub(r"\{@(\d+)@\};", lambda match: numbers[int(match[1])], text)


def _prune_definitions(text: str) -> str:
    counts = _count_tokens(text)
    parts: dict[str, list[re.Match[str]]] = {}  # A function with its declarations; a constant.
    for pattern in (FUNCTION_PATTERN, DEFINE_PATTERN):
        for match in pattern.finditer(text):
            parts.setdefault(match[1], []).append(match)
    for match in DECLARATION_PATTERN.finditer(text):
        if match[1] in parts:
            parts[match[1]].append(match)
    unused = [name for name, matches in parts.items() if counts[name] == len(matches)]
    removed: list[re.Match[str]] = []
    for name in unused:
        for match in parts[name]:
            removed.append(match)
            tokens = _count_tokens(match[0])
            counts.subtract(tokens)
            unused += [token for token in tokens if token in parts and token != name and counts[token] == len(parts[token])]
    for match in sorted(removed, key=lambda match: -match.start()):
        text = text[: match.start()] + text[match.end() :]
    return re.sub(r"\n{3,}", "\n\n", text)


def _count_tokens(text: str) -> Counter[str]:
    """How often each name or number stands in C, comments left out."""
    return Counter(re.findall(r"\w+", re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)))


BOX_CONSTANTS: Sequence[tuple[str, str]] = (
    ("solvers.residuals", "ROUNDING NEGLIGIBLE_MULTIPLIER:NEGLIGIBLE UNRESOLVED REACH GROWTH UNSEEN CLEAR STRICTER"),
    ("solvers.rounding_errors", "PROBES FRAGILE WORTH INSIDE SUM_ERROR SPREAD MIXED STIRRED"),
    (
        "solvers.active_set",
        "MAX_INDEX_SETS:MOST_INDEX_SETS PRIMAL_DUAL_SWEEPS CANCELLED EQUILIBRATIONS NOUGHT "
        "REGULARISED PIVOTS_EACH PIVOTS_MORE GONE PREFERRED PIVOT_ERROR MIN_PIVOT:LEAST_PIVOT TIED "
        "RANK POLISHED",
    ),
)
STEP_CONSTANTS: Sequence[tuple[str, str]] = (
    ("modeling.time_grid", "SAME_STEP_TOLERANCE:SAME"),
    ("modeling.signals.base", "NEAR_TOLERANCE:NEAR"),
    *BOX_CONSTANTS,
    (
        "solvers.mlcp",
        "SEMISMOOTH_ITERATIONS GAUSS_SEIDEL_SWEEPS SWEPT CONVERGED ACCEPTED ARMIJO MIN_DAMPED_STEP:LEAST_STEP REGULARISATIONS",
    ),
    ("solvers.constant_matrices", "ILL_CONDITIONED"),
    ("solvers.linearisation", "NEWTON_ITERATIONS REFINEMENTS HALVINGS EARLY NEAREST"),
    ("solvers.linearisation", "ENOUGH"),
    ("solvers.newton", "GAIN EXTRA_ROW_OPERATIONS:BESIDE"),
    ("solvers.time_stepper", "NEARBY_SETS"),
    ("solvers.sparse", "PIVOTED_SETS PATIENCE SHIFT"),
    ("solvers.sparse", "SINGULAR_PIVOT"),
    ("solvers.structure", "MONOTONE_ERROR"),
    ("solvers.catching_up", "USED CUT_ITERATIONS CUT_TOLERANCE ACTS BISECTIONS"),
    ("modeling.laws.ellipsoid", "MULTIPLIER_ITERATIONS"),
    ("modeling.laws.coulomb", "MIN_DRAG DRAG_DECADES MAX_CANCELLATION DRAG_BISECTIONS"),
    ("solvers.friction_contacts", "MAX_MODES"),
    ("codegen.features", "AFFINE_ITERATIONS FRAGILE_REFINEMENTS"),
    ("codegen.structs", "READY"),
)
PIECE_CONSTANTS: Sequence[tuple[str, str]] = (
    (
        "event_driven.integrator",
        "MIN_RTOL:LEAST_RTOL ROOM UNITS OCTAVES LONGER STUMP STARTS TOO_SHORT MAX_UNDECIDED_MOTION:TOLD HARDLY",
    ),
    ("event_driven.piece_bounds", "SHORTENINGS CAUTION"),
    ("event_driven.problem", "SAME_TIME"),
    ("event_driven.piece", "TINY_PIECES TINY MANY FASTER SPACINGS"),
    (
        "event_driven.modes",
        "NONZERO_SHARE PIVOTS TOGETHER MAX_NUDGES:LATER MAX_NUDGE:MOST_CREEP FEW GUESS_RESIDUAL",
    ),
    ("event_driven.state_updates", "PROJECTIONS AROUND"),
    ("event_driven.bernstein", "NONE NARROW ITERATIONS EXACT GERM ORDERS HALF_ORDERS PACES HALVED GERM_DIFFERENCE:APART"),
    (
        "event_driven.event_location",
        "POLISHING ON_EVENT STEPS_PER_EXPANSION TAIL LOST DIP STEEP T_ROUNDING MIN_PART:LEAST_PART",
    ),
    ("event_driven.event_location", "ALMOST CLOSER WIDER MAX_DISCS:MOST_DISCS MAX_MULTIPLICITY:MOST_MULTIPLE DEGREE NEAR"),
    ("event_driven.step_size", "BEYOND LOCAL ROUGHEST LONGEST MULTIPLIERS PASSES FIRST SMALL"),
    ("event_driven.step_size", "POINT SEEN SEEN_ROW"),
    ("event_driven.disc_arithmetic", "MAX_EXP_ARGUMENT:MOST_EXPONENT PRODUCT_ROUNDINGS FUNCTION_ROUNDINGS"),
    ("event_driven.recurrences", "TWO_OVER_ROOT_PI"),
    (
        "event_driven.piece_bounds",
        "RADIUS_OF_BALL WIDE_RADIUS CLOSE_RADIUS PROVED NEARLY SHRINKINGS SLOWLY QUICKLY AT_REST "
        "ENTRY_CANCELLED AS_NOW MAX_STILL_PIECES:MOST_STILL CAPS CAP_OCTAVES FAR GROWS",
    ),
    ("event_driven.piece", "NEAR_0 STEEPER"),
    ("event_driven.collocation", "SMALLEST COVER_RADIUS COVER_DEGREE"),
    ("event_driven.multipliers", "TERM_ROUNDING TIE NEGLIGIBLE_MOTION:NEGLIGIBLE"),
    ("event_driven.multipliers", "HIDDEN SINGULAR MAX_MINOR_ROWS:MOST_MINORS BALANCING NOTHING SHORT"),
    ("event_driven.system", "NEWTON NEWTON_CONVERGED:SETTLED HELD_ORDERS LITTLE RESTS AT_ZERO"),
    ("event_driven.system", "STAYS"),
    (
        "event_driven.radau",
        "STIFF_START STIFF_STAY LOW_ORDERS INNER_SHARE OCTAVES_MORE SAFE ENDINGS ENDED MOVED MAX_WAIT_OCTAVES:MOST_WAIT",
    ),
    ("event_driven.radau", "STAGE_ITERATIONS STAGE_CONVERGED:STAGE_SETTLED SLOW STAGE_NEAR STAGE_ROUNDING ORDERS_OF_TWO"),
    ("solvers.step", "RUNAWAY_LIMIT:WIDEST"),
    ("codegen.event_driven_spec", "TANGENT_SHARE TANGENT_ROUNDING TANGENT_AT_ONCE TANGENT_SAME"),
    ("codegen.event_driven_batch", "MAX_PIECES:MOST_PIECES"),
    ("codegen.structs", "READY"),
)


def define_lines(table: Sequence[tuple[str, str]]) -> str:
    """``#define`` of the constants NAME, or NAME:NAME_IN_C, of (module, constants), as lines of C; see `prune_unused`."""
    return "".join(define_line(module, name) for module, names in table for name in names.split())


@cache
def define_line(module: str, constant: str) -> str:
    """``#define name value``, with the comment that the constant has in its module; ``constant`` is NAME, or NAME:NAME_IN_C."""
    name, _, in_c = constant.partition(":")
    owner = import_module(f"nsmodel.{module}")
    value = getattr(owner, name)
    text = _short_float(value) if isinstance(value, float) else str(value) if value < 2**31 else f"{value}UL"
    line = re.search(rf"^((?:#.*\n)*)(?:\w+, )*{name}\b[^#\n]*(#.*)?$", inspect.getsource(owner), re.MULTILINE)
    comment = re.sub(r"\s*#\s*|\s*\([+~]\)$", " ", (line[2] or line[1]).strip()).strip() if line else ""
    return f"#define {in_c or name} {text}" + (f" /* {comment} */" if comment else "") + "\n"


def _short_float(value: float) -> str:
    short = f"{value:g}"
    return short if "e" in short and float(short) == value else c_number(value).text
