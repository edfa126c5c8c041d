"""Functions and modules that can be read at once."""

import ast
import io
import tokenize
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "nsmodel"
STATEMENTS, LINES = 40, 350  # of a function, of a module
EXCEPTIONS = {  # A module that is one idea, longer than others.
    "certificate/verify.py": "a stranger reads it alone, as one file",
    "run/controlled.py": "one walk, every part of which reads and moves the same place",
    "solve/build.py": "the ways to compute one step, which fall back on one another",
}
MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
NO_STATEMENT = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER, tokenize.ENCODING
}  # fmt: skip


def long_functions(text):
    """(name, lines of statements) of the functions beyond the limit; docstrings, comments and blank lines do not count."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = {line for token in tokens if token.type not in NO_STATEMENT for line in range(token.start[0], token.end[0] + 1)}
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node, clean=False) is not None:
            lines -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            count = len(lines & set(range(node.body[0].lineno, node.end_lineno + 1)))
            if count > STATEMENTS:
                yield node.name, count


@pytest.mark.parametrize("name", MODULES)
def test_functions_and_modules_are_short(name):
    text = (PACKAGE / name).read_text()
    if name in EXCEPTIONS:
        assert len(text.splitlines()) > LINES
    else:
        assert len(text.splitlines()) <= LINES
    assert list(long_functions(text)) == []


def test_exceptions_are_modules_of_the_package():
    assert set(EXCEPTIONS) <= set(MODULES)


def test_what_counts_as_a_statement():
    body = ["    a = 1\n", "    # about b\n", "\n", '    b = """\n', "    two lines\n", '    """\n']
    text = 'def f():\n    """Says.\n\n    More.\n    """\n' + "".join(body * (STATEMENTS // 4))
    assert list(long_functions(text)) == []
    assert list(long_functions(text + "    return b\n")) == [("f", STATEMENTS + 1)]
    nested = "def outer():\n    def inner():\n" + "        a = 1\n" * STATEMENTS
    assert list(long_functions(nested)) == [("outer", STATEMENTS + 1)]
