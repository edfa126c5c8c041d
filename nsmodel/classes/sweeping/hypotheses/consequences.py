"""What follows from the hypotheses of a sweeping process: prox-regularity, the step bound, the order and its constant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, Consequence, Finding, common_scope, make_consequence
from nsmodel.hypotheses.scope import Scope, intersect_scopes
from nsmodel.modeling.base import Model
from nsmodel.simulation.trajectory import Trajectory

BERNICOT_VENEL_2010 = "Bernicot and Venel 2010"
REGULARITY_HYPOTHESES = ("S-convex", "A1", "A4", "A5'")
MOTION_HYPOTHESES = ("S-convex", "A0", "A1", "A2", "A5")
SOLVABILITY_HYPOTHESES = ("S-convex", "A0", "A1", "A2", "A4", "A5", "S-f", "S-start")


class _TheoryConstants(NamedTuple):
    """The constants of the theory; ``bend`` is M/(2a), ``eta_on_U`` that with the M of all of U_i."""

    K_L: float
    K_L_paper: float
    c: float
    r: float
    Theta: float
    kappa: float
    bend: float
    eta: float
    eta_on_U: float


def _theory_constants(number: dict[tuple[str, str], float], moves_in_all: bool, p: int) -> _TheoryConstants:
    """``moves_in_all``: A0 may be proved without a number, for U_i is all of space."""
    nothing = (np.inf, 0.0) if not p else (0.0, np.inf)
    a, b = number.get(("A1", "a"), nothing[0]), number.get(("A1", "b"), nothing[1])
    speed = number.get(("A2", "b"), nothing[1])
    c = number.get(("A0", "c"), np.inf if moves_in_all else 0.0)
    M, M_contact = (number.get(("A4", name), nothing[1]) for name in ("M", "M_contact"))
    if not M and np.isfinite(c):  # U_i is not all: beyond c nothing is as straight as there, and |q - q_k| <= |q - q_k|^2 / c.
        M = M_contact = 2 * a / c
    gamma, gamma_0, rho = number[("A5", "gamma")], number[("A5'", "gamma")], number.get(("A5", "rho"), np.inf)
    Theta = _product_or_zero(2 * gamma, _quotient_or_inf(b, a))
    return _TheoryConstants(
        K_L=_product_or_zero(gamma, _quotient_or_inf(speed, a)),
        K_L_paper=_product_or_zero(gamma, _quotient_or_inf(max(speed, b), a)), c=c,
        r=min(_quotient_or_inf(rho, 6 * b), _quotient_or_inf(a, _product_or_zero(4 * gamma, M))), Theta=Theta,
        kappa=_product_or_zero(Theta * p, _quotient_or_inf(M, 2 * a)),
        bend=_quotient_or_inf(M, 2 * a), eta=_quotient_or_inf(a, _product_or_zero(M_contact, gamma_0)),
        eta_on_U=_quotient_or_inf(a, _product_or_zero(M, gamma_0)),
    )  # fmt: skip


def sweeping_consequences(model: Model, findings: Sequence[Finding], runs: Sequence[Trajectory], p: int) -> list[Consequence]:
    """Return what follows, with the constants of the theory; ``p`` is the number of constraints."""
    number = {(finding.id, name): value for finding in findings for name, value in finding.value.items()}
    verdicts = {finding.id: finding.verdict for finding in findings}
    known = _theory_constants(number, verdicts["A0"] in (HOLDS, SAMPLED), p)
    bound = _quotient_or_inf(known.c, known.K_L)
    h = float(np.max(model.steps)) if model.steps is not None else float(model.step or np.nan)
    met = "" if np.isnan(h) else f"; the model's own step {h:.4g} " + ("meets it" if h < bound else "does not meet it")
    steps = {"h": bound, "h with b": _quotient_or_inf(known.c, known.K_L_paper)} | ({} if np.isnan(h) else {"step": h})
    found = [
        make_consequence(
            "well posed", "one and only one absolutely continuous solution", findings, SOLVABILITY_HYPOTHESES,
            f"{BERNICOT_VENEL_2010}, Theorem 2.5",
        ),
        *_set_consequences(findings, known),
        make_consequence(
            "step bound", f"the scheme is well defined for {'every h' if np.isinf(bound) else 'h < c / K_L'}{met}", findings,
            MOTION_HYPOTHESES, f"{BERNICOT_VENEL_2010}, section 3", steps,
        ),
        *_linearisation_consequences(findings, known, p),
    ]  # fmt: skip
    return [*found, _order_consequence(model, findings, runs, number, known.K_L, known.kappa, known.r)]


def _set_consequences(findings: Sequence[Finding], known: _TheoryConstants) -> list[Consequence]:
    """Prox-regularity and speed."""
    local = {
        name: bool((scope := common_scope(findings, ids)) and scope.states)
        for name, ids in (("eta", REGULARITY_HYPOTHESES), ("K_L", MOTION_HYPOTHESES))
    }
    return [
        make_consequence(
            "prox-regular", _regularity_statement(known.eta, local["eta"]), findings, REGULARITY_HYPOTHESES,
            f"{BERNICOT_VENEL_2010}, Proposition 2.3", {"eta": known.eta, "eta on U": known.eta_on_U}, moving=False,
        ),
        make_consequence(
            "K_L", _speed_statement(local["K_L"]), findings, MOTION_HYPOTHESES, f"{BERNICOT_VENEL_2010}, Proposition 2.4",
            {"K_L": known.K_L, "K_L with b": known.K_L_paper}, moving=False,
        ),
    ]  # fmt: skip


def _linearisation_consequences(findings: Sequence[Finding], known: _TheoryConstants, p: int) -> list[Consequence]:
    """How far it is from the set."""
    return [
        make_consequence(
            "linearisation error", "the distance from q in Q(t) to the linearised Q_i(t) at q_k is at most M/(2a) |q - q_k|^2",
            findings, ("S-convex", "A1", "A4"), f"{BERNICOT_VENEL_2010}, Proposition 3.6", {"M/(2a)": known.bend}, moving=False,
        ),
        make_consequence(
            "metric qualification",
            "d(q, linearised Q) <= Theta sum d(q, linearised Q_i) within r/4, r = min(rho/(6b), a/(4 M gamma)), "
            f"Theta = 2 gamma b/a; kappa = Theta p M/(2a) with p = {p}, the number of all constraints",
            findings, ("S-convex", "A1", "A4", "A5"), f"{BERNICOT_VENEL_2010}, Theorem 4.9",
            {"r": known.r, "Theta": known.Theta, "kappa": known.kappa, "p": p}, moving=False,
        ),
    ]  # fmt: skip


def _regularity_statement(eta: float, local: bool) -> str:
    """Prox-regularity in words: of a box it is told of the points there alone, for the set beyond is not known."""
    if local:
        bound = "0" if np.isinf(eta) else "|n| |q' - q|^2 / (2 eta), eta = a/(M gamma(0)) with M at contact,"
        return (
            f"at q in Q(t) inside the box and n normal to Q(t) there, <n, q' - q> <= {bound} for q' in Q(t) near q inside the "
            "box. Q(t) as a whole need not be prox-regular"
        )
    return "Q(t) is convex" if np.isinf(eta) else "Q(t) is eta-prox-regular, eta = a/(M gamma(0)) with M at contact"


def _speed_statement(local: bool) -> str:
    """The speed of the set in words."""
    rate = "K_L = gamma sup|d_t g_i| / a; with the paper's b: gamma b/a"
    if local:
        return (
            "a point of Q(t) inside the box is within K_L |t - s| of Q(s), as long as that is less than its distance from the "
            f"sides of the box; {rate}. Nothing is said of Q(t) beyond"
        )
    return f"d_H(Q(t), Q(s)) <= K_L |t - s|, {rate}"


def _order_consequence(
    model: Model, findings: Sequence[Finding], runs: Sequence[Trajectory], number: dict[tuple[str, str], float],
    K_L: float, kappa: float, r: float,
) -> Consequence:  # fmt: skip
    """max |q_h - q| <= C_0 sqrt(h): C_0 with C bounding |q_h| and K bounding |q_h'| on the runs."""
    statement = "max |q_h(t) - q(t)| <= C_0 sqrt(h): order 1/2 is proved, order 1 is what smooth scenes show"
    value: dict[str, float] = {"order": 0.5}
    T = max((float(run.t[-1]) for run in runs), default=0.0)
    rows = [run for run in runs if len(run.t) > 1 and np.isfinite(run.x).all()]
    K_f, L_f, L_t = (number.get(("S-f", name), np.inf) for name in ("K_f", "L_f", "L_t"))
    if rows:
        C = max(float(np.linalg.norm(run.x, axis=1).max()) for run in rows)
        K = max(float((np.linalg.norm(np.diff(run.x, axis=0), axis=1) / np.diff(run.t)).max()) for run in rows)
        value |= {"log10 C_0": log_error_constant(K, C, T, K_f, L_f, L_t, K_L, kappa, r), "K": K, "C": C}
        h = _quotient_or_inf(r, 16 * K), _quotient_or_inf(r, 8 * K_L)
        value["for h up to"] = min(1.0, *h)
        statement += "; C_0 with K and C of the runs"
    elif np.isfinite(L_t):
        statement += "; C_0 needs a run, for bounds K of |q_h'| and C of |q_h|"
    if not np.isfinite(L_t):
        statement += "; it needs f to be Lipschitz in t, and no L_t is known"
    rests_on = ("S-convex", "A0", "A1", "A2", "A3", "A4", "A5", "A5'", "S-f", "S-start")
    source = f"{BERNICOT_VENEL_2010}, Theorem 3.4, whose proof bounds the square of the error"
    found = make_consequence("order 1/2", statement, findings, rests_on, source, value)
    found = replace(found, scope=intersect_scopes(found.scope, Scope(time=(0.0, T)))) if rows else found  # C_0 grows with T
    return found if np.isfinite(L_t) else replace(found, verdict=UNKNOWN)


