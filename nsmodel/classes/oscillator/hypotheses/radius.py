"""The largest ball in A(0) = sum_j H_j' B(0, r_j): its radius is the least sigma(d) = sum_j r_j |H_j d| over |d| = 1.

Bounds from below: sigma(d) >= g'd for each g = sum_j r_j H_j'u_j with |u_j| <= 1. On a cone of directions g'd/|d| is quasiconcave
where it is >= 0, and so least at one of the cone's edges. The cones over cells of the faces of a cube are cut until the bounds
meet a value that is attained. g is best with u_j = H_j d/|H_j d| at the middle d of the cell; where H_j d may vanish there, with
the u_j that leave g as parallel to d as they can: at a minimiser on the sphere some g is a multiple of d.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import product
from typing import NamedTuple

import numpy as np

from nsmodel.proof import exact

FrictionElements = Sequence[tuple[float, np.ndarray]]  # r_j > 0 and H_j
MAX_CELL_STATES = 4  # In more dimensions the least singular value bounds the radius.
MAX_CELLS, CELL_BATCH, CELL_TOLERANCE = 60_000, 2048, 1e-10
MACHINE_EPS = float(np.finfo(float).eps)


class RadiusBound(NamedTuple):
    """``low`` <= radius <= ``value`` = sigma(``at``)."""

    low: float
    value: float
    at: np.ndarray


def support_function(elements: FrictionElements, d: np.ndarray) -> float:
    """Return sigma(d) = sum_j r_j |H_j d|."""
    return float(sum(r * np.linalg.norm(H @ d) for r, H in elements))


def friction_radius(elements: FrictionElements, n: int) -> RadiusBound:
    """Bound the radius; the H_j have full column rank together."""
    even = [(r, H) for r, H in elements if n == 1 or _is_isotropic(H)]  # their part of sigma is constant on the sphere
    rest = [(r, H) for r, H in elements if n > 1 and not _is_isotropic(H)]
    low = _support_lower_bound(even)
    if not rest:
        return RadiusBound(min(low, support_function(even, np.eye(n)[0])), support_function(even, np.eye(n)[0]), np.eye(n)[0])
    free = exact.nullspace(np.vstack([H for _, H in rest]))
    if free.shape[1]:
        d = exact.doubles(free[:, 0])
        d = d / np.linalg.norm(d)
        return RadiusBound(low, max(low, support_function(elements, d)), d)
    own = _anisotropic_radius(rest, n)
    value = support_function(elements, own.at)
    return RadiusBound(min(float(np.nextafter(low + own.low, 0)) if even else own.low, value), value, own.at)


def _anisotropic_radius(elements: FrictionElements, n: int) -> RadiusBound:
    """The radius of elements of which none is isotropic."""
    stacked = np.vstack([r * H for r, H in elements])
    value, d = _minimise_support(elements, [*np.linalg.svd(stacked)[2], *np.eye(n)])
    low = _singular_value_bound(elements, n)
    if n <= MAX_CELL_STATES:
        found = _radius_by_cells(elements, n, value, d)
        low, value, d = max(low, found.low), found.value, found.at
    return RadiusBound(min(low, value), value, d)


def _is_isotropic(H: np.ndarray) -> bool:
    """Whether H'H = c^2 I, exactly."""
    G = exact.matrix_product(H.T, H)
    return bool((G == G[0, 0] * exact.eye(len(G))).all())


def _support_lower_bound(elements: FrictionElements) -> float:
    """A lower bound of sigma(e_1), whole roots exactly."""
    total = 0.0
    for r, H in elements:
        square = exact.matrix_product(H[:, :1].T, H[:, :1])[0, 0] * Fraction(r) ** 2
        root = float(np.sqrt(float(square)))
        while Fraction(root) ** 2 > square:
            root = float(np.nextafter(root, 0))
        total = root if not total else float(np.nextafter(total + root, 0))
    return total


def _singular_value_bound(elements: FrictionElements, n: int) -> float:
    """The least singular value of the stacked r_j H_j, as sum |a_j| >= |(a_1, a_2, ...)|, by exact signs."""
    G = sum((Fraction(r) ** 2 * exact.matrix_product(H.T, H) for r, H in elements), exact.zeros(n, n))
    near = float(np.linalg.eigvalsh(exact.doubles(G))[0])
    for guess in (
        near * (1 - 1e-12),
        near * (1 - 1e-6),
        near / 2,
        *(float(np.trace(exact.doubles(G))) * 10.0**-k for k in range(8, 40, 4)),
    ):
        if guess > 0 and exact.is_psd(G - Fraction(guess) * exact.eye(n)):
            return float(np.sqrt(guess)) * (1 - 2 * MACHINE_EPS)
    return 0.0


