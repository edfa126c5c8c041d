"""What runs are compared with: the closed form a model declares, or a refined run that shows its own error; and the errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from nsmodel.brief import brief
from nsmodel.columns import output_names
from nsmodel.errors import UsageError
from nsmodel.model.base import Model
from nsmodel.proof.sure import sure
from nsmodel.scheme.problem import OneStepProblem
from nsmodel.solve.active_set import equilibrate
from nsmodel.solve.certificate import NumericLaw, numeric_law
from nsmodel.solve.newton import Newton
from nsmodel.solve.structure import read
from nsmodel.study.between import AtRows, Between, Step
from nsmodel.study.lines import Point
from nsmodel.trajectory import Trajectory

BETWEEN = ("max", "l2")  # Measures that look at the states at all times.
CLEAR = 5.0  # A point is resolved where its error is so many times the reference's own.
ROUNDING = 1e-14  # What a closed form is known to, relative.
UNSEEN = 1e-9  # A state smaller than this part of its group is no more than rounding.
ORDERS = 0.5, 2.0  # The schemes' orders; outside of them an order seen on three runs is chance.
REGULAR = 1e-10  # Least singular value, relative to the largest, of a matrix that determines its multipliers.
FINER = 8  # Parts in which a piece is compared.
INDEX_SETS = 60  # So many different index sets of a run are looked at.


@dataclass(frozen=True)
class Rows:
    """What is compared of a run: times (N+1,), states (N+1, n), and multipliers (N+1, m) where they are unique; of declared
    outputs the means over the run and the largest values.
    """

    t: np.ndarray
    x: np.ndarray
    multipliers: np.ndarray | None = None
    outputs: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    __repr__ = brief

    @classmethod
    def of(cls, run: Trajectory) -> Rows:
        """Return the rows of a run; the multipliers of a sweeping process are its reactions.

        Of an event-driven run also times between its rows, where it is its polynomials and no straight lines, and no multipliers:
        those that are compared are constant between rows.
        """
        if not run.is_event_driven:
            return cls(run.t, run.x, run.arrays.get("reactions", run.arrays.get("multipliers")), _means(run))
        inside = (run.t[:-1, None] + np.diff(run.t)[:, None] * np.arange(1, FINER) / FINER).ravel()
        t, x = np.concatenate([run.t, inside]), np.concatenate([run.x, run.at(inside).x])
        order = np.argsort(t, kind="stable")
        return cls(t[order], x[order], outputs=_means(run))


@dataclass(frozen=True)
class Reference:
    """The state that counts as right.

    Attributes:
        text: what it is, in a line; run: what the refined run is, empty where there was none.
        state: times (N,) -> states (N, n), and what they may err by because the times are none of the reference's own.
        scale: what an error of each state is divided by (n,).
        rows: the refined run, None where there was none.
        own: its own error by measure, of the same kind as the errors measured with it.
        without_multipliers: why multipliers are not compared, empty where they are.
    """

    text: str
    run: str
    state: Callable[[np.ndarray], tuple[np.ndarray, float]]
    scale: np.ndarray
    rows: Rows | None
    own: Mapping[str, float]
    without_multipliers: str = ""

    __repr__ = brief

    def errors(self, rows: Rows) -> dict[str, float]:
        """Return the errors of a run: "max", "end", "l2", and "multipliers" where both have them."""
        return self._measured(rows)[0]

    def _measured(self, rows: Rows) -> tuple[dict[str, float], float]:
        """The errors, and what the reference may err by at these rows besides its own."""
        right, more = self.state(rows.t)
        found = _state_errors(rows, right, self.scale)
        if self.rows is not None and not self.without_multipliers:
            error = _multiplier_error(rows, self.rows)
            if error is not None:
                found["multipliers"] = error
        if self.rows is not None and (shared := self.rows.outputs.keys() & rows.outputs.keys()):
            found["outputs"] = max(_apart(rows.outputs[name], self.rows.outputs[name]) for name in shared)
        return found, more

    def point(self, label: str, rows: Rows, seconds: float | None, step: float | None = None) -> Point:
        """Return a run as a point, with its errors; those that are not clear of the reference's own are unresolved."""
        errors, more = self._measured(rows)
        known = {key: own + (more if key in BETWEEN else 0.0) for key, own in self.own.items()}
        unresolved = tuple(key for key, error in errors.items() if error < CLEAR * known.get(key, 0.0))
        return Point(label, seconds, errors, step=step, steps=len(rows.t) - 1, unresolved=unresolved)


