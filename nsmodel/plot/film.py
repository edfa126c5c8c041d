"""A film of many bodies, as GIF or MP4."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nsmodel.errors import MissingExtraError, PlotError
from nsmodel.files.storage import replace_atomically
from nsmodel.models.crowd.measure import present
from nsmodel.plot import style
from nsmodel.proof.verdict import not_none

if TYPE_CHECKING:
    from nsmodel.simulation.trajectory import Trajectory
from nsmodel.plot.crowd import PRESSURE_COLOURS, CrowdArtists, plane_axis_labels

# Frames a second that a GIF is shown with: it counts hundredths of a second, and viewers slow down frames of a single one.
MAX_GIF_FPS = 50
MAX_DEFAULT_SECONDS = 20.0  # A film left to itself lasts no longer, s: 300 pictures at 15 a second; a longer run is shown faster.


def animate(
    run: Trajectory, path: str | Path, *, seconds: float | None = None, fps: float = 15, scale: float | None = None,
    size: tuple[float, float] = (7, 6), dpi: float = 80,
) -> Path:  # fmt: skip
    """Write a film of a run as GIF or MP4 (by the ending of the path), beside its place and then renamed.

    Args:
        run: a run of many bodies in the plane, whose scene has radii.
        path: NAME.gif or NAME.mp4; MP4 needs the program ffmpeg.
        seconds: how long the film lasts; by default as long as the run, in its unit of time, and at most 20 s.
        fps: frames a second.
        scale: pressure at the end of the colour scale, the same for all frames; see `frame`.
        size: of a frame, inches.
        dpi: pixels an inch.

    Raises:
        PlotError: another ending, no such folder, a length or rate that is not > 0, a run without radii.
        MissingExtraError: MP4 without ffmpeg.
    """
    path, span = check_film(path), float(run.t[-1] - run.t[0])
    seconds = min(span, MAX_DEFAULT_SECONDS) if seconds is None else seconds
    for name, value in (("seconds", seconds), ("fps", fps), ("dpi", dpi)):
        if not (np.isfinite(value) and value > 0):
            raise PlotError(f"{name}: {value}; expected a number > 0")
    write = {".gif": _write_gif, ".mp4": _write_mp4}[path.suffix.lower()]
    if write is _write_gif and fps > MAX_GIF_FPS:
        raise PlotError(f"fps: {fps}; a GIF shows at most {MAX_GIF_FPS} frames a second")
    count = max(2, round(seconds * fps))
    rows = np.searchsorted(run.t, np.linspace(run.t[0], run.t[-1], count) + 1e-9 * span, side="right") - 1
    pictures = _render_frames(
        run, rows, f"   {span / seconds:.3g} times as fast" * (abs(span / seconds - 1) > 0.01), scale, size, dpi
    )
    with replace_atomically(path) as part:
        write(part, pictures, count, fps)
    return path


def check_film(path: str | Path) -> Path:
    """The path of a film; PlotError where none can be written there, MissingExtraError for MP4 without ffmpeg."""
    path = Path(path)
    if path.suffix.lower() not in (".gif", ".mp4"):
        raise PlotError(f"{path.name}: a film ends in .gif or .mp4")
    if not path.parent.is_dir():
        raise PlotError(f"{path}: the folder {path.parent} does not exist")
    if path.suffix.lower() == ".mp4":
        _ffmpeg()
    return path


def _render_frames(
    run: Trajectory, rows: np.ndarray, suffix: str, scale: float | None, size: tuple[float, float], dpi: float
) -> Iterator[np.ndarray]:
    """The pictures (H, W, 3); what never moves is drawn once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = style.blank(*size)
    figure.set_dpi(dpi)
    canvas, ax = FigureCanvasAgg(figure), figure.add_subplot()
    people = CrowdArtists(ax, run, scale)
    style.dress(ax, " ", *plane_axis_labels(run), grid=False)
    title = ax.text(0, 1.01, "", transform=ax.transAxes, ha="left", va="bottom", color=style.INK, fontsize=11, fontweight="bold")
    moving = (people.discs, people.lines, title)
    for artist in moving:
        artist.set_animated(True)
    canvas.draw()
    figure.set_layout_engine("none")
    still = canvas.copy_from_bbox(figure.bbox)
    here, unit = present(run).sum(axis=1), style.quantity_unit(run, "t")
    digits = max(0, int(np.ceil(-np.log10(max(float(np.diff(run.t[rows]).max()), 1e-12)))))
    for row in rows:
        canvas.restore_region(still)
        people.show(row)
        title.set_text(f"t = {run.t[row]:.{digits}f} {unit}   {here[row]} people{suffix}")
        for artist in moving:
            ax.draw_artist(artist)
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _write_gif(path: Path, pictures: Iterator[np.ndarray], count: int, fps: float) -> None:
    """One palette for all frames, so that nothing flickers: that of the first one and of all pressures."""
    from matplotlib import colormaps
    from PIL import Image

    start = next(pictures)
    height, width = start.shape[:2]
    pressures = np.uint8(255 * colormaps[PRESSURE_COLOURS](np.linspace(0, 1, width))[:, :3])
    palette = Image.fromarray(np.concatenate([start, np.broadcast_to(pressures, (height, width, 3))])).quantize(96)
    first = Image.fromarray(start)
    coded = (Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    first = first.quantize(palette=palette, dither=Image.Dither.NONE)
    ends = np.round(np.arange(count + 1) * 100 / fps).astype(int) * 10  # A GIF counts in hundredths of a second.
    first.save(path, save_all=True, append_images=coded, duration=np.diff(ends).tolist(), loop=0)


def _ffmpeg() -> str:
    program = shutil.which("ffmpeg")
    if program is None:
        raise MissingExtraError("MP4 needs the program ffmpeg, which was not found; install it, or write a .gif")
    return program


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], _: int, fps: float) -> None:
    program, first = _ffmpeg(), next(pictures)
    height, width = (n - n % 2 for n in first.shape[:2])  # The usual coding of colours wants even numbers.
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps}", "-i", "-"]
    command = [program, "-y", "-loglevel", "error", *given, "-pix_fmt", "yuv420p", "-f", "mp4", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        pipe = not_none(process.stdin)
        try:
            for picture in chain([first], pictures):
                pipe.write(np.ascontiguousarray(picture[:height, :width]).tobytes())
        except BrokenPipeError:
            pass
        message = process.communicate()[1].decode(errors="replace").strip()
    if process.returncode:
        raise PlotError(f"ffmpeg could not write the film: {message or f'status {process.returncode}'}")
