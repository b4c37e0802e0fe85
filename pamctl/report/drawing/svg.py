"""Old names of plots."""

from pamctl.report.figure import COLOURS, MUTED, PlotAxis, plot_apart
from pamctl.report.figure import Plot as SvgPlot

__all__ = ["COLOURS", "MUTED", "PlotAxis", "SvgPlot", "plot_apart"]
