"""The step of many bodies: what is near, what of that acts, in groups that do not touch; each answer certified on all rows.

    min 1/2 |d - h f|^2  over  y_i = g_i + grad g_i . d >= 0;    d = h f + G' m,  0 <= m ⟂ y >= 0

Pairs with g_i = |q_i - q_j| - c beyond a cut-off are left out. As |grad g_i| = 1 in either body, their rows hold if
|d_i| + |d_j| <= cut-off: where the two largest |d_i| exceed it, the step is taken again with a wider one. Of the rows that are
left, those enter that are violated without them. Rows are divided by n_i = |grad g_i|: m and y are lengths.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from nsmodel.classes.bodies.schemes.prediction_correction import BODIES_SCHEME, BodiesProblem, ContactRows, uses_neighbour_search
from nsmodel.contacts import NO_CONTACTS, Contacts
from nsmodel.errors import StepError, UsageError
from nsmodel.solve import mlcp, qp
from nsmodel.solve.certificate import EPS, REACH
from nsmodel.solve.contact_projection import (
    ACTIVE_SET,
    CLARABEL,
    MAX_LEMKE_ROWS,
    ContactForces,
    ContactGroup,
    contact_residual,
    largest_coordinate,
    opposing_contacts,
    scale_contact_rows,
)
from nsmodel.solve.diagnose import describe_overreach
from nsmodel.solve.near import candidate_contact_rows, candidate_members, least_gap

BODIES_SOLVERS = ("auto", ACTIVE_SET, CLARABEL, *qp.QP_SOLVERS, mlcp.LEMKE)
CUTOFF_FACTOR = 1.25  # The cut-off, beside what moved in the last step.


class BodiesWarmStart(NamedTuple):
    """Where the next step starts to look: the contacts of the last one, and the sum of its two largest |d_i|."""

    contacts: Contacts
    moved: float


COLD_BODIES_START = BodiesWarmStart(NO_CONTACTS, 0.0)


class BodiesStepResult(NamedTuple):
    """One verified step.

    Attributes:
        q: positions (N, d) at t + h, NaN for bodies that are not there.
        contacts: what acted.
        gap_min: the least g of all constraints at (t + h, q); inf where there is none.
        residual: see `certificate`.
        warm: for the next step.
        solver: the solver whose answer was accepted; "none needed" where no constraint acts.
        groups: how many groups of touching bodies were solved apart.
    """

    q: np.ndarray
    contacts: Contacts
    gap_min: float
    residual: float
    warm: BodiesWarmStart
    solver: str
    groups: int


class BodiesStepper:
    """A step of many bodies by the contract of `solve.stepper`, pure but for ``seconds``, which adds up run times.

    Its state are the positions (N, d), NaN for bodies that are not there.

    Raises:
        UsageError: an unknown solver, too many rows in a family.
    """

    def __init__(self, problem: BodiesProblem, solver: str, tolerance: float) -> None:
        if solver not in BODIES_SOLVERS:
            raise UsageError(f"solver '{solver}' is unknown for many bodies; choose one of {', '.join(BODIES_SOLVERS)}")
        self.problem, self.solver, self.tolerance = problem, solver, tolerance
        self.seconds = {"search": 0.0, "assembly": 0.0, "solve": 0.0}
        self._searched = any(map(uses_neighbour_search, problem.families))

    def __call__(
        self, t: float, h: float, state: np.ndarray, warm: BodiesWarmStart = COLD_BODIES_START, k: int = 0
    ) -> BodiesStepResult:
        """Advance the bodies that are there, q = ``state`` (N, d), from t to t + h.

        Raises:
            StepError: no solver reaches the tolerance; f or a constraint is not finite.
        """
        clock, seconds = time.perf_counter, self.seconds
        q, present = state, np.all(np.isfinite(state), axis=1)
        start = clock()
        hf = h * self.problem.f(t, q, present)
        cutoff = CUTOFF_FACTOR * max(_sum_two_largest_norms(hf), warm.moved)
        while True:
            members = candidate_members(self.problem, t + h, q, present, cutoff)
            searched_at = clock()
            rows, n = scale_contact_rows(candidate_contact_rows(self.problem, t + h, q, members, cutoff), self.problem, t + h, q)
            assembled_at = clock()
            found = ContactGroup(rows, hf).solve(
                self.solver, n * h * self._last_reactions(rows, warm.contacts), self._violation_tolerance(hf, q)
            )
            moved = _sum_two_largest_norms(found.d)
            seconds["search"] += searched_at - start
            seconds["assembly"] += assembled_at - searched_at
            seconds["solve"] += (start := clock()) - assembled_at
            if not (moved > cutoff and self._searched):
                break
            cutoff = CUTOFF_FACTOR * moved
        residual, worst = contact_residual(rows, n, hf, found.d, found.m, q[present], self.tolerance)
        if not residual <= self.tolerance:
            raise self._step_error(t + h, rows, hf, found, residual, worst)
        after = q + found.d
        acting = np.flatnonzero(found.m > 0)
        self._check_linearisation_reach(t, h, q, after, rows.at(acting), n[acting])
        gap = self._least_gap(t + h, after, present, rows, cutoff - moved)
        contacts = Contacts(
            rows.family[acting], rows.first[acting].astype(np.int32), rows.second[acting].astype(np.int32),
            found.m[acting] / (n[acting] * h),
        )  # fmt: skip
        seconds["solve"] += clock() - start
        return BodiesStepResult(after, contacts, gap, residual, BodiesWarmStart(contacts, moved), found.solver, found.groups)

    def _last_reactions(self, rows: ContactRows, contacts: Contacts) -> np.ndarray:
        """The reactions of the last step (R,)."""
        wide = 1 + max([self.problem.count, *(family.second.group.count for family in self.problem.families if family.second)])

        def contact_keys(of: ContactRows | Contacts) -> np.ndarray:
            return (of.family.astype(np.int64) * self.problem.count + of.first) * wide + of.second + 1

        now, order = contact_keys(rows), np.argsort(contact_keys(contacts))
        last = contact_keys(contacts)[order]
        at = np.minimum(np.searchsorted(last, now), last.size - 1) if last.size else np.zeros(now.size, int)
        return np.where(last[at] == now, contacts.reaction[order][at], 0.0) if last.size else np.zeros(now.size)

    def _violation_tolerance(self, hf: np.ndarray, q: np.ndarray) -> float:
        """What is no violation: a small part of what the certificate allows."""
        return 1e-2 * self.tolerance * float(np.sqrt((hf**2).sum(axis=1)).max(initial=0.0)) + EPS * largest_coordinate(q)

    def _check_linearisation_reach(
        self, t: float, h: float, q: np.ndarray, after: np.ndarray, rows: ContactRows, n: np.ndarray
    ) -> None:
        """Refuse a verified step of a linearisation that means nothing where it leads; `prediction_correction._overreach`.

        ``rows``: those that act, of unit gradient, which was n_i.
        """
        true, end = np.empty(len(n)), np.empty((len(n), 2 * q.shape[1]))
        for family in np.unique(rows.family):
            of = np.flatnonzero(rows.family == family)
            at_end = self.problem.rows(int(family), t + h, after, rows.first[of], rows.second[of])
            true[of], end[of] = at_end.g / n[of], np.hstack([at_end.G, at_end.H]) / n[of, None]
        d = np.hstack([(after - q)[rows.first], np.where(rows.pair[:, None], (after - q)[rows.other], 0.0)])
        start = np.hstack([rows.G, rows.H])
        d[(start == 0) & (end == 0)] = 0.0
        off = np.minimum(true - rows.g - (start * d).sum(axis=1), ((end - start) * d).sum(axis=1))
        beyond = ~(off <= REACH * np.sqrt((d**2).sum(axis=1)))  # also where a constraint is not finite
        if beyond.any():
            worst = int(np.argmax(np.where(beyond, np.nan_to_num(off, nan=np.inf), -np.inf)))
            ratio, name = off[worst] / np.sqrt((d[worst] ** 2).sum()), self._row_name(rows, worst)
            raise StepError(
                f"no verified step from t = {t:.10g} to {t + h:.10g}: {describe_overreach(name, ratio)}",
                residual=float(ratio), component=name,
            )  # fmt: skip

    def _least_gap(self, t: float, q: np.ndarray, present: np.ndarray, rows: ContactRows, beyond: float) -> float:
        """The least gap; all rows that were left out are farther than ``beyond``."""
        least = np.inf
        for family in range(len(self.problem.families)):
            of = np.flatnonzero(rows.family == family)
            if of.size:
                least = min(least, float(self.problem.gap(family, t, q, rows.first[of], rows.second[of]).min()))
        return least if least <= beyond or not self._searched else least_gap(self.problem, t, q, present)

    def _step_error(
        self, t: float, rows: ContactRows, hf: np.ndarray, found: ContactForces, residual: float, worst: int | None
    ) -> StepError:
        """Why there is no verified step, in the user's words."""
        name = None if worst is None else self._row_name(rows, worst)
        reason = "no solver reached the tolerance" if self.solver == "auto" else "the forced solver did not find it"
        opposed = [] if worst is None else opposing_contacts(rows, hf, worst)
        if opposed:
            listed = " and ".join(f"'{self._row_name(rows, i)}' (weight {u:.3g})" for i, u in opposed)
            reason, name = f"the constraints leave no point: {listed} oppose each other", self._row_name(rows, opposed[0][0])
            if any(self.problem.curved[rows.family[i]] for i, _ in opposed):
                reason = f"linearised at the step's start, {reason} (with curved ones smaller steps may find one)"
        at = "" if name is None else f", worst at '{name}'"
        return StepError(
            f"no verified step to t = {t:.10g}: {reason} (residual {residual:.3g}, tolerance {self.tolerance:g}{at})",
            residual=residual, component=name,
        )  # fmt: skip

    def _row_name(self, rows: ContactRows, i: int) -> str:
        return self.problem.name(int(rows.family[i]), int(rows.first[i]), int(rows.second[i]))


