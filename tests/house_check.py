"""Measure the structure of the package beside its limits: ``python tests/house_check.py [--list MEASURE]``.

The exit status is 1 where a measure exceeds its limit. Which package may import which is a contract in ``pyproject.toml``
(``lint-imports``); what is counted here is what that contract does not see.
"""

from __future__ import annotations

import argparse
import ast
import gc
import re
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import grimp
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

REPOSITORY = Path(__file__).resolve().parents[1]
LIMITS = {  # A structure that needs more is to be thought over; a limit that has become loose is lowered.
    "packages": 14,
    "loose modules": 5,
    "files": 350,
    "lines of the longest module": 700,
    "lines of verify.py": 1500,
    "import circles": 0,
    "upward imports": 0,
    "modules found by strings": 8,
    "class names used twice": 0,
    "banned words": 0,
    "short docstrings": 0,
    "options given by position": 0,
    "bytes of docs/architecture.md": 20_000,
}
SHORT = 14  # Characters of a docstring that is too short to say anything.
BANNED = set(  # No name in the code and no file has one of these as a part; the glossary has the word to take.
    """
    told beside standing noted noting settled settle later brief twins course asked stretch stretches turns turned walk pace
    shelf judge misfits begun anew torn there arranged sure quiet felt shown words apart refuse MOST LEAST
    """.split()
)
ALLOWED = {"LaterFormatError", "beside"}  # Public names: an error, an argument of `nsmodel.crowd`.
Modules = dict[Path, list[ast.AST]]  # The nodes of each file, the module first.
PART_OF_NAME = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")


def read_modules() -> Modules:
    """Parse every file of the package."""
    paths = sorted((REPOSITORY / "nsmodel").rglob("*.py"))
    gc.disable()  # A million nodes, none of them garbage: looking for some takes most of the time.
    try:
        return {path.relative_to(REPOSITORY): list(ast.walk(ast.parse(path.read_text()))) for path in paths}
    finally:
        gc.enable()


def find_import_circles(graph: grimp.ImportGraph) -> list[str]:
    """Return the sets of modules that import each other, also inside functions and for type checkers alone."""
    names = sorted(graph.modules)
    place = {name: i for i, name in enumerate(names)}
    arrows = np.array([(place[a], place[b]) for a in names for b in graph.find_modules_directly_imported_by(a)]).T
    matrix = csr_array((np.ones(arrows.shape[1]), arrows), shape=(len(names), len(names)))
    circles = defaultdict(list)
    for name, label in zip(names, connected_components(matrix, connection="strong")[1], strict=True):
        circles[label].append(name)
    return [" ".join(circle) for circle in circles.values() if len(circle) > 1]


def find_upward_imports(graph: grimp.ImportGraph) -> list[str]:
    """Return the imports of a package by one that the contract in ``pyproject.toml`` has in a line below."""
    contracts = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["id"] == "layers")
    rank = {f"nsmodel.{part}": -i for i, line in enumerate(layers) for part in re.findall(r"\w+", line)}
    packages = {name: ".".join(name.split(".")[:2]) for name in graph.modules}
    return [
        f"{name} imports {imported}"
        for name in sorted(graph.modules)
        for imported in sorted(graph.find_modules_directly_imported_by(name))
        if name != "nsmodel" and rank.get(packages[imported], 1) > rank.get(packages[name], 1)
    ]


def find_modules_by_string(modules: Modules) -> Iterator[str]:
    """Yield the calls that import a module by a name in a string, which no tool follows."""
    for path, call in calls(modules):
        called, first = getattr(call.func, "id", getattr(call.func, "attr", "")), call.args[0] if call.args else None
        is_text = isinstance(first, ast.JoinedStr) or isinstance(getattr(first, "value", None), str)
        if called == "import_module" or (called in ("part", "optional") and isinstance(call.func, ast.Attribute) and is_text):
            yield f"{path}:{call.lineno} {ast.unparse(call)}"


