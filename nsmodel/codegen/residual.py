"""The residual of a row of a law as C, written by the formula that Python evaluates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from nsmodel.solve.certificate import Ops, box_residual


@dataclass(frozen=True)
class Text:
    """An expression of C, with the operators that the formula has."""

    text: str

    def __sub__(self, other: Text) -> Text:
        """Of two names."""
        return Text(f"{self.text} - {other.text}")

    def __lt__(self, other: float) -> Text:
        """A comparison of a name with a number."""
        return Text(f"{self.text} < {other:g}")

    def __gt__(self, other: float) -> Text:
        """A comparison of a name with a number."""
        return Text(f"{self.text} > {other:g}")

    def __str__(self) -> str:
        """The C itself."""
        return self.text


class _Row(NamedTuple):
    """The ends of a row by their names in C."""

    lower: Text
    upper: Text


def _called(name: str) -> Any:
    return lambda *given: Text(f"{name}({', '.join(map(str, given))})")


def _unused(*given: Any) -> Text:
    raise NotImplementedError("the residual of a row needs no masks")


C = Ops(
    abs=_called("fabs"),
    max=_called("max_of"),
    min=_called("min_of"),
    where=lambda condition, a, b: Text(f"{condition} ? {a} : {b}"),
    choose=_unused,
    largest=_unused,
    lesser=lambda a, b, end: Text(f"min_of({a},\n                  is_finite({end}) ? {b} : INFINITY)"),
    ratio=_called("ratio"),
)


def of_row() -> str:
    """The value of ``row_residual`` in `affine.c`."""
    lo, up, l, y, s_y, s_l = map(Text, ("lo", "up", "l", "y", "s_y", "s_l"))
    law: Any = _Row(lo, up)
    return str(box_residual(law, l, y, s_y, s_l, C))
