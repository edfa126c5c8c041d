"""The command line: ``nsmodel run FILE``, and ``check``, ``study``, ``stress``, ``codegen``."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from nsmodel.defaults import TOLERANCE
from nsmodel.errors import CodegenError, ModelError, NsmodelError, StepError, StorageError, UsageError
from nsmodel.hypotheses.findings import VIOLATED
from nsmodel.hypotheses.report.report import Report
from nsmodel.loader import load_with
from nsmodel.lock import held
from nsmodel.model.base import Model
from nsmodel.run.loop import RunInterrupted
from nsmodel.simulate import explain, simulate
from nsmodel.solve.choose import SOLVERS
from nsmodel.storage import STAMP, dumps, refuse_unwritable, write_json, write_text
from nsmodel.trajectory import Trajectory
from nsmodel.version import VERSION
from nsmodel.words import print_shown as print

T = TypeVar("T")
DONE, AT_FAULT, USAGE, FAILED_STEP, REFUSED = 0, 1, 2, 3, 4
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM

_ACCEPTED = f"largest accepted residual (default {TOLERANCE:g})".replace("e-0", "e-")


class Terminated(KeyboardInterrupt):
    """SIGTERM: ends a command as Ctrl-C does."""

    signal = signal.SIGTERM


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    0 done; 1 a hypothesis is violated (``check --strict``) or a cell is wrong (``stress``); 2 usage or model; 3 a step failed;
    4 no C code; 130 interrupted by Ctrl-C, 143 by SIGTERM.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be text
    arguments = _parser().parse_args(argv)
    status = DONE
    try:
        with _signals(), _apart(arguments):
            status = arguments.command(arguments)
            arguments.stdout.flush()
            return status
    except NsmodelError as error:
        return _refused(error)
    except KeyboardInterrupt as stop:
        print("nsmodel: interrupted", file=sys.stderr)
        return _by_signal(stop)
    except OSError as error:
        return max(status, _silenced(error))


@contextlib.contextmanager
def _signals() -> Iterator[None]:
    """SIGTERM raises Terminated; afterwards signals do what they did before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    usual = {number: signal.getsignal(number) or signal.SIG_DFL for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, frame: Any) -> None:
        raise Terminated

    if usual[signal.SIGTERM] is not signal.SIG_IGN:
        signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)


def _no_more_signals() -> None:
    """One more Ctrl-C would cost what is being saved."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _by_signal(stop: BaseException | None) -> int:
    """The exit status of an interruption: that of the first signal among what led to it."""
    while stop is not None and not hasattr(stop, "signal"):
        stop = stop.__context__
    return 128 + getattr(stop, "signal", signal.SIGINT)


def _silenced(error: OSError) -> int:
    """Give up standard output; no fault where its reader (head, less) has gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return DONE
    print(f"nsmodel: error: cannot write the output: {error}", file=sys.stderr)
    return USAGE


@contextlib.contextmanager
def _apart(arguments: argparse.Namespace) -> Iterator[None]:
    """Keep standard output for the document of --json: what a model file prints meanwhile goes to standard error."""
    arguments.stdout = sys.stdout
    with contextlib.redirect_stdout(sys.stderr if getattr(arguments, "json", False) else sys.stdout):
        yield