@dataclass(frozen=True)
class ClosedForm:
    """The user's function of times (N,) -> (N, n), what it returns checked."""

    exact: Callable[[np.ndarray], np.ndarray]
    n: int

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states, which err by 0.

        Raises:
            UsageError: the function raises, or gives another shape or what is not finite.
        """
        try:
            found = np.asarray(self.exact(times), float)
        except Exception as error:
            raise UsageError(f"exact: it raised {type(error).__name__}: {error}") from error
        if found.shape != (len(times), self.n) or not np.isfinite(found).all():
            size = f"shape {found.shape} for {len(times)} times; expected {(len(times), self.n)}, all finite"
            raise UsageError(f"exact: it returned {size}")
        return found, 0.0


def closed_form(
    exact: Callable[[np.ndarray], np.ndarray],
    model: Model,
    t: np.ndarray,
    refined: Reference | None,
    without_multipliers: str = "",
) -> Reference:
    """Return the closed form as reference, with the multipliers of a refined run where there is one.

    Raises:
        UsageError: it raises, gives another shape, or what is not finite.
    """
    state = ClosedForm(exact, len(model.names))
    own: dict[str, float] = dict.fromkeys(("max", "end", "l2"), ROUNDING)
    scale = scale_of(model, state(t)[0])
    text = "the closed form that the model declares"
    if refined is None:
        return Reference(text, "", state, scale, None, own, without_multipliers or "there is no refined run")
    own |= {key: value for key, value in refined.own.items() if key not in own}
    return Reference(text, refined.run, state, scale, refined.rows, own)


def refined_run(model: Model, run: str, runs: list[Rows], without_multipliers: str, step: Step) -> Reference:
    """Return the last of three runs, each with half the step of the one before, as reference with an estimate of its error.

    Between its rows ``step`` takes a step from the row before, wherever a line would add to that error.

    The order p is read off the three (within ORDERS), and the error is |x_h - x_2h|/(2^p - 1), measure by measure.
    """
    wide, medium, fine = runs
    scale = scale_of(model, fine.x)
    state = AtRows(fine.t, fine.x, step) if model.u.numel() else Between(fine.t, fine.x, step, scale, np.inf)
    reference = Reference(run, run, state, scale, fine, {}, without_multipliers)
    far, near = reference.errors(wide), reference.errors(medium)
    own = {measure: _own(far[measure], near[measure]) for measure in near}
    return replace(reference, own=own, state=replace(state, good=own["max"]) if isinstance(state, Between) else state)


@dataclass(frozen=True)
class Polynomials:
    """An event-driven run as a function of times (N,) -> (N, n); at the start the state before a jump."""

    run: Trajectory

    def __call__(self, times: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the states, which err by no more between rows than at them."""
        return np.where((times <= 0)[:, None], self.run.x[0], self.run.at(np.minimum(times, self.run.t[-1])).x), 0.0


def polynomials(model: Model, rtol: float, rough: Trajectory, fine: Trajectory, refined: Reference) -> tuple[Reference, str]:
    """Return an event-driven run as reference, whose own error is how far a rougher one is from it.

    The multipliers are those of the refined run, which it must agree with to the errors of both; where it does not, that run
    is the reference, what they differ by its own error, and a note says so.
    """
    scale = scale_of(model, fine.smooth().x)
    means, known = _means(fine), sure(refined.rows).outputs
    outputs = {name: (means[name][0], size) for name, (_, size) in known.items() if name in means}
    rows = replace(sure(refined.rows), outputs=outputs)
    new = replace(refined, text=f"an event-driven run, rtol = {rtol:g}", state=Polynomials(fine), scale=scale, rows=rows)
    states = {measure: max(error, ROUNDING) for measure, error in new.errors(Rows.of(rough)).items()}
    apart = new.errors(sure(refined.rows))
    if apart["max"] > CLEAR * (refined.own["max"] + states["max"]):
        own = {measure: max(error, apart.get(measure, 0.0)) for measure, error in refined.own.items()}
        return replace(refined, own=own), (
            f"an event-driven run and {refined.text} differ by {apart['max']:.1e}, more than their own errors tell; this counts "
            "as the error of the reference"
        )
    return replace(new, own={**refined.own, **states}), ""


def scale_of(model: Model, x: np.ndarray) -> np.ndarray:
    """Return the largest value of each state; of its symbol's group where it is zero all the time, 1 where all of that is."""
    sizes = np.abs(x).max(axis=0)
    scale = sizes.copy()
    for columns in model.stems.values():
        group = sizes[columns].max()
        scale[columns] = np.where(sizes[columns] > UNSEEN * group, sizes[columns], group if group > 0 else 1.0)
    return scale


