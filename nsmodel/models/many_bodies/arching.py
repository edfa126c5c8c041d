"""When many bodies stand still: since when, whether anything will ever change again, and who holds the others.

A step is a pure function of its state. Where nothing in the model depends on time and nobody is to come, the state never
changes again if one of two facts holds, each about the step itself:

- **the state is given back**: positions and contacts are bit for bit those before the step;
- **the contacts hold it**: the gradients of the contacts with a reaction > 0 span all states of the bodies that they touch,
  and the other bodies have not moved at all. Then the step's answer near here is the one point where these constraints are 0,
  and what moves is rounding. Bodies that balance on fewer contacts than that may still slide off.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from nsmodel._utils import EPS
from nsmodel.models.many_bodies.contact_solver import BodiesWarmStart, ContactGroup
from nsmodel.models.many_bodies.model import ManyBodies
from nsmodel.models.many_bodies.schemes import BodiesProblem, ContactRows
from nsmodel.solvers.contacts import Contacts

# Beside the largest position: what moves less moves by rounding, as a step adds some dozen numbers of that size.
MOVEMENT_ROUNDING = 64 * EPS
# Steps after which bodies that have moved by no more than that are said to stand still: over some they may stand by chance.
STANDSTILL_STEPS = 20
MIN_REACTION_SHARE = 1e-8  # A reaction below this part of the largest one holds nobody: it may be the error of the solver.
# A pivot below this part of the largest one is 0: contacts whose matrix is so near to singular do not hold the bodies.
MIN_PIVOT_SHARE = 1e-10


ItemKey = tuple[int, int]  # A family and a member.
BodyChain = tuple[list[int], ItemKey | None]


class StandstillState(NamedTuple):
    """Where bodies have been, to the rounding of their positions, since step ``since``."""

    q: np.ndarray
    since: int

    def after(self, k: int, q: np.ndarray, warm: BodiesWarmStart) -> StandstillState:
        """The same after step k, which ended at q, or from there on."""
        bound = MOVEMENT_ROUNDING * float(np.abs(q[np.isfinite(q)]).max(initial=0.0))
        if warm.moved <= 2 * bound and np.array_equal(np.isnan(q), np.isnan(self.q)):
            if not (np.abs(q - self.q) > bound).any():
                return self
        return StandstillState(q, k)


def is_autonomous(model: ManyBodies) -> bool:
    """Whether nothing in a model depends on time; a function f says so by an attribute ``autonomous``."""
    given = [family.g for family in model.constraints.values()]
    given += [part for part in (model.f, model.leave) if isinstance(part, ca.SX)]
    steady = isinstance(model.f, ca.SX) or getattr(model.f, "autonomous", False) is True
    return steady and not model.is_driven and not ca.depends_on(ca.vertcat(*map(ca.vec, given)), model.t)


def is_state_repeated(before: tuple[np.ndarray, BodiesWarmStart], after: tuple[np.ndarray, BodiesWarmStart]) -> bool:
    """Whether a step has given back its state, bit for bit."""
    (q, warm), (q_next, warm_next) = before, after
    same = warm.moved == warm_next.moved and np.array_equal(q, q_next, equal_nan=True)
    return same and all(map(np.array_equal, warm.contacts, warm_next.contacts))


def is_held_by_contacts(problem: BodiesProblem, t: float, before: np.ndarray, q: np.ndarray, contacts: Contacts) -> bool:
    """Whether the contacts alone hold all bodies at q (N, d), which were at ``before`` one step ago."""
    rows = _contact_constraints(problem, t, q, _loaded_contacts(contacts))
    touched = np.zeros(len(q), bool)
    touched[rows.first] = True
    touched[rows.second[rows.pair]] = True
    free = ~touched
    if not np.array_equal(before[free], q[free], equal_nan=True):
        return False
    B = sp.diags_array(1 / rows.size) @ ContactGroup(rows, np.zeros(q.shape)).B[:, np.repeat(touched, q.shape[1])]
    if B.shape[0] < B.shape[1] or not np.isfinite(B.data).all():
        return False
    try:
        pivots = np.abs(splu((B.T @ B).tocsc()).U.diagonal())
    except RuntimeError:  # exactly singular
        return False
    return bool(pivots.min(initial=np.inf) > MIN_PIVOT_SHARE * pivots.max(initial=0.0))


def find_arches(problem: BodiesProblem, q: np.ndarray, contacts: Contacts) -> list[dict[str, Any]]:
    """Who holds the others: before each exit the body nearest to it, and the bodies over which its load goes to the walls.

    From that body the shortest two chains of contacts lead, over different bodies, to two items; where the scene has no exits,
    from the body with most pressure of each group.

    Returns:
        For each arch ``exit`` (its name or number; None), ``bodies`` from one end to the other, ``at`` (their places),
        ``ends``, the names of the contacts with items at both ends, and ``pressed``: how many bodies are in its group.
    """
    pressed, families = _loaded_contacts(contacts), problem.families
    near: dict[int, set[int]] = {}
    ends: dict[int, list[ItemKey]] = {}
    for family, first, second in zip(*(part.tolist() for part in pressed[:3]), strict=True):
        near.setdefault(first, set())
        if families[family].of_pairs:
            near[first].add(second)
            near.setdefault(second, set()).add(first)
        else:
            ends.setdefault(first, []).append((family, second))
    found = []
    for name, crown in _arch_crowns(problem, q, pressed, near):
        one, other = _two_chains(crown, near, {body: sorted(items) for body, items in ends.items()})
        bodies = [*one[0][::-1], *other[0][1:]]
        found.append({
            "exit": name, "bodies": bodies, "at": q[bodies].tolist(), "pressed": len(_touching_group(crown, near)),
            "ends": [problem.name(end[0], chain[-1], end[1]) for chain, end in (one, other) if end is not None],
        })  # fmt: skip
    return found


def _loaded_contacts(contacts: Contacts) -> Contacts:
    """The contacts whose reaction is more than rounding."""
    strong = contacts.reaction > MIN_REACTION_SHARE * contacts.reaction.max(initial=0.0)
    return Contacts(*(part[strong] for part in contacts))


def _contact_constraints(problem: BodiesProblem, t: float, q: np.ndarray, contacts: Contacts) -> ContactRows:
    """The constraints of these contacts."""
    parts = []
    for family in range(len(problem.families)):
        of = contacts.family == family
        parts.append(problem.rows(family, t, q, contacts.first[of], contacts.second[of]))
    return ContactRows(*(np.concatenate([getattr(part, name) for part in parts]) for name in ContactRows.__dataclass_fields__))


def _arch_crowns(
    problem: BodiesProblem, q: np.ndarray, contacts: Contacts, near: dict[int, set[int]]
) -> Iterable[tuple[Any, int]]:
    """The bodies at which arches are looked for, each with the exit that it stands before."""
    bodies, scene = np.array(sorted(near), int), problem.model.scene or {}
    exits = scene.get("exits", np.zeros((0, 2, 2)))
    if not bodies.size:
        return []
    if len(exits) and problem.d == 2:
        from nsmodel.models.crowd.geometry import nearest_points

        away = np.linalg.norm(nearest_points(q[bodies], exits) - q[bodies][:, None], axis=2)
        first, names = away.argmin(axis=0), scene.get("exit_names")
        return [(k if names is None else str(names[k]), int(bodies[i])) for k, i in enumerate(first) if away[i].argmin() == k]
    total = np.bincount(contacts.first, contacts.reaction, len(q))
    pairs = np.array([family.of_pairs for family in problem.families], bool)[contacts.family]
    total += np.bincount(contacts.second[pairs], contacts.reaction[pairs], len(q))
    groups = {min(group): group for group in (_touching_group(body, near) for body in bodies.tolist())}
    return [(None, max(sorted(group), key=lambda body: total[body])) for _, group in sorted(groups.items())]


def _touching_group(body: int, near: dict[int, set[int]]) -> set[int]:
    """All bodies that touch this one, directly or not."""
    found, edge = {body}, [body]
    while edge:
        fresh = near[edge.pop()] - found
        found |= fresh
        edge += fresh
    return found


def _two_chains(crown: int, near: dict[int, set[int]], ends: dict[int, list[ItemKey]]) -> tuple[BodyChain, BodyChain]:
    """Two short chains of bodies from the crown to two different items; an item is None where there is no way to one."""
    one = _shortest_chain(crown, near, ends, set(), None)
    return one, _shortest_chain(crown, near, ends, set(one[0]), one[1])


def _shortest_chain(
    crown: int, near: dict[int, set[int]], ends: dict[int, list[ItemKey]], avoided: set[int], taken: ItemKey | None
) -> BodyChain:
    """The shortest chain to an item that is not ``taken``, breadth first."""
    way: dict[int, int | None] = {crown: None}
    edge = [crown]
    for body in edge:
        free = [item for item in ends.get(body, []) if item != taken]
        if free:
            chain, at = [], body
            while at is not None:
                chain.append(at)
                at = way[at]
            return chain[::-1], free[0]
        for other in sorted(near[body] - avoided - way.keys()):
            way[other] = body
            edge.append(other)
    return [crown], None
