"""The options of a run: each is declared once, with its type, its default, its text, its check and its flag.

`simulate` and its like take them by keyword: `takes_options` gives these functions the signature and the docstring that say so.
"""

from __future__ import annotations

import functools
import inspect
import itertools
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, TypeVar, get_type_hints

from nsmodel._utils import DEFAULT_TOLERANCE, check_keywords
from nsmodel.errors import UsageError
from nsmodel.modeling.inputs import Signals
from nsmodel.modeling.parameters import Values
from nsmodel.modeling.time_grid import check_tolerance, format_value, is_number
from nsmodel.solvers.plan import STEP_SOLVERS

CERTIFY_CHOICES = ("estimate", "interval")
METHODS = ("auto", "event-driven", "time-stepping")

GRID_DOC = "override the model's own grid."
TOLERANCE_HELP = f"largest accepted residual (default {DEFAULT_TOLERANCE:g})".replace("e-0", "e-")


class Flag(NamedTuple):
    """The flag of an option on the command line.

    Attributes:
        name: as it is typed.
        help: what the help says, for each command that has the flag: {names of commands, with blanks between: text}.
        arguments: what argparse is told besides; a type Path is that of a path to write to.
    """

    name: str
    help: Mapping[str, str]
    arguments: Mapping[str, Any]

    @property
    def dest(self) -> str:
        """The name under which argparse keeps what was given."""
        return self.name.removeprefix("--").replace("-", "_")


class Declaration(NamedTuple):
    """What is said of an option beside its type and its default."""

    doc: str
    check: Callable[[Any], Any]
    flag: Flag | None


def flag(name: str, help: Mapping[str, str], **arguments: Any) -> Flag:
    """Return a flag; ``arguments`` are those of argparse."""
    return Flag(name, help, arguments)


def option(default: Any, doc: str, check: Callable[[Any], Any] = lambda value: value, flag: Flag | None = None) -> Any:
    """Declare an option as a field of `Options`.

    Args:
        default: what is taken where the user says nothing.
        doc: what `simulate` says of the option; neighbours with the same text share an entry.
        check: returns the value as a run takes it, or raises UsageError.
        flag: its flag on the command line.
    """
    return field(default=default, metadata={"declaration": Declaration(doc, check, flag)})


def declaration(one: Field[Any]) -> Declaration:
    """Return what `option` was told of a field."""
    return one.metadata["declaration"]


def _checked_tolerance(value: Any) -> float:
    check_tolerance(value)
    return float(value)


def _checked_save_every(value: Any) -> int:
    if not (is_number(value) and value >= 1 and float(value).is_integer()):
        raise UsageError(f"save_every = {format_value(value)}; expected a whole number >= 1")
    return int(value)


def _checked_out(value: Any) -> Any:
    if value is not None and not str(value).strip():
        raise UsageError("out is empty; give the name of a folder, or leave it out")
    return value


def _checked_compiled(value: Any) -> Any:
    if not (isinstance(value, bool) or (isinstance(value, str) and value == "auto")):
        raise UsageError(f"compiled = {value!r}; expected True, False or 'auto'")
    return value


def _checked_halve(value: Any) -> Any:
    if not isinstance(value, bool):
        raise UsageError(f"halve = {value!r}; expected True or False")
    return value


def _one_of(name: str, choices: Sequence[str]) -> Callable[[Any], Any]:
    def check(value: Any) -> Any:
        if value not in choices:
            raise UsageError(f"{name} = {value!r}; expected one of {', '.join(choices)}")
        return value

    return check


