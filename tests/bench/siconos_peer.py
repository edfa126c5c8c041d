"""Scenes of ``cases/`` in Siconos, run by the Python that has it: prints microseconds a step of computeOneStep + nextStep.

CPU time, one warm-up, the minimum over repeats. A forcing is evaluated in Python, as Siconos' own Python examples do.
"""

import sys
import time

import numpy as np
import siconos.kernel as sk
import siconos.numerics as sn

REPEATS = 5
KEEP = []  # Siconos holds raw pointers to what Python made.


def complementarity(m):
    """Law and solver of a linear complementarity problem."""
    return sk.ComplementarityConditionNSL(m), sk.LCP(sn.SICONOS_LCP_LEMKE)


def relay(m, lower=-1.0, upper=1.0):
    """Law and solver of relays."""
    return sk.RelayNSL(m, lower, upper), sk.Relay(sn.SICONOS_RELAY_LEMKE)


class Forced(sk.FirstOrderLinearDS):
    """x' = A x + b(t) + r."""

    def __init__(self, x0, A, rows, forcing):
        """Put ``forcing(t)`` into the given rows of b."""
        sk.FirstOrderLinearDS.__init__(self, x0, A)
        self.value, self.rows, self.forcing = np.zeros(len(x0)), rows, forcing
        self.setbPtr(self.value)

    def computeb(self, t):
        """Evaluate b."""
        self.value[self.rows] = self.forcing(t)
        self.setbPtr(self.value)


class Genes(sk.FirstOrderType2R):
    """The relation of two genes with threshold switches."""

    def computeh(self, t, x, l, y):
        """Evaluate y = h(x)."""
        y[:] = [4 - x[0], 4 - x[1], 8 - x[0], 8 - x[1]]

    def computeg(self, t, l, r):
        """Evaluate r = g(l)."""
        r[:] = [40 * l[1] * (1 - l[2]), 40 * l[0] * (1 - l[3])]

    def computeJachx(self, t, x, l, C):
        """Evaluate dh/dx."""
        C[:] = [[-1, 0], [0, -1], [-1, 0], [0, -1]]

    def computeJachlambda(self, t, x, l, D):
        """Evaluate dh/dl."""
        D[:] = 0

    def computeJacglambda(self, t, l, B):
        """Evaluate dg/dl."""
        B[:] = [[0, 40 * (1 - l[2]), -40 * l[1], 0], [40 * (1 - l[3]), 0, 0, -40 * l[0]]]


class Bouncing(sk.FirstOrderNonLinearR):
    """The relation of the Zhuravlev-Ivanov ball."""

    kappa, G = 0.5, 9.81

    def __init__(self):
        """Set the constant part."""
        sk.FirstOrderNonLinearR.__init__(self)
        self.setCPtr(np.eye(2))

    def computeh(self, t, x, l, z, y):
        """Evaluate y = x."""
        y[:] = x[:2]

    def computeg(self, t, x, l, z, r):
        """Evaluate r = g(x, l)."""
        p = self.kappa * l[0] * l[1]
        r[:] = [-p * x[1], self.G * l[0] / (1 - p)]

    def computeJachx(self, t, x, l, z, C):
        """Evaluate dh/dx."""
        C[:] = np.eye(2)

    def computeJachlambda(self, t, x, l, z, D):
        """Evaluate dh/dl."""
        D[:] = 0

    def computeJacgx(self, t, x, l, z, K):
        """Evaluate dg/dx."""
        K[:] = [[0, -self.kappa * l[0] * l[1]], [0, 0]]

    def computeJacglambda(self, t, x, l, z, B):
        """Evaluate dg/dl."""
        k, q = self.kappa, (1 - self.kappa * l[0] * l[1]) ** 2
        B[:] = [[-k * l[1] * x[1], -k * l[0] * x[1]], [self.G / q, self.G * k * l[0] ** 2 / q]]


def linear(A, B, C, D, law, x0, forced=None):
    """System, relation, law and solver of a linear scene; ``forced`` is (rows, forcing)."""
    A, B, C = (np.array(M, float) for M in (A, B, C))
    system = sk.FirstOrderLinearTIDS(x0, A) if forced is None else Forced(x0, A, *forced)
    relation = sk.FirstOrderLinearTIR(C, B)
    if D is not None:
        relation.setDPtr(np.array(D, float))
    return system, relation, *law


