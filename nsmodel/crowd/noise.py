"""A will that changes: the direction that each person wants, turned at random now and then.

An arch before a door holds for ever where all wishes are steady. Models of crowds have fluctuations for that: a random force
in Helbing and Molnar (Social force model for pedestrian dynamics, Phys. Rev. E 51, 1995), a random angle that is even on an
interval in Vicsek et al. (Novel type of phase transition in a system of self-driven particles, Phys. Rev. Lett. 75, 1995); the
latter is the one here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nsmodel._utils import former_names, short_repr
from nsmodel.crowd.given import checked_number
from nsmodel.crowd.paths import DesiredVelocity
from nsmodel.errors import ModelError
from nsmodel.modeling.parameters import describe_argument


@dataclass(frozen=True)
class Noise:
    """How a will changes: every ``every`` seconds each person draws an angle, even on [-angle, angle], to turn the wish by.

    The angle of person i in the n-th interval is a function of (seed, n, i) alone, by a generator that counts (Philox): it is
    the same however a run is stepped, and after it was resumed.

    Attributes:
        angle: the largest angle, rad; pi forgets where the exit is.
        every: s.
        seed: a whole number >= 0.
    """

    angle: float
    every: float = 0.5
    seed: int = 1

    def __post_init__(self) -> None:
        angle = checked_number(self.angle, "noise: angle", "an angle > 0 and at most pi, in radians")
        if angle > np.pi:
            raise ModelError(f"noise: angle: {angle:g}; expected an angle > 0 and at most pi, in radians")
        checked_number(self.every, "noise: every", "a number > 0, in s")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int | np.integer) or not 0 <= self.seed < 2**128:
            raise ModelError(f"noise: seed: {describe_argument(self.seed)}; expected a whole number >= 0")

    def angles(self, t: float, count: int) -> np.ndarray:
        """The angles (count,) at time t."""
        interval = int(np.floor(t / self.every + 1e-9))
        raw = np.random.Philox(counter=interval << 64, key=int(self.seed)).random_raw(count)
        return self.angle * (2.0**-52 * (raw >> np.uint64(11)) - 1.0)


@dataclass(frozen=True, eq=False)
class NoisyVelocity:
    """The velocity wanted, turned by noise inside the room: ``(t, q (N, 2)) -> (N, 2)``; who is past a door walks on."""

    desired: DesiredVelocity
    noise: Noise

    __repr__ = short_repr

    def __call__(self, t: float, q: np.ndarray) -> np.ndarray:
        """The velocity (N, 2) of people at q (N, 2)."""
        wanted = self.desired(t, q)
        angle = np.where(self.desired.outside(q), 0.0, self.noise.angles(t, len(q)))
        c, s = np.cos(angle), np.sin(angle)
        return np.column_stack([c * wanted[:, 0] - s * wanted[:, 1], s * wanted[:, 0] + c * wanted[:, 1]])


__getattr__ = former_names(__name__, Wavering="NoisyVelocity")
