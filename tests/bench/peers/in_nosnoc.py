"""Relay scenes in nosnoc (finite elements with switch detection), run by a Python that has it.

CPU time of the simulation loop, one warm-up, the minimum over repeats; building the model and creating the solver is not timed.
Of its options all but one are the default: elastic complementarity takes 5 ms an interval, where Scholtes'
relaxation takes 40. It ends in a wrong solution at one of the settings.

    in_nosnoc.py SCENE    a line a run, JSON: method, label, seconds, t, x, message
"""

import contextlib
import io
import json
import sys
import time

import casadi as ca
import nosnoc
import numpy as np

REPEATS = 2
ELEMENTS = 2  # finite elements of a control interval: the least with which a switch can be found in it
STUDIES = {3: (3, 6, 12, 24, 48), 4: (3, 6, 12, 24)}  # Radau stages: numbers of intervals
TOLERANCE = 1e-10  # of complementarity


def friction_oscillator():
    """Model, end time, and the columns that are the scene's state."""
    x = ca.SX.sym("x", 2)
    return relay(x, lambda l: ca.vertcat(x[1], -x[0] + l), x[1], [5.3, 0.0]), 12.0, [0]


def sliding_relay():
    """Model, end time, and the columns that are the scene's state; the last one is the time."""
    x = ca.SX.sym("x", 3)
    return relay(x, lambda l: ca.vertcat(x[1], 2 * l + ca.sin(x[2]), 1), x[0] + x[1], [1.0, 0.0, 0.0]), 5.0, [0, 1]


def relay(x, field, y, x0):
    """x' = field(l), l in -Sgn(y)."""
    fields = ca.horzcat(field(-1), field(1))
    return nosnoc.NosnocModel(x=x, F=[fields], S=[np.array([[1.0], [-1.0]])], c=[y], x0=np.array(x0))


SCENES = {"friction_oscillator": friction_oscillator, "sliding_relay": sliding_relay}


def run(scene, stages, intervals):
    """Seconds, times, states and, where nosnoc says that it failed, how often."""
    model, end, columns = SCENES[scene]()
    options = nosnoc.NosnocOpts()
    options.n_s, options.N_finite_elements, options.terminal_time = stages, ELEMENTS, end / intervals
    options.comp_tol = options.sigma_N = TOLERANCE
    options.tol_ipopt = None
    options.mpcc_mode = nosnoc.MpccMode.ELASTIC_INEQ
    x0 = np.array(model.x0)
    solver = nosnoc.NosnocSolver(options, model)
    seconds = []
    for _ in range(REPEATS + 1):
        loop = nosnoc.NosnocSimLooper(solver, x0, intervals)
        start = time.process_time()
        with contextlib.redirect_stdout(io.StringIO()):
            loop.run()
        seconds.append(time.process_time() - start)
    found = loop.get_results()
    failed = sum(status != nosnoc.Status.SUCCESS for status in found["status"])
    message = f"{failed} of {intervals} intervals end with the status INFEASIBLE" if failed else ""
    return min(seconds[1:]), found["t_grid"].tolist(), found["X_sim"][:, columns].tolist(), message


def main(scene):
    """Print a line a run."""
    for stages, counts in STUDIES.items():
        for intervals in counts:
            line = {"method": f"nosnoc, FESD, {stages} Radau stages", "label": f"{intervals} x {ELEMENTS} elements"}
            try:
                line["seconds"], line["t"], line["x"], line["message"] = run(scene, stages, intervals)
            except Exception as error:
                line["message"] = f"{type(error).__name__}: {error}"
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
