"""What code does to numbers, as straight Python: it runs once, on symbols that note each operation.

An operation on numbers alone is done and not noted, one with 0 or 1 is none: what is 0 in all runs costs nothing. Operations are
those of the code, in its order: the numbers are the same bits. But for the sign of 0, for 0 times what is no number, which is 0,
and for ``sum``, which is a chain of additions: of floats it makes up for their rounding from Python 3.12 on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import CodeType
from typing import Any

NESTED = 24  # Operations within one another in an expression; the parser's limit is beyond.


class TooManyOperations(Exception):
    """More operations than were allowed."""


class TracedNumber:
    """A number that is not known yet; true where it is asked: it may be other than 0."""

    __slots__ = ("place", "tape")

    def __init__(self, tape: TracingTape, place: int) -> None:
        self.tape, self.place = tape, place

    def __add__(self, other: Any) -> Any:
        """+."""
        return self if _equals_constant(other, 0) else self.tape.note("({} + {})", self, other)

    def __radd__(self, other: Any) -> Any:
        """+."""
        return self if _equals_constant(other, 0) else self.tape.note("({} + {})", other, self)

    def __sub__(self, other: Any) -> Any:
        """-."""
        return self if _equals_constant(other, 0) else self.tape.note("({} - {})", self, other)

    def __rsub__(self, other: Any) -> Any:
        """-."""
        return self.tape.note("({} - {})", other, self)

    def __mul__(self, other: Any) -> Any:
        """*."""
        return (
            0.0
            if _equals_constant(other, 0)
            else self
            if _equals_constant(other, 1)
            else self.tape.note("({} * {})", self, other)
        )

    def __rmul__(self, other: Any) -> Any:
        """*."""
        return (
            0.0
            if _equals_constant(other, 0)
            else self
            if _equals_constant(other, 1)
            else self.tape.note("({} * {})", other, self)
        )

    def __truediv__(self, other: Any) -> Any:
        """/."""
        return self if _equals_constant(other, 1) else self.tape.note("({} / {})", self, other)

    def __rtruediv__(self, other: Any) -> Any:
        """/."""
        return 0.0 if _equals_constant(other, 0) else self.tape.note("({} / {})", other, self)

    def __neg__(self) -> TracedNumber:
        """-."""
        return self.tape.note("(-{})", self)

    def __gt__(self, other: Any) -> Any:
        """Noted, as are the others."""
        return self.tape.note("({} > {})", self, other)

    def __eq__(self, other: object) -> Any:
        """Noted."""
        return self.tape.note("({} == {})", self, other)

    def __ne__(self, other: object) -> Any:
        """Noted."""
        return self.tape.note("({} != {})", self, other)

    __hash__ = None  # pyright: ignore[reportAssignmentType]


def _equals_constant(value: Any, number: int) -> bool:
    return not isinstance(value, TracedNumber) and value == number


class TracingTape:
    """Operations, each once: its text with places for what it is applied to; ``most``: how many are allowed."""

    def __init__(self, most: int) -> None:
        self.most = most
        self._ops: list[tuple[str, tuple[Any, ...]]] = []
        self._known: dict[tuple, int] = {}

    def note(self, text: str, *args: Any) -> TracedNumber:
        """The symbol of an operation."""
        key = (text, *(("", arg.place) if isinstance(arg, TracedNumber) else arg for arg in args))
        if key not in self._known:
            if len(self._ops) >= self.most:
                raise TooManyOperations
            self._known[key] = len(self._ops)
            self._ops.append((text, args))
        return TracedNumber(self, self._known[key])

    def known(self, functions: Mapping[str, Callable[..., float]]) -> dict[str, Callable[..., Any]]:
        """The functions, and ``where``, ``both`` and ``one`` of `printed.SYMBOLS`: noted where they see a symbol."""
        found = {
            name: self._traced(f"{name}({{}}{', {}' * (name in ('atan2', 'hypot', 'pow'))})", f) for name, f in functions.items()
        }
        found["where"] = self._traced("({1} if {0} else {2})", lambda condition, a, b: a if condition else b)
        found["both"] = self._traced("({} and {})", lambda a, b: a and b)
        found["one"] = self._traced("({} or {})", lambda a, b: a or b)
        return found

    def _traced(self, text: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def traced_call(*args: Any) -> Any:
            return self.note(text, *args) if any(isinstance(arg, TracedNumber) for arg in args) else function(*args)

        return traced_call

    def written(self, names: Sequence[str], parameters: str, outputs: Sequence[tuple[str, Any]]) -> CodeType:
        """``make(names)``, which returns ``of(parameters)``: it computes what it puts to ``outputs``, (where, symbol or list)."""
        uses = [0] * len(self._ops)
        flat = [one for _, value in outputs for one in (value if isinstance(value, list) else [value])]
        for one in flat:
            if isinstance(one, TracedNumber):
                uses[one.place] += 1
        for place in range(len(uses) - 1, -1, -1):
            for arg in self._ops[place][1] if uses[place] else ():
                if isinstance(arg, TracedNumber):
                    uses[arg.place] += 1
        texts, depth, lines = [""] * len(uses), [0] * len(uses), []
        for place, (text, args) in enumerate(self._ops):
            if not uses[place]:
                continue
            inner = [arg.place for arg in args if isinstance(arg, TracedNumber)]
            value = text.format(*(texts[arg.place] if isinstance(arg, TracedNumber) else _number_text(arg) for arg in args))
            depth[place] = 1 + max((depth[arg] for arg in inner), default=0)
            if args and uses[place] == 1 and depth[place] < NESTED:
                texts[place] = value
            else:
                texts[place], depth[place] = f"v{place}", 0
                lines.append(f"        v{place} = {value}\n")

        def operand_text(one: Any) -> str:
            return texts[one.place] if isinstance(one, TracedNumber) else _number_text(one)

        lines += [
            f"        {where} = "
            f"{f'[{chr(44).join(map(operand_text, value))}]' if isinstance(value, list) else operand_text(value)}\n"
            for where, value in outputs
        ]
        text = f"def make({', '.join(names)}):\n    def of({parameters}):\n{''.join(lines)}    return of\n"
        return compile(text, "<noted>", "exec")


def _number_text(value: float) -> str:
    return repr(value) if math.isfinite(value) else f"float('{value!r}')"
