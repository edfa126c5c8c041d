"""Random problems of contact with Coulomb friction, y = W l + b: whether each that has an answer gets one, and a right one.

    python -m tests.search.contacts                     # 1000 problems of each kind, interpreted
    python -m tests.search.contacts --problems 50 --first 7

Kinds: in the plane and in space; W of full rank or of 30 to 95 % of it; with an answer that is planted, or with b drawn. mu from
0 to 2, 1 to 6 contacts. The answers are judged from W, b and mu by the natural map with the change of variable of de Saxcé and
Feng, written here anew; what is refused is given to a Gauss-Seidel method, and in the plane to all modes. Status 1 where an
answer is wrong, or where one that exists was not found.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from nsmodel.modeling.laws import CoulombSet
from nsmodel.solvers import mlcp
from nsmodel.solvers.residuals import NumericLaw

TOLERANCE = 1e-9
REACH = 1e3  # Times what b asks for: a larger l does not excuse more.
SWEEPS = 3000  # Of the Gauss-Seidel method that is compared with.
KINDS = [(d, planted, full) for d in (2, 3) for planted in (False, True) for full in (False, True)]


class ContactProblem(NamedTuple):
    """y = W l + b of contacts with d rows each; ``answer``: an l that solves it, or None."""

    W: np.ndarray
    b: np.ndarray
    mus: np.ndarray
    d: int
    answer: np.ndarray | None

    @property
    def law(self) -> NumericLaw:
        """The law of all contacts."""
        d, m = self.d, self.b.size
        sets = tuple((slice(d * a, d * a + d), CoulombSet(float(mu))) for a, mu in enumerate(self.mus))
        return NumericLaw(np.full(m, -np.inf), np.full(m, np.inf), sets)


def draw_problem(seed: int, d: int, planted: bool, full: bool) -> ContactProblem:
    """A problem of a kind; W = G G' with G Gaussian."""
    rng = np.random.default_rng((seed, d, planted, full))
    count = int(rng.integers(1, 7))
    m = d * count
    rank = m + 2 if full else max(1, round(rng.uniform(0.3, 0.95) * m))
    G = rng.normal(size=(m, rank))
    mus = np.where(rng.random(count) < 0.1, 0.0, rng.uniform(0, 2, count))
    if not planted:
        b = G @ rng.normal(size=rank) if rng.random() < 0.7 else rng.normal(size=m)
        return ContactProblem(G @ G.T, b, mus, d, None)
    l, y = planted_point(rng, mus, d)
    return ContactProblem(G @ G.T, y - G @ (G.T @ l), mus, d, l)


def planted_point(rng: np.random.Generator, mus: np.ndarray, d: int) -> tuple[np.ndarray, np.ndarray]:
    """(l, y) with every law met: each contact open, stuck or slipping."""
    l, y = np.zeros((len(mus), d)), np.zeros((len(mus), d))
    for a, mu in enumerate(mus):
        e = rng.normal(size=d - 1)
        e /= np.linalg.norm(e)
        mode, push = rng.integers(3), rng.uniform(0.1, 2)
        if mode == 0:
            y[a] = [push, *rng.normal(size=d - 1)]
        elif mode == 1 and mu > 0:
            l[a] = [push, *(mu * push * rng.uniform(0, 1) * e)]
        else:
            l[a], y[a] = [push, *(-mu * push * e)], [0, *(rng.uniform(0.1, 2) * e)]
    return l.ravel(), y.ravel()


def natural_map(problem: ContactProblem, l: np.ndarray) -> float:
    """The largest |P - P_K(P - rho ŷ)| of a contact beside what it consists of, rho = d / trace(W_aa)."""
    W, b, d, worst = problem.W, problem.b, problem.d, 0.0
    y = W @ l + b
    for a, mu in enumerate(problem.mus):
        own = slice(d * a, d * a + d)
        rho = d / np.trace(W[own, own])
        moved = rho * y[own]
        moved[0] += rho * mu * np.linalg.norm(y[own][1:])
        u = l[own] - moved
        n, s = u[0], np.linalg.norm(u[1:])
        if 0 < mu and 0 <= n and s <= mu * n:
            nearest = u
        elif mu * s <= -n:
            nearest = np.zeros(d)
        else:
            k = (n + mu * s) / (1 + mu**2)
            nearest = np.concatenate([[k], mu * k / s * u[1:] if s > 0 else u[1:] * 0])
        size = max(rho * np.linalg.norm(b[own]), min(np.linalg.norm(l[own]), REACH * rho * np.linalg.norm(b)))
        away = np.linalg.norm(moved if nearest is u else l[own] - nearest)  # l may be so large that y is lost in it
        worst = max(worst, away / size if size else 0.0)
    return float(worst) if np.isfinite(l).all() else np.inf


