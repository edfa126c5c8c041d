"""Error against run time of derivatives through a switch, for docs/derivatives.md: nsmodel, differences of its runs, and peers.

Run it from anywhere, with a Python that has diffrax and nosnoc; it rewrites the table between the marks of docs/derivatives.md
and docs/images/derivatives_peers.png. A minute. Where one is not installed the page stays as it is, and the picture goes to
results/.
"""

from __future__ import annotations

import contextlib
import io
import math
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from page import put, save

import nsmodel
from nsmodel.codegen.event_driven_batch import PieceBatch
from nsmodel.plot.style import LINES, blank, dress

IMAGES = Path(__file__).resolve().parents[1] / "images"
RESULTS = IMAGES.parents[1] / "results"
VALUES = np.array([1.0, 1.0, 5.3])  # a, k, x(0)
END = 5.0
SECONDS = 1.0  # That a setting is repeated for.
CELLS = 1000  # Of a call, where cells run together.


class Point(NamedTuple):
    """One setting of a method: the seconds of three derivatives, and their largest error beside the largest of them."""

    method: str
    setting: str
    seconds: float
    error: float


def exact() -> np.ndarray:
    """Of x(5) by a, k, x(0): x'' = -a sgn x' - k x turns once before, x(5) = -a/k - (3 a/k - x(0)) cos(5 sqrt k)."""
    (a, k, start), w = VALUES, math.sqrt(VALUES[1])
    rest, c, s = a / k, math.cos(END * w), math.sin(END * w)
    return np.array([-(1 + 3 * c) / k, rest / k * (1 + 3 * c) + (3 * rest - start) * s * END / (2 * w), c])


def point(method: str, setting: str, run: Callable[[], Any], parts: int = 1) -> Point:
    """The least of many times, after one to warm up, of one of so many parts."""
    found, best, began = np.asarray(run(), float).ravel(), math.inf, time.perf_counter()
    while best == math.inf or time.perf_counter() - began < SECONDS:
        start = time.perf_counter()
        run()
        best = min(best, time.perf_counter() - start)
    return Point(method, setting, best / parts, float(np.abs(found - exact()).max() / np.abs(exact()).max()))


def by_nsmodel() -> Iterator[Point]:
    """`sensitivity`, and central differences of six runs in one call of C."""
    x, s, a, k, start = (ca.SX.sym(name) for name in ("x", "s", "a", "k", "start"))
    model = nsmodel.FrictionOscillator(
        x=x, potential=k * x**2 / 2, s=s, friction=a * ca.fabs(s), x0=[start], v0=[0],
        parameters={a: 1, k: 1, start: VALUES[2]}, t_end=END, step=0.01,
    )  # fmt: skip
    by = ["a", "k", "start"]
    for rtol in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        yield point(
            "nsmodel", f"rtol {rtol:.0e}", lambda rtol=rtol: nsmodel.sensitivity(model, by=by, at=[END], rtol=rtol).of("x")[-1]
        )
    for rtol in (1e-4, 1e-8, 1e-12):
        own = PieceBatch(model, None, rtol, None, [END], by)
        yield point("cells in C", f"rtol {rtol:.0e}", lambda own=own: cells(own, by), CELLS)
    batch = PieceBatch(model, None, 1e-12, None, [END])

    def ends(values: np.ndarray) -> np.ndarray:
        return batch.run(values, ["x"]).arrays["x"][:, -1, 0]

    for width in (1e-2, 1e-4, 1e-6, 1e-8):
        yield point("differences of runs", f"width {width:.0e}", lambda width=width: differences(ends, width))


def cells(batch: PieceBatch, by: Sequence[str]) -> np.ndarray:
    """The derivatives of CELLS cells, of which all are the same."""
    found = batch.run(np.tile(VALUES, (CELLS, 1)), [f"x by {name}" for name in by]).arrays
    return np.array([found[f"x by {name}"][-1, -1, 0] for name in by])


def differences(ends: Callable[[np.ndarray], np.ndarray], width: float) -> np.ndarray:
    """Central, three pairs, of the ends (6,) of runs at values (6, 3)."""
    above, below = ends(np.vstack([VALUES + width * np.eye(3), VALUES - width * np.eye(3)])).reshape(2, 3)
    return (above - below) / (2 * width)


