"""All verbs: the help of the whole and the advice about an unknown verb import none of them.

Each is one record: its group, where it is, the first paragraph of its help, what to type, how it
exits, and what it does where it is silent for seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

_MEANINGS = {
    0: "ok",
    2: "wrong usage",
    3: "a check failed, data were lost or the daemon refused",
    4: "safety trip",
    5: "too many missed ticks",
    65: "bad data",
    69: "device, driver or daemon unavailable",
    78: "bad configuration",
}
_USAGE, _DAEMON, _LOGS, _FILES = (0, 2), (0, 2, 3, 69), (0, 2, 65), (0, 2, 78)
_RIG, _CHECKS_RIG, _MODELS = (0, 2, 3, 4, 5, 69, 78), (0, 2, 3, 69, 78), (0, 2, 65, 78)


class Verb(NamedTuple):
    """A verb; one within a group, such as `log cut`, has the panel and the exits of its group."""

    examples: Sequence[str]
    """What may follow its name."""
    waits: str = ""
    """What it does where it may be silent for seconds."""
    panel: str = ""
    """Its group in `pamctl --help`."""
    place: str = ""
    """`module:attribute` below `pamctl.cli`: a function, or a `Typer` with verbs of its own."""
    exits: Sequence[int] = ()
    told: str = ""
    """The first paragraph of its help."""
    context: Mapping[str, Any] = {}


# fmt: off
_ALL: Mapping[str, Verb] = {
    "run": Verb(
        ["--fast",
         "--rig rig.yaml --controller qsmc --experiment tracking-1 --rt require",
         "--fast --set controller.lambda_per_s=60 --log faster.mcap"],
        "", "Run", "rig_verbs:run", _RIG,
        "Move the muscle, log every tick, and show how well it tracked."),
    "daemon": Verb(
        ["--rig rig.yaml --logs logs", "--backend sim --monitor --plant plant.yaml"],
        "", "Daemon", "rig_verbs:daemon", _RIG,
        "Stay up: home, run experiments and hold positions as clients such as `pamctl start` ask."),
    "status": Verb(
        ["", "--json"], "", "Daemon", "orders:status", _DAEMON, "Show what the daemon is doing."),
    "start": Verb(
        ["tracking-2", "sine --note 'new seal'"], "homing, if the muscle is not homed",
        "Daemon", "orders:start", _DAEMON,
        "Run an experiment; home first if the muscle is not homed."),
    "stop": Verb(
        [""], "", "Daemon", "orders:stop", _DAEMON,
        "Stop what is running, smoothly; the muscle stays homed."),
    "estop": Verb(
        [""], "", "Daemon", "orders:estop", _DAEMON,
        "Drive the safe voltage within a tick; latched until `pamctl ack`."),
    "ack": Verb(
        [""], "", "Daemon", "orders:ack", _DAEMON,
        "Acknowledge a fault, so that the daemon runs again."),
    "disarm": Verb(
        [""], "", "Daemon", "orders:disarm", _DAEMON,
        "End the session; the next run homes again."),
    "mark": Verb(
        ["'touched the hose'"], "", "Daemon", "orders:mark", _DAEMON,
        "Put a remark into the log of the run that goes on, of the daemon or of pamctl run."),
    "watch": Verb(
        ["", "--web --allow-control"], "", "Daemon", "orders:watch", _DAEMON,
        "Show state, position, error, pressure, command and timing ten times a second."),
    "report": Verb(
        ["run.mcap", "before.mcap after.mcap --interactive --out both.html"],
        "reading and drawing", "Analyse", "analyse:report", _LOGS,
        "Write one self-contained HTML page with figures and plots of these logs."),
    "replay": Verb(
        ["run.mcap", "run.mcap --controller pid --csv what-if.csv"],
        "reading and computing every tick", "Analyse", "analyse:replay", (0, 2, 3, 65, 78),
        "Run the tick over a log's raw samples, and compare every stage with the log."),
    "compare": Verb(
        ["run.mcap", "run.mcap --plant paper --plant mine.yaml --plot gaps.html --interactive"],
        "simulating", "Analyse", "analyse:compare", _MODELS,
        "Drive models by the logged command, and compare them with the measurement."),
    "audit": Verb(
        ["diagnosis", "run.mcap --verbose"],
        "simulating and judging", "Analyse", "diagnose:audit", _MODELS,
        "Show which effects an experiment or a log cannot show, before anything is fitted."),
    "diagnose": Verb(
        ["run-1.mcap --holdout run-2.mcap --out diagnosis",
         "run.mcap --plant mine.yaml --out diagnosis --jobs 2 --interactive"],
        "reading", "Analyse", "diagnose:diagnose",
        (0, 2, 3, 4, 5, 65, 69, 78),  # with --on-rig it runs programs
        "Find what the model lacks to explain the logs, say what is sure of it, and add it."),
    "health": Verb(
        ["logs --out health"], "reading and fitting", "Analyse", "analyse:health", _LOGS,
        "Fit the plant's numbers to every run of a folder, and say which of them drift."),
    "tune": Verb(
        ["--law qsmc --plant plant.yaml --out tuned.yaml",
         "--law pid --plant plant.yaml --ensemble 40 --out robust.yaml"],
        "compiling and drawing plants", "Tune", "tune:tune", _FILES,
        "Search gains by simulation, or score given ones; Ctrl-C keeps the best so far."),
    "safe": Verb(
        ["--rig rig.yaml"], "", "Rig", "rig_verbs:safe", _CHECKS_RIG,
        "Drive the rig to its safe voltage, in any situation."),
    "doctor": Verb(
        ["", "--rig rig.yaml --actuate"], "", "Rig", "rig_verbs:doctor", _CHECKS_RIG,
        "Check whether this PC and this rig are fit for a run, with a fix for each fault."),
    "reproduce": Verb(
        ["all --out paper", "fig5 --out fig5"],
        "simulating", "Other", "analyse:reproduce", _USAGE,
        "Write DIR/index.html and DIR/numbers.json; every number is simulated now."),
    "manual": Verb(
        ["", "first-run"], "", "Other", "file_verbs:manual", _USAGE,
        "List the pages of the manual, or print one of them."),
    "goto": Verb(
        ["12mm", "8mm --in 2"], "homing, if the muscle is not homed",
        "Daemon", "orders:goto", _DAEMON, "Go to a position and hold it.",
        # A negative position is an argument, not an option: goto -1mm.
        {"ignore_unknown_options": True}),
    "set": Verb(
        ["controller.lambda_per_s=60 --ramp 2"], "", "Daemon", "orders:set", _DAEMON,
        "Change gains while the loop runs, on a ramp."),
    "gains": Verb(
        [], "", "Daemon", "orders:gains_app", _DAEMON, "Load and show the daemon's gains."),
    "gains load": Verb(["qsmc", "tuned.yaml"]),
    "gains show": Verb([""]),
    "calibrate": Verb(
        [], "", "Rig", "rig_verbs:calibrate_app", _RIG,
        "Measure sensor, encoder and valve of the rig, and write a new rig file."),
    "calibrate pressure": Verb(["--rig rig.yaml --out rig-new.yaml"]),
    "calibrate encoder": Verb(["--rig rig.yaml --out rig-new.yaml"]),
    "calibrate valve": Verb(["--rig rig.yaml --out rig-new.yaml"]),
    "log": Verb(
        [], "", "Logs", "log_verbs:log_app", (0, 2, 3, 65),
        "Look into logs, mend, cut, export and import them."),
    "log info": Verb(["run.mcap"], "reading"),
    "log check": Verb(["run.mcap", "logs/*.mcap --json"], "reading every record"),
    "log recover": Verb(["broken.mcap whole.mcap"], "reading and writing"),
    "log export": Verb(
        ["run.mcap run.csv --fields t_s,position_m,pressure_pa",
         "run.mcap run.mat --from 5 --to 15"], "reading and writing"),
    "log cut": Verb(["run.mcap --out part.mcap --from-s 5 --to-s 15"], "reading and writing"),
    "log import": Verb(["measured.csv measured.mcap --map columns.yaml"], "reading and writing"),
    "runs": Verb(
        ["", "--where law=qsmc --where 'rms_um<20' --last 5"],
        "reading new logs", "Logs", "runs:runs_app", _LOGS,
        "Find runs again by law, date, error, tag or setting."),
    "runs tag": Verb(["good run-1.mcap run-2.mcap"]),
    "runs untag": Verb(["good run-1.mcap"]),
    "runs note": Verb(["'after the new seal' run-1.mcap"]),
    "plant": Verb(
        [], "", "Analyse", "file_verbs:plant_app", _MODELS,
        "Make and export plant files, which describe a rig."),
    "plant new": Verb(
        ["--out plant.yaml",
         "--actuator muscle --value rest_length_m='200 mm' --out plant.yaml"]),
    "plant rig": Verb(["paper rig.yaml", "paper rig.yaml --backend nidaq"]),
    "plant export": Verb(["paper muscle.fmu"]),
    "config": Verb(
        [], "", "Other", "file_verbs:config_app", _FILES,
        "Check, show and describe the configuration files."),
    "config check": Verb(["rig.yaml"]),
    "config show": Verb(["--rig rig.yaml"]),
    "config schema": Verb([""]),
}
# fmt: on
VERBS: Mapping[str, Verb] = {words: verb for words, verb in _ALL.items() if verb.place}
"""Without the verbs within groups."""
PANELS = ("Run", "Daemon", "Analyse", "Tune", "Rig", "Logs", "Other")
EXAMPLES: Mapping[str, Sequence[str]] = {
    words: [f"pamctl {words} {more}".rstrip() for more in verb.examples]
    for words, verb in _ALL.items()
    if verb.examples
}
"""What to type, by verb. A test types each of them."""
SLOW_VERBS = {words: f"{words}: {verb.waits}" for words, verb in _ALL.items() if verb.waits}
"""What a verb says of itself while it is silent."""


def write_epilog(words: str) -> str:
    """Return the end of the help of a verb, such as `log cut`: what to type, how it exits."""
    examples = "\n\n".join(f"  {command}" for command in EXAMPLES[words])
    codes = VERBS[words.split()[0]].exits
    exits = ", ".join(f"{code} {_MEANINGS[code]}" for code in codes)
    return f"Examples:\n\n{examples}\n\nExit codes: {exits}; all stand in `pamctl --help`."
