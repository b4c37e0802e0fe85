"""The log file (MCAP): schema, writer and reader; checking, repair, import and export.

Read `schema.py` first, then `reader.py`.

How to read any log, also an imported one:

    import pamctl.log

    log = pamctl.log.read("run.mcap")             # Log: arrays by field, events, configuration
    error_m = log["position_m"] - log["reference_m"]
    log.is_imported                               # True if another system measured it

    measured = pamctl.log.signals(log)            # Signals: the data to compare a model with
    measured.t_s, measured.valve_v, measured.pressure_pa, measured.position_m

    pamctl.log.read("long.mcap", fields=("t_s", "position_m"))  # saves memory

The command line's tools are functions too: `check.check_log`, `recover.recover_file`,
`edit.cut_log`, `export.export_ticks` and `importing.pipeline.import_log`.

Names are loaded when they are first used: the loop process imports parts of this package and
must not load numpy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pamctl.log.framing import LogError
    from pamctl.log.measured_signals import NO_PHASE, Signals, signals
    from pamctl.log.reader import Log, info, read

__all__ = ["NO_PHASE", "Log", "LogError", "Signals", "info", "read", "signals"]

_HOMES = {
    "Log": "reader",
    "LogError": "framing",
    "NO_PHASE": "measured_signals",
    "Signals": "measured_signals",
    "info": "reader",
    "read": "reader",
    "signals": "measured_signals",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
