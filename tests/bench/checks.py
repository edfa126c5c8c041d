"""CPU time of `nsmodel check --quick` for chains of masses, beside a plain baseline of the same run; and how it grows.

    python tests/bench/checks.py

The unit is a loop of plain Python and NumPy, timed in the same process, so that lines of two machines can be compared.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import casadi as ca
import numpy as np

import nsmodel
from nsmodel import FirstOrderSystem, FrictionOscillator, LureSystem, MonotoneInclusion, relay
from nsmodel.modeling.base import Model

SHORT = bool(os.environ.get("NSMODEL_SHORT"))
SIZES = (5, 10) if SHORT else (50, 100)


def baseline() -> None:
    """Small matrices and Python numbers."""
    A, total = np.eye(20) + 0.01, 0.0
    for k in range(20_000):
        total += float((A @ A)[k % 20, 0]) + sum(range(20))


def friction(n: int) -> Model:
    """A Lur'e system: linear springs, Coulomb friction."""
    return nsmodel.load("friction_chain", n=n)


def hardening(n: int) -> Model:
    """The same with springs of third degree."""
    x = ca.SX.sym("x", 2 * n)
    stretch = ca.diff(ca.vertcat(0, x[:n], 0))
    zero, one, force = np.zeros((n, n)), np.eye(n), 10 * stretch + stretch**3
    return LureSystem(
        x=x, A=ca.vertcat(x[n:], ca.diff(force) - 0.1 * x[n:]), B=np.vstack([zero, one]), C=np.hstack([zero, one]), law=relay(n),
        x0=np.append(waves(n), np.zeros(n)), t_end=1, step=0.01, theta=0.5,
    )  # fmt: skip


def first_order(n: int, cubic: float = 0.0) -> Model:
    """Springs and Coulomb friction as a first-order system."""
    x, l = ca.SX.sym("x", 2 * n), ca.SX.sym("l", n)
    stretch = ca.diff(ca.vertcat(0, x[:n], 0))
    force = 100 * stretch + cubic * stretch**3
    return FirstOrderSystem(
        x=x, lam=l, f=ca.vertcat(x[n:], ca.diff(force)), h=x[n:], g=ca.vertcat(ca.SX.zeros(n), l), law=relay(n),
        x0=np.append(waves(n), np.zeros(n)), t_end=1, step=0.01,
    )  # fmt: skip


def hardening_first_order(n: int) -> Model:
    """The same with springs of third degree."""
    return first_order(n, cubic=1.0)


def oscillator(n: int) -> Model:
    """Dry friction between neighbours, and a wall for each mass."""
    x, s, D = ca.SX.sym("x", n), ca.SX.sym("s"), np.eye(n) - np.eye(n, k=-1)
    return FrictionOscillator(
        x=x, s=s, potential=50 * ca.sumsqr(ca.diff(ca.vertcat(0, x, 0))), t_end=1, step=0.01, x0=waves(n), v0=np.zeros(n),
        friction={f"m{i}": (D[[i]], (0.5 + 0.01 * i) * s) for i in range(n)},
        constraints={f"w{i}": 1.5 - x[i] for i in range(n)},
    )  # fmt: skip


def inclusion(n: int) -> Model:
    """No inertia, springs of third degree, friction between neighbours."""
    x = ca.SX.sym("x", n)
    stretch = ca.diff(ca.vertcat(0, x, 0))
    return MonotoneInclusion(
        x=x, field=10 * ca.diff(stretch) - x**3 - ca.sin(x), phi=ca.sum1(ca.fabs(stretch)), x0=waves(n), t_end=1, step=0.01
    )


def waves(n: int) -> np.ndarray:
    """The places at the start."""
    return np.sin(2 * np.pi * np.arange(1, n + 1) / (n + 1))


def cpu_seconds(job: Callable[[], object]) -> float:
    """Of one run."""
    start = time.process_time()
    job()
    return time.process_time() - start


def main() -> None:
    """Print a line for each kind of chain."""
    nsmodel.check(friction(3), quick=True)  # what is imported at first use
    unit = min(cpu_seconds(baseline) for _ in range(3))
    print(f"CPU time of quick checks; the unit is {unit:.2f} s here")
    print(f"{'masses:':22}" + "".join(f"{n:>18}" for n in SIZES))
    for kind in (friction, hardening, first_order, hardening_first_order, oscillator, inclusion):
        models = [kind(n) for n in SIZES]
        times = [cpu_seconds(lambda model=model: nsmodel.check(model, quick=True)) for model in models]
        print(f"{kind.__name__:22}" + "".join(f"{own:8.2f} s {own / unit:5.1f} u" for own in times), flush=True)


if __name__ == "__main__":
    main()