@dataclass(frozen=True, kw_only=True)
class Options:
    """The options of `simulate`, checked.

    Raises:
        UsageError: a value that no model could be run with.
    """

    step: float | None = option(
        None,
        GRID_DOC,
        flag=flag(
            "--step",
            {"run": "time step (default: the model's)", "stress": "the step that is taken for 1 (default: the model's)"},
            type=float,
            metavar="H",
        ),
    )
    steps: Sequence[float] | None = option(None, GRID_DOC)
    t_end: float | None = option(
        None,
        GRID_DOC,
        flag=flag(
            "--t-end",
            {
                "run": "end of the run (default: the model's)",
                "sweep study": "end of the runs (default: the model's)",
                "sensitivity": "end of the run (default: the model's)",
            },
            type=float,
            metavar="T",
        ),
    )
    parameters: Values | None = option(
        None,
        "values of parameters, by name or symbol.",
        flag=flag(
            "--set",
            {
                "run check sweep study stress sensitivity codegen": "value of a parameter or of an argument of model(): a "
                "number, V1,V2,... or rows with ; between; repeatable"
            },
            action="append",
            default=[],
            metavar="NAME=VALUE",
        ),
    )
    inputs: Signals | None = option(
        None,
        "signals of inputs, by name or symbol, in place of those declared: steps end at their edges (see `docs/inputs.md`).",
        flag=flag(
            "--input",
            {
                "run sweep study stress sensitivity": "signal of an input: a number, or a table of rows t, value, ...; behind "
                "commas kind=hold|linear|cubic, after=hold|error|periodic, period=T; repeatable"
            },
            action="append",
            default=[],
            metavar="NAME=FILE.csv",
        ),
    )
    solver: str = option(
        "auto",
        '"auto", or one solver to use alone ("qpoases", "qrqp", "daqp", "ipopt", "lemke", ...).',
        flag=flag(
            "--solver",
            {"run": f"use this solver alone: {', '.join(STEP_SOLVERS[1:])}", "sweep": "use this solver alone"},
            metavar="SOLVER",
        ),
    )
    tolerance: float = option(
        DEFAULT_TOLERANCE,
        "largest accepted residual (relative, without unit).",
        check=_checked_tolerance,
        flag=flag("--tolerance", {"run sweep codegen": TOLERANCE_HELP}, type=float, metavar="TOL"),
    )
    save_every: int = option(
        1,
        "keep every n-th row, and the last (that of each part, where a run was resumed).",
        check=_checked_save_every,
        flag=flag("--save-every", {"run": "keep every N-th row"}, type=int, metavar="N"),
    )
    out: str | Path | None = option(
        None,
        "folder for numbered chunks (constant memory while it runs), checkpoints and ``trajectory.npz``; for one run at a time.",
        check=_checked_out,
        flag=flag("--out", {"run": "folder for trajectory.npz, summary.json and pictures"}, type=Path, metavar="DIR"),
    )
    resume: bool = option(
        False,
        "continue the run found in ``out``.",
        flag=flag("--resume", {"run": "continue the run found in --out"}, action="store_true"),
    )
    progress: bool = option(False, "show a progress bar at a terminal, or in a notebook.")
    compiled: bool | str = option(
        "auto",
        "True: step in C, built once for this model and kept in the user's cache folder (a step that C cannot certify is taken "
        'by the interpreted solvers); False: never; "auto": where building, or finding what was built before, takes less time '
        "than the interpreted steps, both estimated from the structure (see `solvers.plan`). Where parameters are declared the "
        "library is that of all their values, and other values build nothing, but for runs so long that code of the numbers "
        "alone pays: that is decided by the model and the number of steps, not by what was built before. A run that is resumed "
        "goes on as it began.",
        check=_checked_compiled,
        flag=flag(
            "--compiled",
            {
                "run": "step in C, built once for this model (left out: only where the run is long enough to pay for it)",
                "sweep": "run in C (left out: where it pays)",
            },
            action="store_const",
            const=True,
        ),
    )
    rtol: float | None = option(
        None,
        "the error allowed of each state, beside its largest value so far, >= 1e-14. The run is event-driven where that applies: "
        "one smooth piece after another, switches found exactly (see `docs/events.md`); rows are the ends of pieces, "
        "``run.at(t)`` gives any time, ``run.events`` the switches.",
        flag=flag(
            "--rtol",
            {
                "run sweep": "error allowed, relative: event-driven where that applies",
                "sensitivity": "error allowed of the run, relative (default 1e-8)",
            },
            type=float,
            metavar="R",
        ),
    )
    atol: float | Sequence[float] | None = option(
        None,
        "an absolute error allowed besides, one for all states or one for each; 0 if left out.",
        flag=flag("--atol", {"run sweep sensitivity": "error allowed besides, absolute (default 0)"}, type=float, metavar="A"),
    )
    method: str = option(
        "auto",
        'with ``rtol``: "event-driven" refuses what it cannot take, or cannot go on with; "time-stepping" chooses the steps by '
        "local error control (see `simulation.error_control`; rtol >= 1e-12, ``step`` is the first step); "
        '"auto" is event-driven, and takes time stepping, with a warning, where that does not apply, and for a stretch where it '
        "stops.",
        check=_one_of("method", METHODS),
        flag=flag(
            "--method",
            {
                "run": "with --rtol: auto (event-driven, else time stepping), or one of them alone",
                "sweep": "with --rtol: as of nsmodel run",
            },
            choices=METHODS,
        ),
    )
    times: Sequence[float] | None = option(
        None, "the rows of an event-driven run, increasing, from 0 to t_end; left out: the ends of its pieces."
    )
    halve: bool = option(
        False,
        "run once more with each time step halved, and keep as ``run.halving`` (N+1, n) the states of that run less those "
        "of this one: an estimate of their error, no bound; not with ``rtol``.",
        check=_checked_halve,
        flag=flag("--halve", {"run": "run once more with halved steps: an estimate of the error"}, action="store_true"),
    )
    certify: str = option(
        "estimate",
        '"interval": prove of each piece of an event-driven run, by interval arithmetic, a bound of its defect and the signs of '
        "its conditions, and of the run a bound of its error where the model is monotone (see `docs/events.md`); what is not "
        'proved is named, and the run is one all the same. "estimate": do not.',
        check=_one_of("certify", CERTIFY_CHOICES),
        flag=flag("--certify", {"run": "interval: prove the pieces of an event-driven run"}, choices=CERTIFY_CHOICES),
    )

    def __post_init__(self) -> None:
        """Check each option, then what they say together."""
        for one in fields(self):
            object.__setattr__(self, one.name, declaration(one).check(getattr(self, one.name)))
        if self.compiled is True and self.solver != "auto":
            raise UsageError(
                f"solver '{self.solver}' and compiled=True are both given: compiled steps bring their own solvers; keep one"
            )
        if self.method == METHODS[1] and self.rtol is None:
            raise UsageError(f"method '{self.method}' needs rtol (--rtol), the error that is allowed")
        if self.halve and (self.rtol is not None or self.atol is not None):
            raise UsageError(
                "halve (--halve) and rtol are both given: rtol already controls the error, halve estimates that of constant "
                "steps; leave one of them out"
            )
        if self.times is not None and (self.rtol is None or self.method == METHODS[2]):
            raise UsageError("times are rows of an event-driven run: give rtol, and leave method out; else take step or steps")
        if self.certified and (self.rtol is None or self.method == METHODS[2]):
            raise UsageError(
                "certify='interval' (--certify interval) proves the pieces of an event-driven run, and time steps have none: "
                "give rtol, and leave method out; of steps, run.residual is verified"
            )
        if self.certified and self.resume:
            raise UsageError("certify='interval' and resume are both given: whole runs are proved; leave one of them out")
        if self.resume and self.out is None:
            raise UsageError("resume needs out=, the folder of the run to continue")

    @property
    def certified(self) -> bool:
        """Whether pieces are to be proved."""
        return self.certify == CERTIFY_CHOICES[1]

    @property
    def folder(self) -> Path | None:
        """Where the run is kept."""
        return None if self.out is None else Path(self.out)


