"""Figures that show themselves in a notebook, once, whether or not it draws with pyplot; axes made with theirs too.

Figures are made without pyplot, which alone would tell the notebook about them. Where its inline backend is active, the backend's
own printer of figures is used instead.
"""

from __future__ import annotations

import io
from typing import Any

from matplotlib import axes, figure

PNG_DPI = 100  # Dots per inch of a picture in a notebook: that of matplotlib.


class NotebookFigure(figure.Figure):
    """A figure with a picture of its own."""

    def _repr_png_(self) -> bytes:
        return png(self)


class NotebookAxes(axes.Axes):
    """Axes that were made with their figure: they show it."""

    def _repr_png_(self) -> bytes:
        return png(self.get_figure(root=True))


def light_png(drawn: Any, dpi: int) -> bytes:
    """The same in 64 colours, a fourth of the bytes: for pages that hold many."""
    from PIL import Image

    stream = io.BytesIO()
    whole = Image.open(io.BytesIO(png(drawn, dpi))).convert("RGB")
    whole.quantize(64, dither=Image.Dither.NONE).save(stream, "png", optimize=True)
    return stream.getvalue()


def png(drawn: Any, dpi: int = PNG_DPI) -> bytes:
    """A figure, or that of axes, as a PNG file."""
    stream = io.BytesIO()
    (drawn if isinstance(drawn, figure.Figure) else drawn.get_figure(root=True)).savefig(stream, format="png", dpi=dpi)
    return stream.getvalue()