def _print_json(arguments: argparse.Namespace, document: Any) -> None:
    print(dumps(document, indent=2), file=arguments.stdout)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nsmodel",
        description="Nonsmooth dynamics: run a model file, every step verified; check its hypotheses; write its step in C.",
        epilog="exit status: 0 done; 1 a hypothesis is violated (check --strict) or a cell is wrong (stress); "
        "2 usage, missing file or wrong model; 3 a step failed, 130 interrupted by Ctrl-C, 143 by SIGTERM (what was computed is "
        "saved); "
        "4 the model has no C counterpart",
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"nsmodel {VERSION}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="simulate a model file", description="Simulate a model file and print a summary.")
    run.add_argument("files", metavar="FILE", nargs="+", help="a Python file that defines model = ... or def model(...)")
    run.add_argument("--step", type=float, metavar="H", help="time step (default: the model's)")
    run.add_argument("--t-end", type=float, metavar="T", help="end of the run (default: the model's)")
    run.add_argument("--rtol", type=float, metavar="R", help="choose the steps by error control: error allowed, relative")
    run.add_argument("--atol", type=float, metavar="A", help="error allowed besides, absolute (default 0)")
    _add_set(run)
    run.add_argument("--solver", default="auto", metavar="NAME", help=f"use this solver alone: {', '.join(SOLVERS[1:])}")
    run.add_argument(
        "--compiled", action="store_true",
        help="step in C, built once for this model (left out: only where the run is long enough to pay for it)",
    )  # fmt: skip
    run.add_argument("--tolerance", type=float, default=TOLERANCE, metavar="TOL", help=_ACCEPTED)
    run.add_argument("--save-every", type=int, default=1, metavar="N", help="keep every N-th row")
    run.add_argument("--resume", action="store_true", help="continue the run found in --out")
    run.add_argument("--out", metavar="DIR", help="folder for trajectory.npz, summary.json and pictures")
    run.add_argument("--csv", metavar="PATH", help="also write the trajectory as CSV")
    run.add_argument("--plot", action="store_true", help="write pictures into --out (default: FILE-run)")
    run.add_argument("--film", metavar="PATH", help="write a film of bodies in the plane: .gif, or .mp4 with ffmpeg")
    run.add_argument("--explain", action="store_true", help="say what is used and what is left out, and why; then run")
    run.add_argument("--json", action="store_true", help="print the summary as JSON")
    run.add_argument("--quiet", action="store_true", help="print warnings and errors only")
    run.set_defaults(command=_run)
    about = "Decide the hypotheses that the theory of the model's class rests on, and say what follows from them."
    checker = commands.add_parser("check", help="check the hypotheses behind a model file", description=about)
    checker.add_argument("files", metavar="FILE", nargs="+", help="a Python file that defines model = ... or def model(...)")
    _add_set(checker)
    checker.add_argument(
        "--parameters",
        action="append",
        default=[],
        metavar="NAME=LOW:HIGH",
        help="decide for all values of a parameter between these; may be repeated",
    )
    checker.add_argument(
        "--region", action="append", default=[], metavar="NAME=LOW:HIGH",
        help="interval of a state, where no proof covers all states (default: around the run); repeatable",
    )  # fmt: skip
    checker.add_argument("--quick", action="store_true", help="skip runs and global searches")
    checker.add_argument("--strict", action="store_true", help="exit with status 1 where a hypothesis is violated")
    checker.add_argument("--json", action="store_true", help="print the report as JSON")
    checker.add_argument("--markdown", metavar="PATH", help="also write the report as Markdown, with the equations")
    checker.add_argument(
        "--certificate", metavar="DIR", help="also write what proves each hypothesis that holds, and a program that verifies it"
    )
    checker.set_defaults(command=_check)
    about = "Measure how accurate the schemes and solvers that apply to a model are for what they cost."
    measurer = commands.add_parser("study", help="measure errors and times: a work-precision study", description=about)
    measurer.add_argument("file", metavar="FILE", help="a Python file that defines model = ... or def model(...)")
    measurer.add_argument("--steps", metavar="H1,H2,...", help="time steps (default: 16 h, 8 h, ... h/8 around the model's own)")
    measurer.add_argument("--target", type=float, metavar="ERROR", help="say what this relative error costs")
    measurer.add_argument("--t-end", type=float, metavar="T", help="end of the runs (default: the model's)")
    _add_set(measurer)
    measurer.add_argument("--solvers", metavar="A,B,...", help="solvers to time alone (default: all that apply; '' for none)")
    measurer.add_argument("--budget", type=float, default=60.0, metavar="SECONDS", help="wall time of the study (default 60)")
    measurer.add_argument("--json", action="store_true", help="print the study as JSON")
    measurer.add_argument("--csv", metavar="PATH", help="also write one row a point as CSV")
    measurer.add_argument("--out", metavar="DIR", help="folder for study.txt, study.json, study.csv and study.png")
    measurer.set_defaults(command=_study)
    about = "Push a model: its step, its units, its parameters; say of each short run whether it is right, stopped or wrong."
    pusher = commands.add_parser("stress", help="push a model's step, units and parameters", description=about)
    pusher.add_argument("file", metavar="FILE", help="a Python file that defines model = ... or def model(...)")
    _add_set(pusher)
    pusher.add_argument(
        "--vary", action="append", default=[], metavar="NAME=V1,V2,...",
        help="values of a parameter or of an argument of model(); repeatable: all combinations are run",
    )  # fmt: skip
    pusher.add_argument("--step", type=float, metavar="H", help="the step that is taken for 1 (default: the model's)")
    pusher.add_argument(
        "--budget", type=float, metavar="SECONDS", help="wall time; cells beyond it are left out (default: none is)"
    )
    pusher.add_argument("--json", action="store_true", help="print all cells as JSON")
    pusher.add_argument("--out", metavar="DIR", help="folder for stress.txt, stress.json and stress.png")
    pusher.set_defaults(command=_stress)
    about = "Write the model's verified step as a C99 library: header, source, Makefile, example, description, README."
    writer = commands.add_parser("codegen", help="write a model's step as a C library", description=about)
    writer.add_argument("file", metavar="FILE", help="a Python file that defines model = ... or def model(...)")
    writer.add_argument("--out", metavar="DIR", help="folder of the library (default: FILE-c)")
    writer.add_argument("--name", metavar="NAME", help="prefix of all names in C (default: the file's name)")
    writer.add_argument("--step", type=float, metavar="H", help="time step of the code (default: the model's)")
    writer.add_argument("--any-step", action="store_true", help="let a linear scene take any step, not this one alone")
    writer.add_argument("--tolerance", type=float, default=TOLERANCE, metavar="TOL", help=_ACCEPTED)
    writer.add_argument("--max-work", type=int, metavar="N", help="most linear systems, index sets and sweeps in a step")
    _add_set(writer)
    writer.set_defaults(command=_codegen)
    return parser


