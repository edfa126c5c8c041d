"""Every code block of the documentation runs, and prints what the page shows.

A ``python`` block runs as a script. ``python model-file NAME.py exit=3`` is a model file: it must run with this exit status
(0 where none is given); ``picture`` asks the site for one of its run. One marked ``compiler`` is left out where there is none.
The ``{code-cell}`` blocks of a page are a notebook: they run in order, and know what those before them did.
``python peer PROGRAM`` is a script of another program: it runs where that is installed, and else is compiled only.
A ``text`` block right after either is its output. In a ``console`` block each ``$ nsmodel ...`` line
runs, and the lines after it are its output. Each block runs in a new folder with the page's model files and ``cases/`` in it.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import re
import shlex
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
from bench.peers import programs

from nsmodel.cli import main
from nsmodel.codegen import library as codegen_library
from nsmodel.study import methods

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
PAGES = [REPOSITORY / "README.md", *sorted(page for page in DOCS.rglob("*.md") if page.relative_to(DOCS).parts[0] != "gallery")]
LARGEST_PICTURE = 150_000

NUMBER = re.compile(r"\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
ROUNDING = 1e-8  # Below it a number is round-off: two of them are the same.


@dataclass(frozen=True, repr=False)
class Block:
    """A fenced block: its page, the line of its first code line, the words after the fence, and the output that follows."""

    page: Path
    line: int
    words: tuple[str, ...]
    code: str
    output: str | None

    @property
    def is_model_file(self) -> bool:
        return self.words[:2] == ("python", "model-file")

    def __str__(self) -> str:
        return f"{named(self.page)}:{self.line}"


def named(page):
    """The page, from docs/ on."""
    return page.relative_to(DOCS).as_posix() if page.is_relative_to(DOCS) else page.name


def blocks_of(page):
    """All fenced blocks of a page in order."""
    fences = list(re.finditer(r"^```(.*)\n((?:.*\n)*?)```$", page.read_text(encoding="utf-8"), re.MULTILINE))
    found = []
    for i, fence in enumerate(fences):
        following = fences[i + 1] if i + 1 < len(fences) else None
        is_output = following is not None and following[1] == "text" and not fence.string[fence.end() : following.start()].strip()
        line = fence.string.count("\n", 0, fence.start(2)) + 1
        found.append(Block(page, line, tuple(fence[1].split()), fence[2], following[2] if is_output else None))
    return found


BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def blocks(kind):
    chosen = [b for b in BLOCKS if b.words[:1] == (kind,)]
    return pytest.mark.parametrize("block", chosen, ids=str)


@pytest.fixture
def folder(tmp_path, monkeypatch, request):
    """A working folder with the page's model files and the cases."""
    for block in blocks_of(request.getfixturevalue("block").page):
        if block.is_model_file:
            (tmp_path / block.words[2]).write_text(block.code, encoding="utf-8")
    (tmp_path / "cases").symlink_to(REPOSITORY / "cases")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setattr(methods, "LONG_RUN_SECONDS", 0.0)  # Each run of a study is made once: no page is held to its seconds.
    return tmp_path


def printed(function, *arguments):
    """(what ``function`` returns, what it prints on either stream)."""
    stream = io.StringIO()
    with contextlib.redirect_stdout(stream), contextlib.redirect_stderr(stream):
        result = function(*arguments)
    return result, stream.getvalue()


def printed_by_peer(block):
    """What a peer's script prints; None where the program is not installed. Its syntax is looked at in either case."""
    compile(block.code, str(block), "exec")
    peer = block.words[2]
    python = programs.siconos() if peer == "siconos" else programs.from_pypi(peer)
    return python and subprocess.run([python, "-c", block.code], capture_output=True, text=True, check=True).stdout


