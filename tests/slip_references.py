"""Blocks under dry friction by other means: SciPy's DOP853 from stop to release, with the modes of unit masses chosen by hand.

x'' = F(t, x, v) + l with l in K_b for each block b of velocities, K_b = {l'Q l <= 1}; in slip l = -growth(size) Q^-1 y/size with
size = sqrt(y'Q^-1 y). A slip ends where its speed is 3e-12 of the largest; a release starts with such a speed, by Radau,
as its direction is stiff while it is slow. Good to 1e-9 of the largest values.
"""

import numpy as np
from scipy.integrate import solve_ivp

STILL, SLOW = 3e-12, 1e-3


class Slides:
    def __init__(self, force, blocks, growth=lambda size: 1.0):
        """``blocks``: (rows, Q^-1) each."""
        self.force, self.blocks, self.growth = force, blocks, growth

    def rates(self, t, z, modes):
        x, v = np.split(z, 2)
        v = v.copy()
        for (rows, _), slips in zip(self.blocks, modes, strict=True):
            v[rows] *= slips
        a = self.force(t, x, v)
        for (rows, inverse), slips in zip(self.blocks, modes, strict=True):
            size = np.sqrt(v[rows] @ inverse @ v[rows]) if slips else 1.0
            a[rows] = (a[rows] - self.growth(size) * inverse @ v[rows] / size) * slips
        return np.concatenate([v, a])

    def load(self, t, z, block):
        """How much of what stick can bear is asked of it, and the force."""
        rows, inverse = block
        f = self.force(t, *np.split(z, 2))[rows]
        return np.sqrt(f @ np.linalg.solve(inverse, f)), f

    def begin(self, t, z, block, scale):
        """Whether the block slips from y = 0; the direction of a y that does is that of its y'."""
        rows, inverse = block
        share, f = self.load(t, z, block)
        y = np.split(z, 2)[1]
        y[rows] = 0
        if share <= 1 - 1e-9:
            return False
        e = np.linalg.solve(inverse, f)
        if share > 1 + 1e-6:
            for _ in range(500):
                w = f - inverse @ e / np.sqrt(e @ inverse @ e)
                e = e / np.linalg.norm(e) / 2 + w / np.linalg.norm(w) / 2
        y[rows] = 10 * STILL * scale * e / np.linalg.norm(e)
        return True

    def run(self, x0, v0, times):
        """The states (k, 2 n) at these times, and the times of events."""
        z, t, T = np.concatenate([x0, v0]).astype(float), 0.0, times[-1]
        scale, rows_at, events, out = max(np.abs(v0).max(), 1e-3), len(x0), [], np.full((len(times), len(z)), np.nan)
        modes = [bool(np.any(z[rows_at:][b[0]])) or self.begin(t, z, b, scale) for b in self.blocks]
        young = True
        while t < T:
            scale = max(scale, np.abs(z[rows_at:]).max())
            slow = [
                b
                for b, m in zip(self.blocks, modes, strict=True)
                if young and m and np.linalg.norm(z[rows_at:][b[0]]) < SLOW * scale
            ]
            ends = [self._end(block, slips, scale) for block, slips in zip(self.blocks, modes, strict=True)]
            if slow:
                ends.append(self._quick(slow, scale))
            method, rtol, atol = ("Radau", 1e-11, 1e-15) if slow else ("DOP853", 3e-14, 1e-16)
            found = solve_ivp(
                self.rates, (t, T), z, method, args=(modes,), rtol=rtol, atol=atol, events=ends, dense_output=True
            )  # fmt: skip
            assert found.status >= 0, found.message
            inside = (times >= t) & (times <= found.t[-1])
            if inside.any():
                out[inside] = found.sol(times[inside]).T
            t, z = found.t[-1], found.y[:, -1].copy()
            hit = [i for i, at in enumerate(found.t_events) if len(at) and i < len(modes)]
            young = bool(hit)
            events += [t] * bool(hit)
            for i in hit:
                modes[i] = self.begin(t, z, self.blocks[i], scale)
        return out, events

    def _end(self, block, slips, scale):
        rows = block[0]

        def condition(t, z, modes):
            return np.linalg.norm(np.split(z, 2)[1][rows]) - STILL * scale if slips else 1 - self.load(t, z, block)[0]

        condition.terminal, condition.direction = True, -1
        return condition

    def _quick(self, slow, scale):
        def condition(t, z, modes):
            return min(np.linalg.norm(np.split(z, 2)[1][rows]) for rows, _ in slow) - 2 * SLOW * scale

        condition.terminal, condition.direction = True, 1
        return condition
