"""Total variation flow: each cell of a noisy signal rubs against its neighbours; noise goes, edges stay.

    u_i' = l_i - l_{i-1},    l_i in Sgn(u_{i+1} - u_i),    l_0 = l_24 = 0;    the run's multipliers are -l_i

What to see: a cell above both neighbours falls at 2, a plateau of k cells at 2/k: the noise is gone by t = 0.55, and the
middle plateau, of eight, falls at 1/4. Cell 8, noise on the edge, is on the way from one plateau to the next and rests at
0.4 until 2.9. At t = 5 all is flat at the mean, 0.6625, exactly.

A wrong answer: diffusion, u_i' = u_{i+1} - 2 u_i + u_{i-1}, blurs the edges with the noise: at t = 0.55 no two cells are
equal, and it is never flat. Where the sign is smoothed cells never quite meet.

Source: Andreu, Ballester, Caselles and Mazon, Minimizing total variation flow (2001). It is flat at max |sum_{j <= i}
(u_j - mean)| of the start.
"""

import numpy as np
import scipy.sparse as sp

from nsmodel import LureSystem, relay

noise = [3, -2, 1, -4, 2, 2, -3, 4, -1, -2, 3, -3, 2, -4, 1, 3, -1, -3, 4, -2, 1, -1, 2, -3]  # tenths
start = np.repeat([0.0, 1.5, 0.5], 8) + np.array(noise) / 10
n = start.size
differences = sp.eye(n - 1, n, k=1) - sp.eye(n - 1, n)

model = LureSystem(
    A=sp.csc_matrix((n, n)),
    B=differences.T,
    C=differences,
    law={"edge": relay(n - 1)},
    x0=start,
    t_end=6,
    step=5e-3,
    names=[f"u_{i}" for i in range(1, n + 1)],
    title="Total variation flow",
)
