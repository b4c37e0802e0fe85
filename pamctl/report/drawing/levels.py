"""Old place of named bars."""

from pamctl.report.figure import Levels

__all__ = ["Levels"]