def _add_set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE",
        help="value of a parameter or of an argument of model(): a number, V1,V2,... or rows with ; between; repeatable",
    )  # fmt: skip


def _certify(report: Report, folder: str, quiet: bool) -> None:
    from nsmodel.certificate.write import write_certificate

    path, proved, left = write_certificate(report, folder)
    if not quiet:
        more = f", {left} of them not checkable: each says why" if left else ""
        print(f"\ncertificate  {path}: {proved + left} statements{more}\n             python {path.parent / 'verify.py'} {path}")


def _check(arguments: argparse.Namespace) -> int:
    """Check each file; several end in a line a file. The status is that of the worst."""
    from nsmodel.checking import check

    several = len(arguments.files) > 1
    for option in ("markdown", "certificate"):
        if several and getattr(arguments, option):
            raise UsageError(f"--{option} takes one model file; check them one by one")
    region = _by_name((_interval("--region", one, "q_0=-2:2") for one in arguments.region), "--region")
    boxes = _by_name((_interval("--parameters", one, "mu=0.1:0.5") for one in arguments.parameters), "--parameters")
    if twice := set(boxes) & set(_by_name(map(_setting, arguments.set), "--set")):
        raise UsageError(f"'{min(twice)}' is given with --set and with --parameters; keep one")
    if boxes and arguments.certificate:
        raise UsageError("--certificate: certificates are of numbers; give the parameters values with --set")
    reports: list[tuple[str, Report | None, int]] = []
    documents = []
    for file in arguments.files:
        try:
            model, values = _load(file, arguments.set)
            report = check(model, parameters={**values, **boxes}, region=region, quick=arguments.quick)
        except NsmodelError as error:
            reports.append((file, None, _refused(error)))
            documents.append({"file": file, "status": "refused", "message": str(error)})
            continue
        at_fault = arguments.strict and report.having(VIOLATED)
        reports.append((file, report, AT_FAULT if at_fault else DONE))
        documents.append({"file": file, **report.document()} if arguments.json else {})
        if not arguments.json:
            print(report.text(), end="\n\n" if several else "\n")
    if arguments.markdown and reports[0][1] is not None:
        write_text(Path(arguments.markdown), reports[0][1].markdown())
    if arguments.certificate and reports[0][1] is not None:
        _certify(reports[0][1], arguments.certificate, quiet=arguments.json)
    if arguments.json:
        _print_json(arguments, documents if several else documents[0])
    elif several:
        width = max(len(Path(file).stem) for file, _, _ in reports)
        for file, report, _ in reports:
            print(f"{Path(file).stem:{width}}  {'refused' if report is None else report.verdict}")
    return max(status for *_, status in reports)