def log_error_constant(
    K: float, C: float, T: float, K_f: float, L_f: float, L_t: float, K_L: float, kappa: float, r: float
) -> float:  # fmt: skip
    """Return log10 of C_0, C_0^2 = C_5 (exp(2 L T) - 1) / L (the proof of Theorem 3.4, its gaps closed); inf if unbounded."""
    C_1 = L_f * (1 + C) + K
    C_2 = C_1 * (K_L + _product_or_zero(2 * kappa, (K + K_L) ** 2)) if np.isfinite(K_L) else np.inf
    C_3 = max(_product_or_zero(2 * C_1, kappa), _quotient_or_inf(32 * C_1, r))
    C_4 = max(C_2, _quotient_or_inf(128 * C_1 * K**2, r))
    C_5 = 2 * C_4 + 4 * K**2 + _product_or_zero(8 * K**2, K_f) + _product_or_zero(L_t, 0.5 + 2 * K)
    L = 2 * C_3 + 2 * K_f + L_t / 2
    if not (np.isfinite(C_5) and np.isfinite(L)):
        return np.inf
    if C_5 == 0:
        return -np.inf
    x = 2 * L * T
    grown = x if x > 50 else np.log(np.expm1(x)) if x > 0 else 0.0
    return float((np.log(C_5) + (grown - np.log(L) if L > 0 else np.log(2 * T))) / (2 * np.log(10)))


def _quotient_or_inf(x: float, y: float) -> float:
    """x / y where x/0 and inf/x are inf and 0/0 (a bound on nothing) is inf."""
    return x / y if y and not (np.isinf(x) and np.isinf(y)) else np.inf


def _product_or_zero(x: float, y: float) -> float:
    """x y with 0 inf = 0."""
    return x * y if x and y else 0.0
