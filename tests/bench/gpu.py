"""A million friction oscillators on a graphics card: the C of lanes, compiled as CUDA C++, each run a thread with one lane.

Every step is judged by the same certificate, in doubles, nothing contracted. Needs a card and CuPy (the extra ``gpu``);
where there is none a sentence says so. Time is wall time, with the copies to and from the card.
"""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np
from lanes import drawn, friction

from nsmodel.codegen.batch import StepBatch
from nsmodel.codegen.source import write_source
from nsmodel.codegen.step_spec import spec_for_all_values
from nsmodel.codegen.structs import BATCH_CELLS
from nsmodel.modeling.base import Model
from nsmodel.modeling.time_grid import TimeGrid, make_grid

RUNS = 1000 if os.environ.get("NSMODEL_SHORT") else 1_000_000
COMPARED = 64
THREADS = 128  # Of a block.
OPTIONS = ("-std=c++17", "-default-device", "-fmad=false", "-DSTEP_LANES=1", "-DSTEP_NO_MALLOC", "-Drestrict=__restrict__")
HEADERS = {  # What the C includes and a card's compiler does not have.
    "float.h": "#define DBL_EPSILON 2.2204460492503131e-16\n",
    "math.h": (
        "#define INFINITY __longlong_as_double(0x7ff0000000000000LL)\n#define NAN __longlong_as_double(0x7ff8000000000000LL)\n"
        "inline double ldexp(int a, int exponent) { return ldexp((double)a, exponent); }\n"
    ),
    "stdlib.h": "",
    "string.h": (
        "inline int memcmp(const void *a, const void *b, size_t count)\n{\n"
        "    for (size_t i = 0; i < count; i++)\n"
        "        if (((const unsigned char *)a)[i] != ((const unsigned char *)b)[i])\n            return 1;\n"
        "    return 0;\n}\n"
    ),
    "time.h": "#define CLOCKS_PER_SEC 1000000\n",
}
KERNEL = """
extern "C" __global__ void run_each(const step_cells *all, const double *values, double *kept, signed char *status, double *worst)
{
    const long i = (long)blockIdx.x*blockDim.x + threadIdx.x;
    if (i >= all->cells)
        return;
    step_lanes g;
    step_cells b = *all;
    double whole[WIDTH], taken = 0, changes = 0, newton = 0, failed_at = 0;
    b.cells = 1;
    b.step = -1;
    b.cell = 0;
    b.values = values + STEP_NP*i;
    b.kept = kept + b.rows*b.width*i;
    b.status = status + i;
    b.worst = worst + i;
    b.whole = whole;
    b.taken = &taken;
    b.changes = &changes;
    b.newton = &newton;
    b.failed_at = &failed_at;
    while (!step_run_lanes(&g, &b, 1e9, 0)) {}
}
"""


def grid_of(model: Model) -> TimeGrid:
    """The model's own grid."""
    return make_grid(model.bind(dict.fromkeys(model.parameters, 1.0)), None, None, None)


def source_of(model: Model) -> tuple[str, dict[str, str]]:
    """CUDA C++ of a model's runs, and the files that it includes."""
    source = write_source(spec_for_all_values(model, grid_of(model), 1e-9), "step", "", in_lanes=True)
    return f"{source.rollout}\n#define WIDTH 64\n{KERNEL}", {"step.c": source.code, "step.h": source.header}


def card() -> Any:
    """CuPy, where it finds a card; else None."""
    try:
        import cupy

        return cupy if cupy.cuda.runtime.getDeviceCount() else None
    except Exception as why:
        print(f"a graphics card: skipped, as CuPy finds none ({type(why).__name__}: {why})")
        return None


def of_one_file(model: Model) -> str:
    """The source with all that it includes: a card's compiler need not find any file."""
    text, files = source_of(model)
    for name, content in (files | HEADERS).items():
        text = text.replace(f'#include "{name}"', content).replace(f"#include <{name}>", content)
    return text


def on_card(cupy: Any, kernel: Any, values: np.ndarray, grid: TimeGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x at the end, status, worst residual) of each run."""
    cells, known = len(values), 1
    given, columns = cupy.asarray(values), cupy.asarray(np.arange(1))
    kept = cupy.full((cells, known + 1, 1), np.nan)
    status, worst = cupy.full(cells, -1, np.int8), cupy.zeros(cells)
    control = BATCH_CELLS.ctypes_structure()(
        cells=cells, steps=grid.N, every=grid.N, rows=known + 1, first=known, width=1, last=grid.step(grid.N - 1),
        columns=columns.data.ptr, step=-1,
    )  # fmt: skip
    record = cupy.asarray(np.frombuffer(bytes(control), np.uint8))
    kernel((-(-cells // THREADS),), (THREADS,), (record, given, kept, status, worst))
    return cupy.asnumpy(kept)[:, -1, 0], cupy.asnumpy(status), cupy.asnumpy(worst)


def main() -> None:
    """Print runs a second, the worst residual, and how far they are from C on the processor."""
    cupy = card()
    if cupy is None:
        return
    model = friction()
    grid, values = grid_of(model), np.resize(drawn((0.5, 1.5), (0.8, 1.2), (3, 6)), (RUNS, 3))
    kernel = cupy.RawModule(code=of_one_file(model), options=OPTIONS).get_function("run_each")
    on_card(cupy, kernel, values[:THREADS], grid)
    start = time.perf_counter()
    x, status, worst = on_card(cupy, kernel, values, grid)
    seconds = time.perf_counter() - start
    print(f"{RUNS} friction oscillators of {grid.N} steps on a card: {seconds:.2f} s with copies, {RUNS / seconds:.0f} runs/s")
    print(f"  done {int((status == 0).sum())}, worst residual {worst.max():.1e}")
    for words, in_lanes in (("lanes on the processor", True), ("scalar C", False)):
        found = StepBatch(model, grid, 1e-9, in_lanes=in_lanes).run(values[:COMPARED], ["x"], grid.N).arrays["x"][:, -1, 0]
        same = int((found == x[:COMPARED]).sum())
        print(f"  off {words}: {np.abs(found - x[:COMPARED]).max():.1e}, the same bits in {same} of {COMPARED} runs")


if __name__ == "__main__":
    main()
