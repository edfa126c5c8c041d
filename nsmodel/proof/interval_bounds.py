"""Bounds of expressions over boxes: the instructions of a CasADi function replayed on intervals.

Bounds are rigorous, rounding included, for the expression as it stands, at the points where all parts of it are defined. An
operation that may be undefined on its arguments (sqrt or log of what can be negative, a division by an interval around 0) has
no bound, but what holds it may have one: cos(log(x)) lies in [-1, 1] wherever it is a number. What is a number though an argument
is none (fmin, fmax, comparisons) is bounded as it is evaluated: fmin(cos(log(x)), 9) is 9 at x = -1. Whether an expression is
defined on a whole box is for ``is_continuous`` to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.proof.expression_graph import Instruction, Program
from nsmodel.proof.expression_graph import program as program
from nsmodel.proof.interval_arithmetic import (
    LARGEST_DOUBLE,
    MINUS_ONE,
    ONE,
    UNBOUNDED,
    IntervalPair,
    add,
    mul,
    neg,
    point_interval,
    select_interval,
    sub,
)
from nsmodel.proof.interval_functions import OPERATIONS

# Boxes looked at before continuity is left unproved: those that hold a jump stay open, however small they get.
MAX_CONTINUITY_BOXES = 4000
# Cuts of each coordinate: a part of 2^-40 that is still open is at a jump, or where bounds never get narrow enough.
MAX_CUT_DEPTH = 40


def run_program(code: Program, lower: np.ndarray, upper: np.ndarray) -> list[IntervalPair]:
    """Return the interval of every value over boxes (k, n); arrays (k,), or (1,) of constants."""
    return _run(code, lower, upper, _asks_for_numbers(code))[0]


def run_with_numbers(code: Program, lower: np.ndarray, upper: np.ndarray) -> tuple[list[IntervalPair], list[np.ndarray]]:
    """Return the interval of every value, and whether it is proved to be a number all over each box."""
    return _run(code, lower, upper, True)


def _asks_for_numbers(code: Program) -> bool:
    """Whether an operation has a value also where an argument is not a number, and one may have none."""
    loose = any(step.op in OPERATIONS and OPERATIONS[step.op].loose is not None for step in code.steps)
    return loose and any(_may_be_undefined(step, code) for step in code.steps)


def _may_be_undefined(step: Instruction, code: Program) -> bool:
    """Whether the operation may have no value, as far as its code tells."""
    if step.op == ca.OP_DIV and (bottom := code.steps[step.sources[1]]).op == ca.OP_CONST:
        return not np.isfinite(bottom.number) or bottom.number == 0
    if step.op in OPERATIONS:
        return not OPERATIONS[step.op].total
    return step.op not in (ca.OP_INPUT, ca.OP_CONST) or not np.isfinite(step.number)


def _run(code: Program, lower: np.ndarray, upper: np.ndarray, with_numbers: bool) -> tuple[list[IntervalPair], list[np.ndarray]]:
    values: list[IntervalPair] = []
    numbers: list[np.ndarray] = []
    for step in code.steps:
        args = [values[j] for j in step.sources]
        if step.op == ca.OP_INPUT:
            values.append((lower[:, step.slot], upper[:, step.slot]))
        elif step.op == ca.OP_CONST:
            values.append(UNBOUNDED if np.isnan(step.number) else point_interval(step.number))
        elif step.op in OPERATIONS:
            values.append(OPERATIONS[step.op].bounds(*args))
        else:
            values.append(UNBOUNDED)
        if not with_numbers:
            continue
        fine = [numbers[j] for j in step.sources]
        numbers.append(_is_number(step, values[-1], args, fine))
        loose = OPERATIONS[step.op].loose if step.op in OPERATIONS else None
        if loose is not None and not all(part.all() for part in fine):
            values[-1] = loose(values[-1], fine, *args)
    return values, numbers


def _is_number(step: Instruction, result: IntervalPair, args: list[IntervalPair], sources: list[np.ndarray]) -> np.ndarray:
    """Whether a value is proved to be a number as it is evaluated: its operation has one, and its arguments are some."""
    if step.op not in OPERATIONS:
        return np.full(1, step.op in (ca.OP_INPUT, ca.OP_CONST) and not np.isnan(step.number))
    fine, loose = OPERATIONS[step.op].defined(result, *args), OPERATIONS[step.op].loose is not None
    if step.op in (ca.OP_FMIN, ca.OP_FMAX):
        return sources[0] | sources[1]
    if step.op == ca.OP_IF_ELSE_ZERO:
        off = (args[0][0] == 0) & (args[0][1] == 0)
        return off & sources[0] | sources[1]
    needed = [] if loose and OPERATIONS[step.op].jumps else sources[:1] if step.op == ca.OP_COPYSIGN else sources
    for part in needed:
        fine = fine & part
    return fine


def _is_operation_continuous(step: Instruction, result: IntervalPair, args: list[IntervalPair]) -> np.ndarray:
    """Whether the operation is proved continuous on its arguments."""
    if step.op in (ca.OP_INPUT, ca.OP_CONST):
        return np.full(1, bool(np.isfinite(step.number)))
    if step.op not in OPERATIONS:
        return np.zeros(1, bool)
    rule = OPERATIONS[step.op].continuous
    return np.ones(1, bool) if rule is None else rule(result, *args)


def reverse_slopes(
    code: Program, values: list[IntervalPair], seeds: tuple[int, ...], count: int, numbers: Sequence[np.ndarray] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return intervals s (len(seeds), count, n) with f(u) - f(v) = sum s_i (u_i - v_i) for all u, v in one box.

    ``numbers``: which values are numbers, where an operation has a value without (``run_with_numbers``).

    Such an s exists wherever every operation is Lipschitz on its arguments; elsewhere it is (-inf, inf). Slopes are carried
    backwards from the outputs ``seeds``, as in reverse differentiation.
    """
    shape = (len(seeds), count, code.inputs)
    lo, hi = np.zeros(shape), np.zeros(shape)
    bars: list[IntervalPair | None] = [None] * len(code.steps)
    for row, seed in enumerate(seeds):
        unit = np.zeros((len(seeds), 1))
        unit[row] = 1.0
        _accumulate_bar(bars, code.outputs[seed], (unit, unit))
    for i in reversed(range(len(code.steps))):
        step, bar = code.steps[i], bars[i]
        if bar is None or not code.uses[i]:
            continue
        bars[i] = None
        if step.op == ca.OP_INPUT:
            lo[:, :, step.slot], hi[:, :, step.slot] = bar
            continue
        args = [values[j] for j in step.sources]
        regular = _is_operation_continuous(step, values[i], args)
        if numbers and step.op in OPERATIONS and OPERATIONS[step.op].loose is not None:
            asking = step.sources[:1] if step.op == ca.OP_IF_ELSE_ZERO else step.sources
            regular = np.logical_and.reduce(np.broadcast_arrays(regular, *(numbers[j] for j in asking)))
        known = OPERATIONS[step.op].slopes(values[i], *args) if step.op in OPERATIONS else [UNBOUNDED] * len(args)
        for j, slope in zip(step.sources, known, strict=True):
            if code.uses[j]:
                _accumulate_bar(
                    bars,
                    j,
                    _multiply_slope(bar, slope) if regular.all() else mul(bar, select_interval(regular, slope, UNBOUNDED)),
                )
    return lo, hi


