"""Model files: a Python file that defines ``model``, or ``def model(**parameters)``.

The cases that come with the package: model files to run, read and copy, each described by its own docstring.
"""

from __future__ import annotations

import ast
import difflib
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nsmodel._utils import did_you_mean, short_repr
from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.modeling.base import Model
from nsmodel.modeling.pickling import MODULE_PREFIX, current_path, execute_module, folder_importable, module_spec

TOPICS = ("circuits", "control", "mechanics", "crowds", "biology", "mathematics")
_PACKAGE = Path(__file__).parents[1]
_CASE_FOLDERS = (_PACKAGE / "cases", _PACKAGE.parent / "cases")  # as installed; in a checkout


@dataclass(frozen=True)
class Case:
    """A case: its name, its file, and what the paragraphs of the file's docstring say.

    ``title`` is the first line, ``story`` what stands between it and the paragraphs that begin with a label, which are ``see``
    ("What to see:"), ``wrong`` ("A wrong answer:" and how it would show) and ``source`` ("Source:"). A paragraph that is not
    there is "". ``topic`` is the name of the file's folder, one of TOPICS.
    """

    name: str
    path: Path
    title: str
    story: str
    see: str
    wrong: str
    source: str
    topic: str

    __repr__ = short_repr


def all_cases() -> tuple[Case, ...]:
    """All cases, by name.

    Raises:
        UsageError: this installation has none.
    """
    found = case_files()
    if not found:
        raise UsageError(f"no cases beside the package: expected the folder {_CASE_FOLDERS[0]}; install nsmodel anew")
    return tuple(map(read_case, found.values()))


def case_files() -> dict[str, Path]:
    """The files of the cases by name; empty where this installation has none."""
    folder = next((place for place in _CASE_FOLDERS if place.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted(folder.glob("*/*.py"), key=lambda path: path.stem)}


def case_or_file_path(given: str | Path) -> Path:
    """The file that is given, where it lies now; that of the case of this name where there is no such file."""
    path = current_path(Path(given))
    return path if path.is_file() else case_files().get(str(given), path)


def file_note(given: str | Path) -> str:
    """What to know where a file has moved, or a name is that of a case and of a file NAME.py too; "" elsewhere."""
    path = Path(given)
    if (now := current_path(path)) != path:
        return f"{path} is {now} now"
    other = path.is_file() or str(given) not in case_files() or not Path(f"{given}.py").is_file()
    return "" if other else f"{given} is the case that comes with nsmodel; {given}.py here is another file"


def path_suggestion(path: Path) -> str:
    """What a path that is no file may be meant for, as a question; "" where nothing is near."""
    if (own := path.with_name(f"{path.name}.py")).is_file():
        return f"did you mean {own}?"
    here = {str(path.with_name(one.name)) for one in path.parent.glob("*.py")}
    near = difflib.get_close_matches(str(path), [*case_files(), *sorted(here)], 3, 0.7)
    return f"did you mean {' or '.join(near)}?" if near else ""


def find_case(name: str) -> Case:
    """The case of that name.

    Raises:
        UsageError: there is none; the message has the names that are near.
    """
    found = {case.name: case for case in all_cases()}
    if name not in found:
        near = difflib.get_close_matches(name, found, 3)
        what = f"did you mean {', '.join(near)}?" if near else f"nsmodel cases lists the {len(found)} that there are"
        raise UsageError(f"no case '{name}'; {what}")
    return found[name]


def read_case(path: Path) -> Case:
    """The case in a file, which is read and not run."""
    title, *paragraphs = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n\n")
    labels = {"What to see:": "", "A wrong answer:": "", "Source:": ""}
    story = []
    for paragraph in paragraphs:
        label = next((label for label in labels if paragraph.startswith(label)), None)
        if label is None:
            story.append(paragraph)
        else:
            labels[label] = paragraph.removeprefix(label).strip()
    return Case(path.stem, path, " ".join(title.split()), "\n\n".join(story), *labels.values(), topic=path.parent.name)


def load(path: str | Path, **parameters: Any) -> Model:
    """Return the model that the file at ``path`` defines; ``parameters`` go to its ``model`` function where it is one.

    ``path`` may be the name of a case (`nsmodel cases` lists them) where there is no file of that name.

    Raises:
        UsageError: the file is missing, or a parameter that its function does not take, or lacks.
        ModelError: the file fails, defines no ``model``, or something that is not one.
    """
    if note := file_note(path):
        warnings.warn(note, stacklevel=2)
    path = case_or_file_path(path)
    found = _read_definition(path)
    if _is_model_function(found):
        taken = _keyword_arguments(found)
        for name in parameters:
            if taken is not None and name not in taken:
                raise UsageError(f"{path}: model() takes no '{name}'; it takes {', '.join(taken) or 'nothing'}")
        return _call_model_function(found, path, parameters)
    if parameters:
        raise UsageError(f"{path} defines a model, not a function: it takes no {', '.join(parameters)}")
    return _check_loaded_model(found, path)


def load_with_values(path: str | Path, values: Mapping[str, Any]) -> tuple[Model, dict[str, Any]]:
    """Return the model built with those ``values`` that its function takes, and the values of its own parameters.

    Raises:
        UsageError: a name that is neither; and as for `load`.
        ModelError: as for `load`.
    """
    path = case_or_file_path(path)
    found = _read_definition(path)
    taken = _keyword_arguments(found) if _is_model_function(found) else ()
    own = {name: value for name, value in values.items() if taken is None or name in taken}
    model = _call_model_function(found, path, own) if _is_model_function(found) else _check_loaded_model(found, path)
    declared = model.parameter_names
    for name in values:
        if name not in own and name not in declared:
            _check_not_constant(name, path)
            raise UsageError(
                f"{path} takes no '{name}': arguments of model() are {', '.join(taken or ()) or 'none'}, parameters of the model "
                f"{', '.join(declared) or 'none'}" + did_you_mean(name, [*(taken or ()), *declared])
            )
    return model, {name: value for name, value in values.items() if name in declared}


def _check_not_constant(name: str, path: Path) -> None:
    """Raise UsageError for the name of a number that the file, which was just run, writes down."""
    value = getattr(sys.modules.get(f"{MODULE_PREFIX}{path.stem}"), name, None)
    if isinstance(value, int | float) and not isinstance(value, bool):
        raise UsageError(
            f"{path}: {name} = {value:g} is a number in this file and no parameter; declare it as a parameter, "
            f"{name} = ca.SX.sym('{name}') with parameters={{{name}: {value:g}}}, or as an argument, def model({name}={value:g})"
        )


def model_arguments(path: str | Path) -> tuple[str, ...] | None:
    """Names that the file's ``model`` function takes, none where it is a model; None where it takes any. Errors as for `load`."""
    found = _read_definition(case_or_file_path(path))
    return _keyword_arguments(found) if _is_model_function(found) else ()


def _read_definition(path: Path) -> Any:
    """What the file calls ``model``."""
    spec = module_spec(path, "" if path.is_file() else path_suggestion(path))
    module = _run_file_code(lambda: execute_module(spec), path)
    if not hasattr(module, "model"):
        raise ModelError(f"{path} defines no 'model'; end the file with model = LureSystem(...) or def model(): ...")
    return module.model


def _is_model_function(found: Any) -> bool:
    return callable(found) and not isinstance(found, Model | type)


def _keyword_arguments(function: Callable) -> tuple[str, ...] | None:
    """Names that a function takes as keywords; None where it takes any."""
    try:
        given = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return ()
    if any(p.kind is p.VAR_KEYWORD for p in given):
        return None
    return tuple(p.name for p in given if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY))