def _means(run: Trajectory) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """{name: (mean over the run, largest value)} of declared outputs, (k,) each; of those that have a mean."""
    found = {}
    for name in output_names(run):
        with suppress(UsageError):
            mean, size = np.atleast_1d(run.mean(name)), np.nanmax(np.abs(run.arrays[name]), axis=0)
            found[name] = mean, np.atleast_1d(size)
    return found


def _apart(one: tuple[np.ndarray, np.ndarray], right: tuple[np.ndarray, np.ndarray]) -> float:
    """How far a mean is from the right one, beside the largest value."""
    size = np.where(right[1] > 0, right[1], 1.0)
    return float((np.abs(one[0] - right[0]) / size).max())


def _own(far: float, near: float) -> float:
    p = np.log2(max(far / near - 1, 1e-3)) if near > 0 else ORDERS[1]
    return max(near / (2 ** np.clip(p, *ORDERS) - 1), ROUNDING)


def _state_errors(rows: Rows, right: np.ndarray, scale: np.ndarray) -> dict[str, float]:
    known = ~np.isnan(right).any(axis=1)
    error = np.abs(rows.x - right)[known] / scale
    steps = np.diff(rows.t[known])
    square = (steps[:, None] * error[1:] ** 2).sum(axis=0) / steps.sum()
    return {"max": float(error.max()), "end": float(error[-1].max()), "l2": float(np.sqrt(square.max()))}


def _multiplier_error(rows: Rows, right: Rows) -> float | None:
    """The integral of sum |l - l_ref| over that of sum |l_ref|; None where a run has none."""
    if rows.multipliers is None or right.multipliers is None or not rows.multipliers.size:
        return None
    (t, steps, l), (times, lengths, expected) = _known(rows), _known(right)
    size = lengths @ np.abs(expected).sum(axis=1)
    error = steps @ np.abs(l - _between(t, times, expected)).sum(axis=1)
    return float(error / size) if size > 0 else None


def _known(rows: Rows) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, steps and multipliers of the rows that have multipliers: not the start."""
    l = sure(rows.multipliers)
    known = np.all(np.isfinite(l), axis=1)
    return rows.t[known], np.diff(rows.t, prepend=rows.t[0])[known], l[known]


def _between(t: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(t, times, column) for column in values.T])


def why_not_unique(model: Model, problem: OneStepProblem, run: Trajectory) -> str:
    """Say why the multipliers of a run are not unique, as its index sets show; empty where they are.

    They are where the rows and columns of W with y_i = 0 are a regular matrix: y = W l + b then has one solution with this
    index set.
    """
    if problem.prediction is not None:
        return "catching-up has no multipliers: it projects"
    if not problem.l.numel():
        return "the model has none"
    law = numeric_law(problem.law)
    newton = Newton(problem, read(problem), law, run.metadata["tolerance"])
    n, m, codes = len(model.names), law.size, run.index_set
    _, rows = np.unique(codes, axis=0, return_index=True)
    for k in [k for k in np.sort(rows) if codes[k].min() >= -1][:INDEX_SETS]:
        held = np.flatnonzero(codes[k] == 0)
        state = np.zeros(problem.state.numel())
        state[:n] = run.x[k - 1]
        if "inputs" in run.arrays:
            state[-2 * run.inputs.shape[1] :] = np.concatenate([run.inputs_begin[k], run.inputs[k]])
        l = run.multipliers[k] if run.multipliers.shape[1] == m else np.zeros(m)
        W, _ = newton.affine_problem(float(run.t[k - 1]), float(run.step[k]), state, l)
        if W is None:
            return f"not known to be unique: the step's matrix is singular at t = {run.t[k]:.4g}"
        if held.size and not _regular(W[np.ix_(held, held)]):
            names = [problem.rows[i] for i in held[:4]] + (["..."] if held.size > 4 else [])
            return f"not unique: the matrix of the active rows ({', '.join(names)}) is singular at t = {run.t[k]:.4g}"
    return ""


def _regular(W: np.ndarray) -> bool:
    free = NumericLaw(np.full(len(W), -np.inf), np.full(len(W), np.inf), ())
    values = np.linalg.svd(equilibrate(W, np.zeros(len(W)), free)[0], compute_uv=False)
    return bool(values[-1] > REGULAR * values[0])
