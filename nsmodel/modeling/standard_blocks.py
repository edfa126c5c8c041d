"""Blocks that many models have, written with `sampled` and `each_step`.

Blocks with memory beside a model: controllers, switches and latches that read it at their ticks and hold what they set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

from nsmodel._utils import checks_keywords
from nsmodel.errors import ModelError
from nsmodel.modeling.block import Block, each_step, sampled


@checks_keywords
def hysteresis(
    u: Any, y: Any, low: Any, high: Any, *, start: float, below: float = 1.0, above: float = 0.0, period: float | None = None
) -> Block:
    """``u`` is ``below`` once y <= low, ``above`` once y >= high, and stays as it is between: a thermostat, a Schmitt trigger.

    Args:
        u: its symbol; y, low, high: expressions; start: its value before the start.
        below, above: its values.
        period: of its ticks; left out: each step.
    """
    u = _scalar_symbol(u)
    update = {u: ca.if_else(y <= low, below, ca.if_else(y >= high, above, u))}
    return _memory_block(f"hysteresis {u}", period, {u: start}, update, {u: (start, below, above)})


@checks_keywords
def latch(q: Any, set: Any, reset: Any, *, start: float = 0.0, period: float | None = None) -> Block:
    """``q`` is 0 once reset >= 0, else 1 once set > 0, and stays as it is between; reset wins.

    Args:
        q: its symbol; set, reset: expressions whose signs say so, such as ``reset=i - 4``; start: its value before the start.
        period: of its ticks; left out: each step.
    """
    q = _scalar_symbol(q)
    update = {q: ca.if_else(reset >= 0, 0, ca.if_else(set > 0, 1, q))}
    return _memory_block(f"latch {q}", period, {q: start}, update, {q: (start, 0, 1)})


@checks_keywords
def thyristor(q: Any, gate: Any, current: Any, *, period: float | None = None) -> Block:
    """``q`` is 1 once gate > 0, and stays 1 until gate <= 0 and current <= 0.

    Where l is its current and y minus its voltage, its law is 0 <= l ⟂ q y + (1 - q) >= 0: with q = 0 that is 1, and l = 0.

    Args:
        q: its symbol; gate, current: expressions.
        period: of its ticks; left out: each step.
    """
    q = _scalar_symbol(q)
    fired = ca.if_else(gate > 0, 1, ca.if_else(current <= 0, 0, q))
    return _memory_block(f"thyristor {q}", period, {q: 0.0}, {q: fired}, {q: (0, 1)})


@checks_keywords
def delay(w: Any, y: Any, *, samples: int, period: float, start: float = 0.0) -> Block:
    """``w`` is what y was so many ticks ago.

    Args:
        w: its symbol; y: an expression.
        samples: >= 1; period: of the ticks; start: y before the start.

    Raises:
        ModelError: a number of samples that is not >= 1.
    """
    w = _scalar_symbol(w)
    if not (isinstance(samples, int) and samples >= 1):
        raise ModelError(f"delay {w}: samples = {samples!r:.60}; expected a whole number >= 1")
    line = [ca.SX.sym(f"{w}.{k}") for k in range(1, samples + 1)]
    follow = dict(zip(line, [ca.SX(y), *line[:-1]], strict=True))
    return sampled(f"delay {w}", period=period, memory=dict.fromkeys(line, start), outputs={w: line[-1]}, update=follow)


@checks_keywords
def pid(
    w: Any,
    e: Any,
    *,
    kp: Any,
    ki: Any = 0.0,
    kd: Any = 0.0,
    period: float,
    low: Any = -ca.inf,
    high: Any = ca.inf,
    start: float = 0.0,
) -> Block:
    """A sampled PID controller: w = kp e + z + kd (e - e_last)/period within [low, high], then z gains ki period e.

    The integral z stands still while w is at a bound that e drives it further into (conditional integration).

    Args:
        w: its symbol; e: the error, reference minus value, an expression.
        kp, ki, kd: gains, numbers or parameters; period: of its ticks.
        low, high: bounds of w; start: z at the start.
    """
    w, e = _scalar_symbol(w), ca.SX(e)
    z, last, started = (ca.SX.sym(f"{w}.{part}") for part in ("integral", "error", "begun"))
    slope = ca.if_else(started > 0, (e - last) / period, 0)
    free = kp * e + z + kd * slope
    wound = ca.logic_or(ca.logic_and(free > high, ki * e > 0), ca.logic_and(free < low, ki * e < 0))
    return sampled(
        f"pid {w}", period=period, memory={z: start, last: 0.0, started: 0.0}, outputs={w: ca.fmin(ca.fmax(free, low), high)},
        update={z: ca.if_else(wound, z, z + ki * period * e), last: e, started: ca.SX(1)},
    )  # fmt: skip


@checks_keywords
def dead_time(on: Any, off: Any, command: Any, t: Any, *, delay: float, period: float | None = None) -> Block:
    """Two switches of a leg, never both on: ``on`` follows command > 0, ``off`` the opposite, ``delay`` later each.

    Args:
        on, off: their symbols; command: an expression; t: the model's time.
        delay: a time >= 0, found to within a tick.
        period: of its ticks; left out: each step.
    """
    on, off = _scalar_symbol(on), _scalar_symbol(off)
    was, since = ca.SX.sym(f"{on}.command"), ca.SX.sym(f"{on}.since")
    now = ca.if_else(command > 0, 1, 0)
    started = ca.if_else(now == was, since, t)
    ready = t - started >= delay * (1 - 1e-9)
    up, down = ca.if_else(ca.logic_and(now == 1, ready), 1, 0), ca.if_else(ca.logic_and(now == 0, ready), 1, 0)
    memory, update = {was: 0.0, since: -delay, on: 0.0, off: 1.0}, {was: now, since: started, on: up, off: down}
    return _memory_block(f"dead time {on}", period, memory, update, {on: (0, 1), off: (0, 1)})


def _memory_block(
    name: str, period: float | None, memory: Mapping[Any, Any], update: Mapping[Any, Any], values: Mapping[Any, Sequence[Any]]
) -> Block:  # fmt: skip
    """A block of memory alone; ``values``: those that its symbols take, left out where one is not a number."""
    few = {symbol: taken for symbol, taken in values.items() if all(isinstance(one, int | float) for one in taken)}
    if period is None:
        return each_step(name, memory=memory, update=update, values=few)
    return sampled(name, period=period, memory=memory, update=update, values=few)


def _scalar_symbol(symbol: Any) -> ca.SX:
    """A scalar symbol of CasADi's, or by its name."""
    if isinstance(symbol, str):
        return ca.SX.sym(symbol)
    if not (isinstance(symbol, ca.SX) and symbol.numel() == 1 and symbol.is_symbolic()):
        raise ModelError(f"a block sets one SX symbol, not {symbol!r:.60}")
    return symbol


__all__ = ["Block", "dead_time", "delay", "each_step", "hysteresis", "latch", "pid", "sampled", "thyristor"]
