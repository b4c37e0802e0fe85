"""Record a rig that explains itself: its supply begins to starve in the middle of an experiment.

    python scripts/record_starving_supply.py --out FOLDER [--pictures]

A real daemon with the monitor follows a sine. Half-way the regulator starves. The monitor's alarm
and explanation are taken from `pamctl status`; then `pamctl diagnose --on-rig` runs its programs
and names the effect. `pamctl tune` searches gains for the plant that was found, and the daemon
tracks the sine before and after them. Nothing is drawn that was not measured. FOLDER keeps logs,
pages and `story.json`; the pictures go into .readme/ and need Chromium. It takes some minutes in
real time, and the search as long as `pamctl tune` takes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from daemon_of_rig import PATIENCE_S, ROOT, hold_daemon, install_backend
from readme_figures import take_picture

from pamctl.report.figure import Plot, PlotAxis
from pamctl.report.html_page import write_html
from pamctl.report.report import Figure, Report
from pamctl.session.daemon_rig import connect
from pamctl.session.run import Run
from pamctl.session.steered_rig import SteeredRig
from pamctl.signals import Phase

SINE = {
    "kind": "sine", "offset_mm": 11.8, "amplitude_mm": 3, "frequency_hz": 2, "cycles": 60,
}  # fmt: skip
MOTION = {**SINE, "cycles": 24}
HEALTHY: dict[str, Any] = {"effects": {"supply_droop": {"resistance_pa_s_per_kg": 1.0}}}
STARVING: dict[str, Any] = {
    "parameters": {"tank_pressure_pa": 390e3},
    "effects": {"supply_droop": {"resistance_pa_s_per_kg": 2.5e7, "refill_time_s": 0.3}},
}
"""The regulator holds 390 kPa in place of 441, and gives way by 25 kPa to each g/s."""
STARVES_AFTER_S = 14.0
EXPLAINED_WITHIN_S = 180.0
"""The explanation runs at idle priority: on a busy PC it may come later."""
CODE = '''
"""A simulated rig whose supply starves as soon as a file is there."""
import json, os
from dataclasses import replace
from hal.sim import SIM
from pamctl.plant.model import PlantSettings, plant_parameters
from pamctl.plant.simulated import SimulatedPlant


class StarvingPlant(SimulatedPlant):
    """Two plants with one state: it moves into the second one."""

    starves = False

    def advance(self, command_v, duration_s):
        if not self.starves and os.path.exists(os.environ["STARVING"]):
            self.starves = True
            plant = json.loads(os.environ["STARVING_PLANT"])
            self.parameters = plant_parameters(PlantSettings.model_validate(plant))
        super().advance(command_v, duration_s)


def build(request):
    plant = StarvingPlant(request.plant.parameters)
    return SIM.build(replace(request, plant=plant))


BACKEND = replace(SIM, name="starving", description="Its supply starves.", build=build)
'''


def record(folder: Path) -> dict[str, Any]:
    """Run the whole story; return what the programs said, and where the logs are."""
    install_backend(folder, "starving", CODE)
    (folder / "healthy.yaml").write_text(yaml.safe_dump(HEALTHY))
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, (ROOT, folder))),
        "STARVING": str(folder / "starved"),
        "STARVING_PLANT": json.dumps(STARVING),
    }
    options = ("--plant", str(folder / "healthy.yaml"), "--monitor", "--monitor-plant", "paper")
    with hold_daemon(folder, "starving", environment, options) as socket:

        def pamctl(*words: str) -> str:
            command = [sys.executable, "-m", "pamctl", *words]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            tell(f"$ pamctl {' '.join(words)}\n{done.stdout[-1500:]}{done.stderr[-1500:]}")
            return done.stdout

        with connect(socket) as rig:
            rig.run(MOTION, name="motion")  # a healthy run: the monitor learns the noise
            fits = _await(lambda: (at := rig.status()["monitor"])["blocks"] and at["sentence"])
            tell(str(fits))
            watched = _watch(rig, folder / "starved")
        of_daemon = ("--socket", str(socket))
        told, out = pamctl("status", *of_daemon), str(folder / "found")
        found = pamctl("diagnose", "--on-rig", "--yes", "--json", "--out", out, *of_daemon)
        gains = folder / "gains.yaml"
        pamctl("tune", "--law", "qsmc", "--plant", f"{out}/plant.yaml", "--out", str(gains))
        with connect(socket) as rig:
            tracked = {"before": str(rig.run(MOTION, name="before").path)}
            rig.load(gains)
            tracked["after"] = str(rig.run(MOTION, name="after").path)
        spoken = {"fits": fits, "status": told, "found": json.loads(found)}
        return {**watched, **spoken, "tracked": tracked}


def _await(find: Callable[[], Any], patience_s: float = PATIENCE_S) -> Any:
    """Return what is found, as soon as it is; what is there then, if the patience ends."""
    deadline_s = time.monotonic() + patience_s
    while not (found := find()) and time.monotonic() < deadline_s:
        time.sleep(1.0)
    return found


def _watch(rig: SteeredRig, flag: Path) -> dict[str, Any]:
    """Let the supply starve in the run; return the first alarm, and the explanation."""
    log, began_s, alarm = str(rig.start(SINE, name="sine")), time.time(), None
    while (at := rig.status())["log"] == log:
        if not flag.exists() and time.time() - began_s > STARVES_AFTER_S:
            flag.touch()
        alarm = alarm or next((b["alarm"] for b in at["monitor"]["blocks"] if b["alarm"]), None)
        time.sleep(0.2)
    _await(lambda: rig.status()["monitor"]["explanation"], EXPLAINED_WITHIN_S)
    monitor = rig.status()["monitor"]
    return {"log": log, "alarm": alarm, "monitor": monitor}


def draw_run(folder: Path, story: dict[str, Any]) -> Report:
    """Draw the run in which the supply starved: what the log holds, and the two moments."""
    run = Run.open(story["log"])
    shown = run["phase"] == Phase.TRACK
    zero_s = run.t_s[shown][0]
    t_s = run.t_s[shown] - zero_s
    moments = _find_moments(run, folder / "starved")
    time_axis = PlotAxis("time", "s", tight=True)
    plots = [
        Plot("Pressure", time_axis, PlotAxis("absolute", "kPa"), height_px=120).line(
            t_s, 1e-3 * run["pressure_pa"][shown]
        ),
        Plot("Command", time_axis, PlotAxis("valve", "V"), height_px=120).line(
            t_s, run["valve_v"][shown]
        ),
        Plot("Tracking error", time_axis, PlotAxis("x - x_D", "µm"), height_px=120).line(
            t_s, 1e6 * run.error_m[shown]
        ),
    ]
    for plot in plots:
        for at, text in moments:
            plot.place(at - zero_s, text if plot is plots[0] else "")
    page = Report(
        "The supply begins to starve", subtitle=f"Log {run.path.name}", numbers_figures=False
    )
    page.add(Figure([*plots]))
    return page


def _find_moments(run: Run, flag: Path) -> list[tuple[float, str]]:
    """Return when the supply starved and when the monitor first said so, on the axis of `t_s`."""
    starved = int(np.searchsorted(run.log.time_ns, flag.stat().st_mtime_ns))
    alarms = [(at, "the alarm") for at, text in run.marks if "x its floor" in text]
    return [(float(run.t_s[starved]), "the supply starves"), *alarms[:1]]


def draw_tracking(story: dict[str, Any]) -> Report:
    """Draw the tracking error with the old gains and with the new ones, on the same axes."""
    page = Report("Tracking on the starved rig", subtitle="before and after", numbers_figures=False)
    plots = []
    for colour, (name, log) in enumerate(story["tracked"].items()):
        run = Run.open(log)
        shown = run["phase"] == Phase.TRACK
        rms_um = 1e6 * run.metrics.rms_error_m
        axes = PlotAxis("time", "s", tight=True), PlotAxis("x - x_D", "µm", low=-250.0, high=250.0)
        plot = Plot(f"{name}: {rms_um:.1f} µm RMS", *axes, height_px=120)
        t_s = run.t_s[shown] - run.t_s[shown][0]
        plots.append(plot.line(t_s, 1e6 * run.error_m[shown], colour=colour))
    page.add(Figure([*plots]))
    return page


def tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="folder; kept, if it has a story")
    parser.add_argument("--pictures", action="store_true", help="draw them from the kept story")
    options = parser.parse_args()
    folder = options.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    kept = folder / "story.json"
    if not kept.exists():
        kept.write_text(json.dumps(record(folder), indent=1))
    story = json.loads(kept.read_text())
    if options.pictures:
        pages = {"run": draw_run(folder, story), "tracking": draw_tracking(story)}
        for name, page in pages.items():
            file = folder / f"{name}.html"
            file.write_text(write_html(page), encoding="utf-8")
            take_picture(file, f"starving-{name}", 920, 700 if name == "run" else 500)
        take_picture(folder / "found" / "report.html", "starving-diagnosis", 920, 1300)


if __name__ == "__main__":
    main()
