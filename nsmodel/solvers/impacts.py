"""Impacts: where a multiplier acts on its output too late to hold it, so that a state jumps; seen on the rows of a run.

Take a row 0 <= y ⟂ l whose l may be as large as it must. If no such multiplier enters y or y' (the rows of D and of C B are
zero; or those of h_l and h_x M^{-1} g_l), then y' is continuous whatever they do: once y comes to 0 with y' < 0, an impulse alone
keeps y >= 0, and what it acts on jumps: in mechanics a velocity. Where the row of D or C B is not zero something else may hold y,
and nothing is said; nor where contact does not close in the run, closes with y' = 0, or with a y' that a step explains.
The rows of a second-order cone are one such contact: it is open where l_1 = 0, and closes as y_1 - |(y_2, ...)| comes to 0.

A relay's l is bounded, so that no state jumps. Where it alone acts on y'' and not before, it is switched ever faster around y = 0
and does not come to rest there in finite time: a run that begins to slide shows the damping of the scheme.

Where an entry of the diagonal of C B is below 0, and D has none there, a larger l lowers its y, which a monotone law needs it to
raise: friction with the wrong sign.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel._utils import cached_per_object
from nsmodel.modeling.base import Model
from nsmodel.modeling.laws import Law
from nsmodel.modeling.laws.base import SecondOrder
from nsmodel.modeling.parts import Part
from nsmodel.modeling.variants import initial_inputs

PRODUCT_ROUNDING = 1e-12  # A sum is 0 below this part of its terms, 4500 EPS. (+)
NEGLIGIBLE_RATE = 1e-9  # A rate is 0 below this part of the largest |y'|: steps are solved to as much. (+)
# IMPACT_RATE_FACTOR: a smooth y' that comes to 0 is as large as its change then.
IMPACT_RATE_FACTOR = 2.0  # A rate below so many times its change in a step is none of an impact.
IMPACTS_GUIDE = "docs/guide.md, 2.7"
MAX_NAMED_ROWS = 4  # Multipliers that a sentence names.
SAMPLE_POINTS = 4  # States where rows are looked at, the start, and others around it: an entry that is 0 at all of them is 0.


@dataclass(frozen=True)
class ImpactRow:
    """A row of y, or a cone of rows, that may call for an impulse (a contact) or slide by the scheme's damping alone (a relay).

    Attributes:
        names: of its multipliers; column: where the first, of a cone its axis, is in a run; lower, upper: its ends.
        degree: of the least derivative of y that it enters: 2, 3, ...; 0: none.
        moved: the states that it acts on; pushed: how strongly on each of s at the start, |row of F_l|.
        rate: (t, s, l, u) -> y', of a cone (y_1 - |(y_2, ...)|)'; and y' of all its rows. s: the states, of an oscillator also
            its velocities; l: the columns ``inputs`` of a run.
        untouched: what no such multiplier enters, in words.
    """

    names: tuple[str, ...]
    column: int
    lower: float
    upper: float
    degree: int
    moved: tuple[str, ...]
    pushed: np.ndarray
    rate: ca.Function
    inputs: slice
    untouched: str

    @property
    def name(self) -> str:
        """Of its first multiplier."""
        return self.names[0]

    @property
    def relay(self) -> bool:
        """Whether l is bounded."""
        return bool(np.isfinite([self.lower, self.upper]).all())

    @property
    def cone(self) -> bool:
        """Whether its rows are those of a cone."""
        return len(self.names) > 1

    @property
    def impulsive(self) -> bool:
        """Whether it is a contact of one row, whose l may be as large as it must."""
        return not self.relay and not self.cone

    @property
    def acts(self) -> str:
        """What the multiplier acts on, in words."""
        least = "y" + "'" * self.degree if self.degree < 4 else f"the derivative {self.degree} of y"
        who = f"the cone of '{self.name}'" if self.cone else f"'{self.name}'"
        return f"{who} acts on {least} only" if self.degree else f"{who} acts on no derivative of y"

    @property
    def jumps(self) -> str:
        """The states that jump where y closes, in words."""
        return " and ".join(f"'{name}'" for name in self.moved[:4]) + (", ..." if len(self.moved) > 4 else "")

    def free(self, l: np.ndarray) -> np.ndarray:
        """Where l is at an end: open, or a relay that is not at y = 0; so is a start, whose l is not known."""
        return ~((l > self.lower) & (l < self.upper))

    def approach_speed(self, rate: np.ndarray) -> np.ndarray:
        """How fast y comes to 0 from the side where it may be: > 0 where it does."""
        if self.relay or not np.isfinite([self.lower, self.upper]).any():
            return np.abs(rate)
        return -rate if np.isfinite(self.lower) else rate


class ImpactStructure(NamedTuple):
    """s' = F(t, s, l), y = Y(t, s, l), and how l enters. lower, upper: its ends, NaN where it is in no box; cones: their rows."""

    t: ca.SX
    s: ca.SX
    l: ca.SX
    F: ca.SX
    Y: ca.SX
    F_l: ca.SX
    Y_s: ca.SX
    Y_l: ca.SX
    start: ca.SX
    lower: np.ndarray
    upper: np.ndarray
    states: Sequence[str]
    multipliers: Sequence[str]
    first: int  # The column of the first of l in a run.
    untouched: str = "y'"  # What rows that are watched have no multiplier in.
    cones: tuple[slice, ...] = ()
    u: ca.SX = ca.SX(0, 1)
    moving: frozenset[int] = frozenset()  # The rows whose ends move: those of a set of the same kind stand for them.

    @property
    def given(self) -> tuple[ca.SX, ...]:
        """What F and Y are expressions of."""
        return self.t, self.s, self.l, self.u