def _minimise_support(elements: FrictionElements, starts: Sequence[np.ndarray]) -> tuple[float, np.ndarray]:
    """Local minima of sigma on the sphere, by repeated least squares."""
    best = min(((support_function(elements, d), d) for d in starts), key=lambda item: item[0])
    for d in starts:
        for _ in range(50):
            sizes = [max(float(np.linalg.norm(H @ d)), 1e-9 * float(np.linalg.norm(H))) for _, H in elements]
            weighted = sum((r / size * H.T @ H for (r, H), size in zip(elements, sizes, strict=True)), np.zeros((len(d), len(d))))
            d = np.linalg.eigh(weighted)[1][:, 0]
            best = min(best, (support_function(elements, d), d), key=lambda item: item[0])
        best = min(best, _support_in_kernel(elements, d), key=lambda item: item[0])
    return best


def _support_in_kernel(elements: FrictionElements, d: np.ndarray) -> tuple[float, np.ndarray]:
    """Where some terms of sigma vanish up to rounding: the same direction with these terms 0."""
    small = [H / np.linalg.norm(H) for _, H in elements if np.linalg.norm(H @ d) <= 1e-6 * np.linalg.norm(H)]
    if small:
        _, values, vectors = np.linalg.svd(np.vstack(small))
        free = vectors[np.count_nonzero(values > 1e-9) :]
        inner = free.T @ (free @ d)
        if np.linalg.norm(inner) > 0.5:
            d = inner / np.linalg.norm(inner)
    return support_function(elements, d), d


# -- cells -------------------------------------------------------------------------------------------------------------


def _radius_by_cells(elements: FrictionElements, n: int, value: float, at: np.ndarray) -> RadiusBound:
    """The radius by cutting the faces of a cube; ``value`` is attained, ``at`` some direction."""
    middle, half = np.eye(n), 1.0 - np.eye(n)
    bound, count, low = _cell_bounds(elements, middle, half), n, np.inf
    while count < MAX_CELLS and len(bound):
        here = sum(r * np.linalg.norm(middle @ H.T, axis=1) for r, H in elements) / np.linalg.norm(middle, axis=1)
        d = middle[int(np.argmin(here))]
        d = d / np.linalg.norm(d)
        if support_function(elements, d) < value:
            value, at = min((value, at), _minimise_support(elements, [d]), key=lambda item: item[0])
        order = np.argsort(bound)
        middle, half, bound = middle[order], half[order], bound[order]
        worst = int(np.searchsorted(bound, value * (1 - CELL_TOLERANCE)))
        low = min(low, float(bound[worst:].min(initial=np.inf)))
        if not worst:
            bound = bound[:0]
            break
        number = min(worst, CELL_BATCH)
        axis = np.argmax(half[:number], axis=1)
        rows = np.arange(number)
        step = np.zeros((number, n))
        step[rows, axis] = half[rows, axis] / 2
        smaller = half[:number] - step
        parts = np.vstack([middle[:number] - step, middle[:number] + step])
        new = np.maximum(_cell_bounds(elements, parts, np.vstack([smaller, smaller])), np.tile(bound[:number], 2))
        middle, half = np.vstack([parts, middle[number:worst]]), np.vstack([smaller, smaller, half[number:worst]])
        bound = np.concatenate([new, bound[number:worst]])
        count += 2 * number
    return RadiusBound(float(min(value * (1 - CELL_TOLERANCE), low, bound.min(initial=np.inf))), value, at)


def _cell_bounds(elements: FrictionElements, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Lower bounds (k,) of sigma(d) / |d| on the cells middle +- half, rounding included."""
    n = middle.shape[1]
    size = sum(r * float(np.linalg.norm(H)) for r, H in elements)
    rows = sum(len(H) for _, H in elements)
    corners = middle[:, None, :] + half[:, None, :] * np.array(list(product([-1.0, 1.0], repeat=n)))[None]
    lengths = np.linalg.norm(corners, axis=2)
    unit = middle / np.linalg.norm(middle, axis=1)[:, None]
    reach = np.linalg.norm(half, axis=1)
    plain, firm = np.zeros(middle.shape), np.zeros(middle.shape)
    columns, scale = [], []
    for r, H in elements:
        image = middle @ H.T
        length = np.linalg.norm(image, axis=1)
        u = image / np.where(length > 0, length, 1.0)[:, None]
        loose = length <= np.linalg.norm(H) * reach
        plain += r * u @ H
        firm += np.where(loose[:, None], 0.0, r * u @ H)
        columns.append(np.where(loose[:, None, None], (r * H.T)[None], 0.0))
        scale.append(len(H))
    S = np.concatenate(columns, axis=2)
    across = S - unit[:, :, None] * (unit[:, None, :] @ S)
    wanted = firm - unit * (unit * firm).sum(axis=1)[:, None]
    u = -(np.linalg.pinv(across, rcond=1e-10) @ wanted[:, :, None])[:, :, 0]
    at = 0
    for m in scale:
        part = u[:, at : at + m]
        u[:, at : at + m] = part / np.maximum(1.0, np.linalg.norm(part, axis=1))[:, None]
        at += m
    found = np.full(len(middle), -np.inf)
    for g in (plain, firm + (S @ u[:, :, None])[:, :, 0]):
        found = np.maximum(found, ((corners @ g[:, :, None])[:, :, 0] / lengths).min(axis=1))
    return np.maximum(found, 0.0) - (64 + 8 * (n + rows)) * MACHINE_EPS * size
