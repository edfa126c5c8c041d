"""Sweeping processes of many bodies: one symbolic constraint for a pair, and the pairs it runs over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel.classes.sweeping.model import SweepingProcess
from nsmodel.errors import ModelError
from nsmodel.model.base import Model, shown
from nsmodel.model.convert import to_sx
from nsmodel.model.parameters import gathered
from nsmodel.pickled import Pickled
from nsmodel.proof.graph import applied, fold, operations

_POLYNOMIAL = {
    ca.OP_INPUT,
    ca.OP_OUTPUT,
    ca.OP_CONST,
    ca.OP_ASSIGN,
    ca.OP_ADD,
    ca.OP_SUB,
    ca.OP_NEG,
    ca.OP_MUL,
    ca.OP_SQ,
    ca.OP_TWICE,
}
WRITTEN_OUT_UP_TO = 20_000  # Constraints that `written_out` puts into one model.


class Member(Pickled):
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


class Items(Pickled):
    """Things that do not move, such as walls: ``Items(a=starts, b=ends)``, each an array of one row (or number) an item.

    Attributes:
        numbers: {name: (count, k) array}.
        count: how many there are.

    Raises:
        ModelError: arrays of different lengths, entries that are no finite numbers.
    """

    def __init__(self, **numbers: Any) -> None:
        if not numbers:
            raise ModelError("Items: no numbers are given; give for example Items(a=starts, b=ends)")
        self.numbers: Mapping[str, np.ndarray] = MappingProxyType({key: _rows(value, key) for key, value in numbers.items()})
        lengths = {key: len(value) for key, value in self.numbers.items()}
        if len(set(lengths.values())) != 1:
            listed = ", ".join(f"{key} has {length}" for key, length in lengths.items())
            raise ModelError(f"one row for each is needed, but {listed}")
        self.count = next(iter(lengths.values()))

    @property
    def made_of(self) -> Mapping[str, Any]:
        """The numbers."""
        return self.numbers

    def member(self, name: str) -> Member:
        """Any one of them, in symbols that begin with ``name``."""
        return Member(self, name)

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
                "q is the state of each body; give the starts as the first argument, other numbers under other names"
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
class Family(Pickled):
    """One constraint g >= 0 for many: ``Family(g, i)``, ``Family(g, i, j)``, ``Family(g, i, w)``.

    Attributes:
        g: a scalar expression of the members' symbols (and t, and parameters), convex in the states.
        first: a member of the bodies.
        second: another member of the same bodies, or a member of some Items; None: the constraint is on each body alone.
        over: the members it runs over: (P, 2) numbers, or (P,) for each body alone. Left out: all bodies; all pairs i < j of
            bodies; all bodies with all items. Of those, a step looks only at what is near (see `reach`).
    """

    g: Any
    first: Member
    second: Member | None = None
    over: Any = None

    @property
    def of_pairs(self) -> bool:
        """Whether both members are bodies."""
        return self.second is not None and isinstance(self.second.group, Bodies)

    @property
    def members(self) -> tuple[Member, ...]:
        """The one or two of which g speaks."""
        return (self.first,) if self.second is None else (self.first, self.second)

    @property
    def moving(self) -> tuple[Member, ...]:
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
        return -ca.substitute(self.g, ca.vertcat(q, p), ca.SX.zeros(2 * q.numel())) if _is_distance(self.g, q, p) else None


def neighbours(count: int) -> np.ndarray:
    """The pairs (0, 1), (1, 2), ... of a chain (count - 1, 2)."""
    return np.column_stack([np.arange(count - 1), np.arange(1, count)])


@dataclass(frozen=True, kw_only=True, eq=False)
class ManyBodies(Model):
    """q_i'(t) + N(Q(t), q)_i ∋ f(t, q_i) for many bodies i, Q(t) = {q : all constraints of all families >= 0}.

    The scheme is that of `SweepingProcess`; what it costs follows what acts in a step. Bodies may leave, and enter.

    Attributes:
        bodies: the bodies, with their starts.
        f: the velocity that a body would have alone: d expressions of one member's symbols and t; or a function
            (t, q (N, d)) -> (N, d), called once a step (rows of absent bodies are NaN and do not matter; an attribute
            ``autonomous`` that is True says that it does not depend on t); left out: 0.
        constraints: {name: Family}.
        leave: an expression of one member's symbols (and t): a body leaves after the step that makes it > 0.
        enter: times (count,) from which each body is there, as soon as its start is free; left out: 0.
        scene: {"walls": (W, 2, 2), "exits": (E, 2, 2), "exit_names": (E,), "radii": (N,)} for pictures, bodies in the plane.

    Raises:
        ModelError: wrong shapes, undeclared symbols, NaN.
    """

    bodies: Bodies
    f: Any = None
    constraints: Any = None
    leave: Any = None
    enter: Any = None
    scene: Mapping[str, Any] | None = None

    q: ca.SX = field(init=False, repr=False)
    me: Member = field(init=False, repr=False)  # Any one of the bodies, in symbols.

    paper: ClassVar[str] = SweepingProcess.paper
    schemes: ClassVar[tuple[str, ...]] = SweepingProcess.schemes
    letter: ClassVar[str] = "q"
    refuses: ClassVar[Mapping[str, str]] = {
        "stress": "is a model of many bodies, whose steps are judged as they are taken; push a small scene written out, "
        "stress(model.written_out())",
        "study": "is a model of many bodies, whose states come and go; study a small scene written out, "
        "study(model.written_out()), or compare two runs of simulate(model, step=...)",
    }

    def _declare(self) -> None:
        if not isinstance(self.bodies, Bodies):
            raise ModelError(f"bodies: {shown(self.bodies)}; expected Bodies(q0, r=...)")
        n, d = self.bodies.q0.shape
        self._settle("q", q=ca.SX.sym("q", n * d))
        families = {} if self.constraints is None else self.constraints
        if not isinstance(families, Mapping):
            raise ModelError(f"constraints: expected a dictionary {{name: Family(...)}}, not a {type(families).__name__}")
        me = self.bodies.member("i")
        self._set(
            me=me,
            f=self.f if callable(self.f) and not isinstance(self.f, ca.SX) else self._of_one(self.f, "f", d, me),
            constraints=MappingProxyType({str(name): self._family(name, family) for name, family in families.items()}),
            leave=None if self.leave is None else self._of_one(self.leave, "leave", 1, me),
            enter=np.zeros(n) if self.enter is None else _times(self.enter, n),
            scene=None if self.scene is None else _scene(self.scene, n),
        )

    @property
    def row_names(self) -> tuple[str, ...]:
        """Those of the constraints and of the numbers of bodies."""
        return (*self.constraints, *self.bodies.numbers)

    @property
    def q0(self) -> np.ndarray:
        """The starts, one after the other (count d,)."""
        return self.bodies.q0.ravel()

    @property
    def axes(self) -> tuple[tuple[str, ...], Mapping[str, Sequence[int]]]:
        """Those of one body: ``i.q_0``, ``i.q_1``, ... with the stem ``i.q``."""
        return tuple(symbol.name() for symbol in ca.vertsplit(self.me.q)), {f"{self.me.name}.q": range(self.bodies.d)}

    def points(self, rows: np.ndarray) -> np.ndarray:
        """A point for each body in each row."""
        return rows.reshape(-1, self.bodies.d)

    def _symbols(self, *members: Member) -> dict[str, ca.SX]:
        """{name: symbol} of what an expression of these members may use."""
        known = ca.vertcat(self.t, self.p, *(member.symbols for member in members))
        return {symbol.name(): symbol for symbol in ca.vertsplit(known)}

    def _of_one(self, value: Any, label: str, size: int, me: Member) -> ca.SX:
        """``size`` expressions of the symbols of any one body, written with those of ``me``."""
        value = 0 if value is None else value
        if isinstance(value, list | tuple) and any(isinstance(entry, ca.SX) for entry in value):
            value = ca.vertcat(*(entry if isinstance(entry, ca.SX) else to_sx(entry, {}, label) for entry in value))
        column = ca.densify(ca.SX(value)) if isinstance(value, ca.SX) else ca.densify(to_sx(value, {}, label))
        column = ca.SX.zeros(size) if column.numel() == 1 and size != 1 and column.is_zero() else ca.vec(column)
        if column.numel() != size:
            raise ModelError(f"{label}: shape {column.shape}; expected {size} expression{'s' * (size > 1)} of one body's symbols")
        prefixes = {s.name().partition(".")[0] for s in ca.symvar(column) if "." in s.name()}
        if len(prefixes) > 1:
            raise ModelError(f"{label} speaks of several bodies ({', '.join(sorted(prefixes))}); it is a function of one")
        for prefix in prefixes - {me.name}:
            one = {s.name(): s for s in ca.symvar(column)}
            mine = self._symbols(me)
            own = {name: me.name + name[len(prefix) :] for name in one if "." in name}
            unknown = [name for name, wanted in own.items() if wanted not in mine]
            if unknown:
                raise ModelError(f"{label} depends on '{unknown[0]}', which the bodies do not have; they have {self._has()}")
            column = ca.substitute(column, ca.vertcat(*(one[k] for k in own)), ca.vertcat(*(mine[k] for k in own.values())))
        return to_sx(column, self._symbols(me), label)

    def _has(self) -> str:
        return ", ".join(self.bodies.numbers)

    def _family(self, name: Any, family: Any) -> Family:
        """The family checked: a scalar g of its members' symbols, numbers of members that exist."""
        label = f"constraint '{name}'"
        if not isinstance(family, Family):
            raise ModelError(f"{label}: {shown(family)}; expected Family(g, i, j) with members i, j of the bodies or of items")
        first, second = family.first, family.second
        if not isinstance(first, Member) or first.group is not self.bodies:
            raise ModelError(
                f"{label}: the first member, {shown(first)}, is not one of the model's bodies; take bodies.member('i')"
            )
        if second is not None and (not isinstance(second, Member) or (family.of_pairs and second.group is not self.bodies)):
            raise ModelError(f"{label}: the second member, {shown(second)}, is neither a body of the model nor one of some Items")
        if second is not None and second.name == first.name:
            raise ModelError(f"{label}: both members are called '{first.name}'; give them different names")
        g = ca.densify(to_sx(family.g, self._symbols(*family.members), label))
        if g.numel() != 1:
            raise ModelError(f"{label}: shape {g.shape}; expected one scalar expression")
        over = None if family.over is None else _numbers_of_members(family, label)
        return Family(g, first, second, over)

    def written_out(self) -> SweepingProcess:
        """The same process with its constraints one by one, for small scenes; who leaves and enters is not in it.

        Raises:
            ModelError: f is a function, or there are more than WRITTEN_OUT_UP_TO constraints.
        """
        count = sum(family.count for family in self.constraints.values())
        if count > WRITTEN_OUT_UP_TO:
            raise ModelError(f"{count} constraints are too many to be written out; at most {WRITTEN_OUT_UP_TO}")
        if not isinstance(self.f, ca.SX):
            raise ModelError("f is a function of numbers; to write the model out it must be an expression")
        n, d = self.bodies.q0.shape
        q = [self.q[i * d : (i + 1) * d] for i in range(n)]
        numbers = self.bodies.table[:, d:]
        own = ca.Function("f", [self.t, self.p, self.me.symbols], [self.f])
        rows = {}
        for name, family in self.constraints.items():
            members = [family.first.symbols, ca.SX(0, 1) if family.second is None else family.second.symbols]
            g = ca.Function("g", [self.t, self.p, *members], [family.g])
            for i, j in family.pairs.tolist():
                one = ca.vertcat(q[i], numbers[i])
                other = ca.SX(0, 1)
                if family.second is not None:
                    other = ca.vertcat(q[j], numbers[j]) if family.of_pairs else ca.SX(family.second.group.table[j])
                rows[f"{name} {i}" if j < 0 else f"{name} {i}-{j}"] = g(self.t, self.p, one, other)
        shared = {key: getattr(self, key) for key in ("t_end", "step", "steps", "exact", "title")}
        units = {name: unit for name, unit in self.units.items() if name in ("t", *self.stems, *(self.names or ()))}
        scene = self.scene and {key: self.scene[key] for key in ("radii", "walls") if key in self.scene}
        f = ca.vertcat(*(own(self.t, self.p, ca.vertcat(q[i], numbers[i])) for i in range(n)))
        return SweepingProcess(
            t=self.t, q=self.q, f=f, constraints=rows, q0=self.q0, parameters=gathered(self.parameters, self.vectors),
            scene=scene, units=units, **shared,
        )  # fmt: skip


