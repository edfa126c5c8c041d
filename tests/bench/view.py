"""How long the page of a run takes: a million rows by ten columns, written, opened, zoomed, moved, played, in headless Chromium.

    python tests/bench/view.py [--rows N] [--json FILE]

Needs the Python package playwright and Chromium. Each time is that of a frame as the browser shows them, from one to the next
while every frame asks for another picture, and of the script alone in brackets: of each frame the least of five times, as a
busy machine makes some longer. Beside them stands the processor's time of all processes of the browser, for a frame (Linux).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from nsmodel.simulation.trajectory import Trajectory

ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")
COUNT, REPEATS = 60, 5
PICKS = {"median": np.median, "most": max}
FRAMES = """async ([count, code]) => {
  const move = {zoom: (k) => nsview.zoom(k < count / 2 ? 0.8 : 1.25, 0.3 * nsview.span[1]),
    pan: (k) => nsview.show(0.2 + 0.01 * k, 0.3 + 0.01 * k),
    slider: (k) => nsview.select(Math.floor((nsview.clock.n * k) / count))}[code];
  nsview.reset();
  await new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  nsview.frames.length = 0;
  const times = [];
  for (let k = 0; k < count; k++) {
    move(k);
    times.push(await new Promise((done) => requestAnimationFrame(done)));
  }
  return {shown: times.slice(1).map((t, k) => t - times[k]), script: [...nsview.frames]};
}"""


def long_run(rows: int) -> Trajectory:
    """Random walks, positive noise, noise, residuals: ten columns that compress as badly as any."""
    rng = np.random.default_rng(0)
    walks = np.cumsum(rng.standard_normal((rows, 5)), axis=0)
    multipliers, y = abs(rng.standard_normal((rows, 2))), rng.standard_normal((rows, 2))
    residual = 10 ** rng.uniform(-16, -11, rows)
    for array in (multipliers, y, residual):
        array[0] = np.nan
    arrays = {"t": np.linspace(0, 1, rows), "x": walks, "multipliers": multipliers, "y": y, "residual": residual}
    arrays["index_set"] = rng.integers(-1, 1, (rows, 2)).astype(np.int8)
    return Trajectory(arrays, {"title": "A million rows", "model_class": "LureSystem", "tolerance": 1e-9, "status": "done"})


def processor_seconds() -> float:
    """Of all processes that this one has started, and of those that they have; NaN where there is no /proc."""
    parents, used, found = {}, {}, 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields = stat.read_text().rpartition(")")[2].split()
            parents[int(stat.parent.name)], used[int(stat.parent.name)] = int(fields[1]), int(fields[11]) + int(fields[12])
    for process in used:
        above = parents[process]
        while above > 1 and above != os.getpid():
            above = parents.get(above, 0)
        found += used[process] if above == os.getpid() else 0
    return found / os.sysconf("SC_CLK_TCK") if used else float("nan")


def main() -> None:
    """Print the table."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    run, found = long_run(arguments.rows), {}
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        start = time.perf_counter()
        path = run.view(Path(folder) / "long.html")
        found["write"], found["megabytes"] = time.perf_counter() - start, path.stat().st_size / 1e6
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": 1400, "height": 1600})
        before = processor_seconds()
        page.goto(path.as_uri(), wait_until="commit")
        found["open"] = page.evaluate(
            """async () => {
              while (!window.nsview?.frames.length) await new Promise((done) => setTimeout(done, 5));
              return performance.now() / 1000;
            }"""
        )
        found["open_processor"] = processor_seconds() - before
        page.get_by_role("button", name="y of the law").click()
        for code in ("zoom", "pan", "slider"):
            before = processor_seconds()
            repeats = [page.evaluate(FRAMES, [COUNT, code]) for _ in range(REPEATS)]
            busy = 1e3 * (processor_seconds() - before) / (COUNT * REPEATS)
            times = {key: np.min([one[key][: COUNT - 1] for one in repeats], axis=0) for key in ("shown", "script")}
            found[code] = {f"{key}_{word}": pick(times[key]) for key in times for word, pick in PICKS.items()}
            found[code]["processor"] = busy
        browser.close()
    print(f"{arguments.rows:,} rows by 10 columns: written in {found['write']:.2f} s, {found['megabytes']:.1f} MB")
    print(f"opened, from navigation to the first picture: {found['open']:.2f} s (processor {found['open_processor']:.2f} s)")
    for code in ("zoom", "pan", "slider"):
        f = found[code]
        print(
            f"{code:7} a frame takes {f['shown_median']:.0f} ms, at most {f['shown_most']:.0f} ms "
            f"(script {f['script_median']:.0f}, at most {f['script_most']:.0f}; processor {f['processor']:.0f} ms)"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(found, default=float, indent=1))


if __name__ == "__main__":
    main()
