"""Model files: a Python file that defines ``model``, or ``def model(**parameters)``."""

from __future__ import annotations

import difflib
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from copy import copy
from pathlib import Path
from typing import Any

from nsmodel import shelf
from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.model.base import Model
from nsmodel.model_files import MODULE_PREFIX, execute_module, folder_importable, module_spec


def load(path: str | Path, **parameters: Any) -> Model:
    """Return the model that the file at ``path`` defines; ``parameters`` go to its ``model`` function where it is one.

    ``path`` may be the name of a case (`nsmodel cases` lists them) where there is no file of that name.

    Raises:
        UsageError: the file is missing, or a parameter that its function does not take, or lacks.
        ModelError: the file fails, defines no ``model``, or something that is not one.
    """
    if note := shelf.shadowed_case_note(path):
        warnings.warn(note, stacklevel=2)
    path = shelf.case_or_file_path(path)
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
    path = shelf.case_or_file_path(path)
    found = _read_definition(path)
    taken = _keyword_arguments(found) if _is_model_function(found) else ()
    own = {name: value for name, value in values.items() if taken is None or name in taken}
    model = _call_model_function(found, path, own) if _is_model_function(found) else _check_loaded_model(found, path)
    declared = model.parameter_names
    for name in values:
        if name not in own and name not in declared:
            _check_not_constant(name, path)
            hint = difflib.get_close_matches(name, [*(taken or ()), *declared], 1)
            raise UsageError(
                f"{path} takes no '{name}': arguments of model() are {', '.join(taken or ()) or 'none'}, parameters of the model "
                f"{', '.join(declared) or 'none'}" + (f". Did you mean '{hint[0]}'?" if hint else "")
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
    found = _read_definition(shelf.case_or_file_path(path))
    return _keyword_arguments(found) if _is_model_function(found) else ()


def _read_definition(path: Path) -> Any:
    """What the file calls ``model``."""
    spec = module_spec(path, "" if path.is_file() else shelf.path_suggestion(path))
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
        raise ModelError(f"{path}:{_error_line(error, path)}: {type(error).__name__}: {what}") from error


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