def _is_distance(g: Any, q: ca.SX, p: ca.SX) -> bool:
    """Whether g is written as |q - p| and what does not depend on q and p, added or taken away."""
    z, root = ca.vertcat(q, p), ca.OP_SQRT if q.numel() > 1 else ca.OP_FABS
    states = {symbol.element_hash() for symbol in ca.vertsplit(z)}
    free, other = 0, None  # What a node has of |q - p|: that many times it and what is free of q and p; None: anything else.

    def apply(op: int, parts: list[tuple[int | None, ca.SX]]) -> tuple[int | None, ca.SX]:
        times = [part[0] for part in parts]
        if op == ca.OP_CALL:
            return other, ca.SX(0)
        expr = applied(op, [part[1] for part in parts])
        if all(number == free for number in times):
            return free, expr
        if op == root and _is_between(parts[0][1], q, p):
            return 1, expr
        if any(number is None for number in times) or op not in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG, ca.OP_ASSIGN):
            return other, expr
        first, *second = [number for number in times if number is not None]
        return (-first if op == ca.OP_NEG else first + (-1 if op == ca.OP_SUB else 1) * sum(second)), expr

    parts = fold(
        ca.SX(g), lambda s: (other if s.element_hash() in states else free, s), lambda value: (free, ca.SX(value)), apply
    )
    return parts[0][0] == 1


