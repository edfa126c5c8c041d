"""Sweeping processes of many bodies: one symbolic constraint for a pair, and the pairs it runs over.

What the functions of a model of many bodies give: they are known by that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.conversion import to_sx
from nsmodel.modeling.parameters import describe_argument, gather_values
from nsmodel.modeling.time_grid import TimeGrid
from nsmodel.models.many_bodies.families import Bodies, Family, GroupMember, checked_entry_times, checked_member_numbers
from nsmodel.models.sweeping_process.model import SweepingProcess

NO_SYMBOLS = ca.SX(0, 1)
MAX_WRITTEN_OUT = 20_000  # Constraints that `written_out` puts into one model, each an expression of its own; more are refused.


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ManyBodies(Model):
    """q_i'(t) + N(Q(t), q)_i ∋ f(t, q_i) for many bodies i, Q(t) = {q : all constraints of all families >= 0}.

    The scheme is that of `SweepingProcess`; what it costs follows what acts in a step. Bodies may leave, and enter.

    Attributes:
        bodies: the bodies, with their starts.
        f: the velocity that a body would have alone: d expressions of one member's symbols, t and inputs; or a function
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
    me: GroupMember = field(init=False, repr=False)  # Any one of the bodies, in symbols.

    paper: ClassVar[str] = SweepingProcess.paper
    schemes: ClassVar[tuple[str, ...]] = SweepingProcess.schemes
    letter: ClassVar[str] = "q"
    outputless: ClassVar[str] = "many bodies take none; give them to the run, run.evaluate({...})"
    unblocked: ClassVar[str] = "many bodies take none; let a loop of steps give what drives f"
    refuses: ClassVar[Mapping[str, str]] = {
        "stress": "is a model of many bodies, whose steps are judged as they are taken; push a small scene written out, "
        "stress(model.written_out())",
        "study": "is a model of many bodies, whose states come and go; study a small scene written out, "
        "study(model.written_out()), or compare two runs of simulate(model, step=...)",
    }

    def _declare(self) -> None:
        if not isinstance(self.bodies, Bodies):
            raise ModelError(f"bodies: {describe_argument(self.bodies)}; expected Bodies(q0, r=...)")
        n, d = self.bodies.q0.shape
        self._declare_symbols("q", q=ca.SX.sym("q", n * d))
        families = {} if self.constraints is None else self.constraints
        if not isinstance(families, Mapping):
            raise ModelError(f"constraints: expected a dictionary {{name: Family(...)}}, not a {type(families).__name__}")
        me = self.bodies.member("i")
        self._set(
            me=me,
            f=self.f
            if callable(self.f) and not isinstance(self.f, ca.SX)
            else self._body_expressions(self.f, "f", d, me, self.u),
            constraints=MappingProxyType({str(name): self._checked_family(name, family) for name, family in families.items()}),
            leave=None if self.leave is None else self._body_expressions(self.leave, "leave", 1, me),
            enter=np.zeros(n) if self.enter is None else checked_entry_times(self.enter, n),
            scene=None if self.scene is None else _checked_bodies_scene(self.scene, n),
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
        """A point for each body in each of the ``rows`` of states (k, n)."""
        return rows.reshape(-1, self.bodies.d)

    @property
    def is_driven(self) -> bool:
        """Whether inputs are in f."""
        return isinstance(self.f, ca.SX) and bool(self.u.numel()) and ca.depends_on(self.f, self.u)

    def _usable_symbols(self, *members: GroupMember, inputs: ca.SX = NO_SYMBOLS) -> dict[str, ca.SX]:
        """{name: symbol} of what an expression of these members may use."""
        known = ca.vertcat(self.t, self.p, inputs, *(member.symbols for member in members))
        return {symbol.name(): symbol for symbol in ca.vertsplit(known)}

    def _body_expressions(self, value: Any, label: str, size: int, me: GroupMember, inputs: ca.SX = NO_SYMBOLS) -> ca.SX:
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
            raise ModelError(
                f"{label} refers to several bodies ({', '.join(sorted(prefixes))}); it must be a function of one body"
            )
        for prefix in prefixes - {me.name}:
            one = {s.name(): s for s in ca.symvar(column)}
            mine = self._usable_symbols(me)
            own = {name: me.name + name[len(prefix) :] for name in one if "." in name}
            unknown = [name for name, wanted in own.items() if wanted not in mine]
            if unknown:
                raise ModelError(
                    f"{label} depends on '{unknown[0]}', which the bodies do not have; they have {self._number_names()}"
                )
            column = ca.substitute(column, ca.vertcat(*(one[k] for k in own)), ca.vertcat(*(mine[k] for k in own.values())))
        return to_sx(column, self._usable_symbols(me, inputs=inputs), label)

    def _number_names(self) -> str:
        return ", ".join(self.bodies.numbers)

    def _checked_family(self, name: Any, family: Any) -> Family:
        """The family checked: a scalar g of its members' symbols, numbers of members that exist."""
        label = f"constraint '{name}'"
        if not isinstance(family, Family):
            raise ModelError(
                f"{label}: {describe_argument(family)}; expected Family(g, i, j) with members i, j of the bodies or of items"
            )
        first, second = family.first, family.second
        if not isinstance(first, GroupMember) or first.group is not self.bodies:
            raise ModelError(
                f"{label}: the first member, {describe_argument(first)}, is not one of the model's bodies; take "
                "bodies.member('i')"
            )
        if second is not None and (not isinstance(second, GroupMember) or (family.of_pairs and second.group is not self.bodies)):
            raise ModelError(
                f"{label}: the second member, {describe_argument(second)}, is neither a body of the model nor one of some Items"
            )
        if second is not None and second.name == first.name:
            raise ModelError(f"{label}: both members are called '{first.name}'; give them different names")
        g = ca.densify(to_sx(family.g, self._usable_symbols(*family.members), label))
        if g.numel() != 1:
            raise ModelError(f"{label}: shape {g.shape}; expected one scalar expression")
        over = None if family.over is None else checked_member_numbers(family, label)
        return Family(g, first, second, over)

    def written_out(self) -> SweepingProcess:
        """The same process with its constraints one by one, for small scenes; who leaves and enters is not in it.

        Raises:
            ModelError: f is a function, or there are more than MAX_WRITTEN_OUT constraints.
        """
        count = sum(family.count for family in self.constraints.values())
        if count > MAX_WRITTEN_OUT:
            raise ModelError(f"{count} constraints are too many to be written out; at most {MAX_WRITTEN_OUT}")
        if not isinstance(self.f, ca.SX):
            raise ModelError("f is a function of numbers; to write the model out it must be an expression")
        n, d = self.bodies.q0.shape
        q = [self.q[i * d : (i + 1) * d] for i in range(n)]
        numbers = self.bodies.table[:, d:]
        own = ca.Function("f", [self.t, self.p, self.u, self.me.symbols], [self.f])
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
        shared = {key: getattr(self, key) for key in ("t_end", "step", "steps", "switch_times", "exact", "title")}
        units = {name: unit for name, unit in self.units.items() if name in ("t", *self.stems, *(self.names or ()))}
        scene = self.scene and {key: self.scene[key] for key in ("radii", "walls") if key in self.scene}
        f = ca.vertcat(*(own(self.t, self.p, self.u, ca.vertcat(q[i], numbers[i])) for i in range(n)))
        u = dict(zip(self.input_names, ca.vertsplit(self.u), strict=True))
        inputs = {ca.vertcat(*(u[one] for one in self.input_groups[name])): signal for name, signal in self.inputs.items()}
        return SweepingProcess(
            t=self.t, q=self.q, f=f, constraints=rows, q0=self.q0, parameters=gather_values(self.parameters, self.vectors),
            scene=scene, units=units, inputs=inputs, **shared,
        )  # fmt: skip


def _checked_bodies_scene(scene: Any, n: int) -> dict[str, np.ndarray]:
    if not isinstance(scene, Mapping) or not set(scene) <= {"radii", "walls", "exits", "exit_names"}:
        raise ModelError(
            f"scene: {describe_argument(scene)}; expected a dictionary {{'radii': [...], 'walls': [...], 'exits': [...]}}"
        )
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


def values_of_functions(model: ManyBodies, grid: TimeGrid) -> list[np.ndarray]:
    """The velocities at the start, where they are a function."""
    return [] if isinstance(model.f, ca.SX) else [np.array(model.f(0.0, model.bodies.q0.copy()), float)]