def reference_answer(problem: ContactProblem) -> np.ndarray | None:
    """An answer by Gauss-Seidel sweeps over the contacts, or in the plane by all modes; None where neither finds one."""
    found = _gauss_seidel(problem)
    if natural_map(problem, found) <= TOLERANCE:
        return found
    return next(_on_all_modes(problem), None) if problem.d == 2 and len(problem.mus) <= 5 else None


def _gauss_seidel(problem: ContactProblem) -> np.ndarray:
    """Each contact in turn by a few hundred fixed point steps l = P_K(l - rho ŷ): slow, and no method of the package."""
    W, b, d = problem.W, problem.b, problem.d
    l = np.zeros(b.size)
    for _ in range(SWEEPS):
        last = l.copy()
        for a, mu in enumerate(problem.mus):
            own = slice(d * a, d * a + d)
            rho = 1 / np.linalg.norm(W[own, own], 2)
            y = W[own] @ l + b[own]
            u = l[own] - rho * (y + np.r_[mu * np.linalg.norm(y[1:]), np.zeros(d - 1)])
            n, s = u[0], np.linalg.norm(u[1:])
            k = max((n + mu * s) / (1 + mu**2), 0.0)
            l[own] = u if 0 <= n and s <= mu * n else np.concatenate([[k], mu * k / s * u[1:] if s > 0 else u[1:] * 0])
        if not np.isfinite(l).all():
            return last
        if np.abs(l - last).max() <= 1e-13 * np.abs(l).max():
            break
    return l


def _on_all_modes(problem: ContactProblem):
    W, b, m = problem.W, problem.b, problem.b.size
    unit = np.eye(m)
    for modes in product(range(4), repeat=len(problem.mus)):
        A, right = [], []
        for a, (mode, mu) in enumerate(zip(modes, problem.mus, strict=True)):
            i = 2 * a
            A += [unit[i] if mode == 0 else W[i], unit[i + 1] if mode == 0 else W[i + 1]]
            right += [0.0, 0.0] if mode == 0 else [-b[i], -b[i + 1]]
            if mode > 1:
                A[-1], right[-1] = unit[i + 1] + (1 if mode == 2 else -1) * mu * unit[i], 0.0
        l = np.linalg.lstsq(np.array(A), np.array(right), rcond=1e-12)[0]
        if natural_map(problem, l) <= TOLERANCE:
            yield l


def answer(problem: ContactProblem) -> mlcp.MlcpSolution:
    """What the package answers, from nothing."""
    m = problem.b.size
    warm, index = np.zeros(m), np.full(m, -1, np.int8)
    return mlcp.solve_mlcp(problem.W, problem.b, problem.law, warm, index, (mlcp.SEMISMOOTH,), True, TOLERANCE / 10)


def judge(problem: ContactProblem) -> str:
    """'' where the answer is right, or refused as it must be; else what is wrong."""
    found = answer(problem)
    if found.residual <= TOLERANCE:
        by_map = natural_map(problem, found.l)
        return "" if by_map <= TOLERANCE else f"certified with {found.residual:.1e}, but the natural map has {by_map:.1e}"
    if problem.answer is not None:
        return f"refused ({found.residual:.1e}) though an answer was planted"
    return f"refused ({found.residual:.1e}) though another method solves it" if reference_answer(problem) is not None else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Judge the problems asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.search.contacts", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--problems", type=int, default=1000, help="problems of each kind")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    given, wrong = parser.parse_args(arguments), 0
    for d, planted, full in KINDS:
        began, found = time.perf_counter(), []
        for seed in tqdm(range(given.first, given.first + given.problems), leave=False, disable=not sys.stderr.isatty()):
            if text := judge(draw_problem(seed, d, planted, full)):
                found.append(f"    {seed}: {text}")
        wrong += len(found)
        kind = f"{'plane' if d == 2 else 'space'}, {'planted' if planted else 'drawn'}, W {'definite' if full else 'singular'}"
        each = 1e3 * (time.perf_counter() - began) / max(given.problems, 1)
        print(f"{kind}: {given.problems} problems, {len(found)} wrong, {each:.1f} ms each", *found, sep="\n")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
