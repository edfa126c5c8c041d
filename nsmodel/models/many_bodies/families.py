"""Many bodies, what stands around them, and the families of constraints between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from nsmodel._utils import checks_keywords, short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.parameters import describe_argument
from nsmodel.modeling.pickling import Picklable
from nsmodel.proof.expression_graph import POLYNOMIAL_OPERATIONS, apply_operation, fold_graph, operation_codes


class GroupMember(Picklable):
    """Any one member of a group, in symbols: ``i.q``, ``i.r``, ... are columns of SX, scalars where one number is meant."""

    def __init__(self, group: Items, name: str) -> None:
        self.group, self.name = group, name
        for key, values in group.numbers.items():
            setattr(self, key, ca.SX.sym(f"{name}.{key}", values.shape[1]))

    if TYPE_CHECKING:

        def __getattr__(self, key: str) -> Any: ...

    @property
    def symbols(self) -> ca.SX:
        """All of them as one column, in the order of ``group.numbers``."""
        return ca.vertcat(ca.SX(0, 1), *(getattr(self, key) for key in self.group.numbers))

    @property
    def made_of(self) -> Mapping[str, Any]:
        """The group under its name: all members of a group have the same numbers."""
        return {self.name: self.group}

    def __repr__(self) -> str:
        """Return the name and what it has."""
        return f"{self.name} with {', '.join(f'{self.name}.{key}' for key in self.group.numbers)}"


class Items(Picklable):
    """Things that do not move, such as walls: ``Items(a=starts, b=ends)``, each an array of one row (or number) an item.

    Attributes:
        numbers: {name: (count, k) array}.
        count: how many there are.

    Raises:
        ModelError: arrays of different lengths, entries that are no finite numbers.
    """

    __repr__ = short_repr

    def __init__(self, **numbers: Any) -> None:
        if not numbers:
            raise ModelError("Items: no numbers are given; give for example Items(a=starts, b=ends)")
        self.numbers: Mapping[str, np.ndarray] = MappingProxyType(
            {key: _checked_rows(value, key) for key, value in numbers.items()}
        )
        lengths = {key: len(value) for key, value in self.numbers.items()}
        if len(set(lengths.values())) != 1:
            listed = ", ".join(f"{key} has {length}" for key, length in lengths.items())
            raise ModelError(f"one row for each is needed, but {listed}")
        self.count = next(iter(lengths.values()))

    @property
    def made_of(self) -> Mapping[str, Any]:
        """The numbers of the items."""
        return self.numbers

    def member(self, name: str) -> GroupMember:
        """Any one of them, in symbols that begin with ``name``."""
        return GroupMember(self, name)

    @property
    def table(self) -> np.ndarray:
        """All numbers of each, side by side (count, K), in the order of ``Member.symbols``."""
        return np.hstack(list(self.numbers.values()))


class Bodies(Items):
    """Bodies that move: ``Bodies(q0, r=radii)`` has the starts q0 (count, d) and further numbers of each body.

    The state of a member i is ``i.q`` (d,).
    """

    def __init__(self, q0: Any, **numbers: Any) -> None:
        if "q" in numbers:
            raise ModelError(
                "q is the state of each body; give the initial positions as the first argument, other numbers under other names"
            )
        super().__init__(q=q0, **numbers)

    @property
    def q0(self) -> np.ndarray:
        """The starts (count, d)."""
        return self.numbers["q"]

    @property
    def d(self) -> int:
        """States of each body."""
        return self.q0.shape[1]


@dataclass(frozen=True, eq=False)
class Family(Picklable):
    """One constraint g >= 0 for many: ``Family(g, i)``, ``Family(g, i, j)``, ``Family(g, i, w)``.

    Attributes:
        g: a scalar expression of the members' symbols (and t, and parameters), convex in the states.
        first: a member of the bodies.
        second: another member of the same bodies, or a member of some Items; None: the constraint is on each body alone.
        over: the members it runs over: (P, 2) numbers, or (P,) for each body alone. Left out: all bodies; all pairs i < j of
            bodies; all bodies with all items. Of those, a step looks only at what is near (see `reach`).
    """

    g: Any
    first: GroupMember
    second: GroupMember | None = None
    over: Any = None

    __repr__ = short_repr

    @property
    def of_pairs(self) -> bool:
        """Whether both members are bodies."""
        return self.second is not None and isinstance(self.second.group, Bodies)

    @property
    def members(self) -> tuple[GroupMember, ...]:
        """The one or two of which g speaks."""
        return (self.first,) if self.second is None else (self.first, self.second)

    @property
    def moving(self) -> tuple[GroupMember, ...]:
        """Those of them that are bodies."""
        return tuple(member for member in self.members if isinstance(member.group, Bodies))

    @property
    def count(self) -> int:
        """How many constraints there are."""
        if self.over is not None:
            return len(self.over)
        n = self.first.group.count
        return n * (n - 1) // 2 if self.of_pairs else n * (1 if self.second is None else self.second.group.count)

    @property
    def pairs(self) -> np.ndarray:
        """All the members it runs over (P, 2), the second -1 where there is none."""
        n = self.first.group.count
        if self.over is not None:
            return self.over
        if self.of_pairs:
            return np.column_stack(np.triu_indices(n, 1))
        m = 1 if self.second is None else self.second.group.count
        pairs = np.column_stack([np.repeat(np.arange(n), m), np.tile(np.arange(m), n)])
        return pairs if self.second is not None else np.column_stack([pairs[:, 0], np.full(n, -1)])

    @cached_property
    def reach(self) -> ca.SX | None:
        """c where g = |q_i - q_j| - c with c >= 0 a function of numbers: what a neighbour search needs; else None."""
        if not self.of_pairs:
            return None
        q, p = (member.q for member in self.moving)
        return -ca.substitute(self.g, ca.vertcat(q, p), ca.SX.zeros(2 * q.numel())) if is_distance(self.g, q, p) else None


@checks_keywords
def neighbours(count: int) -> np.ndarray:
    """The pairs (0, 1), (1, 2), ... of a chain (count - 1, 2)."""
    return np.column_stack([np.arange(count - 1), np.arange(1, count)])


def is_distance(g: Any, q: ca.SX, p: ca.SX) -> bool:
    """Whether g is written as |q - p| and what does not depend on q and p, added or taken away."""
    z, root = ca.vertcat(q, p), ca.OP_SQRT if q.numel() > 1 else ca.OP_FABS
    states = {symbol.element_hash() for symbol in ca.vertsplit(z)}
    free, other = 0, None  # What a node has of |q - p|: that many times it and what is free of q and p; None: anything else.

    def apply(op: int, parts: list[tuple[int | None, ca.SX]]) -> tuple[int | None, ca.SX]:
        times = [part[0] for part in parts]
        if op == ca.OP_CALL:
            return other, ca.SX(0)
        expr = apply_operation(op, [part[1] for part in parts])
        if all(number == free for number in times):
            return free, expr
        if op == root and _is_squared_difference(parts[0][1], q, p):
            return 1, expr
        if any(number is None for number in times) or op not in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG, ca.OP_ASSIGN):
            return other, expr
        first, *second = [number for number in times if number is not None]
        return (-first if op == ca.OP_NEG else first + (-1 if op == ca.OP_SUB else 1) * sum(second)), expr

    parts = fold_graph(
        ca.SX(g), lambda s: (other if s.element_hash() in states else free, s), lambda value: (free, ca.SX(value)), apply
    )
    return parts[0][0] == 1


def _is_squared_difference(inside: ca.SX, q: ca.SX, p: ca.SX) -> bool:
    """Whether a root's argument is |q - p|^2, or that of an absolute value q - p or p - q."""
    if not operation_codes(inside) <= POLYNOMIAL_OPERATIONS:
        return False
    z, one = ca.vertcat(q, p), q.numel() == 1
    wanted = q - p if one else ca.sumsqr(q - p)
    if one and not _are_equal_matrices(ca.jacobian(inside, z), ca.jacobian(wanted, z)):
        wanted = p - q
    at_zero = ca.substitute(ca.vertcat(inside, ca.gradient(inside - wanted, z)), z, ca.SX.zeros(2 * q.numel()))
    return ca.densify(at_zero).is_zero() and _are_equal_matrices(ca.hessian(inside, z)[0], ca.hessian(wanted, z)[0])


