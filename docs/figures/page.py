"""Tables of a page, each between marks: ``<!-- table: NAME -->``, ``<!-- end -->``; pictures of few colours; model files."""

from __future__ import annotations

import io
import re
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

DOCS = Path(__file__).resolve().parents[1]


def put(page: str, name: str, text: str) -> None:
    """Print a table and write it between its marks on a page of docs/."""
    print(f"{name}\n\n{text}\n", flush=True)
    path = DOCS / page
    before = path.read_text(encoding="utf-8")
    mark = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(<!-- end -->)", re.DOTALL)
    after, found = mark.subn(lambda marks: f"{marks[1]}\n{text}\n\n{marks[2]}", before)
    if found != 1:
        raise SystemExit(f"{path}: expected one mark for the table {name}, found {found}")
    path.write_text(after, encoding="utf-8")


def model_file(page: str, name: str) -> str:
    """The text of a model file that stands on a page of docs/."""
    text = (DOCS / page).read_text(encoding="utf-8")
    found = re.search(rf"^```python model-file {re.escape(name)}.*\n((?:.*\n)*?)```$", text, re.MULTILINE)
    if found is None:
        raise SystemExit(f"{page} has no model file {name}")
    return found[1]


def save(figure: Figure, path: Path, colours: int, dpi: int = 110) -> None:
    """Write a picture with so many colours at most, which is small."""
    memory = io.BytesIO()
    figure.savefig(memory, dpi=dpi)
    Image.open(memory).convert("RGB").quantize(colours, dither=Image.Dither.NONE).save(path, optimize=True)