def _study(arguments: argparse.Namespace) -> int:
    """Measure a file's model; Ctrl-C keeps what was measured."""
    from nsmodel.study import StudyInterrupted, study

    model, values = _load(arguments.file, arguments.set)
    status, given = DONE, arguments.solvers
    try:
        found = study(
            model, steps=None if arguments.steps is None else _steps(arguments.steps), target=arguments.target,
            t_end=arguments.t_end, parameters=values, budget=arguments.budget, progress=not arguments.json,
            solvers=None if given is None else [name for name in map(str.strip, given.split(",")) if name],
        )  # fmt: skip
    except StudyInterrupted as stop:
        _no_more_signals()
        found, status = stop.study, _by_signal(stop)
    document = {"file": arguments.file, **found.document()}
    if arguments.json:
        _print_json(arguments, document)
    else:
        print(found.text())
    if arguments.csv:
        found.to_csv(arguments.csv)
    if arguments.out:
        folder = Path(arguments.out)
        write_text(folder / "study.txt", found.text())
        write_json(folder / "study.json", document)
        found.to_csv(folder / "study.csv")
        names = ["study.txt", "study.json", "study.csv"]
        if any(point.drawn for line in found.lines for point in line.points):
            from nsmodel.plot import save

            save(found.plot().figure, folder / "study.png")
            names.append("study.png")
        if not arguments.json:
            print(f"\nsaved in {folder}: {', '.join(names)}")
    if status != DONE:
        print("nsmodel: interrupted; what was measured before is above", file=sys.stderr)
    return status


def _stress(arguments: argparse.Namespace) -> int:
    """Push a file's model, for each combination of the values given with --vary; the status says whether a cell is wrong."""
    from nsmodel.stress import push

    given, vary = _by_name(map(_setting, arguments.set), "--set"), _by_name(map(_varied, arguments.vary), "--vary")
    twice = next((name for name in vary if name in given), None)
    if twice is not None:
        raise UsageError(f"'{twice}' is given with --set and with --vary; keep one")
    variants = []
    for values in product(*vary.values()):
        varied = dict(zip(vary, values, strict=True))
        model, own = load_with(arguments.file, given | varied)
        variants.append((varied, model.bind(own)))
    found = push(variants, step=arguments.step, budget=arguments.budget, progress=not arguments.json)
    document = {"file": arguments.file, **found.document()}
    if arguments.json:
        _print_json(arguments, document)
    else:
        print(found.text())
    if arguments.out:
        folder = Path(arguments.out)
        write_text(folder / "stress.txt", found.text())
        write_json(folder / "stress.json", document)
        from nsmodel.plot import save

        save(found.plot().figure, folder / "stress.png")
        if not arguments.json:
            print(f"\nsaved in {folder}: stress.txt, stress.json, stress.png")
    return AT_FAULT if found.wrong else DONE


def _varied(setting: str) -> tuple[str, list[int | float]]:
    name, equals, text = setting.partition("=")
    try:
        if not equals or not name.strip():
            raise ValueError
        return name.strip(), [_parsed(one) for one in text.split(",")]
    except ValueError:
        raise UsageError(f"--vary {setting}: expected NAME=V1,V2,..., for example --vary mu=0.1,0.5,1") from None


def _steps(text: str) -> list[float]:
    try:
        return [float(step) for step in text.split(",")]
    except ValueError:
        raise UsageError(f"--steps {text}: expected numbers with commas between, for example --steps 1e-2,5e-3") from None