def scene(name):
    """(system, relation, law, solver), step, number of steps, theta, and the settings of a Newton loop where one is needed."""
    n = int(name.removeprefix("friction_chain_")) if name.startswith("friction_chain_") else 0
    if n:
        springs = 100 * (2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1))
        zero, one, i = np.zeros((n, n)), np.eye(n), np.arange(1, n + 1)
        x0 = np.concatenate([np.sin(2 * np.pi * i / (n + 1)), np.zeros(n)])
        forced = slice(n, 2 * n), lambda t: 3 * np.sin(2 * t + 0.3 * (i - 1))
        A, B = np.block([[zero, one], [-springs, zero]]), np.vstack([zero, one])
        return linear(A, B, B.T, None, relay(n), x0, forced), 1e-2, 1000 if n <= 50 else 30, 0.5, None
    if name == "diode_bridge":
        L, C, R = 1e-2, 1e-6, 1e3
        D = [[1 / R, 1 / R, -1, 0], [1 / R, 1 / R, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]]
        B, C_ = [[0, 0, -1 / C, 1 / C], [0, 0, 0, 0]], [[0, 0], [0, 0], [-1, 0], [1, 0]]
        return linear([[0, -1 / C], [1 / L, 0]], B, C_, D, complementarity(4), [10.0, 0.0]), 1e-6, 5000, 0.5, None
    if name == "relay_oscillator":
        A = [[0, 1, 0], [0, 0, 1], [0, -3, -2]]
        x0 = [0, 3 * np.sqrt(2) / (2 * np.pi), 0]
        return linear(A, [[0], [0], [1]], [[1, 0, 0]], None, relay(1), x0), 1e-2, 10000, 0.5, None
    if name == "friction_oscillator_relay":
        return linear([[0, 1], [-1, 0]], [[0], [1]], [[0, 1]], None, relay(1), [12.0, 6.0]), 1e-2, 10000, 0.5, None
    if name == "two_masses":
        A = [[0, 1, 0, 0], [-10, 0, 10, 0], [0, 0, 0, 1], [10, 0, -10, 0]]
        B = np.array([[0, 0], [1, 0], [0, 0], [0, 1.0]])
        forced = slice(1, 2), lambda t: 2 * np.sin(t)
        return linear(A, B, B.T, None, relay(2), [1.0, 0, -1, 0], forced), 1e-3, 10000, 0.5, None
    if name == "gene_network":
        law, solver = relay(4, 0.0, 1.0)
        solver.numericsSolverOptions().dparam[0] = 1e-8
        return (sk.FirstOrderLinearDS([1.0, 6.0], [[-4.5, 0], [0, -1.5]]), Genes(), law, solver), 1e-3, 3000, 0.5, (5e-4, 20)
    if name == "zhuravlev_ivanov":
        return (sk.FirstOrderLinearDS([1.0, 10.0], [[0, 1.0], [0, 0]]), Bouncing(), *relay(2)), 1e-3, 10000, 1.0, (1e-10, 40)
    raise SystemExit(f"no scene is called {name}")


def seconds(name):
    """(CPU seconds of all steps, their number) of one run."""
    (system, relation, law, solver), h, steps, theta, newton = scene(name)
    interaction = sk.Interaction(law, relation)
    dynamics = sk.NonSmoothDynamicalSystem(0, 10 * steps * h)
    dynamics.insertDynamicalSystem(system)
    dynamics.link(interaction, system)
    stepping = sk.TimeStepping(dynamics, sk.TimeDiscretisation(0, h), sk.EulerMoreauOSI(theta), solver)
    if newton is not None:
        stepping.setComputeResiduY(True)
        stepping.setComputeResiduR(True)
        stepping.setNewtonTolerance(newton[0])
        stepping.setNewtonMaxIteration(newton[1])
        stepping.setUseRelativeConvergenceCriteron(False)
        stepping.setResetAllLambda(False)
    KEEP.append((system, relation, law, solver, interaction, dynamics, stepping))
    one, following = stepping.computeOneStep, stepping.nextStep
    start = time.process_time()
    for _ in range(steps):
        one()
        following()
    return time.process_time() - start, steps


def main(names):
    """Print a line a scene: its name and microseconds a step."""
    for name in names:
        found = [seconds(name) for _ in range(REPEATS + 1)][1:]
        print(name, 1e6 * min(found)[0] / found[0][1], flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
