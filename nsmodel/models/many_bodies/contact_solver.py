"""The step of many bodies: what is near, what of that acts, in groups that do not touch; each answer certified on all rows.

    min 1/2 |d - h f|^2  over  y_i = g_i + grad g_i . d >= 0;    d = h f + G' m,  0 <= m ⟂ y >= 0

Pairs with g_i = |q_i - q_j| - c beyond a cut-off are left out. As |grad g_i| = 1 in either body, their rows hold if
|d_i| + |d_j| <= cut-off: where the two largest |d_i| exceed it, the step is taken again with a wider one. Of the rows that are
left, those enter that are violated without them. Rows are divided by n_i = |grad g_i|: m and y are lengths.

The projection on the linearised constraints of many bodies, group by group, and its certificate.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from nsmodel._utils import EPS
from nsmodel.errors import StepError, UsageError
from nsmodel.models.many_bodies.contact_search import candidate_contact_rows, candidate_members, least_gap
from nsmodel.models.many_bodies.schemes import BODIES_SCHEME, BodiesProblem, ContactRows, uses_neighbour_search
from nsmodel.proof import conic
from nsmodel.solvers import mlcp
from nsmodel.solvers.contacts import NO_CONTACTS, Contacts
from nsmodel.solvers.diagnosis import describe_overreach, opposing_rows
from nsmodel.solvers.residuals import REACH, UNRESOLVED, NumericLaw

ACTIVE_SET, CLARABEL, PIQP = "active-set", "clarabel", "piqp"
# Rows of a matrix that is inverted dense: 0.5 of the time of sparse factors for 50 rows, 0.8 for 100, three times it for 200.
MAX_DENSE_FACTOR_ROWS = 100
MAX_LEMKE_ROWS = 60  # Rows of a group up to which Lemke's pivoting is the robust way; an interior method scales better beyond.
MAX_DENSE_SOLVER_ROWS = 3000  # Rows of a group that a solver of dense problems takes: a matrix of 72 MB; more are refused.
# Changes of the active set without fewer wrong rows, after which it is given up: it may go round in circles.
ACTIVE_SET_PATIENCE = 10
# Passes in each of which rows that the last answer violates are added, so that groups join; after them the residual decides.
MAX_GROUP_PASSES = 100
# Added to a diagonal of 1, and taken back by refinement: so that rows that depend on others have factors.
DIAGONAL_REGULARISATION = 1e-11


@dataclass
class ContactForces:
    """m (R,) and d (N, d) = h f + G' m; whether primal-dual has settled; what found it."""

    m: np.ndarray
    d: np.ndarray
    solver: str
    groups: int = 0


