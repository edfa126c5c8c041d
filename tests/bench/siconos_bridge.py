"""Diode bridge in Siconos, run by the Python that has it; prints microseconds a step of computeOneStep + nextStep."""

import sys
import time

import siconos.kernel as sk
import siconos.numerics as sn


def main(steps: int) -> None:
    """Step the bridge of cases/diode_bridge.py with Siconos' theta scheme and Lemke's method."""
    L, C, R, h = 1e-2, 1e-6, 1e3, 1e-6
    system = sk.FirstOrderLinearTIDS([10.0, 0.0], [[0, -1 / C], [1 / L, 0]])
    relation = sk.FirstOrderLinearTIR([[0, 0.0], [0, 0], [-1, 0], [1, 0]], [[0, 0, -1 / C, 1 / C], [0, 0, 0, 0.0]])
    relation.setDPtr([[1 / R, 1 / R, -1, 0], [1 / R, 1 / R, 0, -1], [1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    dynamics = sk.NonSmoothDynamicalSystem(0, 10 * steps * h)
    dynamics.insertDynamicalSystem(system)
    dynamics.link(sk.Interaction(sk.ComplementarityConditionNSL(4), relation), system)
    solver = sk.LCP(sn.SICONOS_LCP_LEMKE)
    stepping = sk.TimeStepping(dynamics, sk.TimeDiscretisation(0, h), sk.EulerMoreauOSI(0.5), solver)
    start = time.process_time()
    for _ in range(steps):
        stepping.computeOneStep()
        stepping.nextStep()
    print(1e6 * (time.process_time() - start) / steps)


if __name__ == "__main__":
    main(int(sys.argv[1]))
