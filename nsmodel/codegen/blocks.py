"""The tables and functions of a model's blocks in C; what calls them is ``c/blocks.c``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import casadi as ca

from nsmodel.codegen.expressions import c_function_text, c_number, c_table, looped_c_function
from nsmodel.codegen.fragments import comment_text
from nsmodel.codegen.step_spec import InputRoles
from nsmodel.modeling.blocks import ModelBlock
from nsmodel.modeling.signals.pwm import PWM_KINDS


def blocks_code(model: Any, places: InputRoles) -> str:
    """All that is the model's own."""
    blocks: Sequence[ModelBlock] = model.blocks
    parts = [*_input_tables(places), _start_function(model, places), _next_tick_function(blocks)]
    given = _solver_symbols(model) | {"u": model.u}
    parts += [
        looped_c_function(f"tick_{i}", given, {"w": block.next}, comment_text(block.name)) for i, block in enumerate(blocks)
    ]
    parts.append(
        _due_ticks_function(blocks, "tick", "what blocks that are due set: all read u before one of them writes w", latches=False)
    )
    if places.pulses:
        parts.append(_due_ticks_function(blocks, "latch", "the duties in force of periods that begin", latches=True))
    return "\n".join(parts)


def _solver_symbols(model: Any) -> dict[str, ca.SX]:
    """What blocks read of a solver."""
    found = {"s->t": model.t, "s->x": model.state, "s->l": getattr(model, "lam", ca.SX(0, 1)), "s->p": model.p}
    return {key: symbols for key, symbols in found.items() if symbols.numel()}


def _input_tables(places: InputRoles) -> Iterator[str]:
    if places.memory:
        yield c_table("memory_at", places.memory, "MODEL_NZ", "which inputs memory is", "int")
    if places.held:
        yield c_table("held_at", places.held, "MODEL_NW", "and what is held", "int")
    if places.given:
        yield c_table("given_at", places.given, "MODEL_NU", "those that the caller sets", "int")
    if places.pulses:
        yield f"enum {{ {', '.join(kind.upper() for kind in PWM_KINDS)} }};\n\n" + _pulse_table(places)


def _pulse_table(places: InputRoles) -> str:
    rows = []
    for at, duty, pwm in places.pulses:
        numbers = ", ".join(c_number(value).text for value in (pwm.period, pwm.phase, pwm.low, pwm.high))
        rows.append(f"    {{{at}, {duty}, {pwm.kind.upper()}, {numbers}}},\n")
    return (
        "/* PWMs: which input they are, which is the duty in force, where the pulse lies in a period. */\n"
        "static const struct pulse {\n    int at, duty, kind;\n    double period, phase, low, high;\n"
        f"}} pulses[MODEL_PULSES] = {{\n{''.join(rows)}}};\n"
    )


def _start_function(model: Any, places: InputRoles) -> str:
    """What blocks hold before their first ticks, but where a start has a step behind it; outputs may be expressions of memory."""
    u, lam = ca.vertsplit(model.u), getattr(model, "lam", ca.SX(0, 1))
    for _ in range(0 if model.tied_to_step else 2):
        for block in model.blocks:
            now = ca.vertcat(*u, 0, ca.SX.zeros(lam.numel()))
            u[block.at[0] : block.at[-1] + 1] = ca.vertsplit(ca.substitute(block.start, ca.vertcat(model.u, model.t, lam), now))
    given = {"x": model.state, "u": model.u} | ({"s->p": model.p} if model.p.numel() else {})
    kept = len(places.memory) + len(places.held)
    return looped_c_function("start_held", given, {"w": ca.vertcat(*u[-kept:])}, "what blocks hold before their first ticks")


def _next_tick_function(blocks: Sequence[ModelBlock]) -> str:
    """The first tick of all after a time."""
    ticks = dict.fromkeys(_period_arguments(block) for block in blocks if block.period is not None)
    lines = [f"first = min_of(first, multiple_after(t, {times}));" for times in ticks]
    unused = [] if ticks else ["(void)t;"]
    body = "\n".join(f"    {line}" for line in [*unused, "double first = INFINITY;", *lines, "return first;"])
    return f"/* The first tick after t; infinite where there is none. */\nstatic double tick_after(double t)\n{{\n{body}\n}}\n"


def _due_ticks_function(blocks: Sequence[ModelBlock], name: str, about: str, *, latches: bool) -> str:
    """A function with the ticks that are due at the time of a solver."""
    lines = []
    for i, block in enumerate(blocks):
        if block.latch is latches:
            call = f"tick_{i}(s, u, w + {block.at[0]});"
            lines += [call] if block.period is None else [f"if (is_multiple(s->t, {_period_arguments(block)}))", f"    {call}"]
    return c_function_text(name, ["u"], ["w"], lines, f"{about[0].upper()}{about[1:]}.")


def _period_arguments(block: ModelBlock) -> str:
    """Period and offset as arguments."""
    return f"{c_number(float(block.period or 0)).text}, {c_number(block.offset).text}"
