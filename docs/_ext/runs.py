"""What is made by running model files: pictures, numbers, verdicts, kept under the hash of the file and of the package."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import multiprocessing
import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import nsmodel
from nsmodel.hypotheses.equations import model_equations

PROCESSES = 2
THUMBNAIL = (3.2, 2.0)  # inches, of 150 pixels


@dataclass(frozen=True)
class Job:
    """A model file to run: its name, its text, and whether its hypotheses are checked and a thumbnail is drawn, as for a case."""

    name: str
    code: str
    case: bool = False

    @property
    def key(self) -> str:
        """What the result is kept under."""
        return digest(package_hash(), Path(__file__).read_bytes(), self.name, self.code, str(self.case))


@dataclass(frozen=True)
class Made:
    """What a job has made: files, and facts that JSON holds (title, summary; of a case equations, findings and verdict)."""

    file: Path
    picture: Path
    thumbnail: Path
    facts: dict[str, Any]


def digest(*parts: str | bytes) -> str:
    """16 hexadecimal digits."""
    found = hashlib.sha256()
    for part in parts:
        found.update(part.encode() if isinstance(part, str) else part)
        found.update(b"\0")
    return found.hexdigest()[:16]


@functools.cache
def package_hash() -> str:
    """The hash of all sources of the package."""
    root = Path(nsmodel.__file__).parent
    files = sorted(path for path in root.rglob("*") if path.suffix in (".py", ".c", ".h", ".js", ".css"))
    return digest(*(part for path in files for part in (str(path.relative_to(root)), path.read_bytes())))


def made(jobs: Iterable[Job], folder: Path) -> Iterator[Made]:
    """The results of the jobs in order, each as soon as it is there; those not in the folder are run, in two processes.

    Raises:
        RuntimeError: a job failed; its name, and what went wrong.
    """
    jobs = list(jobs)
    todo = {job.key: job for job in jobs if not (folder / job.key / "facts.json").is_file()}
    if not todo:
        yield from (_kept(job, folder) for job in jobs)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(PROCESSES, len(todo)), mp_context=context, initializer=_end_with_parent) as pool:
        running = {key: pool.submit(_make, job, folder) for key, job in todo.items()}
        for job in jobs:
            try:
                if job.key in running:
                    running[job.key].result()
            except Exception as error:
                pool.shutdown(cancel_futures=True)
                raise RuntimeError(f"{job.name}: {type(error).__name__}: {error}") from error
            yield _kept(job, folder)


def forget(folder: Path, jobs: Iterable[Job]) -> None:
    """Remove from the folder what none of the jobs has made."""
    keys = {job.key for job in jobs}
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name not in keys:
            shutil.rmtree(path)


def _kept(job: Job, folder: Path) -> Made:
    """The result of a job that was run."""
    at, stem = folder / job.key, Path(job.name).stem
    facts = json.loads((at / "facts.json").read_text(encoding="utf-8"))
    return Made(at / job.name, at / f"{stem}.png", at / f"{stem}-small.png", facts)


def _end_with_parent() -> None:
    """Let this process end as soon as the one that started it is gone, by whatever signal: its job is for nobody."""

    def watch(parent: int) -> None:
        wait([parent])
        os._exit(1)

    threading.Thread(target=watch, args=(multiprocessing.parent_process().sentinel,), daemon=True).start()


def _make(job: Job, folder: Path) -> None:
    """Run a job, in a process of its own; its folder has its name only once it is whole."""
    from nsmodel.plot import save

    at = folder / f"{job.key}.part"
    shutil.rmtree(at, ignore_errors=True)
    at.mkdir(parents=True)
    file = at / job.name
    file.write_text(job.code, encoding="utf-8")
    model = nsmodel.load(file)
    try:
        run = nsmodel.simulate(model)
    except nsmodel.StepError as error:
        if error.trajectory is None:
            raise
        run = error.trajectory
    save(run.plot(model=model), at / f"{file.stem}.png")
    facts = {"title": run.title, "status": run.status, "model_class": type(model).__name__, "summary": run.summary_text()}
    if job.case:
        save(_thumbnail(run, model), at / f"{file.stem}-small.png", dpi=150)
        facts |= {"equations": model_equations(model)} | _checked(model)
    (at / "facts.json").write_text(json.dumps(facts), encoding="utf-8")
    at.rename(folder / job.key)


def _checked(model: Any) -> dict[str, Any]:
    """The verdicts on the hypotheses of a case; a check that asks for more than the file says tells what for."""
    try:
        report = nsmodel.check(model)
    except nsmodel.UsageError as error:
        return {"verdict": str(error), "findings": []}
    findings = [{"id": one.id, "statement": one.statement, "verdict": one.verdict, "how": one.how} for one in report.findings]
    return {"verdict": report.verdict, "findings": findings}


def _thumbnail(run: Any, model: Any) -> Any:
    """A run at a glance: people in their room, discs in the plane, or the states."""
    from nsmodel.plot import configuration, crowd, states

    for draw in (lambda: crowd.frame(run), lambda: configuration(run, model)):
        with contextlib.suppress(nsmodel.PlotError):
            return _without_words(draw().figure)
    return _without_words(states(run).figure)


def _without_words(figure: Any) -> Any:
    """The figure small, its lines alone."""
    for ax in figure.axes:
        ax.set_title("", loc="left")
        ax.set(title="", xlabel="", ylabel="")
        ax.tick_params(length=0, labelbottom=False, labelleft=False, labelright=False)
        ax.spines[:].set_visible(False)
        if legend := ax.get_legend():
            legend.remove()
    figure.set_size_inches(*THUMBNAIL)
    return figure
