"""What to edit where a test fails: the page, the case and the lines of nsmodel that its report names."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

from nsmodel.modeling.model_files import case_files

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "nsmodel"


def files_to_edit(function: FunctionType, parameters: Mapping[str, Any], traceback: Iterable[tuple[Path, int, str]]) -> list[str]:
    """The files of the product that a failed test is about, one a line.

    Pages and cases are those that the test is given or names. Of nsmodel it is the innermost frame (path, line, function) of the
    traceback; where the test's own comparison fails, the modules of what the test calls, also through helpers in its file.
    """
    named = {**dict.fromkeys(map(_page_or_case, parameters.values())), **dict.fromkeys(_cases_of(function))}
    frames = [frame for frame in traceback if Path(frame[0]).is_relative_to(PACKAGE)]
    if frames:
        path, line, name = frames[-1]
        found = [f"{_in_repository(path)}:{line} in {name}"]
    else:
        found = sorted(set(_called_modules(function, set())))
    return [*filter(None, named), *found]


def _in_repository(path: str | Path) -> str:
    return Path(path).relative_to(REPOSITORY).as_posix()


def _page_or_case(value: Any) -> str | None:
    """The file that the parameter of a test is or names; with its line where it is a block of a page."""
    page = getattr(value, "page", value)
    if isinstance(page, Path) and page.is_relative_to(REPOSITORY):
        return _in_repository(page) + (f":{value.line}" if hasattr(value, "line") else "")
    return _in_repository(case_files()[value]) if isinstance(value, str) and value in case_files() else None


def _cases_of(function: FunctionType) -> list[str | None]:
    return [_page_or_case(constant) for constant in function.__code__.co_consts]


def _names(code: CodeType) -> Iterator[str]:
    """All names of a function's code, those of functions inside it too."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _called_modules(function: FunctionType, seen: set[FunctionType]) -> Iterator[str]:
    seen.add(function)
    names = list(_names(function.__code__))
    used = [function.__globals__[name] for name in names if name in function.__globals__]
    for module in [value for value in used if isinstance(value, ModuleType) and value.__name__.startswith("nsmodel")]:
        used += [getattr(module, name) for name in names if hasattr(module, name)]
    for value in map(inspect.unwrap, used):
        if isinstance(value, FunctionType) and value.__globals__ is function.__globals__ and value not in seen:
            yield from _called_modules(value, seen)
        elif callable(value) and (module := inspect.getmodule(value)) and Path(module.__file__ or "").is_relative_to(PACKAGE):
            yield _in_repository(module.__file__)