def flagged_options(command: str) -> Iterator[tuple[Field[Any], Flag, str]]:
    """Yield the options of which a command has the flag: the option, its flag, what the command's help says."""
    for one in fields(Options):
        if (flag := declaration(one).flag) is not None:
            for commands, text in flag.help.items():
                if command in commands.split():
                    yield one, flag, text


# -- which function takes which ----------------------------------------------------------------------------------------


class StepperKeywords(TypedDict, total=False):
    """The options of `stepper`, and of all that are below."""

    step: float | None
    parameters: Values | None
    inputs: Signals | None
    solver: str
    tolerance: float
    compiled: bool | str


class ExplainKeywords(StepperKeywords, total=False):
    """The options of `explain`."""

    t_end: float | None
    rtol: float | None
    method: str
    certify: str


class PrepareKeywords(ExplainKeywords, total=False):
    """The options of `prepare`: all but those of a folder and of a bar."""

    steps: Sequence[float] | None
    save_every: int
    atol: float | Sequence[float] | None
    times: Sequence[float] | None


class OptionKeywords(PrepareKeywords, total=False):
    """The options of `simulate`: all."""

    halve: bool
    out: str | Path | None
    resume: bool
    progress: bool


class SweepKeywords(TypedDict, total=False):
    """The options that `sweep` hands to each run as they are."""

    solver: str
    tolerance: float
    compiled: bool | str
    t_end: float | None
    rtol: float | None
    atol: float | Sequence[float] | None
    method: str
    times: Sequence[float] | None