def by_diffrax() -> Iterator[Point]:
    """Reverse mode through sgn v smoothed as tanh(v/eps): its events end a solve, and their number is fixed."""
    import diffrax as dx  # pyright: ignore[reportMissingImports]
    import jax  # pyright: ignore[reportMissingImports]
    import jax.numpy as jnp  # pyright: ignore[reportMissingImports]

    jax.config.update("jax_enable_x64", True)

    def end(values: Any, width: float) -> Any:
        def rate(_: Any, z: Any, p: Any) -> Any:
            return jnp.array([z[1], -p[0] * jnp.tanh(z[1] / width) - p[1] * z[0]])

        control = dx.PIDController(rtol=1e-8, atol=1e-8)
        start = jnp.array([values[2], 0.0])
        found = dx.diffeqsolve(
            dx.ODETerm(rate), dx.Kvaerno5(), 0.0, END, 0.01, start, values, stepsize_controller=control, max_steps=16384
        )
        return found.ys[-1, 0]

    for width in (1e-1, 1e-2, 1e-3, 1e-4):
        gradient = jax.jit(jax.grad(lambda values, width=width: end(values, width)))
        values = jnp.array(VALUES)
        yield point(f"diffrax {version('diffrax')}", f"tanh(v/{width:.0e})", lambda g=gradient, v=values: np.asarray(g(v)))


def by_nosnoc() -> Iterator[Point]:
    """Finite elements that detect switches, solved as one program an interval; a and k are numbers of it, so differences."""
    import nosnoc  # pyright: ignore[reportMissingImports]

    def solver(a: float, k: float) -> Any:
        x = ca.SX.sym("x", 2)
        fields = ca.horzcat(*(ca.vertcat(x[1], -k * x[0] + side * a) for side in (-1, 1)))
        model = nosnoc.NosnocModel(x=x, F=[fields], S=[np.array([[1.0], [-1.0]])], c=[x[1]], x0=np.array([VALUES[2], 0.0]))
        options = nosnoc.NosnocOpts()
        options.n_s, options.N_finite_elements, options.terminal_time = 3, 2, END / 5
        options.comp_tol = options.sigma_N = 1e-10
        return nosnoc.NosnocSolver(options, model)

    with contextlib.redirect_stdout(io.StringIO()):
        width = 1e-4
        solvers = {values: solver(*values) for values in {(1.0, 1.0), *((1 + d, 1.0) for d in (-width, width))}}
        solvers |= {(1.0, 1 + d): solver(1.0, 1 + d) for d in (-width, width)}

    def end(values: np.ndarray) -> float:
        loop = nosnoc.NosnocSimLooper(solvers[float(values[0]), float(values[1])], np.array([values[2], 0.0]), 5)
        with contextlib.redirect_stdout(io.StringIO()):
            loop.run()
        return float(np.array(loop.get_results()["X_sim"])[-1][0])

    def ends(values: np.ndarray) -> np.ndarray:
        return np.array([end(row) for row in values])

    yield point(f"nosnoc {version('nosnoc')}", f"differences of solves, width {width:.0e}", lambda: differences(ends, width))


def draw(points: list[Point], path: Path) -> None:
    """Error over milliseconds, a line a method."""
    figure = blank(6.4, 3.6)
    axes = figure.add_subplot()
    for colour, method in zip(LINES, dict.fromkeys(one.method for one in points), strict=False):
        own = [one for one in points if one.method == method]
        axes.loglog([1e3 * one.seconds for one in own], [max(one.error, 1e-16) for one in own], "o-", color=colour, label=method)
    dress(axes, "Three derivatives through a switch", "milliseconds", "largest relative error")
    axes.legend(frameon=False, fontsize=8)
    path.parent.mkdir(exist_ok=True)
    save(figure, path, 32)


def main() -> None:
    """Measure, and write both."""
    points, peers = list(by_nsmodel()), {"diffrax": by_diffrax, "nosnoc": by_nosnoc}
    missing = [name for name in peers if find_spec(name) is None]
    for name, method in peers.items():
        points += [] if name in missing else method()
    rows = [f"| {p.method} | {p.setting} | {float(f'{1e3 * p.seconds:.2g}'):g} | {p.error:.1e} |" for p in points]
    table = "\n".join(["| | setting | ms | error |", "| --- | --- | ---: | ---: |", *rows])
    if missing:
        print(f"{' and '.join(missing)}: not installed; docs/derivatives.md stays as it is, the picture goes to {RESULTS}\n")
        print(f"peers\n\n{table}\n", flush=True)
    else:
        put("derivatives.md", "peers", table)
    draw(points, (RESULTS if missing else IMAGES) / "derivatives_peers.png")


if __name__ == "__main__":
    main()
