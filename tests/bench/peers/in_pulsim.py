"""Circuits of ``cases/`` in Pulsim, run by a Python that has it.

Its switches and diodes are resistors of two values, 1 microohm and 1 gigaohm here. CPU time of ``simulate``, one warm-up, the
minimum over repeats; building the circuit is not timed.

    in_pulsim.py SCENE    a line a run, JSON: method, label, seconds, t, x, message
"""

import json
import sys
import time
import warnings

import numpy as np
import pulsim

REPEATS, ENOUGH = 10, 0.4  # s
ROWS = 2000  # At most so many are handed over.
ON, OFF = 1e6, 1e-9  # S
TOLERANCES = tuple(10.0**-k for k in range(3, 11))
COUNTS = tuple(2**k for k in range(10, 18))  # of fixed steps


def diode_bridge():
    """Circuit, end, switches, and the names of the states."""
    circuit = pulsim.CircuitBuilder()
    circuit.add_capacitor("C", "a", "gnd", 1e-6, 10.0)
    circuit.add_inductor("L", "a", "gnd", 1e-2, 0.0)
    for name, anode, cathode in (("D1", "a", "p"), ("D2", "gnd", "p"), ("D3", "n", "a"), ("D4", "n", "gnd")):
        circuit.add_diode(name, anode, cathode, ON, OFF)
    circuit.add_resistor("R", "p", "n", 1e3)
    return circuit, 5e-3, None, ["V(a)", "I(L)"]


def buck():
    """Circuit, end, switches, and the names of the states."""
    circuit, period, duty = pulsim.CircuitBuilder(), 10e-6, 0.4
    circuit.add_voltage_source("Vin", "vin", "gnd", 24.0)
    circuit.add_switch("S", "vin", "sw", ON, OFF)
    circuit.add_diode("D", "gnd", "sw", ON, OFF)
    circuit.add_inductor("L", "sw", "out", 100e-6)
    circuit.add_capacitor("C", "out", "gnd", 47e-6)
    circuit.add_resistor("R", "out", "gnd", 5.0)
    gate = pulsim.make_pwm_switch_fn(1 / period, duty, circuit.switch_index_of("S"), circuit.graph.num_switches)
    return circuit, 40 * period, gate, ["I(L)", "V(out)"]


SCENES = {scene.__name__: scene for scene in (diode_bridge, buck)}


def measured(scene, options):
    """Seconds, times, states."""
    circuit, end, gate, names = scene
    found = []
    while len(found) < 2 or (len(found) <= REPEATS and sum(found) < ENOUGH):
        start = time.process_time()
        run = pulsim.simulate(circuit, end, switch_fn=gate, **options)
        found.append(time.process_time() - start)
    t, x = np.asarray(run.times), np.asarray(run.states)
    kept = np.unique(np.append(np.arange(0, len(t), max(len(t) // ROWS, 1)), len(t) - 1))
    columns = [circuit.state_var_names().index(name) for name in names]
    return min(found[1:]), t[kept].tolist(), x[kept][:, columns].tolist()


def main(name):
    """Print a line a run."""
    scene = SCENES[name]()
    variable = [
        ("Pulsim, variable-step TR-BDF2", f"rtol = {rtol:.0e}", {"engine": "trbdf2", "rtol": rtol, "atol": 1e-3 * rtol})
        for rtol in TOLERANCES
    ]
    fixed = [("Pulsim, fixed steps", f"h = {scene[1] / count:.3g}", {"dt": scene[1] / count}) for count in COUNTS]
    for method, label, options in variable + fixed:
        line = {"method": method, "label": label}
        try:
            line["seconds"], line["t"], line["x"] = measured(scene, options)
        except Exception as error:
            line["message"] = f"{type(error).__name__}: {error}"
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main(sys.argv[1])
