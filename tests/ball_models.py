"""Random models of every class that balls and ellipsoids may be laws of: blocks of one to three rows, beside boxes."""

import casadi as ca
import numpy as np

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    ball,
    complementarity,
    ellipsoid,
    product,
    relay,
)

t = ca.SX.sym("t")
KINDS = ("lure", "first order", "oscillator", "inclusion")


def definite(rng, n, least=0.3):
    A = rng.normal(size=(n, n))
    return A @ A.T / n + least * np.eye(n)


def curved(rng, n):
    """A ball or an ellipsoid of n rows, of a size about 1/2."""
    if n == 1 or rng.random() < 0.5:
        return ball(n, rng.uniform(0.2, 1))
    return ellipsoid(np.linalg.inv(rng.uniform(0.2, 0.8) ** 2 * definite(rng, n)))


def blocks(rng, boxes=True):
    """Laws in a random order, one of them curved, with their sizes."""
    sizes = [int(rng.integers(2, 4)), *rng.integers(1, 4, int(rng.integers(0, 3)))]
    laws = [(curved(rng, n), n) for n in sizes]
    if boxes and rng.random() < 0.6:
        laws.append((relay(1, -rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.6)), 1))
    rng.shuffle(laws)
    return laws


def pushes(rng, n, size=1.5):
    """Sines."""
    return ca.DM(size * rng.normal(size=n)) * ca.sin(rng.uniform(0.5, 2) * t + ca.DM(rng.uniform(0, 6, n)))


def random_model(seed):
    """(kind, model); the rows of blocks are velocities beside those of a belt that moves, or not."""
    rng = np.random.default_rng([19, seed])
    kind = KINDS[seed % 4]
    return kind, {"lure": _lure, "first order": _first_order, "oscillator": _oscillator, "inclusion": _inclusion}[kind](rng)


def _lure(rng):
    """Masses with springs and dampers under friction; a stop with a spring of its own."""
    laws = blocks(rng)
    n = sum(size for _, size in laws)
    K, damper, H = definite(rng, n), 0.1 * definite(rng, n), rng.normal(size=(n, n)) + 1.5 * np.eye(n)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K, -damper]])
    B, C, D = np.vstack([np.zeros((n, n)), H.T]), np.hstack([np.zeros((n, n)), H]), np.zeros((n, n))
    law = product(*(law for law, _ in laws))
    if rng.random() < 0.4:
        B = np.hstack([B, np.vstack([np.zeros((n, 1)), np.eye(n)[:, :1]])])
        C = np.vstack([C, np.eye(2 * n)[:1]])
        D = np.block([[D, np.zeros((n, 1))], [np.zeros((1, n)), np.full((1, 1), 0.2)]])
        law = product(law, complementarity(1))
    x0 = np.concatenate([rng.normal(size=n), rng.normal(size=n) * (rng.random() < 0.7)])
    return LureSystem(t=t, A=A, B=B, C=C, D=D, f=ca.vertcat(ca.DM.zeros(n), pushes(rng, n)), law=law, x0=x0, t_end=3)


def _first_order(rng):
    """A mass matrix that is full, g that depends on x, rows beside a belt."""
    laws = blocks(rng)
    n = sum(size for _, size in laws)
    x, l = ca.SX.sym("x", 2 * n), ca.SX.sym("l", n)
    M, K, grip = definite(rng, n, 0.8), definite(rng, n), 1.5 + ca.sin(x[0])
    whole = np.block([[np.eye(n), np.zeros((n, n))], [np.zeros((n, n)), M]])
    belt = pushes(rng, n, 0.5) if rng.random() < 0.5 else ca.DM.zeros(n)
    x0 = np.concatenate([rng.normal(size=n), rng.normal(size=n) * (rng.random() < 0.7)])
    return FirstOrderSystem(
        t=t, x=x, lam=l, M=whole, f=ca.vertcat(x[n:], pushes(rng, n, 2) - ca.DM(K) @ ca.sin(x[:n])),
        g=ca.vertcat(ca.SX.zeros(n), grip * l), h=grip * (x[n:] - belt), law=product(*(law for law, _ in laws)), x0=x0, t_end=3,
    )  # fmt: skip


def _oscillator(rng):
    """Elements of one to three rows, of Coulomb friction and of friction that grows."""
    n, s = 3, ca.SX.sym("s")
    x = ca.SX.sym("x", n)
    thetas = [s, s + s**2 / 4, s + s**3 / 6]
    count = int(rng.integers(1, 3))
    friction = {}
    for k in range(count):
        size = int(rng.integers(2, 4)) if k == 0 else int(rng.integers(1, 3))
        H = rng.normal(size=(size, n)) + 1.2 * np.eye(n)[:size]
        friction[f"e{k}"] = (H, rng.uniform(0.2, 0.8) * thetas[int(rng.integers(3))])
    K = definite(rng, n)
    return FrictionOscillator(
        x=x, potential=ca.bilin(ca.DM(K), x, x) / 2 + 0.1 * ca.sum1(ca.cos(x)), friction=friction, s=s,
        x0=2 * rng.normal(size=n), v0=rng.normal(size=n) * (rng.random() < 0.7), t_end=3,
    )  # fmt: skip


def _inclusion(rng):
    """Norms of all states in a set that moves."""
    n = int(rng.integers(2, 6))
    x = ca.SX.sym("x", n)
    sizes = [int(rng.integers(2, 4)), *rng.integers(1, 4, int(rng.integers(0, 2)))]
    norms = [rng.uniform(0.2, 1) * ca.norm_2(ca.DM(rng.normal(size=(size, n))) @ x) for size in sizes]
    x0 = rng.normal(size=n)
    lower = np.full(n, -np.inf).tolist()
    if rng.random() < 0.6:
        lower[0] = x0[0] - 0.3 + 0.6 * ca.sin(rng.uniform(0.5, 2) * t)
    W = 0.5 * rng.normal(size=(n, n)) - 0.2 * np.eye(n)
    return MonotoneInclusion(
        t=t, x=x, field=ca.DM(W) @ x + pushes(rng, n), phi=sum(norms), lower=lower, x0=x0, t_end=3, scheme="implicit"
    )