def _are_equal_matrices(a: ca.SX, b: ca.SX) -> bool:
    """Whether two matrices are numbers, and the same ones."""
    return not ca.symvar(a) and not ca.symvar(b) and bool(np.array_equal(np.array(ca.DM(a)), np.array(ca.DM(b))))


def _checked_rows(value: Any, label: str) -> np.ndarray:
    """One row of numbers for each member (count, k)."""
    try:
        array = np.array(value, float)
    except (TypeError, ValueError):
        raise ModelError(f"{label}: {describe_argument(value)}; expected numbers, one row for each") from None
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2 or not array.size:
        raise ModelError(f"{label}: shape {array.shape}; expected (count,) or (count, k)")
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        raise ModelError(f"{label}[{bad[0, 0]}] = {array[tuple(bad[0])]}; expected finite numbers")
    array.setflags(write=False)
    return array


def checked_entry_times(enter: Any, n: int) -> np.ndarray:
    """When each body enters (n,)."""
    times = _checked_rows(enter, "enter").ravel()
    if times.size != n or (times < 0).any():
        raise ModelError(f"enter: {times.size} times, the least {times.min():g}; expected {n} times >= 0, one for each body")
    return times


def checked_member_numbers(family: Family, label: str) -> np.ndarray:
    """``over`` as whole numbers (P, 2), the second -1 where there is none."""
    over = np.asarray(family.over)
    if family.second is None:
        over = np.column_stack([over.ravel(), np.full(over.size, -1)])
    if over.ndim != 2 or over.shape[1] != 2 or not (np.isreal(over).all() and (over == over.astype(int)).all()):
        raise ModelError(f"{label}: over has shape {np.shape(family.over)}; expected (P, 2) numbers of members")
    over = over.astype(int)
    for column, member in enumerate((family.first, family.second)):
        if member is None:
            continue
        wrong = np.flatnonzero((over[:, column] < 0) | (over[:, column] >= member.group.count))
        if wrong.size:
            raise ModelError(
                f"{label}: over[{wrong[0]}] names {member.name} = {over[wrong[0], column]}; "
                f"expected a number from 0 to {member.group.count - 1}"
            )
    if family.of_pairs and (over[:, 0] == over[:, 1]).any():
        raise ModelError(f"{label}: over pairs a body with itself (number {over[over[:, 0] == over[:, 1]][0, 0]})")
    return over
