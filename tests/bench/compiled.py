"""Time of a compiled step beside Siconos, in one run: the generated C in a loop of its own, and whole runs from Python.

CPU time, one warm-up, the minimum over repeats. Siconos' time is that of computeOneStep and nextStep, driven from Python.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path

import casadi as ca
import numpy as np
from peers import programs

import nsmodel
from nsmodel import codegen
from nsmodel.codegen.library import compiler
from nsmodel.simulation.simulate import prepared_loop

FLAGS = ["-std=c99", "-O2"]
SHORT = bool(os.environ.get("NSMODEL_SHORT"))
REPEATS = 1 if SHORT else 9
RUN_FOR = 100 if SHORT else 100_000
LONG = 0.01 if SHORT else 1.0  # The end of the run from Python.

# scene: (goal: how many times faster than Siconos, steps of a run, arguments of the model, parameters that become numbers)
SCENES = {
    "diode_bridge": (50, 5000, {}, {}),
    "relay_oscillator": (50, 10000, {}, {}),
    "friction_oscillator_relay": (50, 10000, {}, {}),
    "two_masses": (25, 10000, {}, {"m1": 1, "m2": 1, "mu1": 1, "mu2": 1, "k": 10}),
    "gene_network": (10, 3000, {}, {}),
    "zhuravlev_ivanov": (10, 10000, {}, {}),
    "friction_chain": (50, 1000, {}, {}),
}
if SHORT:
    SCENES = {"diode_bridge": SCENES["diode_bridge"]}
PEER = {"friction_chain": "friction_chain_10"}

LOOP = """
#include "NAME.h"
#include <stdio.h>
#include <time.h>

int main(void)
{
    static NAME_solver s;
    double least = 1e30, worst = 0;
    const long runs = 1 + RUN_FOR/STEPS;
    for (int repeat = 0; repeat <= REPEATS; repeat++) {
        const clock_t start = clock();
        for (long run = 0; run < runs; run++) {
            NAME_init(&s);
            for (long k = 0; k < STEPS; k++) {
                if (NAME_step(&s) != 0)
                    return 1;
                if (s.residual > worst)
                    worst = s.residual;
            }
        }
        const double each = (double)(clock() - start)/CLOCKS_PER_SEC/runs/STEPS;
        if (repeat > 0 && each < least)
            least = each;
    }
    printf("%.17g %.17g\\n", 1e9*least, worst);
    return 0;
}
"""


def generated(name: str, folder: Path) -> float:
    """Nanoseconds a step of the generated C."""
    _, steps, arguments, parameters = SCENES[name]
    model = nsmodel.load(name, **arguments)
    codegen.write(model, folder, name=name, parameters=parameters)
    text = (
        LOOP.replace("NAME", name).replace("RUN_FOR", str(RUN_FOR)).replace("STEPS", str(steps)).replace("REPEATS", str(REPEATS))
    )
    (folder / "loop.c").write_text(text)
    command = [*compiler().split(), *FLAGS, "-o", "loop", "loop.c", f"{name}.c", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run(["./loop"], cwd=folder, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[0])


def steps_in_c() -> None:
    """The table of single steps."""
    peers = programs.speed([PEER.get(name, name) for name in SCENES])
    print("a compiled step, gcc -O2, certificate included                ns        Siconos ns    times faster   goal")
    for name, (goal, *_) in SCENES.items():
        with tempfile.TemporaryDirectory() as folder:
            ours = generated(name, Path(folder))
        peer = peers.get(PEER.get(name, name))
        beside = "not installed: skipped" if peer is None else f"{1e3 * peer:12.0f} {1e3 * peer / ours:12.0f}      {goal:6d}"
        print(f"  {name:52s} {ours:9.1f}    {beside}")


def runs_from_python() -> None:
    """A million steps of the bridge: interpreted and compiled, every row kept."""
    model = nsmodel.load("diode_bridge")
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        start = time.perf_counter()
        nsmodel.simulate(model, t_end=1e-5, compiled=True)
        building = time.perf_counter() - start
        seconds = {}
        for compiled in (False, True):
            times = []
            for _ in range(1 if not compiled else 3):
                start = time.perf_counter()
                nsmodel.simulate(model, t_end=LONG, compiled=compiled)
                times.append(time.perf_counter() - start)
            seconds[compiled] = min(times)
    print(f"a run of the diode bridge from Python, {LONG / model.step:.3g} steps, every row kept, wall seconds")
    faster = seconds[False] / seconds[True]
    print(f"  interpreted {seconds[False]:.3f}, compiled {seconds[True]:.3f}: {faster:.1f} times faster (goal 20)")
    print(f"  building, once for a model: {building:.2f}")


def buck(T: float, periods: int) -> nsmodel.LureSystem:
    """A converter with steps of which 7.3 are a period."""
    L, C, R, u = 1e-4, 47e-6, 5.0, ca.SX.sym("u")
    return nsmodel.LureSystem(
        A=[[0, -1 / L], [1 / C, -1 / (R * C)]], B=[1 / L, 0], C=[1, 0], f=[24 * u / L, 0], law=nsmodel.complementarity(1),
        x0=[0, 0], theta=0.5, step=T / 7.3, t_end=periods * T, inputs={u: 0.4},
    )  # fmt: skip


def edges_of_inputs() -> None:
    """A buck converter whose voltage a PWM chops, beside the same with a constant one."""
    T, periods = 1e-5, 20 if SHORT else 2000
    model = buck(T, periods)
    duties = nsmodel.table(T * np.arange(periods), np.random.default_rng(0).uniform(0.1, 0.9, periods))
    signals = {"constant": 0.4, "PWM": nsmodel.pwm(T, 0.4), "PWM, its duty changed each period": nsmodel.pwm(T, duties)}
    print(f"a buck converter of {periods} periods, compiled, a row in 1000 kept, CPU seconds      ratio   goal")
    seconds: dict[str, float] = {}
    for name, signal in signals.items():
        times = []
        for _ in range(REPEATS + 1):
            run = prepared_loop(model, inputs={"u": signal}, compiled=True, save_every=1000)
            run.go()
            times.append(run.cpu_seconds)
        seconds[name] = min(times[1:])
        goal = "   1.5" if name == "PWM" else ""
        print(f"  {name:60s} {seconds[name]:10.5f}   {seconds[name] / seconds['constant']:6.2f} {goal}")


def steps_alone() -> None:
    """The converter in somebody else's loop: one step a call, with a value of its input."""
    print("a buck converter step by step, us a step (CPU)      goal")
    for compiled, name, goal in ((True, "compiled", 5), (False, "interpreted", 12)):
        s = nsmodel.stepper(buck(1e-5, 20), inputs={"u": None}, compiled=compiled)
        times = []
        for _ in range(REPEATS if SHORT else 200):
            start = time.process_time()
            for _ in range(200):
                s.step(0.4)
            times.append((time.process_time() - start) / 200)
        print(f"  {name:20s} {1e6 * min(times):9.2f} {goal:20d}")


def main() -> None:
    """Print the tables."""
    if compiler() is None:
        print("compiled steps: no C compiler, skipped")
        return
    steps_in_c()
    print()
    runs_from_python()
    print()
    edges_of_inputs()
    print()
    steps_alone()


if __name__ == "__main__":
    main()
