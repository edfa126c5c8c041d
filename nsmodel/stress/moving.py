"""Laws that move, as an independent judge sees them: a set for each of N rows, by its definition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BoxAtRows:
    """{lower <= l <= upper}, (N, m) each."""

    lower: np.ndarray
    upper: np.ndarray
    strict = False

    @property
    def extent(self) -> np.ndarray:
        """The largest finite end of each row (N,)."""
        both = np.abs(np.hstack([self.lower, self.upper]))
        return both.max(axis=1, where=np.isfinite(both), initial=0.0)

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond an end; a set without points is infinitely far."""
        return np.where(self.lower <= self.upper, np.maximum(np.maximum(self.lower - l, l - self.upper), 0), np.inf)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """One component after the other at that of its ends where <l', y> is least; far out where there is none."""
        inside, far = np.minimum(np.maximum(l, self.lower), self.upper), 1 + np.abs(l)
        low = np.where(np.isfinite(self.lower), self.lower, inside - far)
        high = np.where(np.isfinite(self.upper), self.upper, inside + far)
        found = np.repeat(inside[None], l.shape[1], axis=0)
        for i in range(l.shape[1]):
            found[i, :, i] = np.where(y > 0, low, high)[:, i]
        return found


@dataclass(frozen=True)
class BallAtRows:
    """{|l| <= radius}, (N, 1)."""

    radius: np.ndarray
    strict = True

    @property
    def extent(self) -> np.ndarray:
        """The radii (N,)."""
        return self.radius[:, 0]

    def excess(self, l: np.ndarray) -> np.ndarray:
        """Beyond the sphere; a set without points is infinitely far."""
        return np.where(self.radius >= 0, np.maximum(np.linalg.norm(l, axis=1, keepdims=True) - self.radius, 0), np.inf)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """-r y/|y|."""
        size = np.linalg.norm(y, axis=1, keepdims=True)
        return (-self.radius * y / np.where(size > 0, size, 1))[None]
