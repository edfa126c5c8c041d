"""Model files: a Python file that defines ``model``, or ``def model(**parameters)``."""

from __future__ import annotations

import importlib.util
import inspect
import sys
from pathlib import Path
from typing import Any

from nsmodel.errors import ModelError, NsmodelError, UsageError
from nsmodel.model.base import Model


def load(path: str | Path, **parameters: Any) -> Model:
    """Return the model that a file defines; ``parameters`` go to its ``model`` function where it is one.

    Raises:
        UsageError: the file is missing, or a parameter that its function does not take.
        ModelError: the file fails, defines no ``model``, or something that is not one.
    """
    path = Path(path)
    if not path.is_file():
        raise UsageError(f"model file '{path}' does not exist; give the path of a Python file that defines model = ...")
    name = f"nsmodel_file_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"'{path}' is not a Python file (.py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except NsmodelError:
        raise
    except Exception as error:
        raise ModelError(f"{path}:{_line_in(error, path)}: {type(error).__name__}: {error}") from error
    found = getattr(module, "model", None)
    if found is None:
        raise ModelError(f"{path} defines no 'model'; end the file with model = LureSystem(...) or def model(): ...")
    if callable(found) and not isinstance(found, Model):
        found = _call(found, path, parameters)
    elif parameters:
        raise UsageError(f"{path} defines a model, not a function: it takes no {', '.join(parameters)}")
    if not isinstance(found, Model):
        raise ModelError(f"{path}: model is a {type(found).__name__}; expected one of nsmodel's model classes")
    return found


def takes(path: str | Path) -> tuple[str, ...]:
    """Names of the arguments of the file's ``model`` function; empty where ``model`` is not a function."""
    module = sys.modules.get(f"nsmodel_file_{Path(path).stem}")
    found = getattr(module, "model", None)
    return tuple(inspect.signature(found).parameters) if inspect.isfunction(found) else ()


def _call(function: Any, path: Path, parameters: dict[str, Any]) -> Any:
    known = inspect.signature(function).parameters
    if not any(p.kind is p.VAR_KEYWORD for p in known.values()):
        for name in parameters:
            if name not in known:
                raise UsageError(f"{path}: model() takes no '{name}'; it takes {', '.join(known) or 'nothing'}")
    try:
        return function(**parameters)
    except NsmodelError:
        raise
    except Exception as error:
        raise ModelError(f"{path}:{_line_in(error, path)}: {type(error).__name__}: {error}") from error


def _line_in(error: BaseException, path: Path) -> int | str:
    trace, line = error.__traceback__, "?"
    if isinstance(error, SyntaxError) and error.lineno:
        return error.lineno
    while trace is not None:
        if Path(trace.tb_frame.f_code.co_filename) == path:
            line = trace.tb_lineno
        trace = trace.tb_next
    return line
