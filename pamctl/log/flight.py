"""The flight record: the last two seconds before a trip, as a table."""

from __future__ import annotations

import csv
from io import StringIO
from pathlib import Path

import numpy as np

from pamctl.log.naming import flight_record_path
from pamctl.log.reader import Log
from pamctl.new_file import write_files

FLIGHT_RECORD_S = 2.0


def dump_last_seconds(log: Log) -> Path:
    """Write the last two seconds of a log beside it as CSV; return its path.

    Raise NewFileError if that fails.
    """
    path = flight_record_path(log.path)
    t_s = log.t
    first = int(np.searchsorted(t_s, t_s[-1] - FLIGHT_RECORD_S))
    text = StringIO()
    table = csv.writer(text)
    table.writerow(log.columns)
    table.writerows(zip(*(log[name][first:].tolist() for name in log.columns), strict=True))
    write_files({path: text.getvalue()}, replaces="")
    return path
