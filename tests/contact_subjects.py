"""Mechanical systems whose libraries are tried with random and hostile numbers: a disc on a floor, the end of a rod on a floor.

The step of Moreau and Jean with theta = 1/2, written out again in extended precision (Acary, CMAME 256, 2013), one contact of two
rows, P = (P_N, P_T):

    M (v+ - v) = h F + G(q + h v / 2)' P,    y = (u_N+ + e min(u_N, 0), u_T+),    -ŷ(y) ∈ N_K(P) where the contact acts,
    M d = G_N(q + h v / 2)' tau,    0 <= gap(q+) ⟂ tau >= 0,    q+ = q + h (v + v+)/2 + d
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from library_fuzz import EPS, LAW, ROUND_OFF, UNDERFLOW, Input, Step, Subject, magnitude, motion, ratios

from nsmodel import Contact, MechanicalSystem, mechanics

MASS, RADIUS, HALF, STEP = np.array([1.0, 1.0, 0.02]), 0.2, 0.5, 0.01
WEIGHT = np.array([0.0, -9.81, 0.0])
MOST_MU = 0.58  # The rod's least mu of two answers is 2 sqrt(13.5)/12.5 = 0.588, by W_NN and W_NT (Painlevé 1895).
OPEN = 1e30  # What is added to y_N of a contact that does not act: speeds beyond it are no longer told apart.
OPEN_GAP = 1e-10  # Part of the largest gap so far up to which a contact counts as closed.

Geometry = Callable[[np.ndarray], tuple[Any, np.ndarray, Any, Any]]  # q -> (gap, rows G, terms of the gap, terms of G)


def disc(load_case: Callable[..., Any]) -> MechanicalSystem:
    """A disc of radius 0.2 m on a floor; mu and e are parameters."""
    q, v, mu, e = ca.SX.sym("q", 3), ca.SX.sym("v", 3), ca.SX.sym("mu"), ca.SX.sym("e")
    floor = mechanics.disc(q, v, RADIUS, ([0, 0], [0, 1]), mu=mu, e=e)
    return _falling(q, v, {"floor": floor}, {mu: 0.3, e: 0.5})


def rod(load_case: Callable[..., Any]) -> MechanicalSystem:
    """A rod of 1 m whose end meets a floor; mu and e are parameters."""
    q, v, mu, e = ca.SX.sym("q", 3), ca.SX.sym("v", 3), ca.SX.sym("mu"), ca.SX.sym("e")
    end = Contact(q[1] + HALF * ca.sin(q[2]), slip=v[0] - HALF * ca.sin(q[2]) * v[2], mu=mu, e=e)
    return _falling(q, v, {"end": end}, {mu: 0.3, e: 0.5})


def _falling(q: ca.SX, v: ca.SX, contacts: dict[str, Contact], parameters: dict[ca.SX, float]) -> MechanicalSystem:
    return MechanicalSystem(
        q=q, v=v, M=np.diag(MASS), F=WEIGHT, contacts=contacts, q0=[0, 1, 0], v0=[1, 0, 0], t_end=1, step=STEP,
        parameters=parameters,
    )  # fmt: skip


def disc_geometry(q: np.ndarray) -> tuple[Any, np.ndarray, Any, Any]:
    G = np.array([[0, 1, 0], [1, 0, np.longdouble(RADIUS)]])
    return q[1] - np.longdouble(RADIUS), G, np.abs(q[1]) + RADIUS, 0.0


def rod_geometry(q: np.ndarray) -> tuple[Any, np.ndarray, Any, Any]:
    sine, cosine = HALF * np.sin(q[2]), HALF * np.cos(q[2])
    turned = HALF * (1 + np.abs(q[2]))  # what an angle off by its rounding moves the end by
    return q[1] + sine, np.array([[0, 1, cosine], [1, 0, -sine]]), np.abs(q[1]) + turned, turned


def coulomb(P: np.ndarray, y: np.ndarray, mu: Any, size_P: Any, size_y: Any) -> float:
    """The distance to the nearest of no contact, P = 0 <= y_N; stick, y = 0, |P_T| <= mu P_N; slip, P_T = -mu P_N sgn y_T."""
    (P_N, P_T), (y_N, y_T) = P, y
    closed = max(ratios(max(-P_N, 0), size_P), ratios(y_N, size_y))
    apart = max(ratios(P_N, size_P), ratios(P_T, size_P), ratios(max(-y_N, 0), size_y))
    outside = max(abs(P_T) / np.hypot(1, mu) - mu / np.hypot(1, mu) * P_N, 0)  # how far P is from the cone
    stick = max(closed, ratios(y_T, size_y), ratios(outside, size_P))
    slip = max(closed, ratios(P_T / np.hypot(1, mu) + mu / np.hypot(1, mu) * P_N * np.sign(y_T), size_P))
    return float(min(apart, stick, slip))


def judge(geometry: Geometry) -> Callable[[Step], tuple[float, float]]:
    """(residual of the laws of velocities and of positions, residual of the two equations of motion)."""

    def judged(step: Step) -> tuple[float, float]:
        h, (mu, e), P, largest = step.h, step.p, step.l, step.state[6]
        q, v, q_end, v_end = step.state[:3], step.state[3:6], step.after[:3], step.after[3:6]
        assert 0 <= e <= 1, e
        _, G, _, blur = geometry(q + h * v / 2)
        blur = ROUND_OFF * (blur + HALF * h * np.abs(v[2])) if np.any(blur) else np.longdouble(0)
        gap, _, gap_terms, _ = geometry(q_end)

        pushed, weight = G.T @ P, h * WEIGHT
        moved = MASS * np.abs(v_end - v) + np.abs(weight) + np.abs(G.T) @ np.abs(P)
        terms = MASS * (np.abs(v_end) + np.abs(v)) + moved
        lost = UNDERFLOW * (1 + np.abs(step.after).sum()) + blur * np.abs(P).sum()
        found = motion(MASS * (v_end - v) - weight - pushed, moved, terms, lost)

        # One scale a contact: of y that of all velocities in it, of P what stops these, and no more than it moves.
        speeds = np.abs(v) + np.abs(v_end)
        size_y = (np.abs(G) @ (speeds + h * np.abs(WEIGHT))).max() + blur * speeds.sum()
        size_P = np.abs(P).max() + EPS * MASS.max() * size_y / LAW
        y = G @ v_end + np.array([e * min(G[0] @ v, 0), 0])
        ahead, _, ahead_terms, _ = geometry(q + h * v + h * h / 2 * WEIGHT / MASS)
        doubt = ROUND_OFF * (ahead_terms + h * (np.abs(v).sum() + h * 10))
        acts, free = (coulomb(P, y + np.array([off, 0]), mu, size_P, size_y + off) for off in (0, OPEN))
        if ahead > OPEN_GAP * largest + doubt:
            law = free
        else:
            law = acts if ahead < OPEN_GAP * largest - doubt else min(acts, free)

        d = q_end - (q + h * (v + v_end) / 2)
        square = G[0] @ G[0]
        tau = (MASS * d) @ G[0] / square
        rounded = MASS * (np.abs(q) + np.abs(q_end) + h * speeds)
        across = np.abs(np.eye(3) - np.outer(G[0], G[0]) / square) @ rounded
        found = max(found, motion(MASS * d - G[0] * tau, MASS * np.abs(d), across, blur * abs(tau)))
        travel = np.abs(d) + h * (speeds + h * np.abs(WEIGHT))  # positions are right beside it
        size_gap = np.abs(G[0]) @ travel + ROUND_OFF * gap_terms / LAW
        size_tau = (MASS * travel).max() + ROUND_OFF * rounded.sum() / LAW
        idle = min(ratios(max(gap, 0), size_gap), ratios(tau, size_tau))
        return float(max(law, idle, ratios(max(-gap, 0), size_gap), ratios(max(-tau, 0), size_tau))), found

    return judged


def contact_input(
    geometry: Geometry, turn: float, length: float | None, most_mu: float
) -> Callable[[np.random.Generator], Input]:
    """Near the floor as often as far from it, at rest as often as fast; ``turn``: the most that a step turns."""

    def drawn(rng: np.random.Generator) -> Input:
        h = 10 ** rng.uniform(-6, -1) if length is None else length
        q, v = magnitude(rng, 3, -6, 2), magnitude(rng, 3, -6, 2)
        q[2] = rng.uniform(-np.pi, np.pi)
        v[2] = np.clip(v[2], -turn / h, turn / h)
        v *= rng.integers(0, 2, 3)
        gap = abs(q[1]) if rng.random() < 0.5 else rng.choice([0, 1e-12, 1e-6, 1e-3]) * rng.uniform(-1, 1)
        q[1] += gap - geometry(q)[0]
        p = np.array([rng.choice([0, most_mu, rng.uniform(0, most_mu)]), rng.choice([0, 1, rng.uniform(0, 1)])])
        return Input(rng.uniform(0, 10), h, np.concatenate([q, v]), np.zeros(6), p)

    return drawn


def is_out_of_range(p: np.ndarray) -> bool:
    """Whether mu < 0, or e is outside [0, 1]."""
    mu, e = p
    return not (mu >= 0 and 0 <= e <= 1)


FIXED, ANY = (contact_input(disc_geometry, np.inf, length, 3) for length in (STEP, None))
TURNING = contact_input(rod_geometry, 0.5, None, MOST_MU)
CONTACTS = {
    "disc": Subject(disc, FIXED, judge(disc_geometry), bad_parameters=is_out_of_range, length=STEP),
    "disc, any step": Subject(disc, ANY, judge(disc_geometry), bad_parameters=is_out_of_range, options=(("any_step", True),)),
    "rod": Subject(rod, TURNING, judge(rod_geometry), bad_parameters=is_out_of_range),
}