def _is_between(inside: ca.SX, q: ca.SX, p: ca.SX) -> bool:
    """Whether a root's argument is |q - p|^2, or that of an absolute value q - p or p - q."""
    if not operations(inside) <= _POLYNOMIAL:
        return False
    z, one = ca.vertcat(q, p), q.numel() == 1
    wanted = q - p if one else ca.sumsqr(q - p)
    if one and not _same_matrix(ca.jacobian(inside, z), ca.jacobian(wanted, z)):
        wanted = p - q
    at_zero = ca.substitute(ca.vertcat(inside, ca.gradient(inside - wanted, z)), z, ca.SX.zeros(2 * q.numel()))
    return ca.densify(at_zero).is_zero() and _same_matrix(ca.hessian(inside, z)[0], ca.hessian(wanted, z)[0])


def _same_matrix(a: ca.SX, b: ca.SX) -> bool:
    """Whether two matrices are numbers, and the same ones."""
    return not ca.symvar(a) and not ca.symvar(b) and bool(np.array_equal(np.array(ca.DM(a)), np.array(ca.DM(b))))


def _rows(value: Any, label: str) -> np.ndarray:
    """One row of numbers for each member (count, k)."""
    try:
        array = np.array(value, float)
    except (TypeError, ValueError):
        raise ModelError(f"{label}: {shown(value)}; expected numbers, one row for each") from None
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2 or not array.size:
        raise ModelError(f"{label}: shape {array.shape}; expected (count,) or (count, k)")
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        raise ModelError(f"{label}[{bad[0, 0]}] = {array[tuple(bad[0])]}; expected finite numbers")
    array.setflags(write=False)
    return array


