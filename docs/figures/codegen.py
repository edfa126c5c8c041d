"""Rewrite the tables of docs/codegen.md: what the C library of each case costs, and some on a microcontroller.

Run it after a change of the generator. The second table needs arm-none-eabi-gcc, its newlib and qemu-system-arm.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import struct
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from page import put

import nsmodel
from nsmodel import codegen
from nsmodel.errors import CodegenError
from nsmodel.modeling.model_files import case_files

HEAD = ("case", "a step", "source, kB", "code, kB", "RAM, bytes", "work, at most")
SIZE = "(unsigned long)sizeof({name}_solver)"
MAIN = '#include "{name}.h"\n#include <stdio.h>\nint main(void) {{ printf("%lu", ' + SIZE + "); return 0; }}\n"


def row(path: Path, folder: Path) -> tuple[str, ...]:
    """The line of one case."""
    name = path.stem
    about = codegen.write(nsmodel.load(path), folder, name=name).about
    source = sum((folder / f"{name}.{end}").stat().st_size for end in "hc")
    subprocess.run(["gcc", "-std=c99", "-O2", "-c", f"{name}.c"], cwd=folder, check=True)
    text = subprocess.run(["size", f"{name}.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
    (folder / "ram.c").write_text(MAIN.format(name=name))
    subprocess.run(["gcc", "-o", "ram", "ram.c"], cwd=folder, check=True)
    ram = subprocess.run(["./ram"], cwd=folder, check=True, capture_output=True, text=True).stdout
    code = int(re.findall(r"^\s*(\d+)", text, re.MULTILINE)[0])
    return name, kind(about), f"{source / 1000:.1f}", f"{code / 1000:.1f}", f"{int(ram):,}", f"{about['max_work']:,}"


BOARD = Path(__file__).resolve().parents[1] / "examples" / "cortex_m4"
ARM = "arm-none-eabi-gcc -std=c99 -O2 -mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16".split()
QEMU = "qemu-system-arm -M mps2-an386 -nographic -semihosting -icount shift=0 -kernel board.elf".split()
TICK = 40  # Instructions of a tick: 25 MHz, and a nanosecond an instruction.
ON_BOARD = ("bouncing_ball", "bowling_ball", "woodpecker", "slider_crank", "diode_bridge", "friction_oscillator")
BOARD_HEAD = ("case", "code, kB", "RAM, bytes", "instructions a step", "in the longest one", "state beside x86-64")


def board_row(name: str, folder: Path) -> tuple[str, ...]:
    """A library on the processor that QEMU emulates: its size, instructions of its steps, its state beside this machine's."""
    model = nsmodel.load(name)
    codegen.write(model, folder, name=name)
    steps = min(round(model.t_end / model.step), 1000)
    given = [f"-DNAME={name}", f"-DSTEPS={steps}", f"-DSTATES={len(model.names)}", f"-D{name.upper()}_NO_MALLOC"]
    sources = [str(BOARD / "board.c"), str(BOARD / "main.c"), f"{name}.c"]
    link = ["-include", f"{name}.h", "-nostartfiles", "--specs=nosys.specs", f"-T{BOARD / 'board.ld'}", *sources, "-lm"]
    subprocess.run([*ARM, *given, *link, "-o", "board.elf"], cwd=folder, check=True, capture_output=True)
    subprocess.run([*ARM, "-c", f"{name}.c", "-o", "own.o"], cwd=folder, check=True)
    text = subprocess.run(["arm-none-eabi-size", "own.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
    code = int(re.findall(r"^\s*(\d+)", text, re.MULTILINE)[0])
    (folder / "ram.c").write_text(f'#include "{name}.h"\nchar ram[sizeof({name}_solver)];\n')
    subprocess.run([*ARM, "-c", "ram.c"], cwd=folder, check=True)
    text = subprocess.run(["arm-none-eabi-size", "ram.o"], cwd=folder, check=True, capture_output=True, text=True).stdout
    ram = sum(map(int, text.splitlines()[1].split()[1:3]))
    said = subprocess.run(QEMU, cwd=folder, check=True, capture_output=True, text=True, timeout=600).stderr.split()
    status, taken, ticks, longest = map(int, said[:4])
    if (status, taken) != (0, steps):
        raise SystemExit(f"{name}: {said}")
    state = np.array([struct.unpack(">d", bytes.fromhex(bits.rjust(16, "0")))[0] for bits in said[4:]])
    here = nsmodel.simulate(model, t_end=steps * model.step, compiled=True).x[-1]
    apart = np.abs(state - here).max() / np.abs(here).max()
    return (
        name,
        f"{code / 1000:.1f}",
        f"{ram:,}",
        f"{ticks * TICK // steps:,}",
        f"{longest * TICK:,}",
        f"{apart:.0e}" if apart else "0",
    )


def kind(about: dict) -> str:
    """How a step is computed, in a few words."""
    used = " ".join(about["used"])
    for words, name in (
        ("clip", "clip"), ("outer polyhedron", "cuts"), ("written down", "fixed matrices"), ("formed once", "kept matrices"),
        ("not in each step", "prepared matrices"), ("one linearisation", "linearised"),
    ):  # fmt: skip
        if words in used:
            return name
    return "Newton"


def main() -> None:
    """Measure and rewrite the table."""
    lines = ["| " + " | ".join(HEAD) + " |", "| --- | --- |" + " ---: |" * (len(HEAD) - 2)]
    for path in case_files().values():
        with tempfile.TemporaryDirectory() as folder, contextlib.suppress(CodegenError):  # f may be a Python function
            lines.append("| " + " | ".join(row(path, Path(folder))) + " |")
    put("codegen.md", "cost", "\n".join(lines))
    if shutil.which(ARM[0]) and shutil.which(QEMU[0]):
        lines = ["| " + " | ".join(BOARD_HEAD) + " |", "| --- |" + " ---: |" * (len(BOARD_HEAD) - 1)]
        for name in ON_BOARD:
            with tempfile.TemporaryDirectory() as folder:
                lines.append("| " + " | ".join(board_row(name, Path(folder))) + " |")
        put("codegen.md", "board", "\n".join(lines))


if __name__ == "__main__":
    main()
