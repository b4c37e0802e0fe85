"""The data of a page's plots and the scripts that draw them, inside the page.

Every drawn picture stays in the page: a browser without scripts shows it, and `plots.js` replaces
it. The page's policy permits these two scripts by their hashes, and nothing else.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from hashlib import sha256
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np

from pamctl.json_text import to_json
from pamctl.plain_text import clean_text
from pamctl.report.drawing.scale import Floats, Scale
from pamctl.report.drawing.svg import PlotAxis, SvgPlot


class EmbeddedPlots(NamedTuple):
    """What makes a page interactive."""

    policy: str
    """What the page's policy must permit."""
    style: str
    body: str
    """Data and scripts, for the end of the page."""


def embed_plots(plots: Sequence[SvgPlot]) -> EmbeddedPlots:
    """Return data and scripts for plots, which stand in the page as `data-plot="0"` and so on."""
    arrays = _Arrays()
    described = [_describe_plot(plot, arrays) for plot in plots]
    data = to_json({"plots": described, "arrays": arrays.texts}).decode().replace("<", "\\u003c")
    folder = files("pamctl.report.interactive")
    scripts = [folder.joinpath(name).read_text() for name in ("uplot/uplot.js", "plots.js")]
    hashes = [b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    permitted = " ".join(f"'sha256-{one}'" for one in hashes)
    return EmbeddedPlots(
        f"script-src {permitted}",
        folder.joinpath("uplot/uplot.css").read_text() + folder.joinpath("plots.css").read_text(),
        f'<script type="application/json" id="plots">{data}</script>'
        + "".join(f"<script>{script}</script>" for script in scripts),
    )


class _Arrays:
    """Arrays as text, each once: plots of one run share their time."""

    def __init__(self) -> None:
        self.texts: list[tuple[str, str]] = []
        self._known: dict[bytes, int] = {}

    def add(self, values: Floats, kind: str) -> int:
        """Return the number of an array; `kind` is `f8` or, for values to look at, `f4`."""
        raw = np.ascontiguousarray(values, f"<{kind}").tobytes()
        key = sha256(kind.encode() + raw).digest()
        if key not in self._known:
            self._known[key] = len(self.texts)
            self.texts.append((kind, b64encode(raw).decode()))
        return self._known[key]


def _describe_plot(plot: SvgPlot, arrays: _Arrays) -> dict[str, Any]:
    frame = plot.make_frame()
    marks = []
    for mark in plot.marks:
        (x,), ys = mark.xs, mark.ys
        marks.append(
            {
                "kind": mark.kind,
                "css": mark.css,
                "label": clean_text(mark.label),
                "x": arrays.add(x, "f8"),
                "y": [arrays.add(y, "f4") for y in ys],
            }
        )
    return {
        "title": clean_text(plot.title),
        "height": plot.height_px,
        "x": {**_describe_axis(plot.x, frame.x), "named": plot.names_x},
        "y": _describe_axis(plot.y, frame.y),
        "marks": marks,
        "lines": [
            line._replace(label=clean_text(line.label))._asdict() for line in plot.straight_lines
        ],
    }


def _describe_axis(axis: PlotAxis, scale: Scale) -> dict[str, Any]:
    return {
        "label": axis.label,
        "unit": axis.unit,
        "low": scale.low,
        "high": scale.high,
        "log": scale.log,
    }