def assert_shown(expected, actual, where):
    """The page's ``expected`` output is ``actual``: numbers within 0.1 %, timings left aside, ``...`` for anything."""
    __tracebackhide__ = True
    expected, actual = (settled(text) for text in (expected, actual))
    pieces = re.split(rf"(\.\.\.|\s+|{NUMBER.pattern})", expected)
    pattern, numbers = "", []
    for piece in pieces:
        if piece == "...":
            pattern += ".*?"
        elif piece.isspace():
            pattern += r"\s+"
        elif NUMBER.fullmatch(piece):
            pattern += f"({NUMBER.pattern})"
            numbers.append(float(piece))
        else:
            pattern += re.escape(piece)
    match = re.fullmatch(pattern, actual, re.DOTALL)
    same = match is not None and all(
        abs(float(found) - number) <= max(1e-3 * abs(number), ROUNDING)
        for found, number in zip(match.groups(), numbers, strict=True)
    )
    if not same:
        difference = difflib.unified_diff(expected.splitlines(), actual.splitlines(), "on the page", "printed", lineterm="")
        pytest.fail(f"{where} prints something else:\n" + "\n".join(difference))


def settled(text):
    """The text without what differs from machine to machine: timings, and where the worst residual was."""
    lines = [line.rstrip() for line in text.splitlines() if not line.lstrip().startswith("run time")]
    return "\n".join(re.sub(r"(worst residual .*?) at t = .*", r"\1", line) for line in lines).strip()


@blocks("python")
def test_python_block_runs_and_prints_what_the_page_shows(block, folder):
    if "compiler" in block.words and codegen_library.compiler() is None:
        pytest.skip("no C compiler")
    if "peer" in block.words:
        output = printed_by_peer(block)
        if output is None:
            pytest.skip(f"no {block.words[2]}")
    elif block.is_model_file:
        options = dict(word.split("=") for word in block.words[3:] if "=" in word)
        status, output = printed(main, ["run", block.words[2]])
        assert status == int(options.get("exit", 0)), output
    else:
        code = compile("\n" * (block.line - 1) + block.code, str(block.page), "exec")
        _, output = printed(exec, code, {"__name__": "__main__"})
    if block.output is not None:
        assert_shown(block.output, output, block)


NOTEBOOKS = sorted({block.page for block in BLOCKS if block.words[:1] == ("{code-cell}",)})
STUDIES = pytest.mark.long  # of notebooks that measure run times


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=STUDIES if page.stem == "accuracy" else ()) for page in NOTEBOOKS], ids=named
)
def test_the_cells_of_a_notebook_run_in_order(page, tmp_path, monkeypatch):
    (tmp_path / "cases").symlink_to(REPOSITORY / "cases")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    names = {"__name__": "__main__"}
    for block in blocks_of(page):
        if block.words[:1] == ("{code-cell}",):
            text = re.sub(r"^:.*", "", block.code, flags=re.MULTILINE)  # options of the cell
            printed(exec, compile("\n" * (block.line - 1) + text, str(page), "exec"), names)


@blocks("console")
def test_console_block_prints_what_the_page_shows(block, folder):
    commands = re.split(r"^\$ ", block.code, flags=re.MULTILINE)
    assert not commands[0].strip()
    for command in commands[1:]:
        line, _, expected = command.partition("\n")
        program, *arguments = shlex.split(line, comments=True)
        assert program == "nsmodel"
        assert_shown(expected, printed(main, arguments)[1], f"{block}: $ {line}")


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_of_a_page_lead_somewhere_and_pictures_are_small(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)", text):
        if "://" not in target:
            path = page.parent / target
            assert path.exists(), f"{named(page)} refers to {target}"
            assert path.suffix != ".png" or path.stat().st_size < LARGEST_PICTURE


def test_a_wrong_output_is_seen():
    assert_shown("x = 1.0000 ...\n  run time 3 s", "x = 1.0002 and more", "page")
    for wrong in ("x = 1.1", "y = 1.0", "x = 1.0 z"):
        with pytest.raises(pytest.fail.Exception, match="prints something else"):
            assert_shown("x = 1.0", wrong, "page")
