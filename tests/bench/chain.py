"""Time and memory of a step of the friction chain against its number of masses, beside Siconos, in one run.

CPU time of verified steps, set-up not counted, the minimum over repeats of a run from the start; of the interpreted step also its
parts, measured in a run of their own. Siconos: computeOneStep and nextStep, driven from Python, from the same start.

    python tests/bench/chain.py
"""

from __future__ import annotations

import os
import time
import tracemalloc
from collections import defaultdict

import numpy as np
from peers import programs

import nsmodel
from nsmodel.codegen.library import compiler
from nsmodel.modeling.model_files import case_files
from nsmodel.simulation.simulate import prepared_loop
from nsmodel.solvers.sparse import FactoredJacobian, SparseStepSolver

CASE = case_files()["friction_chain"]
SHORT = bool(os.environ.get("NSMODEL_SHORT"))
STEPS = {10: 10, 50: 10, 200: 10} if SHORT else {10: 1000, 50: 1000, 200: 1000, 1000: 300, 10000: 100}
PEERS = (10, 50, 200)
REPEATS = 1 if SHORT else 3
GOALS = {50: 100, 200: 1000}  # times faster than Siconos
MOST = 10e3  # microseconds a step at the most masses
EXPONENT = 1.15  # of the growth from 50 masses on
PARTS = {
    "right-hand side": ((SparseStepSolver, "_constant_part"),),
    "factors": ((FactoredJacobian, "_factorise"),),
    "solutions": ((FactoredJacobian, "solve"),),
    "certificate": ((SparseStepSolver, "_evaluate_residual"), (SparseStepSolver, "_residuals")),
}


def table() -> str:
    """The measurements as text, a line for each number of masses, and whether the goals are met."""
    peers = programs.speed([f"friction_chain_{n}" for n in PEERS])
    ways = (False, True) if compiler() else (False,)
    lines = [f"{'masses':>7} {'interpreted':>12} {'compiled':>9} {'Siconos':>9} {'faster':>7} {'set-up':>12} {'memory':>8}"]
    lines.append(f"{'':7} {'us/step':>12} {'us/step':>9} {'us/step':>9} {'times':>7} {'s':>12} {'MB':>8}")
    found, parts = {}, []
    for n, steps in STEPS.items():
        each, ready = {}, {}
        for compiled in ways:
            each[compiled], ready[compiled] = microseconds(n, steps, compiled)
        found[n] = best = min(each.values())
        peer = peers.get(f"friction_chain_{n}")
        beside = f"{peer:9.0f} {peer / best:7.0f}" if peer else f"{'':9} {'':7}"
        compiled = f"{each[True]:9.1f}" if True in each else f"{'':9}"
        setup = " + ".join(f"{value:.1f}" for value in ready.values())
        lines.append(f"{n:7d} {each[False]:12.1f} {compiled} {beside} {setup:>12} {megabytes(n):8.1f}")
        if any(line.startswith("sparse matrices") for line in run_of(n, 2).propagator.plan.used):
            parts.append((n, shares(n, min(steps, 100))))
        if peer and n in GOALS:
            lines[-1] += f"   goal {GOALS[n]} times: {'met' if peer / best >= GOALS[n] else 'NOT MET'}"
    large = [n for n in STEPS if n >= 50]
    exponent = np.polyfit(np.log(large), np.log([found[n] for n in large]), 1)[0]
    grows = f"from {large[0]} to {large[-1]} masses the time grows as n^{exponent:.2f}"
    lines.append(f"{grows} (goal {EXPONENT}: {said(exponent <= EXPONENT)})")
    longest = found[large[-1]]
    lines.append(f"{longest / 1e3:.2f} ms a step at {large[-1]} masses (goal {MOST / 1e3:g} ms: {said(longest <= MOST)})")
    lines.append("parts of an interpreted step, us:")
    lines += [f"{n:7d} " + ", ".join(f"{name} {value:.0f}" for name, value in own.items()) for n, own in parts]
    return "\n".join(lines)


def said(met: bool) -> str:
    """Whether a goal is met, in words."""
    return "met" if met else "NOT MET"


def run_of(n: int, steps: int, compiled: bool = False):
    """A run of so many steps with its set-up behind it; few of its rows are kept."""
    model = nsmodel.load(CASE, n=n)
    return prepared_loop(model, t_end=steps * model.step, compiled=compiled, save_every=max(steps // 10, 1))


def microseconds(n: int, steps: int, compiled: bool) -> tuple[float, float]:
    """CPU microseconds a step, the least of the repeats, and the seconds from the case file to the first step."""
    times, ready = [], 0.0
    for _ in range(REPEATS):
        start = time.perf_counter()
        run = run_of(n, steps, compiled)
        ready = max(ready, time.perf_counter() - start)  # the first one, which builds the library
        run.go()
        assert run.propagator.totals["worst_residual"] <= run.propagator.stepper.tolerance
        times.append(1e6 * run.cpu_seconds / steps)
    return min(times), ready


def megabytes(n: int) -> float:
    """What Python and NumPy hold at most in a run of a few steps, its set-up included."""
    tracemalloc.start()
    run_of(n, 4).go()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 1e6


def shares(n: int, steps: int) -> dict[str, float]:
    """Microseconds a step of each part."""
    run, spent = run_of(n, steps), defaultdict(float)
    sparse = run.propagator.stepper._sparse
    for name, functions in PARTS.items():
        for owner, attribute in functions:
            for target in [sparse] if owner is SparseStepSolver else list(sparse._steps.values()):
                setattr(target, attribute, timed(getattr(target, attribute), spent, name))
    run.go()
    parts = {name: 1e6 * spent[name] / steps for name in PARTS}
    return parts | {"the rest": 1e6 * run.cpu_seconds / steps - sum(parts.values())}


def timed(function, spent, name):
    """The function, its time added up."""

    def measured(*arguments):
        start = time.process_time()
        result = function(*arguments)
        spent[name] += time.process_time() - start
        return result

    return measured


if __name__ == "__main__":
    print(table())
