"""Examples and exit codes of every verb, at the end of its help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

EXAMPLES: Mapping[str, Sequence[str]] = {
    "run": (
        "pamctl run --fast",
        "pamctl run --rig rig.yaml --controller qsmc --experiment tracking-1 --rt require",
        "pamctl run --fast --set controller.lambda_per_s=60 --log faster.mcap",
    ),
    "daemon": (
        "pamctl daemon --rig rig.yaml --logs logs",
        "pamctl daemon --backend sim --monitor --plant plant.yaml",
    ),
    "status": ("pamctl status", "pamctl status --json"),
    "start": ("pamctl start tracking-2", "pamctl start sine --note 'new seal'"),
    "stop": ("pamctl stop",),
    "estop": ("pamctl estop",),
    "ack": ("pamctl ack",),
    "disarm": ("pamctl disarm",),
    "mark": ("pamctl mark 'touched the hose'",),
    "watch": ("pamctl watch", "pamctl watch --web --allow-control"),
    "goto": ("pamctl goto 12mm", "pamctl goto 8mm --in 2"),
    "set": ("pamctl set controller.lambda_per_s=60 --ramp 2",),
    "gains load": ("pamctl gains load qsmc", "pamctl gains load tuned.yaml"),
    "gains show": ("pamctl gains show",),
    "report": (
        "pamctl report run.mcap",
        "pamctl report before.mcap after.mcap --interactive --out both.html",
    ),
    "replay": (
        "pamctl replay run.mcap",
        "pamctl replay run.mcap --controller pid --csv what-if.csv",
    ),
    "compare": (
        "pamctl compare run.mcap",
        "pamctl compare run.mcap --plant paper --plant mine.yaml --plot gaps.html --interactive",
    ),
    "audit": ("pamctl audit diagnosis", "pamctl audit run.mcap --verbose"),
    "diagnose": (
        "pamctl diagnose run-1.mcap --holdout run-2.mcap --out diagnosis",
        "pamctl diagnose run.mcap --plant mine.yaml --out diagnosis --jobs 2 --interactive",
    ),
    "health": ("pamctl health logs --out health",),
    "tune": (
        "pamctl tune --law qsmc --plant plant.yaml --out tuned.yaml",
        "pamctl tune --law pid --plant plant.yaml --ensemble 40 --out robust.yaml",
    ),
    "sweep": (
        "pamctl sweep --fast --set controller.lambda_per_s=20,40,80 --repeat 3",
        "pamctl sweep --daemon --experiment tracking-2 --set controller.lambda_per_s=20,40",
    ),
    "safe": ("pamctl safe --rig rig.yaml",),
    "doctor": ("pamctl doctor", "pamctl doctor --rig rig.yaml --actuate"),
    "calibrate pressure": ("pamctl calibrate pressure --rig rig.yaml --out rig-new.yaml",),
    "calibrate encoder": ("pamctl calibrate encoder --rig rig.yaml --out rig-new.yaml",),
    "calibrate valve": ("pamctl calibrate valve --rig rig.yaml --out rig-new.yaml",),
    "log info": ("pamctl log info run.mcap",),
    "log check": ("pamctl log check run.mcap", "pamctl log check logs/*.mcap --json"),
    "log recover": ("pamctl log recover broken.mcap whole.mcap",),
    "log export": (
        "pamctl log export run.mcap run.csv --fields t_s,position_m,pressure_pa",
        "pamctl log export run.mcap run.mat --from 5 --to 15",
    ),
    "log cut": ("pamctl log cut run.mcap --out part.mcap --from-s 5 --to-s 15",),
    "log import": ("pamctl log import measured.csv measured.mcap --map columns.yaml",),
    "runs": ("pamctl runs", "pamctl runs --where law=qsmc --where 'rms_um<20' --last 5"),
    "runs tag": ("pamctl runs tag good run-1.mcap run-2.mcap",),
    "runs untag": ("pamctl runs untag good run-1.mcap",),
    "runs note": ("pamctl runs note 'after the new seal' run-1.mcap",),
    "plant new": (
        "pamctl plant new --out plant.yaml",
        "pamctl plant new --actuator muscle --value rest_length_m='200 mm' --out plant.yaml",
    ),
    "plant export": ("pamctl plant export paper muscle.fmu",),
    "config check": ("pamctl config check rig.yaml",),
    "config show": ("pamctl config show --rig rig.yaml",),
    "config schema": ("pamctl config schema",),
    "reproduce": ("pamctl reproduce all --out paper", "pamctl reproduce fig5 --out fig5"),
    "manual": ("pamctl manual", "pamctl manual first-run"),
}
"""Examples by verb. A test types each of them."""

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
_AT_THE_RIG = (0, 2, 3, 4, 5, 69, 78)
_ASKS_DAEMON = (0, 2, 3, 69)
_READS_LOGS = (0, 2, 65)
_EXITS: Mapping[str, Sequence[int]] = {
    **dict.fromkeys(("run", "sweep", "daemon", "calibrate"), _AT_THE_RIG),
    **dict.fromkeys(
        ("status", "start", "stop", "estop", "ack", "disarm", "mark", "watch", "goto", "set"),
        _ASKS_DAEMON,
    ),
    "gains": _ASKS_DAEMON,
    **dict.fromkeys(("report", "runs", "health"), _READS_LOGS),
    "log": (0, 2, 3, 65),
    **dict.fromkeys(("compare", "audit", "plant"), (*_READS_LOGS, 78)),
    "diagnose": (0, 2, 3, 4, 5, 65, 69, 78),  # with --on-rig it runs programs
    "replay": (0, 2, 3, 65, 78),
    **dict.fromkeys(("safe", "doctor"), (0, 2, 3, 69, 78)),
    **dict.fromkeys(("config", "tune"), (0, 2, 78)),
}


def write_epilog(words: str) -> str:
    """Return the end of the help of a verb, such as `log cut`: what to type, how it exits."""
    examples = "\n\n".join(f"  {command}" for command in EXAMPLES.get(words, ()))
    codes = _EXITS.get(words) or _EXITS.get(words.split()[0], (0, 2))
    exits = ", ".join(f"{code} {_MEANINGS[code]}" for code in codes)
    return f"Examples:\n\n{examples}\n\nExit codes: {exits}; all stand in `pamctl --help`."
