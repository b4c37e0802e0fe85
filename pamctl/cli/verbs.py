"""All verbs: the help of the whole and the advice about an unknown verb import none of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Verb(NamedTuple):
    """Where a verb is, and what `pamctl --help` says of it."""

    panel: str
    """Its group in the help."""
    place: str
    """`module:attribute` below `pamctl.cli`: a function, or a `Typer` with verbs of its own."""
    told: str
    """The first paragraph of its help."""
    context: Mapping[str, Any] = {}


VERBS: Mapping[str, Verb] = {
    "run": Verb(
        "Run", "rig.run:run", "Move the muscle, log every tick, and show how well it tracked."
    ),
    "daemon": Verb(
        "Daemon",
        "daemon.daemon:daemon",
        "Stay up: home, run experiments and hold positions as clients such as `pamctl start` ask.",
    ),
    "status": Verb("Daemon", "daemon.orders:status", "Show what the daemon is doing."),
    "start": Verb(
        "Daemon", "daemon.orders:start", "Run an experiment; home first if the muscle is not homed."
    ),
    "stop": Verb(
        "Daemon", "daemon.orders:stop", "Stop what is running, smoothly; the muscle stays homed."
    ),
    "estop": Verb(
        "Daemon",
        "daemon.orders:estop",
        "Drive the safe voltage within a tick; latched until `pamctl ack`.",
    ),
    "ack": Verb(
        "Daemon", "daemon.orders:ack", "Acknowledge a fault, so that the daemon runs again."
    ),
    "disarm": Verb("Daemon", "daemon.orders:disarm", "End the session; the next run homes again."),
    "mark": Verb(
        "Daemon",
        "daemon.orders:mark",
        "Put a remark into the log of the run that goes on, of the daemon or of pamctl run.",
    ),
    "watch": Verb(
        "Daemon",
        "daemon.daemon:watch",
        "Show state, position, error, pressure, command and timing ten times a second.",
    ),
    "report": Verb(
        "Analyse",
        "analyse:report",
        "Write one self-contained HTML page with figures and plots of these logs.",
    ),
    "replay": Verb(
        "Analyse",
        "analyse:replay",
        "Run the tick over a log's raw samples, and compare every stage with the log.",
    ),
    "compare": Verb(
        "Analyse",
        "analyse:compare",
        "Drive models by the logged command, and compare them with the measurement.",
    ),
    "audit": Verb(
        "Analyse",
        "audit:audit",
        "Show which effects an experiment or a log cannot show, before anything is fitted.",
    ),
    "diagnose": Verb(
        "Analyse",
        "diagnose:diagnose",
        "Find what the model lacks to explain the logs, say what is sure of it, and add it.",
    ),
    "health": Verb(
        "Analyse",
        "analyse:health",
        "Fit the plant's numbers to every run of a folder, and say which of them drift.",
    ),
    "tune": Verb(
        "Tune",
        "tune:tune",
        "Search gains by simulation, or score given ones; Ctrl-C keeps the best so far.",
    ),
    "sweep": Verb(
        "Tune",
        "runs.sweep:sweep",
        "Run every combination of some settings, repeated; write a table and a page beside the logs.",  # noqa: E501
    ),
    "safe": Verb("Rig", "rig.safe:safe", "Drive the rig to its safe voltage, in any situation."),
    "doctor": Verb(
        "Rig",
        "rig.doctor:doctor",
        "Check whether this PC and this rig are fit for a run, with a fix for each fault.",
    ),
    "reproduce": Verb(
        "Other",
        "other:reproduce",
        "Write DIR/index.html and DIR/numbers.json; every number is simulated now.",
    ),
    "manual": Verb("Other", "other:manual", "List the pages of the manual, or print one of them."),
    # A negative position is an argument, not an option: goto -1mm.
    "goto": Verb(
        "Daemon",
        "daemon.orders:goto",
        "Go to a position and hold it.",
        {"ignore_unknown_options": True},
    ),
    "set": Verb("Daemon", "daemon.orders:set", "Change gains while the loop runs, on a ramp."),
    "gains": Verb("Daemon", "daemon.orders:gains_app", "Load and show the daemon's gains."),
    "calibrate": Verb(
        "Rig",
        "rig.calibrate:calibrate_app",
        "Measure sensor, encoder and valve of the rig, and write a new rig file.",
    ),
    "log": Verb("Logs", "log_verbs:log_app", "Look into logs, mend, cut, export and import them."),
    "runs": Verb(
        "Logs", "runs.runs:runs_app", "Find runs again by law, date, error, tag or setting."
    ),
    "plant": Verb(
        "Analyse", "file_verbs:plant_app", "Make and export plant files, which describe a rig."
    ),
    "config": Verb(
        "Other", "file_verbs:config_app", "Check, show and describe the configuration files."
    ),
}
PANELS = ("Run", "Daemon", "Analyse", "Tune", "Rig", "Logs", "Other")