def _codegen(arguments: argparse.Namespace) -> int:
    """Write the C library of a file; a parameter given with --set becomes a number in the code."""
    from nsmodel import codegen

    model, values = _load(arguments.file, arguments.set)
    stem = Path(arguments.file).stem
    name = codegen.identifier(stem) if arguments.name is None else arguments.name
    written = codegen.write(
        model, arguments.out or f"{stem}-c", name=name, step=arguments.step, any_step=arguments.any_step, parameters=values,
        tolerance=arguments.tolerance, max_work=arguments.max_work,
    )  # fmt: skip
    print(written.text())
    return DONE


def _interval(option: str, setting: str, example: str) -> tuple[str, tuple[float, float]]:
    name, equals, text = setting.partition("=")
    low, colon, high = text.partition(":")
    try:
        if not (equals and colon and name.strip()):
            raise ValueError
        return name.strip(), (float(low), float(high))
    except ValueError:
        raise UsageError(f"{option} {setting}: expected NAME=LOW:HIGH, for example {option} {example}") from None


def _run(arguments: argparse.Namespace) -> int:
    """Run each file; several files end in a table. The status is that of the worst run."""
    if arguments.resume and arguments.out is None:
        raise UsageError("--resume needs --out DIR, the folder of the run to continue")
    several = len(arguments.files) > 1
    stems = [Path(file).stem for file in arguments.files]
    if (arguments.out or arguments.plot) and len(set(stems)) < len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise UsageError(f"two files are called '{twice}': their results would go to one folder; run them one by one")
    if several and arguments.csv:
        raise UsageError("--csv takes one model file; for several give --out DIR and read the trajectory.npz in it")
    if several and arguments.film:
        raise UsageError("--film takes one model file; run them one by one")
    if arguments.film:
        from nsmodel.plot.crowd import check_film

        check_film(arguments.film)
    if arguments.csv:
        refuse_unwritable(arguments.csv)
    results: list[Result] = []
    for file in arguments.files:
        results.append(_run_file(arguments, file, _folder(arguments, file)))
        if results[-1].status in (INTERRUPTED, TERMINATED):
            break
    with contextlib.ExitStack() as kept:
        for result in results:
            if result.run is not None and result.folder is None:
                kept.enter_context(_kept(result.file, result.run))
        if arguments.json:
            documents = [result.document for result in results]
            _print_json(arguments, documents if several else documents[0])
        elif several and not arguments.quiet:
            print(_table(results))
        arguments.stdout.flush()
    return max(result.status for result in results)


class Result(NamedTuple):
    """What became of one file; ``document`` is what --json prints."""

    status: int
    file: str
    run: Trajectory | None
    seconds: float
    folder: Path | None
    document: dict[str, Any]


def _run_file(arguments: argparse.Namespace, file: str, folder: Path | None) -> Result:
    """Run a file; its folder is held until everything is written there."""
    try:
        with contextlib.nullcontext() if folder is None else held(folder):
            return _run_here(arguments, file, folder)
    except NsmodelError as error:
        document = {"file": file, "status": "refused", "message": str(error)}
        return Result(_refused(error), file, None, 0.0, None, document)


def _run_here(arguments: argparse.Namespace, file: str, folder: Path | None) -> Result:
    start, compiled = time.perf_counter(), True if arguments.compiled else "auto"
    try:
        model, values = _load(file, arguments.set)
        if arguments.explain and not arguments.json:
            how = explain(
                model, step=arguments.step, t_end=arguments.t_end, parameters=values, solver=arguments.solver,
                tolerance=arguments.tolerance, compiled=compiled,
            )  # fmt: skip
            print(how, end="\n\n")
        run = simulate(
            model, step=arguments.step, t_end=arguments.t_end, parameters=values, solver=arguments.solver,
            tolerance=arguments.tolerance, save_every=arguments.save_every, out=folder, resume=arguments.resume,
            progress=not (arguments.quiet or arguments.json), compiled=compiled, rtol=arguments.rtol, atol=arguments.atol,
        )  # fmt: skip
    except StepError as error:
        return _stopped(arguments, file, folder, error.trajectory, f"error: {error}", FAILED_STEP, start)
    except RunInterrupted as stop:
        return _stopped(arguments, file, folder, stop.trajectory, str(stop), 128 + stop.signal, start)
    except StorageError as error:
        if error.trajectory is None:
            raise
        return _stopped(arguments, file, None, error.trajectory, f"storage error: {error}", USAGE, start)
    with contextlib.nullcontext() if folder is not None else _kept(file, run):
        return _report(arguments, file, run, time.perf_counter() - start, model.bind(values), folder)


