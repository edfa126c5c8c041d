"""Scenes of ``cases/`` in solve_nivp (implicit steps, laws as projections, semismooth Newton), run by a Python that has it.

A law is written as rows of an algebraic system, its multipliers as states without a rate: relays by the package's own
``SignProjection``, complementarity by a projection onto l >= 0. Jacobians are given. CPU time of ``ODESolver.solve``, one
warm-up, the minimum over repeats.

    in_solve_nivp.py SCENE    a line a run, JSON: method, label, seconds, t, x, message
"""

import json
import sys
import time
import warnings

import numpy as np
from solve_nivp import CompositeMethod, EmbeddedBETR, ImplicitEquationSolver, ODESolver, ODESystem, SignProjection
from solve_nivp.projections import Projection

REPEATS, ENOUGH = 3, 0.4  # s: what took longer is not repeated.
ROWS = 2000  # At most so many are handed over.
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
COUNTS = tuple(2**k for k in range(6, 14))  # of constant steps


class Positive(Projection):
    """The multipliers in ``rows`` onto l >= 0; the other entries stay."""

    def __init__(self, rows):
        super().__init__()
        self.rows = rows

    def project(self, current_state, candidate, rhok=None, t=None, Fk_val=None):
        """Project the candidate."""
        out = candidate.copy()
        out[self.rows] = np.maximum(out[self.rows], 0)
        return out

    def tangent_cone(self, candidate, current_state, rhok=None, t=None, Fk_val=None):
        """Its derivative."""
        kept = np.ones(len(candidate))
        kept[self.rows] = candidate[self.rows] > 0
        return np.diag(kept)


# scene: (matrix of the rates, right-hand side, Jacobian, x0 with multipliers, end, columns of the state, projection, lam);
# lam is the solver's relaxation: this one, which is quicker, and where a run stops with it, or for None, the one that it adapts.


def friction_oscillator():
    """x' = v, v' = -x - w, w in Sgn(v)."""
    J = np.array([[0, 1.0, 0], [-1, 0, -1], [0, 0, 0]])
    law = SignProjection(y_indices=1, w_indices=2)
    return np.diag([1.0, 1, 0]), lambda t, y: J @ y, lambda t, y: J, [5.3, 0.0, 0], 12.0, [0], law, 1e-2


def sliding_relay():
    """x1' = x2, x2' = sin t - 2 w, s = x1 + x2, w in Sgn(s)."""
    J = np.array([[0, 1.0, 0, 0], [0, 0, 0, -2], [1, 1, -1, 0], [0, 0, 0, 0]])
    law = SignProjection(y_indices=2, w_indices=3)

    def rate(t, y):
        out = J @ y
        out[1] += np.sin(t)
        return out

    return np.diag([1.0, 1, 0, 0]), rate, lambda t, y: J, [1.0, 0, 1, 1], 5.0, [0, 1], law, 1e-2


def diode_bridge():
    """x' = A x + B l, 0 <= l, C x + D l >= 0."""
    L, C, R = 1e-2, 1e-6, 1e3
    A, B = [[0, -1 / C], [1 / L, 0]], [[0, 0, -1 / C, 1 / C], [0, 0, 0, 0]]
    rows = np.array([[0, 0], [0, 0], [-1.0, 0], [1, 0]])
    D = np.array([[1 / R, 1 / R, -1, 0], [1 / R, 1 / R, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]])
    J = np.block([[np.array(A), np.array(B)], [-rows, -D]])
    law, start = Positive(slice(2, 6)), [10.0, 0, 10, 0, 10 / R, 0]
    return np.diag([1.0, 1, 0, 0, 0, 0]), lambda t, y: J @ y, lambda t, y: J, start, 5e-3, [0, 1], law, None


def point_past_disc():
    """q' = (1, 0) + l q/|q|, 0 <= l, |q| - 1 >= 0."""

    def rate(t, y):
        r = np.hypot(y[0], y[1])
        return np.array([1 + y[2] * y[0] / r, y[2] * y[1] / r, 1 - r])

    def jacobian(t, y):
        r = np.hypot(y[0], y[1])
        n = y[:2] / r
        return np.block([[y[2] * (np.eye(2) - np.outer(n, n)) / r, n[:, None]], [-n[None], np.zeros((1, 1))]])

    return np.diag([1.0, 1, 0]), rate, jacobian, [-1.5, 0.3, 0], 4.5, [0, 1], Positive(slice(2, 3)), 1.0


SCENES = {scene.__name__: scene for scene in (friction_oscillator, sliding_relay, diode_bridge, point_past_disc)}


def solved(name, method, steps, tolerance, adapts):
    """Seconds, times, states, and in how many steps its Newton method did not converge; so many steps, or by the tolerance."""
    mass, rate, jacobian, x0, end, columns, law, lam = SCENES[name]()
    n = int(np.trace(mass))
    solver = ImplicitEquationSolver(proj=law, tol=1e-10, adaptive_lam=adapts, lam=1.0 if adapts else lam)
    solver.rhs_jacobian = jacobian
    system = ODESystem(
        fun=rate, y0=np.array(x0, float), method=method(solver=solver, A=mass), adaptive=bool(tolerance), atol=tolerance,
        rtol=tolerance, component_slices=[slice(0, n), slice(n, len(x0))],
    )  # fmt: skip
    if tolerance:
        system.adaptive_stepper.skip_error_indices = {1}  # The multipliers jump.
        system.adaptive_stepper.h_max = end / 10  # Longer steps leap over the disc.
    start = time.process_time()
    t, x, _, _, told = ODESolver(system, (0.0, end), h=end / steps).solve()
    return time.process_time() - start, t, x[:, columns], sum(not ok for _, ok, _ in told)


def quickest(name, method, steps, tolerance=0.0):
    """A run, and the seconds of the quickest of several."""
    end, lam = SCENES[name]()[4], SCENES[name]()[7]
    adapts, found = lam is None, []
    if not adapts:
        first = solved(name, method, steps, tolerance, False)
        adapts = first[3] > 0 or first[1][-1] < end * (1 - 1e-9)
    while len(found) < 2 or (len(found) <= REPEATS and sum(run[0] for run in found) < ENOUGH):
        found.append(solved(name, method, steps, tolerance, adapts))
    return min(run[0] for run in found[1:]), *found[-1][1:]


def main(name):
    """Print a line a run."""
    end = SCENES[name]()[4]
    # With the multiplier of a constraint the embedded pair stops where contact begins.
    controlled, called = (CompositeMethod, "composite TR-BE") if name == "point_past_disc" else (EmbeddedBETR, "embedded BE-TR")
    settings = [("composite TR-BE, constant steps", f"h = {end / count:.3g}", (CompositeMethod, count)) for count in COUNTS]
    settings += [(f"{called}, error control", f"rtol = {rtol:.0e}", (controlled, 1000, rtol)) for rtol in TOLERANCES]
    for method, label, run in settings:
        line = {"method": f"solve_nivp, {method}", "label": label}
        try:
            seconds, t, x, failed = quickest(name, *run)
            kept = np.unique(np.append(np.arange(0, len(t), max(len(t) // ROWS, 1)), len(t) - 1))
            line |= {"seconds": seconds, "t": t[kept].tolist(), "x": x[kept].tolist()}
            if t[-1] < end * (1 - 1e-9):
                line["message"] = f"it stopped at t = {t[-1]:.3g}"
            elif failed:
                line["message"] = f"its Newton method did not converge in {failed} of {len(t) - 1} steps"
        except Exception as error:
            line["message"] = f"{type(error).__name__}: {error}"
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1])
