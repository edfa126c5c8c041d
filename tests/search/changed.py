"""The numbers at the top of modules, and a module as it is with another number."""

from __future__ import annotations

import ast
import importlib.machinery
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast


class Number(NamedTuple):
    """A number at the top of a module: in which line, its name, and its place where the line has several."""

    path: Path
    line: int
    name: str
    place: int | None = None


def numbers(path: Path) -> Iterator[Number]:
    """The numbers at the top of a module, or of the modules of a folder."""
    for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
        for node in ast.parse(file.read_text()).body:
            if not (isinstance(node, ast.Assign) and _is_numeric(node.value)):
                continue
            target, several = node.targets[0], isinstance(node.value, ast.Tuple)
            for k in range(len(cast(ast.Tuple, node.value).elts) if several else 1):
                name = target.elts[k] if isinstance(target, ast.Tuple) else target
                text = ast.unparse(name) + f"[{k}]" * (several and name is target)
                yield Number(file, node.lineno, f"{file.stem}.{text}", k if several else None)


def _is_numeric(node: ast.expr) -> bool:
    if isinstance(node, ast.Tuple):
        return bool(node.elts) and all(map(_is_numeric, node.elts))
    if isinstance(node, ast.BinOp):
        return _is_numeric(node.left) or _is_numeric(node.right)
    return _is_numeric(node.operand) if isinstance(node, ast.UnaryOp) else type(getattr(node, "value", None)) in (int, float)


def scaled(value: Any, up: bool) -> Any:
    """Ten times or a tenth; of a whole number twice or half, but not 0."""
    if isinstance(value, tuple):
        return tuple(scaled(v, up) for v in value)
    if isinstance(value, int):
        return 2 * value if up else value // 2 or value
    return value * 10.0 if up else value / 10.0


class Changed(importlib.machinery.SourceFileLoader):
    """Finds and loads one module, with one of its numbers changed."""

    def __init__(self, number: Number, up: bool) -> None:
        super().__init__(".".join(number.path.with_suffix("").parts), str(number.path.resolve()))
        self.number, self.up = number, up

    def find_spec(self, name: str, *_: Any) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_file_location(name, self.path, loader=self) if name == self.name else None

    def get_code(self, fullname: str) -> Any:
        tree = ast.parse(Path(self.path).read_text())
        node = cast(ast.Assign, next(node for node in tree.body if node.lineno == self.number.line))
        values = [node.value] if self.number.place is None else cast(ast.Tuple, node.value).elts
        k = self.number.place or 0
        values[k] = ast.Call(ast.Name("_scaled", ast.Load()), [values[k], ast.Constant(self.up)], [])
        node.value = node.value if self.number.place is not None else values[0]
        return compile(ast.fix_missing_locations(tree), self.path, "exec")

    def exec_module(self, module: Any) -> None:
        module.__dict__["_scaled"] = scaled
        super().exec_module(module)