IMPACT_STRUCTURE = Part[Callable[[Any], ImpactStructure | None]]("schemes.impact_system")


@cached_per_object
def impact_rows(model: Model) -> tuple[ImpactRow, ...]:
    """Return the rows to watch in runs of the bound ``model``: of most models none.

    A class whose states may jump has the part IMPACT_STRUCTURE; it is None of a model whose states do not.
    """
    part = IMPACT_STRUCTURE.optional(model)
    system = None if part is None else part(model)
    if system is None or not system.l.numel():
        return ()
    entries = partial(_nonzero_entries, system, _sample_points(system))
    bounded = np.isfinite(system.lower) & np.isfinite(system.upper)

    def has_entered_multiplier(rows: np.ndarray, columns: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Which of the rows hold a multiplier that counts: beside a relay all do, beside a contact those without end."""
        return np.isin(np.arange(at.size), rows[at[rows] | ~bounded[columns]])

    late = ~has_entered_multiplier(*entries(system.Y_l), bounded) & ~has_entered_multiplier(
        *entries(system.Y_s, system.F_l), bounded
    )
    acted, acting = entries(system.F_l)
    pushes, found = np.array(ca.Function("pushes", list(system.given), [ca.densify(system.F_l)])(*_sample_points(system)[0])), []
    for rows in (*(slice(i, i + 1) for i in map(int, np.flatnonzero(~np.isnan(system.lower)))), *system.cones):
        if not late[rows].all() or rows.start in system.moving or ca.depends_on(system.Y[rows], system.u):
            continue  # of what an input moves y' holds u'
        Y, first, cone = system.Y[rows], rows.start, rows in system.cones
        rate = ca.jtimes(Y, system.s, system.F) + ca.jacobian(Y, system.t)
        degree, derivative, alone = 2, rate, bounded[rows]
        while not has_entered_multiplier(*(at := entries(ca.jacobian(derivative, system.s), system.F_l)), alone).any():
            degree, derivative = degree + 1, ca.jtimes(derivative, system.s, system.F) + ca.jacobian(derivative, system.t)
            if degree > system.s.numel():
                degree = 0
                break
        if bounded[first] and not (degree and (at[1] == first).all()):
            continue  # with others' help a relay may well come to y = 0
        own = np.unique(acted[(rows.start <= acting) & (acting < rows.stop)])
        found.append(ImpactRow(
            names=tuple(system.multipliers[rows]), column=system.first + first, lower=0.0 if cone else float(system.lower[first]),
            upper=np.inf if cone else float(system.upper[first]), degree=degree, moved=tuple(system.states[int(j)] for j in own),
            pushed=np.linalg.norm(pushes[:, rows], axis=1),
            rate=ca.Function(
                "rate", list(system.given), [ca.densify(_cone_gap_rate(Y, rate) if cone else rate), ca.densify(rate)]
            ),
            inputs=slice(system.first, system.first + system.l.numel() or None), untouched=system.untouched,
        ))  # fmt: skip
    return tuple(found)


@cached_per_object
def anti_friction(model: Model) -> dict[str, float]:
    """Return {multiplier: its entry of C B at the start} where that is < 0 and l has an end; of most models {}.

    C B is h_x M^{-1} g_l. Then Assumption 5.1 of Lur'e systems (there is P = P' > 0 with P B = C') is violated. Nothing is said
    of a model that has parameters without a number.
    """
    part = None if model.p.numel() else IMPACT_STRUCTURE.optional(model)
    system = None if part is None else part(model)
    if system is None or not system.l.numel():
        return {}
    products = ca.densify(system.Y_s * system.F_l.T)
    outputs = [ca.sum2(products), ca.sum2(ca.fabs(products)), ca.densify(ca.diag(system.Y_l))]
    values = ca.Function("values", list(system.given), outputs)
    slope, size, direct = (np.array(v).ravel() for v in values(*_sample_points(system)[0][:3], initial_inputs(model)))
    bounded = np.isfinite(system.lower) | np.isfinite(system.upper)  # An equality holds by either sign.
    rows = np.flatnonzero(bounded & (direct == 0) & (slope < -PRODUCT_ROUNDING * size))
    return {system.multipliers[i]: float(slope[i]) for i in rows.tolist()}


def anti_friction_text(slopes: Mapping[str, float]) -> str:
    """What `anti_friction` found in words; of many multipliers the first."""
    first = ", ".join(f"{slope:.3g} for '{name}'" for name, slope in [*slopes.items()][:MAX_NAMED_ROWS])
    more = f" and {len(slopes) - MAX_NAMED_ROWS} more" if len(slopes) > MAX_NAMED_ROWS else ""
    return f"hypothesis 5.1 is violated: C B = {first}{more}"


def anti_friction_hint(model: Model) -> str:
    """The end of the message of a step that failed; "" where no sign is wrong."""
    found = anti_friction(model)
    return f"; {anti_friction_text(found)}" if found else ""


def _cone_gap_rate(y: ca.SX, rate: ca.SX) -> ca.SX:
    """(y_1 - |(y_2, ...)|)', on the axis the one-sided derivative."""
    size = ca.norm_2(y[1:])
    return rate[0] - ca.if_else(size > 0, ca.dot(y[1:], rate[1:]) / size, ca.norm_2(rate[1:]))


def impact_structure(
    model: Any, law: Law, l: ca.SX, F: ca.SX, Y: ca.SX, matrices: Sequence[ca.SX], untouched: str = "y'"
) -> ImpactStructure:
    """The system of a law on the states x; matrices are F_l, Y_x, Y_l."""
    lower, upper, driven = [np.empty(0)], [np.empty(0)], ca.vertcat(model.t, model.u)
    moving = frozenset(i for i, moves in enumerate(law.moves(driven)) if moves)
    law = law.at_rest(driven) if moving else law
    for block in law.blocks:
        low, high = block.bounding_box() if block.separable else np.full((2, block.size), np.nan)
        lower.append(low)
        upper.append(high)
    ends = np.concatenate(lower), np.concatenate(upper)
    cones = tuple(rows for rows, block in law.parts() if isinstance(block.shape(), SecondOrder))
    F_l, Y_x, Y_l = matrices
    return ImpactStructure(
        model.t, model.x, l, F, Y, F_l, Y_x, Y_l, model.x0, *ends, model.names, model.multiplier_names, 0, untouched, cones,
        model.u, moving,
    )  # fmt: skip


def _sample_points(system: ImpactStructure) -> list[tuple[float, np.ndarray, np.ndarray, np.ndarray]]:
    """(t, s, l, u) where rows are looked at."""
    rng, start = np.random.default_rng(0), np.array(ca.DM(system.start)).ravel()
    size = np.abs(start) + (np.abs(start).max(initial=0.0) or 1.0)
    low, high = (
        np.nan_to_num(end, nan=sign, posinf=1.0, neginf=-1.0) for end, sign in ((system.lower, -1.0), (system.upper, 1.0))
    )
    around = [
        (
            rng.uniform(),
            start + size * rng.uniform(-1, 1, start.size),
            rng.uniform(low, np.maximum(low, high)),
            rng.uniform(-1, 1, system.u.numel()),
        )
        for _ in range(SAMPLE_POINTS - 1)
    ]
    return [(0.0, start, np.clip(0.0, low, np.maximum(low, high)), np.zeros(system.u.numel())), *around]


def _nonzero_entries(system: ImpactStructure, places: Sequence[Any], *factors: ca.SX) -> tuple[np.ndarray, np.ndarray]:
    """(rows, columns) where the product of matrices is not 0, beyond the rounding of its terms, at one of the places."""
    first, *others = (ca.DM(factor) if factor.is_constant() else factor for factor in factors)
    product, size = first, ca.fabs(first)
    for factor in others:
        product, size = product @ factor, size @ ca.fabs(factor)
    triplet: Any = product.sparsity().get_triplet()
    rows, columns = (np.array(part, int) for part in triplet)
    if not rows.size:
        return rows, columns
    nonzero, outputs = np.zeros(rows.size, bool), [product, ca.project(size, product.sparsity())]
    f = ca.Function("f", list(system.given), outputs)
    for place in places[: 1 if product.is_constant() else None]:
        value, terms = (np.array(part.nonzeros()) for part in f(*place))
        nonzero |= ~(np.abs(value) <= PRODUCT_ROUNDING * terms)
    return rows[nonzero], columns[nonzero]


def update_impacts(watches: Sequence[ImpactRow], columns: Mapping[str, np.ndarray], known: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is known of a run after its next rows: how often a row watched set in with a jump, or slid, and when first.

    Args:
        watches: of the run's model.
        columns: t (k,), x (k, n), multipliers (k, m), of an oscillator v (k, n), inputs (k, nu): the next rows.
        known: what was returned for the rows before; {} at the start of the run.
    """
    return {watch.name: _update_impact(watch, columns, known.get(watch.name, _NO_IMPACT)) for watch in watches}


_NO_IMPACT = {"count": 0, "t": None, "rate": 0.0, "largest": 0.0, "size": 0.0, "rows": 0, "times": [], "rates": [], "free": []}


def _update_impact(watch: ImpactRow, columns: Mapping[str, np.ndarray], known: Mapping[str, Any]) -> dict[str, Any]:
    t, l = columns["t"], columns["multipliers"]
    s = np.hstack([columns["x"], columns["v"]]) if "v" in columns else columns["x"]
    u = columns.get("inputs", np.zeros((len(t), 0)))
    (rate,), velocity = map(np.array, watch.rate.map(len(t))(t[None, :], s.T, np.nan_to_num(l[:, watch.inputs]).T, u.T))
    old = len(known["rates"])  # of rows that were there before: what follows is found in the new ones
    times, rates = np.concatenate([known["times"], t]), np.concatenate([known["rates"], np.nan_to_num(rate)])
    free = np.concatenate([known["free"], watch.free(l[:, watch.column])]).astype(bool)
    speed = np.append(np.zeros(old), np.linalg.norm(np.nan_to_num(velocity), axis=0))
    size = np.maximum(np.maximum.accumulate(speed), known["size"])
    if watch.relay:
        sets_in = free[:-2] & ~free[1:-1] & ~free[2:]
        sets_in[: 1 if known["rows"] == 0 else 0] = False  # what slides from the start on did not come to it
        at = np.flatnonzero(sets_in) + 1
        at = at[at >= old - 1]
    else:
        change = np.abs(np.diff(rates, prepend=rates[:1]))
        change[2:] = np.minimum(change[2:], change[1:-1])
        jumps = watch.approach_speed(rates) > np.maximum(IMPACT_RATE_FACTOR * change, NEGLIGIBLE_RATE * size)
        at = np.flatnonzero(free[:-1] & ~free[1:] & jumps[:-1]) + 1
        at = at[at >= old]
    tail = {"times": times[-3:].tolist(), "rates": rates[-3:].tolist(), "free": free[-3:].tolist()}
    found = {**known, "size": float(size[-1]), "rows": known["rows"] + len(t), **tail}
    if at.size:
        found |= {"count": known["count"] + at.size, "largest": max(known["largest"], float(np.abs(rates[at - 1]).max()))}
        if known["t"] is None:
            found |= {"t": float(times[at[0]]), "rate": float(rates[at[0] - 1])}
    return found


def describe_impacts(watches: Sequence[ImpactRow], known: Mapping[str, Any], model: Model) -> list[str]:
    """What a run met, in the words of a mechanic: a line for each row that met something."""
    return [_describe_impact(watch, known[watch.name], model) for watch in watches if known.get(watch.name, _NO_IMPACT)["count"]]


def _describe_impact(watch: ImpactRow, found: Mapping[str, Any], model: Model) -> str:
    why = f"{watch.acts}, not on {watch.untouched}"
    if watch.relay:
        return (
            f"{why}, and slides from t = {found['t']:.6g} on: a relay that acts so late is switched ever faster around y = 0 and "
            "does not come to rest there; that it does here is the damping of the scheme. Compare with a smaller step"
        )
    of = "(y_1 - |(y_2, ...)|)'" if watch.cone else "y'"
    times = "once," if found["count"] == 1 else f"{found['count']} times, first"
    theta, gamma = map(float, model.weights or (1.0, 1.0))
    answer = "This scheme's answer is the inelastic one, y' = 0 afterwards."
    if not theta == gamma == 1:
        answer = (
            f"With theta = {theta:g}, gamma = {gamma:g} what comes after it depends on where in a step y closes; take "
            "theta = gamma = 1, whose answer is the inelastic one."
        )
    return (
        f"{why}: where y closes {watch.jumps} must jump, here {times} at t = {found['t']:.6g} with {of} = {found['rate']:.4g}: "
        f"an impact. {answer} The multipliers of the steps there are impulses / h, and grow as h shrinks; "
        f"there is no restitution: see {IMPACTS_GUIDE}"
    )


def cone_impact_message(watch: ImpactRow, t: float) -> str:
    """Why steps under error control end where a cone calls for an impulse, and what does not."""
    return (
        f"{watch.acts}, not on {watch.untouched}: where y closes {watch.jumps} must jump, an impact; at t = {t:.6g} the "
        "least step changes them by more than rtol allows. Error control does not pass that at a cone: what y may be off its "
        "surface is any jump over such a step. Constant steps have the inelastic answer, without restitution: see "
        f"{IMPACTS_GUIDE}"
    )
