"""Rewrite the table of docs/codegen.md: what the C library of each case costs. Run it after a change of the generator."""

from __future__ import annotations

import contextlib
import re
import subprocess
import tempfile
from pathlib import Path

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


if __name__ == "__main__":
    main()