def _times(enter: Any, n: int) -> np.ndarray:
    times = _rows(enter, "enter").ravel()
    if times.size != n or (times < 0).any():
        raise ModelError(f"enter: {times.size} times, the least {times.min():g}; expected {n} times >= 0, one for each body")
    return times


def _numbers_of_members(family: Family, label: str) -> np.ndarray:
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


def _scene(scene: Any, n: int) -> dict[str, np.ndarray]:
    if not isinstance(scene, Mapping) or not set(scene) <= {"radii", "walls", "exits", "exit_names"}:
        raise ModelError(f"scene: {shown(scene)}; expected a dictionary {{'radii': [...], 'walls': [...], 'exits': [...]}}")
    found = {key: np.asarray(value, str if key == "exit_names" else float) for key, value in scene.items()}
    if "radii" in found and found["radii"].shape != (n,):
        raise ModelError(f"scene: radii has shape {found['radii'].shape}; expected ({n},), one for each body")
    for key in {"walls", "exits"} & set(found):
        if found[key].ndim != 3 or found[key].shape[1:] != (2, 2):
            raise ModelError(f"scene: {key} has shape {found[key].shape}; expected (W, 2, 2), two end points for each")
    exits = len(found.get("exits", ()))
    if "exit_names" in found and found["exit_names"].shape != (exits,):
        raise ModelError(f"scene: {found['exit_names'].size} exit_names for {exits} exits; expected one for each")
    return found