@contextlib.contextmanager
def _kept(file: str, run: Trajectory) -> Iterator[None]:
    """Save a run that nobody asked to be saved where it cannot be reported in the way that was asked for."""
    try:
        yield
    except BrokenPipeError:
        raise
    except Exception:
        path = _own_folder(file) / "trajectory.npz"
        run.save(path)
        print(f"nsmodel: the run is saved in {path}", file=sys.stderr)
        raise


def _load(file: str, settings: Sequence[str]) -> tuple[Model, dict[str, Any]]:
    """The model and the values of its parameters; settings that the file's model() takes go there."""
    return load_with(file, _by_name(map(_setting, settings), "--set"))


def _setting(setting: str) -> tuple[str, Any]:
    """The name and its number, list of numbers or list of rows."""
    name, equals, text = setting.partition("=")
    if not equals or not name.strip():
        raise UsageError(f"--set {setting}: expected NAME=VALUE, for example --set mu=0.3")
    try:
        rows = [[_parsed(one) for one in row.split(",")] for row in text.split(";")]
    except ValueError:
        raise UsageError(f"--set {setting}: '{text}' is not a number, nor numbers with commas between") from None
    return name.strip(), rows if len(rows) > 1 else rows[0] if len(rows[0]) > 1 else rows[0][0]


def _parsed(text: str) -> int | float:
    return int(text) if text.strip().lstrip("+-").isdigit() else float(text)


def _by_name(pairs: Iterable[tuple[str, T]], option: str) -> dict[str, T]:
    """The values by name; a name that is given twice is refused."""
    found: dict[str, T] = {}
    for name, value in pairs:
        if name in found:
            raise UsageError(f"{option} gives '{name}' twice; keep one")
        found[name] = value
    return found


def _folder(arguments: argparse.Namespace, file: str) -> Path | None:
    """Where a file's results go: --out, with a folder for each of several files; FILE-run where --plot needs one."""
    if arguments.out is None:
        return _own_folder(file) if arguments.plot else None
    return Path(arguments.out) / Path(file).stem if len(arguments.files) > 1 else Path(arguments.out)


def _own_folder(file: str) -> Path:
    return Path(f"{Path(file).stem}-run")


def _report(
    arguments: argparse.Namespace, file: str, run: Trajectory, seconds: float, model: Model, folder: Path | None
) -> Result:
    """Write what was asked for; print the summary of a single run."""
    pictures = []
    if arguments.csv:
        run.to_csv(arguments.csv)
    if arguments.plot and folder is not None:
        from nsmodel.plot import save_all

        pictures = [str(path) for path in save_all(run, model, folder)]
    if arguments.film:
        from nsmodel.plot import animate

        pictures.append(str(animate(run, arguments.film)))
    printed = not (arguments.json or arguments.quiet or len(arguments.files) > 1)
    document = _document(file, run, seconds, folder, pictures)
    if printed or arguments.json or folder is not None:
        document["hypotheses"] = _verdict(model, run)
    if folder is not None:
        write_json(folder / "summary.json", document)
    where = f"{file}: " if len(arguments.files) > 1 else ""
    for warning in run.metadata["warnings"]:
        print(f"nsmodel: {where}warning: {warning}", file=sys.stderr)
    if printed:
        _print_summary(run, seconds)
        print(textwrap.fill(document["hypotheses"], 100, initial_indent="  hypotheses      ", subsequent_indent=" " * 18))
        if folder is not None:
            print(f"  saved           {folder / 'trajectory.npz'}")
        for path in pictures:
            print(f"  picture         {path}")
        sys.stdout.flush()
    return Result(DONE, file, run, seconds, folder, document)