def _multiply_slope(bar: IntervalPair, slope: IntervalPair) -> IntervalPair:
    return bar if slope is ONE else neg(bar) if slope is MINUS_ONE else mul(bar, slope)


def _accumulate_bar(bars: list[IntervalPair | None], index: int, part: IntervalPair) -> None:
    old = bars[index]
    bars[index] = part if old is None else add(old, part)


class MeanValueBounds(NamedTuple):
    """Bounds of the entries over boxes: lo, hi and, in the middle, mid_lo, mid_hi (numel, k); slopes (numel, k, n)."""

    lo: np.ndarray
    hi: np.ndarray
    slope_lo: np.ndarray
    slope_hi: np.ndarray
    mid_lo: np.ndarray
    mid_hi: np.ndarray


def box_centre(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return a point of each box, the middle where it is bounded."""
    with np.errstate(all="ignore"):
        middle = np.clip(lower + (upper - lower) / 2, lower, upper)
    ends = np.where(np.isfinite(lower), lower, np.where(np.isfinite(upper), upper, 0.0))
    return np.where(np.isfinite(middle), middle, ends)


def mean_value_form(code: Program, lower: np.ndarray, upper: np.ndarray) -> MeanValueBounds:
    """Bounds of each entry by f(c) + sum s_i (x_i - c_i) and by the values themselves, whichever is better."""
    with np.errstate(all="ignore"):
        values, numbers = _run(code, lower, upper, _asks_for_numbers(code))
        middle = box_centre(lower, upper)
        at_middle = run_program(code, middle, middle)
        count, m = len(lower), len(code.outputs)
        lo, hi = reverse_slopes(code, values, tuple(range(m)), count, numbers)
        total = first = _stack_outputs(code, at_middle, count)
        for i in sorted(frozenset().union(*(code.uses[j] for j in code.outputs))):
            total = add(total, mul((lo[:, :, i], hi[:, :, i]), sub((lower[:, i], upper[:, i]), (middle[:, i], middle[:, i]))))
        plain = _stack_outputs(code, values, count)
        low, high = np.maximum(plain[0], total[0]), np.minimum(plain[1], total[1])
        empty = low > high  # undefined on the box, or at its middle
        return MeanValueBounds(np.where(empty, plain[0], low), np.where(empty, plain[1], high), lo, hi, *first)


def natural_extension(code: Program, lower: np.ndarray, upper: np.ndarray) -> IntervalPair:
    """Bounds (numel, k) of each entry over boxes (k, n)."""
    with np.errstate(all="ignore"):
        parts = [
            _stack_outputs(
                code,
                run_program(code, lower[i : i + code.boxes_per_run], upper[i : i + code.boxes_per_run]),
                len(lower[i:][: code.boxes_per_run]),
            )
            for i in range(0, len(lower), code.boxes_per_run)
        ] or [(np.zeros((len(code.outputs), 0)),) * 2]
    return np.concatenate([lo for lo, _ in parts], axis=1), np.concatenate([hi for _, hi in parts], axis=1)


def _stack_outputs(code: Program, values: list[IntervalPair], count: int) -> IntervalPair:
    """Return the values of the outputs as arrays (numel, count)."""
    lo, hi = np.zeros((len(code.outputs), count)), np.zeros((len(code.outputs), count))
    for row, index in enumerate(code.outputs):
        lo[row], hi[row] = values[index]
    return lo, hi


def validated_boxes(z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper as arrays (k, n).

    Raises:
        ValueError: their size is not that of z, an end is NaN, or lower > upper.
    """
    low, high = (end if end.ndim == 2 else end.reshape(1, -1) for end in (np.asarray(lower, float), np.asarray(upper, float)))
    if low.shape != high.shape or low.shape[1] != z.numel():
        raise ValueError(f"a box of shapes {np.shape(lower)} and {np.shape(upper)}; expected ({z.numel()},) or (k, {z.numel()})")
    if not (low <= high).all():
        raise ValueError("a box needs lower <= upper, and no NaN")
    return low, high


def enclose(expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> IntervalPair:
    """Return rigorous bounds of every entry of an expression over a box, or over each of several boxes.

    Args:
        expr: any shape, in the symbols z.
        z: (n, 1) symbols.
        lower, upper: (n,) or (k, n); ends may be infinite.

    Returns:
        lo, hi: of shape ``expr.shape``, or (k, then ``expr.shape``); -inf and inf where there is no bound, never NaN. A box that
            is one point, where the expression is not proved to have a value, gives no bound: 0 log 0 is not 0.

    Raises:
        ValueError: other symbols than z, or no box.
    """
    code, (low, high) = program(expr, z), validated_boxes(z, lower, upper)
    batch = np.ndim(lower) > 1
    rows, columns = code.shape
    ends = natural_extension(code, low, high)
    points = (low == high).all(axis=1)
    if points.any():
        numbers = np.ones((len(code.outputs), len(low)), bool)
        numbers[:, points] = _output_numbers(code, low[points])
        ends = select_interval(numbers, ends, UNBOUNDED)
    lo, hi = (part.T.reshape(len(low), columns, rows).transpose(0, 2, 1) for part in ends)
    return (lo, hi) if batch else (lo[0], hi[0])


def _output_numbers(code: Program, points: np.ndarray) -> np.ndarray:
    """Whether each output is proved to be a number (numel, k) at points (k, n)."""
    with np.errstate(all="ignore"):
        parts = [
            np.array([np.broadcast_to(numbers[j], len(own)) for j in code.outputs]).reshape(len(code.outputs), len(own))
            for own in (points[i : i + code.boxes_per_run] for i in range(0, len(points), code.boxes_per_run))
            for numbers in (run_with_numbers(code, own, own)[1],)
        ]
    return np.concatenate(parts, axis=1)


def is_number(expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether every entry of an expression is proved to have a value all over a box, without cutting it."""
    code, (low, high) = program(expr, z), validated_boxes(z, lower, upper)
    with np.errstate(all="ignore"):
        numbers = run_with_numbers(code, low, high)[1]
    return all(numbers[j].all() for j in code.outputs)


def is_continuous(expr: ca.SX, z: ca.SX, lower: np.ndarray, upper: np.ndarray) -> bool:
    """Whether every entry of an expression is proved to be defined and continuous on a box.

    The box is cut until no operation that jumps can switch within a part (a function continuous on each of finitely many
    closed parts is continuous on their union); False where this does not come to an end.

    Raises:
        ValueError: other symbols than z, or no box.
    """
    code, (low, high) = program(expr, z), validated_boxes(z, lower, upper)
    used = sorted(frozenset().union(*(code.uses[j] for j in code.outputs)))
    count = 0
    for _ in range(MAX_CUT_DEPTH * max(1, len(used))):
        count += len(low)
        smooth = np.concatenate([
            _are_boxes_continuous(code, low[i : i + code.boxes_per_run], high[i : i + code.boxes_per_run])
            for i in range(0, len(low), code.boxes_per_run)
        ])  # fmt: skip
        low, high = low[~smooth], high[~smooth]
        if not len(low):
            return True
        if count + 2 * len(low) > MAX_CONTINUITY_BOXES or (low[:, used] == high[:, used]).all(axis=1).any():
            return False
        widest = np.argmax(np.where(low[:, used] == high[:, used], -1.0, high[:, used] - low[:, used]), axis=1)
        low, high = bisect_boxes(low, high, np.array(used, int)[widest])
    return False


def _are_boxes_continuous(code: Program, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Whether each box (k, n) is proved to have no jump of an output in it, and to be where it is defined."""
    with np.errstate(all="ignore"):
        values = run_program(code, lower, upper)
        known: list[tuple[np.ndarray, np.ndarray]] = []
        for step, result in zip(code.steps, values, strict=True):
            args = [values[j] for j in step.sources]
            known.append(_value_regularity(step, result, args, [known[j] for j in step.sources]))
    total = np.ones(len(lower), bool)
    for index in code.outputs:
        total &= known[index][0] & known[index][1]
    return total


def _value_regularity(
    step: Instruction, result: IntervalPair, args: list[IntervalPair], sources: list[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether a value is proved to be continuous, and defined; jumps do not matter to what is constant all the same."""
    own, jumps = _is_operation_continuous(step, result, args), step.op in OPERATIONS and OPERATIONS[step.op].jumps
    smooth, defined = own, np.ones(1, bool) if jumps else own
    if step.op == ca.OP_IF_ELSE_ZERO:
        off = (args[0][0] == 0) & (args[0][1] == 0)
        return own & sources[0][0] & (off | sources[1][0]), sources[0][1] & (off | sources[1][1])
    for continuous, fine in sources:
        smooth, defined = smooth if jumps else smooth & continuous, defined & fine
    return smooth, defined


def cut_points(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return where to cut intervals: the middle, 0 where it is not far off; unbounded ones at 0, 1 and powers of 2."""
    with np.errstate(all="ignore"):
        middle = lower + (upper - lower) / 2
        off = np.minimum(-lower, upper) >= 0.1 * np.maximum(-lower, upper)
        rising = np.where(lower < 0, 0.0, np.where(lower < 1, 1.0, 2 * lower))
        falling = np.where(upper > 0, 0.0, np.where(upper > -1, -1.0, 2 * upper))
    free = np.isinf(lower) & np.isinf(upper)
    middle = np.where(
        free, 0.0, np.where(np.isinf(upper), rising, np.where(np.isinf(lower), falling, np.where(off, 0.0, middle)))
    )
    return np.clip(np.clip(middle, -LARGEST_DOUBLE, LARGEST_DOUBLE), lower, upper)


def bisect_boxes(lower: np.ndarray, upper: np.ndarray, coordinate: np.ndarray) -> IntervalPair:
    """Return the halves (2k, n) of boxes (k, n), each cut in its coordinate (k,)."""
    rows = np.arange(len(lower))
    where = cut_points(lower[rows, coordinate], upper[rows, coordinate])
    left, right = upper.copy(), lower.copy()
    left[rows, coordinate], right[rows, coordinate] = where, where
    return np.concatenate([lower, right]), np.concatenate([left, upper])