def find_options_by_position(modules: Modules) -> Iterator[str]:
    """Yield the calls of ``Options`` that do not name what they give."""
    return (f"{path}:{call.lineno}" for path, call in calls(modules) if getattr(call.func, "id", "") == "Options" and call.args)


def calls(modules: Modules) -> Iterator[tuple[Path, ast.Call]]:
    """Yield every call with the file in which it stands."""
    return ((path, node) for path, nodes in modules.items() for node in nodes if isinstance(node, ast.Call))


def find_repeated_class_names(modules: Modules) -> list[str]:
    """Return the class names that two modules have; an underscore before the name makes it no other name."""
    classes = [node for nodes in modules.values() for node in nodes[0].body if isinstance(node, ast.ClassDef)]
    count = Counter(node.name.lstrip("_") for node in classes)
    return [f"{name} in {number} modules" for name, number in count.items() if number > 1]


def find_banned_words(modules: Modules) -> Iterator[str]:
    """Yield the files, and the names that the code binds, of which a part is banned."""
    for path, nodes in modules.items():
        for name, line in [(path.stem, 0), *bound_names(nodes)]:
            parts = {name, *PART_OF_NAME.findall(name)}
            if name not in ALLOWED and BANNED & (parts | {part.lower() for part in parts}):
                yield f"{path}:{line} {name}"


def bound_names(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, int]]:
    """Yield functions, classes, arguments, variables and attributes that a module binds, each with its line."""
    for node in nodes:
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
                yield name, node.lineno
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name, node.lineno


def find_short_docstrings(modules: Modules) -> Iterator[str]:
    """Yield the docstrings that are too short to say what something returns or does."""
    for path, nodes in modules.items():
        for node in nodes:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
                text = ast.get_docstring(node)
                if text is not None and len(text) <= SHORT:
                    yield f"{path}:{node.body[0].lineno} {text!r}"


def measure() -> dict[str, tuple[int, list[str]]]:
    """Return each measure of ``LIMITS``: its number, and what stands behind it."""
    modules, graph = read_modules(), grimp.build_graph("nsmodel", cache_dir=None)
    lengths = {str(path): len((REPOSITORY / path).read_text().splitlines()) for path in modules}
    alone = str(next(path for path in modules if path.name == "verify.py"))  # One file that a stranger reads.
    verifier = lengths.pop(alone)
    document = REPOSITORY / "docs" / "architecture.md"
    loose = [path.stem for path in modules if len(path.parts) == 2 and not path.stem.startswith("__")]

    def count(found: Iterable[str]) -> tuple[int, list[str]]:
        found = list(found)
        return len(found), found

    return {
        "packages": count(sorted({path.parts[1] for path in modules if len(path.parts) > 2})),
        "loose modules": count(loose),
        "files": count(map(str, modules)),
        "lines of the longest module": (max(lengths.values()), sorted(lengths, key=lengths.__getitem__)[-5:]),
        "lines of verify.py": (verifier, [alone]),
        "import circles": count(find_import_circles(graph)),
        "upward imports": count(find_upward_imports(graph)),
        "modules found by strings": count(find_modules_by_string(modules)),
        "class names used twice": count(find_repeated_class_names(modules)),
        "banned words": count(find_banned_words(modules)),
        "short docstrings": count(find_short_docstrings(modules)),
        "options given by position": count(find_options_by_position(modules)),
        "bytes of docs/architecture.md": (document.stat().st_size, [str(document)]),
    }


def main() -> int:
    """Print each measure beside its limit, or what stands behind one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", metavar="MEASURE", choices=LIMITS, help="print what stands behind this number")
    chosen = parser.parse_args().list
    sys.path.insert(0, str(REPOSITORY))
    found = measure()
    if chosen:
        print(*found[chosen][1], sep="\n")
        return 0
    for name, limit in LIMITS.items():
        print(f"{name:30} {found[name][0]:6}   at most {limit:6} {'   EXCEEDED' if found[name][0] > limit else ''}".rstrip())
    return int(any(found[name][0] > limit for name, limit in LIMITS.items()))


if __name__ == "__main__":
    sys.exit(main())
