"""Scenes of ``cases/`` in Siconos, run by the Python that has it: the speed of its step, or runs at several steps.

CPU time of computeOneStep + nextStep, one warm-up, the minimum over repeats; set-up is not timed. A forcing, and a relation that
is not linear, is evaluated in Python, as Siconos' own Python examples do.

    in_siconos.py speed SCENE...    a line a scene: its name, microseconds a step
    in_siconos.py runs SCENE        a line a run, JSON: method, label, seconds, t, x, message
"""

import json
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


class Disc(sk.FirstOrderNonLinearR):
    """The relation of a point outside the unit disc: y = |q| - 1, r = l q/|q|."""

    def computeh(self, t, x, l, z, y):
        """Evaluate y."""
        y[0] = np.hypot(x[0], x[1]) - 1

    def computeg(self, t, x, l, z, r):
        """Evaluate r."""
        r[:] = l[0] * x[:2] / np.hypot(x[0], x[1])

    def computeJachx(self, t, x, l, z, C):
        """Evaluate dh/dx."""
        C[:] = x[:2] / np.hypot(x[0], x[1])

    def computeJachlambda(self, t, x, l, z, D):
        """Evaluate dh/dl."""
        D[:] = 0

    def computeJacgx(self, t, x, l, z, K):
        """Evaluate dg/dx."""
        n = x[:2] / np.hypot(x[0], x[1])
        K[:] = l[0] * (np.eye(2) - np.outer(n, n)) / np.hypot(x[0], x[1])

    def computeJacglambda(self, t, x, l, z, B):
        """Evaluate dg/dl."""
        B[:, 0] = x[:2] / np.hypot(x[0], x[1])


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
    if name == "friction_oscillator":
        return linear([[0, 1], [-1, 0]], [[0], [1]], [[0, 1]], None, relay(1), [5.3, 0.0]), 1e-3, 12000, 1.0, None
    if name == "sliding_relay":
        forced = slice(1, 2), np.sin
        return linear([[0, 1], [0, 0]], [[0], [2]], [[1, 1]], None, relay(1), [1.0, 0.0], forced), 1e-2, 500, 1.0, None
    if name == "point_past_disc":
        system = sk.FirstOrderLinearDS([-1.5, 0.3], np.zeros((2, 2)), [1.0, 0.0])
        return (system, Disc(), *complementarity(1)), 1e-2, 450, 1.0, (1e-10, 40)
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


def prepare(name, h=None, steps=None, theta=None, gamma=None):
    """Return (TimeStepping, system, number of steps); what is None is the scene's own."""
    (system, relation, law, solver), own_h, own_steps, own_theta, newton = scene(name)
    h, steps, theta = h or own_h, steps or own_steps, theta or own_theta
    interaction = sk.Interaction(law, relation)
    dynamics = sk.NonSmoothDynamicalSystem(0, 10 * steps * h)
    dynamics.insertDynamicalSystem(system)
    dynamics.link(interaction, system)
    integrator = sk.EulerMoreauOSI(theta) if gamma is None else sk.EulerMoreauOSI(theta, gamma)
    stepping = sk.TimeStepping(dynamics, sk.TimeDiscretisation(0, h), integrator, solver)
    if newton is not None:
        stepping.setComputeResiduY(True)
        stepping.setComputeResiduR(True)
        stepping.setNewtonTolerance(newton[0])
        stepping.setNewtonMaxIteration(newton[1])
        stepping.setUseRelativeConvergenceCriteron(False)
        stepping.setResetAllLambda(False)
    KEEP.append((system, relation, law, solver, interaction, dynamics, integrator, stepping))
    return stepping, system, steps


def seconds(stepping, steps):
    """CPU seconds of all steps."""
    one, following = stepping.computeOneStep, stepping.nextStep
    start = time.process_time()
    for _ in range(steps):
        one()
        following()
    return time.process_time() - start


def speed(names):
    """Print a line a scene: its name and microseconds a step."""
    for name in names:
        found = []
        for _ in range(REPEATS + 1):
            stepping, _, steps = prepare(name)
            found.append(seconds(stepping, steps) / steps)
        print(name, 1e6 * min(found[1:]), flush=True)


# scene: (end time, numbers of steps, (theta, gamma): Siconos' own choice is 1/2, 1, columns of the state)
STUDIES = {
    "friction_oscillator": (12.0, [2**k for k in range(6, 17)], [(1.0, 1.0), (0.5, 1.0)], [0]),
    "sliding_relay": (5.0, [2**k for k in range(5, 16)], [(1.0, 1.0), (0.5, 1.0)], [0, 1]),
    "diode_bridge": (5e-3, [2**k for k in range(7, 17)], [(0.5, 1.0), (0.5, 0.5)], [0, 1]),
    "point_past_disc": (4.5, [2**k for k in range(5, 13)], [(1.0, 1.0)], [0, 1]),
}
WORDS = {0.5: "1/2", 1.0: "1"}
ROWS = 512
ENOUGH = 0.2  # s: what took longer is not repeated.


def runs(name):
    """Print a line a run: its time, and the states of another run with the same steps at up to ROWS + 1 times."""
    end, counts, weights, columns = STUDIES[name]
    for theta, gamma in weights:
        for N in counts:
            line = {"method": f"Siconos, theta = {WORDS[theta]}, gamma = {WORDS[gamma]}", "label": f"h = {end / N:.3g}"}
            try:
                line["seconds"] = quickest(name, end / N, N, theta, gamma)
                line["t"], x, line["message"] = states(name, end / N, N, theta, gamma)
                line["x"] = x[:, columns].tolist()
            except Exception as error:
                line["message"] = f"{type(error).__name__}: {error}"
            print(json.dumps(line), flush=True)


def quickest(*run):
    """CPU seconds of the quickest of several runs after a warm-up."""
    found = []
    while len(found) <= REPEATS and (len(found) < 2 or sum(found[1:]) < ENOUGH):
        stepping, _, steps = prepare(*run)
        found.append(seconds(stepping, steps))
    return min(found[1:])


def states(name, h, N, theta, gamma):
    """Times and states of a run, every so many steps; and in how many steps Newton's method did not converge, in words."""
    stepping, system, _ = prepare(name, h, N, theta, gamma)
    t, x, failed = [0.0], [np.array(system.x())], 0
    for k in range(1, N + 1):
        stepping.computeOneStep()
        failed += not stepping.isNewtonConverge()
        stepping.nextStep()
        if k % max(N // ROWS, 1) == 0:
            t.append(k * h)
            x.append(np.array(system.x()))
    nonlinear = scene(name)[4] is not None
    return t, np.array(x), f"Newton's method did not converge in {failed} of {N} steps" if failed and nonlinear else ""


if __name__ == "__main__":
    if sys.argv[1] == "speed":
        speed(sys.argv[2:])
    else:
        runs(sys.argv[2])