def option_names(keywords: Any) -> tuple[str, ...]:
    """Return the names of the options in a class of keywords."""
    return tuple(keywords.__annotations__)


F = TypeVar("F", bound=Callable[..., Any])
ENTRIES, NAMES = "{entries}", "{names}"
DOC_WIDTH = 126  # Columns of the docstrings that are made of options.


def takes_options(keywords: Any, before: str | None = None) -> Callable[[F], F]:
    """Let a function of ``**options`` name them in its signature, its annotations and its docstring, and refuse others.

    In the docstring ``{entries}``, a line of the arguments, stands for the texts of the options, and ``{names}`` for their names;
    an option that has an entry of its own is left out of both.

    Args:
        keywords: the class of keywords that the function takes.
        before: the parameter that the options precede in the signature; left out: they are the last.
    """
    taken = [one for one in fields(Options) if one.name in option_names(keywords)]
    types = get_type_hints(Options)

    def decorate(function: F) -> F:
        own = inspect.signature(function)
        parameters = [one for one in own.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        place = len(parameters) if before is None else [one.name for one in parameters].index(before)
        parameters[place:place] = [
            inspect.Parameter(one.name, inspect.Parameter.KEYWORD_ONLY, default=one.default, annotation=one.type) for one in taken
        ]
        signature = own.replace(parameters=parameters)

        @functools.wraps(function)
        def checked(*positional: Any, **given: Any) -> Any:
            check_keywords(function.__name__, given, signature.parameters)
            return function(*positional, **given)

        documented: Any = checked
        documented.__signature__ = signature
        documented.__annotations__ = {
            **{one.name: one.annotation for one in parameters},
            **{one.name: types[one.name] for one in taken},
            "return": own.return_annotation,
        }
        documented.__doc__ = function.__doc__ and _completed_docstring(function.__doc__, taken)
        return documented

    return decorate


def _completed_docstring(doc: str, taken: Iterable[Field[Any]]) -> str:
    doc = inspect.cleandoc(doc)
    left = [one for one in taken if not re.search(rf"^ +(\w+, )*{one.name}(, \w+)*: ", doc, re.MULTILINE)]
    entries = [f"{_joined_names(same)}: {text}" for text, same in itertools.groupby(left, lambda one: declaration(one).doc)]
    lines: list[str] = []
    for line in doc.splitlines():
        indent = line[: len(line) - len(line.lstrip())]
        if line.strip() == ENTRIES:
            lines += (_fill(entry, indent) for entry in entries)
        else:
            lines.append(_fill(line.strip().replace(NAMES, _joined_names(left)), indent) if NAMES in line else line)
    return "\n".join(lines)


def _joined_names(options: Iterable[Field[Any]]) -> str:
    return ", ".join(one.name for one in options)


def _fill(text: str, indent: str) -> str:
    """The text in lines; those after the first are set in further where the first is."""
    after = 2 * indent
    return textwrap.fill(text, DOC_WIDTH, initial_indent=indent, subsequent_indent=after, break_on_hyphens=False)