def _verdict(model: Model, run: Trajectory) -> str:
    """What the quick check says, in one line; a run that is done is not refused for what cannot be checked."""
    from nsmodel.checking import check

    try:
        return check(model, [run], quick=True).verdict
    except NsmodelError as error:
        return f"not checked: {error}"


def _stopped(
    arguments: argparse.Namespace, file: str, folder: Path | None, run: Trajectory | None, message: str, status: int, start: float
) -> Result:
    """Save what a stopped run has computed, and say where."""
    seconds = time.perf_counter() - start
    where = f"{file}: " if len(arguments.files) > 1 else ""
    if run is None:
        print(f"nsmodel: {where}{message}", file=sys.stderr)
        return Result(status, file, None, seconds, None, {"file": file, "status": "failed", "message": message})
    _no_more_signals()
    resumable = folder is not None
    if folder is None:
        folder = _own_folder(file)
        try:
            run.save(folder / "trajectory.npz")
        except StorageError:
            print(f"nsmodel: {where}{message}", file=sys.stderr)
            raise
    document = _document(file, run, seconds, folder, [])
    write_json(folder / "summary.json", document)
    if not (arguments.json or arguments.quiet or len(arguments.files) > 1):
        try:
            _print_summary(run, seconds)
            sys.stdout.flush()
        except OSError as error:
            _silenced(error)
    steps = sum(run.metadata["solver_counts"].values())
    how = "; go on with --resume" if resumable and status in (INTERRUPTED, TERMINATED) else ""
    print(f"nsmodel: {where}{message}", file=sys.stderr)
    print(f"nsmodel: {where}{steps} verified steps are saved in {folder / 'trajectory.npz'}{how}", file=sys.stderr)
    return Result(status, file, run, seconds, folder, document)


def _document(file: str, run: Trajectory, seconds: float, folder: Path | None, pictures: list[str]) -> dict[str, Any]:
    """What --json prints and summary.json holds: the summary with its plan, its files and its run time."""
    plan = {key: run.metadata[key] for key in ("scheme", "used", "left_out")}
    saved = None if folder is None else str(folder / "trajectory.npz")
    return {**STAMP, "file": file, **run.summary(), "seconds": seconds, "saved": saved, "pictures": pictures, "plan": plan}


def _print_summary(run: Trajectory, seconds: float) -> None:
    each = seconds / max(run.metadata["steps"], 1)
    text = f"{1e6 * each:.3g} us" if each < 1e-3 else f"{1e3 * each:.3g} ms" if each < 1 else f"{each:.3g} s"
    # Warnings and errors have their own stream.
    print(run.summary_text(messages=False))
    print(f"  run time        {seconds:.3g} s ({text} a step, loading and set-up included)")


def _refused(error: NsmodelError) -> int:
    kinds = ((ModelError, "model error"), (StorageError, "storage error"), (CodegenError, "no C code"), (NsmodelError, "error"))
    print(f"nsmodel: {next(name for kind, name in kinds if isinstance(error, kind))}: {error}", file=sys.stderr)
    return REFUSED if isinstance(error, CodegenError) else USAGE


def _table(results: Sequence[Result]) -> str:
    """One line a file: steps, time simulated and used, worst residual, index-set changes, the overview picture."""
    head = ("model", "status", "steps", "t", "worst residual", "index set changes", "run time", "picture")
    lines: list[tuple[str, ...]] = [head]
    for result in results:
        name, run, folder = Path(result.file).stem, result.run, result.folder
        if run is None:
            lines.append((name, result.document["status"], *[""] * 6))
            continue
        totals, picture = run.metadata["totals"], None if folder is None else folder / "overview.png"
        lines.append((
            name, run.status, str(totals["steps"]), f"{run.t[-1]:g}", f"{totals['worst_residual']:.2g}",
            str(totals["index_set_changes"]), f"{result.seconds:.2f} s", str(picture) if picture and picture.exists() else "",
        ))  # fmt: skip
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines)


if __name__ == "__main__":
    sys.exit(main())