def bodies_plan_lines(problem: BodiesProblem, solver: str) -> tuple[list[str], list[str]]:
    """What a step uses and what it leaves out, as lines for ``--explain``."""
    used, left_out = [f"{problem.count} bodies of {problem.d} states, {BODIES_SCHEME}"], []
    for name, family in zip(problem.names, problem.families, strict=True):
        if uses_neighbour_search(family):
            used.append(f"'{name}': {family.count:,} pairs, found by a search tree within the reach {family.reach} and a cut-off")
            left_out.append(
                f"'{name}': pairs beyond the cut-off, {CUTOFF_FACTOR} times what two bodies moved in the last step: their rows "
                "hold as long as no two bodies move more, which is checked after each step"
            )
        else:
            why = "given one by one" if family.over is not None else "no reach |q_i - q_j| - c to search by"
            used.append(f"'{name}': {family.count:,} constraints, all evaluated in each step ({why})")
    if not problem.families:
        left_out.append("multipliers and every solver: the model has no constraint")
        return used, left_out
    if solver == "auto":
        used.append(
            "solvers: primal-dual active set from the last contacts; where that fails, for each group apart, Lemke "
            f"(up to {MAX_LEMKE_ROWS} rows) or {CLARABEL}; each answer polished on the active set and certified on all rows"
        )
    else:
        used.append(f"solver {solver} alone (forced), its answer polished on the active set and certified on all rows")
    left_out.append("rows that the prediction satisfies: they enter only if the solution violates them")
    left_out.append("one problem for all: groups of bodies that do not touch are solved apart")
    return used, left_out


def _sum_two_largest_norms(d: np.ndarray) -> float:
    """The sum of the two largest |d_i|."""
    size = np.sqrt((d**2).sum(axis=1))
    return float(np.partition(size, -2)[-2:].sum()) if size.size > 1 else float(size.sum())
