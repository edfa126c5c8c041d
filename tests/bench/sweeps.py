"""Sweeps over parameters: one library for all values beside a plain loop in C, fixed costs, workers, memory, and peers.

The scene is x'' + a Sgn(x') + k x = 0 from x0 at rest to t = 12, random (a, k, x0); errors are of x(12) against the closed form.
CPU seconds of one core where nothing else is said; the least of several passes.
"""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

import nsmodel
from nsmodel import FrictionOscillator, LureSystem, relay
from nsmodel.codegen import write
from nsmodel.codegen.library import COMPILER_FLAGS

SHORT = bool(os.environ.get("NSMODEL_SHORT"))
N, FEW, PASSES = (200, 5, 1) if SHORT else (10_000, 60, 3)
RNG = np.random.default_rng(0)
a, k, x0 = RNG.uniform(0.5, 1.5, N), RNG.uniform(0.8, 1.2, N), RNG.uniform(3, 6, N)
SAMPLES = {("a", "k", "x0"): np.column_stack([a, k, x0])}
A, K, X0 = ca.SX.sym("a"), ca.SX.sym("k"), ca.SX.sym("x0")
DEFAULTS = {A: 1, K: 1, X0: 4}


def exact_end() -> np.ndarray:
    """x(12) by half swings."""
    c = a / k
    n = np.maximum(0, np.ceil((x0 / c - 1) / 2))
    t = 12 * np.sqrt(k) / np.pi
    j = np.minimum(np.floor(t), n)
    sign, top = (-1.0) ** j, x0 - 2 * j * c
    return np.where(j < n, sign * (c + (top - c) * np.cos((t - j) * np.pi)), sign * top)


EXACT = exact_end()


def relay_form(step: float) -> LureSystem:
    """The oscillator with friction as a relay, theta = 1/2."""
    return LureSystem(
        names=["x_1", "v_1"], A=ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-K, 0)), B=ca.vertcat(0, A), C=[[0, 1]], D=0,
        law=relay(1), x0=[X0, 0], parameters=DEFAULTS, theta=0.5, t_end=12.0, step=step,
    )  # fmt: skip


def proximal() -> FrictionOscillator:
    """The same in its own class, h = 1e-3: 12 000 steps."""
    x, s = ca.SX.sym("x_1"), ca.SX.sym("s")
    return FrictionOscillator(x=x, potential=K * x**2 / 2, friction=A * s, s=s, x0=X0, parameters=DEFAULTS, t_end=12.0, step=1e-3)


def measured(job: Callable[[], object], passes: int = PASSES) -> tuple[float, float, object]:
    """The least CPU and wall seconds of several passes, and what the last one gave."""
    cpu, wall, found = [], [], None
    for _ in range(passes):
        begin = time.process_time(), time.perf_counter()
        found = job()
        cpu.append(time.process_time() - begin[0])
        wall.append(time.perf_counter() - begin[1])
    return min(cpu), min(wall), found


def told(name: str, count: int, cpu: float, ends: np.ndarray) -> None:
    """A line of the table."""
    error = np.abs(ends - EXACT[:count])
    print(f"{name:62s} {cpu:8.3f} s {count / cpu:9.0f} runs/s   error: median {np.median(error):.1e}, largest {error.max():.1e}")


def swept(model: object, count: int, **options: object) -> Callable[[], nsmodel.Sweep]:
    """A sweep of the first cells, that keeps the end alone."""
    samples = {names: values[:count] for names, values in SAMPLES.items()}
    given = {"samples": samples, "outputs": {"end": "x_1[-1]"}, "compiled": True, "workers": 1}
    return lambda: nsmodel.sweep(model, **(given | options))


PLAIN = """
#include "plain.c"
/* Cells one after the other, no rows: what a loop written by hand around the exported library does. */
int cells(long count, long steps, const double *p, double *x)
{
    static plain_solver s;
    plain_init(&s);
    for (long i = 0; i < count; i++) {
        if (plain_set_parameters(&s, p + PLAIN_NP*i) != PLAIN_OK || plain_reset(&s) != PLAIN_OK)
            return 1;
        for (long j = 0; j < steps; j++)
            if (plain_step(&s) != PLAIN_OK)
                return 2;
        double all[PLAIN_NX];
        plain_get_state(&s, all);
        x[i] = all[0];
    }
    return 0;
}
"""


