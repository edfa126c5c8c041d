"""The residual of a row of a law as C, written by the formula that Python evaluates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from nsmodel.solve.certificate import ResidualOperations, box_residual


@dataclass(frozen=True)
class CText:
    """An expression of C, with the operators that the formula has."""

    text: str

    def __sub__(self, other: CText) -> CText:
        """Of two names."""
        return CText(f"{self.text} - {other.text}")

    def __lt__(self, other: float) -> CText:
        """A comparison of a name with a number."""
        return CText(f"{self.text} < {other:g}")

    def __gt__(self, other: float) -> CText:
        """A comparison of a name with a number."""
        return CText(f"{self.text} > {other:g}")

    def __str__(self) -> str:
        """The C itself."""
        return self.text


class _BoundNames(NamedTuple):
    """The ends of a row by their names in C."""

    lower: CText
    upper: CText


def _c_call(name: str) -> Any:
    return lambda *given: CText(f"{name}({', '.join(map(str, given))})")


def _unsupported_operation(*given: Any) -> CText:
    raise NotImplementedError("the residual of a row needs no masks")


C_OPERATIONS = ResidualOperations(
    abs=_c_call("fabs"),
    max=_c_call("max_of"),
    min=_c_call("min_of"),
    where=lambda condition, a, b: CText(f"{condition} ? {a} : {b}"),
    choose=_unsupported_operation,
    largest=_unsupported_operation,
    lesser=lambda a, b, end: CText(f"min_of({a},\n                  is_finite({end}) ? {b} : INFINITY)"),
    ratio=_c_call("ratio"),
)


def row_residual_code() -> str:
    """The value of ``row_residual`` in `affine.c`."""
    lo, up, l, y, s_y, s_l = map(CText, ("lo", "up", "l", "y", "s_y", "s_l"))
    law: Any = _BoundNames(lo, up)
    return str(box_residual(law, l, y, s_y, s_l, C_OPERATIONS))