def _call_model_function(function: Callable, path: Path, arguments: Mapping[str, Any]) -> Model:
    needed = inspect.signature(function).parameters.values() if inspect.isfunction(function) else ()
    for p in needed:
        if p.default is p.empty and p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY) and p.name not in arguments:
            raise UsageError(f"{path}: model() needs a value for '{p.name}'; give it with --set {p.name}=VALUE, or a default")
    return _check_loaded_model(_run_file_code(lambda: function(**arguments), path), path)


def _check_loaded_model(found: Any, path: Path) -> Model:
    """``found`` if it is a model, with the file's name as its title where it has none."""
    if isinstance(found, type):
        raise ModelError(f"{path}: model is the class {found.__name__} itself; write model = {found.__name__}(...)")
    if not isinstance(found, Model):
        raise ModelError(f"{path}: model is of type {type(found).__name__}; expected one of nsmodel's model classes")
    if found.title:
        return found
    titled = copy(found)
    titled._set(title=os.fsencode(path.stem).decode(errors="replace"))  # a file's name need not be text
    return titled


def _run_file_code(action: Callable[[], Any], path: Path) -> Any:
    """Run code of the file; whatever fails in it becomes an error that names the file and the line."""
    try:
        with folder_importable(path):
            return action()
    except NsmodelError as error:
        raise type(error)(f"{path}:{_error_line(error, path)}: {error}") from error
    except (Exception, SystemExit) as error:
        what = error.msg if isinstance(error, SyntaxError) else error
        hint = SYMBOLIC_CONDITION if "truth value of a CasADi" in str(error) else ""
        raise ModelError(f"{path}:{_error_line(error, path)}: {type(error).__name__}: {what}{hint}") from error


SYMBOLIC_CONDITION = (
    " A condition on a state has no value while the model is written: ca.if_else(x > 0, a, b) is a field that switches, a law "
    "(relay, complementarity) says what holds on the switch, a block what an event sets"
)


def _error_line(error: BaseException, path: Path) -> int | str:
    """The last line of the file that took part; the line itself for a syntax error."""
    if isinstance(error, SyntaxError) and error.filename and _is_same_file(error.filename, path):
        return error.lineno or "?"
    trace, line = error.__traceback__, "?"
    while trace is not None:
        if _is_same_file(trace.tb_frame.f_code.co_filename, path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


def _is_same_file(name: str, path: Path) -> bool:
    return Path(name).absolute() == path.absolute()
