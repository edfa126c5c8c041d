"""Pages read back by other means than those that wrote and draw them, and small runs made by hand."""

from __future__ import annotations

import base64
import json
import re
import zlib
from html.parser import HTMLParser

import numpy as np

from nsmodel.simulation.trajectory import Trajectory
from nsmodel.study import Study
from nsmodel.study.lines import Line, Point

HOSTILE = 'a</script><b>bold</b><!--<img src=x onerror="alert(1)">&amp;\u202e\x1b'


class Parsed(HTMLParser):
    """Elements, attributes and texts of a page."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.elements, self.texts, self.open = [], {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self.open.append((tag, dict(attrs).get("id")))

    def handle_endtag(self, tag):
        while self.open and self.open.pop()[0] != tag:
            pass

    def handle_data(self, data):
        if self.open:
            self.texts[self.open[-1]] = self.texts.get(self.open[-1], "") + data

    @property
    def data(self):
        return json.loads(self.texts["script", "data"])

    @property
    def policy(self):
        found = next(attrs["content"] for tag, attrs in self.elements if attrs.get("http-equiv") == "Content-Security-Policy")
        return dict([*part.split(None, 1), ""][:2] for part in re.split(r"\s*;\s*", found))


def parsed(path):
    return Parsed(path.read_text(encoding="utf-8"))


def unpacked(block):
    """Numbers of a page: bytes of one place in its word together, words as differences modulo 2^32."""
    raw = np.frombuffer(zlib.decompress(base64.b64decode(block["data"]), -15), np.uint8)
    n, planes = block["length"], {"u1": 0, "f4": 1, "f8": 2}[block["type"]]
    if not planes:
        return raw
    places = raw.reshape(planes, 4, n).astype(np.uint64)
    words = np.cumsum(sum(places[:, k] << np.uint64(8 * k) for k in range(4)), axis=1) % 2**32
    words = np.ascontiguousarray(words.T.astype("<u4"))
    return (
        words.view("<f8").ravel() if planes == 2 else block["offset"] + block["scale"] * words.view("<f4").ravel().astype(float)
    )


def by_hand(columns, **more):
    """A run of a class without laws, with states of these values (N+1,)."""
    x = np.column_stack(list(columns.values()))
    arrays = {"t": np.linspace(0, 1, len(x)), "x": x, **more.pop("arrays", {})}
    about = {"title": "By hand", "model_class": "LureSystem", "state_names": list(columns), "status": "done", **more}
    return Trajectory(arrays, about)


def discs(rows=50, bodies=9):
    """Discs that drift to the right in a room, one of which is gone from the middle on; pressures from 0 up."""
    start = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0)), axis=-1).reshape(-1, 2)[:bodies]
    x = (start[None] + np.linspace(0, 2, rows)[:, None, None] * [1, 0]).reshape(rows, -1)
    x[rows // 2 :, :2] = np.nan
    pressure = np.linspace(0, 1, rows)[:, None] * np.arange(bodies)
    walls = [[[-1, -1], [6, -1]], [[-1, 3], [6, 3]]]
    scene = {"radii": [0.4] * bodies, "walls": walls, "exits": [[[6, -1], [6, 3]]]}
    arrays = {"t": np.linspace(0, 5, rows), "x": x, "pressure": pressure}
    return Trajectory(
        arrays, {"title": "Discs", "model_class": "ManyBodies", "scene": scene, "status": "done", "units": {"t": "s"}}
    )


def a_study():
    """Measured elsewhere: two methods, one of which failed once."""
    points = [Point("h = 0.1", 1e-3, {"max": 1e-2}, 0.1), Point("h = 0.01", 1e-2, {"max": 1e-4}, 0.01)]
    other = [Point.failed("h = 0.1", HOSTILE), Point.left_out("h = 0.01", "budget"), Point("h = 0.001", 0.2, {"max": 1e-5})]
    lines = (Line(HOSTILE, tuple(points)), Line("other", tuple(other), kind="peer"))
    return Study(HOSTILE, "LureSystem", 2, 1.0, "s", lines, None, notes=(HOSTILE,))
