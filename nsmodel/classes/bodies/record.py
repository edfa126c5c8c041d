"""The rows of a run of many bodies that are in memory."""

from __future__ import annotations

import numpy as np

from nsmodel.solvers.contacts import Contacts


class BodiesRecord:
    """Rows in memory: ``capacity`` of them, then it is ``full`` and must be cleared; contacts are lists beside them."""

    def __init__(self, bodies: int, d: int, capacity: int) -> None:
        self.t, self.h, self.begin, self.residual, self.gap_min = (np.empty(capacity) for _ in range(5))
        self.x, self.pressure = np.empty((capacity, bodies * d)), np.empty((capacity, bodies))
        self.contacts: list[Contacts] = []
        self.first = 0  # Number of the first row in memory.
        self.filled, self.full = 0, False

    def add(
        self, begin: float, t: float, h: float, q: np.ndarray, gap: float, residual: float, pressure: np.ndarray | float,
        contacts: Contacts,
    ) -> None:  # fmt: skip
        """Add a row, of the step of length h from ``begin`` to t."""
        r = self.filled
        self.begin[r], self.t[r], self.h[r], self.x[r], self.gap_min[r], self.residual[r] = begin, t, h, q.ravel(), gap, residual
        self.pressure[r] = pressure
        self.contacts.append(contacts)
        self.filled = r + 1
        self.full = self.filled == len(self.t)

    def clear(self) -> None:
        """Forget the rows."""
        self.first += self.filled
        self.filled, self.full, self.contacts = 0, False, []

    def columns(self) -> dict[str, np.ndarray]:
        """The rows as the arrays of a trajectory."""
        rows = slice(0, self.filled)
        names = ("t", "x", "residual", "h", "gap_min", "pressure")
        arrays = {"step" if name == "h" else name: getattr(self, name)[rows].copy() for name in names}
        counts = [len(one.first) for one in self.contacts]
        row = np.repeat(np.arange(self.first, self.first + self.filled), counts)
        parts = [np.concatenate(part) for part in zip(*self.contacts, strict=True)]
        return arrays | {"contact_row": row} | {f"contact_{k}": v for k, v in zip(Contacts._fields, parts, strict=True)}