class ContactGroup:
    """The projection for some rows of unit gradient."""

    def __init__(self, rows: ContactRows, hf: np.ndarray) -> None:
        self.rows, self.hf, self.other = rows, hf, rows.other
        d = hf.shape[1]
        columns = np.hstack([rows.first[:, None] * d + np.arange(d), self.other[:, None] * d + np.arange(d)])
        is_present = np.hstack([np.ones((len(rows.g), d), bool), np.repeat(rows.pair[:, None], d, axis=1)])
        indptr = np.concatenate([[0], np.cumsum(is_present.sum(axis=1))])
        self.B = sp.csr_matrix((np.hstack([rows.G, rows.H])[is_present], columns[is_present], indptr), (len(rows.g), hf.size))

    def y(self, d: np.ndarray) -> np.ndarray:
        """The gaps g + G d (R,) after a displacement."""
        return self.rows.g + self.B @ d.ravel()

    def d(self, m: np.ndarray) -> np.ndarray:
        """h f + G' m (N, d)."""
        return self.hf + (self.B.T @ m).reshape(self.hf.shape)

    def solve(self, solver: str, last: np.ndarray, tiny: float) -> ContactForces:
        """The answer of a solver, "auto" or a name; ``last``: the m of the last step."""
        violated = self.y(self.hf) < -tiny
        if not violated.any():
            return ContactForces(np.zeros(last.size), self.hf.copy(), "none needed")
        if solver in ("auto", ACTIVE_SET):
            m, converged = self.primal_dual_active_set(last > 0 if last.any() else violated, tiny)
            if converged or solver == ACTIVE_SET:
                return ContactForces(m, self.d(m), ACTIVE_SET)
            violated |= self.rows.g < 2 * _largest_row_norm(self.hf)
        return self._solve_by_groups(solver, violated, tiny)

    def primal_dual_active_set(self, active: np.ndarray, tiny: float) -> tuple[np.ndarray, bool]:
        """Solve on the active set, drop rows with m < 0, take up those with y < 0, until none is wrong: (m, whether so).

        Where that has not made the wrong rows fewer, only those change that are worst on all their bodies; not for long.
        """
        best, least, waited = np.zeros(active.size), np.inf, 0
        while waited < ACTIVE_SET_PATIENCE:
            m = np.zeros(active.size)
            m[active] = self._solve_active_rows(np.flatnonzero(active))
            off = np.where(active, -m, -self.y(self.d(m)))
            wrong = np.flatnonzero(~(off <= tiny))
            waited = 0 if wrong.size < least else waited + 1
            if wrong.size < least:
                least, best = wrong.size, np.maximum(m, 0)
            if not wrong.size:
                return best, True
            active[wrong if not waited else self._worst_rows(wrong, off[wrong])] ^= True
        return best, False

    def _worst_rows(self, wrong: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Those of the wrong rows that are worst on each of their bodies."""
        one, other = self.rows.first[wrong], np.where(self.rows.pair[wrong], self.other[wrong], self.rows.first[wrong])
        most = np.zeros(len(self.hf))
        np.maximum.at(most, one, off)
        np.maximum.at(most, other, off)
        return wrong[~(off < np.maximum(most[one], most[other]))]

    def _solve_active_rows(self, active: np.ndarray) -> np.ndarray:
        """m with y = 0 on the active rows: G G' m = -(g + G h f), refined; a solution where G G' is singular but there is one."""
        B: Any = self.B[active]
        right = -(self.rows.g[active] + B @ self.hf.ravel())
        M = B @ B.T
        if active.size <= MAX_DENSE_FACTOR_ROWS:
            inverse = np.linalg.inv(M.toarray() + DIAGONAL_REGULARISATION * np.eye(active.size))
            solve = inverse.__matmul__
        else:
            M = (M + DIAGONAL_REGULARISATION * sp.eye_array(active.size)).tocsc()
            solve = splu(M, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).solve
        m = solve(right)
        for _ in range(2):
            m = m + solve(right - B @ (B.T @ m))
        return m

    def _solve_by_groups(self, solver: str, chosen: np.ndarray, tiny: float) -> ContactForces:
        """Solve the chosen rows, each group of bodies that touch apart; rows that are then violated join, until none is."""
        rows, m = self.rows, np.zeros(chosen.size)
        fresh, names = chosen.copy(), set()
        count = 0
        for _ in range(MAX_GROUP_PASSES):
            which = np.flatnonzero(chosen)
            label, count = contact_groups(rows.at(which), len(self.hf))
            for number in np.unique(label[fresh[which]]):
                own = which[label == number]
                m[own], name = ContactGroup(rows.at(own), self.hf).one(solver, tiny)
                names.add(name)
            d = self.d(m)
            fresh = (self.y(d) < -tiny) & ~chosen
            if not fresh.any():
                break
            chosen |= fresh
        return ContactForces(m, self.d(m), "+".join(sorted(names)), count)

    def one(self, solver: str, tiny: float) -> tuple[np.ndarray, str]:
        """m of these rows by one solver, polished; all rows enter."""
        b = self.y(self.hf)
        if solver == "auto":
            solver = mlcp.LEMKE if b.size <= MAX_LEMKE_ROWS else CLARABEL
        raw = self._solve_clarabel() if solver == CLARABEL else self._solve_dense(solver, b)
        if raw is None:
            return np.zeros(b.size), solver
        y = self.y(self.d(raw))
        m, converged = self.primal_dual_active_set(raw > y, tiny)
        return (m if converged else np.maximum(raw, 0)), solver

    def _solve_dense(self, solver: str, b: np.ndarray) -> np.ndarray | None:
        """The answer of a solver of small dense problems."""
        if b.size > MAX_DENSE_SOLVER_ROWS:
            raise StepError(
                f"solver '{solver}': a group has {b.size} rows, more than {MAX_DENSE_SOLVER_ROWS}; use clarabel or active-set"
            )
        W, law = (self.B @ self.B.T).toarray(), NumericLaw(np.zeros(b.size), np.full(b.size, np.inf), ())
        found = mlcp.solve_mlcp(W, b, law, np.zeros(b.size), np.where(b < 0, 0, -1).astype(np.int8), (solver,), True, 1e-13)
        return found.l if np.isfinite(found.l).all() else None

    def _solve_clarabel(self) -> np.ndarray | None:
        """The answer of Clarabel, an interior-point method, in units in which h f is about 1."""
        size = np.abs(self.hf).max() or 1.0
        bodies, inverse = np.unique(self.B.indices, return_inverse=True)
        G = sp.csr_matrix((self.B.data, inverse, self.B.indptr), (len(self.rows.g), bodies.size)).tocsc()
        cones, P = [conic.nonnegative_cone(len(self.rows.g))], sp.eye(bodies.size, format="csc")
        found = conic.solve_conic_program(-self.hf.ravel()[bodies] / size, -G, self.rows.g / size, cones, P, tolerance=1e-11)
        m = size * np.array(found.z)
        return m if np.isfinite(m).all() else None


def contact_residual(
    rows: ContactRows, n: np.ndarray, hf: np.ndarray, d: np.ndarray, m: np.ndarray, q: np.ndarray, tolerance: float
) -> tuple[float, int | None]:
    """The residual of a step without unit, and the row where it is worst (None: the equation for d).

    With S = max_i max(|h f_i|, |d_i|) and the round-off of positions, rows divided by n_i: the largest of |d - h f - G'm| / S,
    (-y_i)+ / S, (-m_i)+ / S, min(m_i, |y_i|) / S, and the duality gap <m, |y|> / (|d|^2 + |h f|^2) where it is above round-off.
    """
    group = ContactGroup(rows, hf)
    floor = 4 * EPS * largest_coordinate(q)
    S = max(_largest_row_norm(hf), _largest_row_norm(d), floor / tolerance, UNRESOLVED)
    y = group.y(d)
    law = np.maximum(np.maximum(-y, -m), np.minimum(m, np.abs(y))) / S
    law = np.where(np.isfinite(law), law, np.inf)
    worst = int(law.argmax()) if law.size else None
    residual = float(law.max(initial=0.0))
    balance = float(np.abs(d - group.d(m)).max(initial=0.0)) / S
    gap = float(np.maximum(m, 0) @ np.abs(y))
    noise = 8 * EPS * float(np.maximum(m, 0) @ (np.abs(rows.g) + abs(group.B) @ np.abs(d).ravel() + largest_coordinate(q)))
    if gap > noise:
        residual = max(residual, gap / max(float((d**2).sum() + (hf**2).sum()), UNRESOLVED))
    if not balance <= residual:
        return (balance if np.isfinite(balance) else np.inf), None
    return residual, worst


def contact_groups(rows: ContactRows, count: int) -> tuple[np.ndarray, int]:
    """The number of the group of each row, and how many groups there are: rows that share bodies, directly or not."""
    bodies, inverse = np.unique(np.concatenate([rows.first, rows.second[rows.pair]]), return_inverse=True)
    links = inverse[: len(rows.g)][rows.pair], inverse[len(rows.g) :]
    graph = sp.coo_matrix((np.ones(len(links[0])), links), (bodies.size, bodies.size))
    count, label = connected_components(graph, directed=False)
    return label[inverse[: len(rows.g)]], count


def opposing_contacts(rows: ContactRows, hf: np.ndarray, worst: int) -> list[tuple[int, float]]:
    """Rows and weights of a proof that no d satisfies them all, looked for around the worst row; empty where there is none."""
    near_by = np.arange(len(rows.g))
    label, _ = contact_groups(rows, len(hf))
    near_by = np.flatnonzero(label == label[worst])
    if near_by.size > 400:
        near_by = near_by[np.argsort(np.abs(near_by - worst), kind="stable")[:400]]
    group = ContactGroup(rows.at(near_by), hf)
    law = NumericLaw(np.zeros(near_by.size), np.full(near_by.size, np.inf), ())
    found = opposing_rows((group.B @ group.B.T).toarray(), group.y(hf), law) or []
    return [(int(near_by[i]), u) for i, u in found]


def scale_contact_rows(rows: ContactRows, problem: BodiesProblem, t: float, q: np.ndarray) -> tuple[ContactRows, np.ndarray]:
    """Rows of unit gradient, and n_i (1 where the gradient is 0).

    Raises:
        StepError: a value or gradient that is not finite, a constraint < 0 without gradient.
    """
    n = rows.size
    bad = np.flatnonzero(~(np.isfinite(rows.g) & np.isfinite(n)) | ((n == 0) & (rows.g < 0)))
    if bad.size:
        i = int(bad[0])
        name = problem.name(int(rows.family[i]), int(rows.first[i]), int(rows.second[i]))
        what = "is < 0 and has no gradient" if n[i] == 0 else "or its gradient is not a finite number"
        raise StepError(
            f"constraint '{name}' {what} at t = {t:.10g}, where body {rows.first[i]} is at {q[rows.first[i]]} "
            "(two bodies in one place, a norm or root at 0?)", component=name
        )  # fmt: skip
    n = np.where(n > 0, n, 1.0)
    return ContactRows(rows.family, rows.first, rows.second, rows.pair, rows.g / n, rows.G / n[:, None], rows.H / n[:, None]), n


def largest_coordinate(q: np.ndarray) -> float:
    """The largest |q_i| of those that are there."""
    size = np.abs(q)
    return float(size[np.isfinite(size)].max(initial=0.0))


def _largest_row_norm(d: np.ndarray) -> float:
    return float(np.sqrt((d**2).sum(axis=1)).max(initial=0.0))


BODIES_SOLVERS = ("auto", ACTIVE_SET, CLARABEL, *mlcp.QP_SOLVERS, mlcp.LEMKE)
# The cut-off, beside what moved in the last step: who moves more is searched for anew, a larger one adds rows to each step.
CUTOFF_FACTOR = 1.25


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
    """A step of many bodies by the contract of `solvers.step`, pure but for ``seconds``, which adds up run times.

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