def plain_loop(model: object, steps: int, count: int) -> Callable[[], np.ndarray]:
    """The exported library in a loop in C."""
    folder = Path(tempfile.mkdtemp())
    write(model, folder, name="plain")
    (folder / "loop.c").write_text(PLAIN, encoding="utf-8")
    flags = [flag for flag in COMPILER_FLAGS if flag != "-lm"]
    subprocess.run(["cc", *flags, "loop.c", "-o", "loop.so", "-lm"], cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "loop.so"))
    values, ends = np.ascontiguousarray(SAMPLES["a", "k", "x0"][:count]), np.zeros(count)

    def run() -> np.ndarray:
        status = library.cells(
            ctypes.c_long(count), ctypes.c_long(steps), ctypes.c_void_p(values.ctypes.data), ctypes.c_void_p(ends.ctypes.data)
        )
        if status:
            raise RuntimeError(f"a step failed ({status})")
        return ends

    return run


def beside_c() -> None:
    """One library for all values beside the plain loop."""
    print("A sweep beside a plain loop in C over the exported library\n")
    for name, model, steps, count in (
        ("proximal, h = 1e-3, 12 000 steps", proximal(), 12_000, max(N // 20, 20)),
        ("relay, h = 1e-2, 1200 steps", relay_form(1e-2), 1200, max(N // 5, 20)),
    ):  # fmt: skip
        loop, whole = plain_loop(model, steps, count), swept(model, count)
        loop(), whole()
        plain, sweep_s = measured(loop)[0], measured(whole)[0]
        print(
            f"  {name:36s} C {1e3 * plain / count:.3f} ms a run, sweep {1e3 * sweep_s / count:.3f} ms: "
            f"{sweep_s / plain:.2f} times"
        )


def fixed_costs() -> None:
    """What a sweep takes beside its steps, new and built; and a cell."""
    print("\nFixed costs\n")
    model, one = relay_form(1e-2), {"t_end": 0.1}
    old = os.environ.get("XDG_CACHE_HOME")
    with tempfile.TemporaryDirectory() as empty:
        os.environ["XDG_CACHE_HOME"] = empty
        cold = measured(swept(model, 10, **one), 1)[1]
        built = measured(swept(model, 10, **one))[1]
    if old is None:
        del os.environ["XDG_CACHE_HOME"]
    else:
        os.environ["XDG_CACHE_HOME"] = old
    swept(model, 10, **one)()
    few, many = measured(swept(model, N // 10, **one))[0], measured(swept(model, N, **one))[0]
    print(
        f"  first sweep {cold:.2f} s (one build), the next {1e3 * built:.0f} ms, a cell of 10 steps "
        f"{1e6 * (many - few) / (0.9 * N):.1f} us"
    )


def workers() -> None:
    """Two threads beside one, two processes beside one."""
    print("\nWorkers, wall seconds\n")
    one, two = (measured(swept(relay_form(1e-2), N, workers=count))[1] for count in (1, 2))
    print(f"  C, {N} cells: 1 worker {one:.2f} s, 2 threads {two:.2f} s: {one / two:.2f} times")
    options = {"compiled": False, "outputs": {"mean": "mean(x_1)"}}
    one, two = (measured(swept(relay_form(1e-2), 4 * FEW, workers=count, **options), 1)[1] for count in (1, 2))
    print(f"  simulate, {4 * FEW} cells: 1 worker {one:.2f} s, 2 processes {two:.2f} s: {one / two:.2f} times")


def memory() -> None:
    """A million cells on disk, in a process of its own."""
    cells = N if SHORT else 1_000_000
    with tempfile.TemporaryDirectory() as folder:
        code = (
            f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
            "import sweeps, numpy as np, nsmodel, resource\n"
            "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
            f"values = np.random.default_rng(1).uniform(0.8, 1.2, ({cells}, 3)) * [1, 1, 4]\n"
            "nsmodel.sweep(sweeps.relay_form(1e-2), samples={('a', 'k', 'x0'): values}, keep=['x_1'], every=5, t_end=0.5,\n"
            f"              compiled=True, out={folder!r} + '/million')\n"
            "print(before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
        )
        begin = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        before, peak = (int(number) / 1024 for number in done.stdout.split())
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()) / 2**20
        print(
            f"\nMemory: {cells} cells, {size:.0f} MB on disk, {time.perf_counter() - begin:.0f} s: {before:.0f} MB before, "
            f"{peak:.0f} MB at most"
        )


def numpy_arrays(count: int, h: float = 1e-3, steps: int = 12_000) -> np.ndarray:
    """The proximal step with arrays over runs; nothing is verified."""
    x, d, K2, inverse = x0[:count].copy(), np.zeros(count), h * h * k[:count], 1 / (1 + h * h * k[:count])
    limit = h * h * a[:count]
    for _ in range(steps):
        b = d - K2 * x
        d = (b + np.clip(-b, -limit, limit)) * inverse
        x = x + d
    return x


def lsoda(count: int, eps: float, rtol: float) -> np.ndarray:
    """SciPy's LSODA, run by run, friction smoothed."""
    ends = np.zeros(count)
    for i in range(count):
        rates = lambda t, z, i=i: (z[1], -a[i] * np.tanh(z[1] / eps) - k[i] * z[0])  # noqa: E731
        ends[i] = solve_ivp(rates, (0, 12), (x0[i], 0.0), method="LSODA", rtol=rtol, atol=rtol).y[0, -1]
    return ends


def peers() -> None:
    """Errors and times of ten thousand oscillators, or of a part of them."""
    print("\nRandom oscillators with friction, t = 12\n")
    for name, model, options in (
        ("nsmodel, relay, theta = 1/2, h = 1e-2", relay_form(1e-2), {}),
        ("nsmodel, event-driven, rtol 1e-8", relay_form(1e-2), {"rtol": 1e-8}),
        ("nsmodel, proximal, h = 1e-3", proximal(), {}),
    ):  # fmt: skip
        swept(model, 10, **options)()
        cpu, _, found = measured(swept(model, N, **options))
        told(name, N, cpu, found["end"].values)
    cpu, _, ends = measured(lambda: numpy_arrays(N), 1)
    told("NumPy arrays over runs, proximal, h = 1e-3, not verified", N, cpu, ends)
    for eps, rtol in ((1e-3, 1e-4), (1e-5, 1e-6)):
        cpu, _, ends = measured(lambda eps=eps, rtol=rtol: lsoda(FEW, eps, rtol), 1)
        told(f"SciPy LSODA, tanh(v/{eps:g}), rtol {rtol:g}", FEW, cpu, ends)
    try:
        import diffrax
        import jax
    except ImportError:
        print("diffrax and JAX are not installed")
        return
    jax.config.update("jax_enable_x64", True)
    for eps, rtol, solver in ((1e-3, 1e-4, diffrax.Kvaerno5()), (1e-4, 1e-5, diffrax.Kvaerno5())):
        count = min(N, 200)
        term = diffrax.ODETerm(lambda t, z, p, eps=eps: jax.numpy.array([z[1], -p[0] * jax.numpy.tanh(z[1] / eps) - p[1] * z[0]]))
        control = diffrax.PIDController(rtol=rtol, atol=rtol)

        def one(a_, k_, x_, term=term, solver=solver, control=control):
            start = jax.numpy.array([x_, 0.0])
            found = diffrax.diffeqsolve(
                term, solver, 0.0, 12.0, None, start, (a_, k_), stepsize_controller=control, max_steps=100_000, throw=False
            )
            return found.ys[-1, 0]

        all_at_once = jax.jit(jax.vmap(one))
        given = [jax.numpy.asarray(values[:count]) for values in (a, k, x0)]
        all_at_once(*given).block_until_ready()
        cpu, _, ends = measured(lambda run=all_at_once, given=given: np.asarray(run(*given)), 1)
        told(f"diffrax vmap {type(solver).__name__}, tanh(v/{eps:g}), rtol {rtol:g}", count, cpu, ends)


if __name__ == "__main__":
    if shutil.which("cc") is None:
        sys.exit("there is no C compiler: nothing to measure")
    beside_c()
    fixed_costs()
    workers()
    memory()
    peers()
