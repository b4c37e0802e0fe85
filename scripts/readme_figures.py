"""Make the pictures of the README: screenshots of `pamctl report`, `reproduce` and `diagnose`.

    python scripts/readme_figures.py [NAME ...]     # default: all

Writes into .readme/. Needs Chromium (apt-get install chromium).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from pamctl.log import read
from pamctl.models.reproduction import PRINTED_QSMC, TUNED, reproduce_paper
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import Plot
from pamctl.report.html_page import write_html
from pamctl.report.report import Figure, Report
from pamctl.report.run_page import compose_report
from pamctl.signals import Phase

PICTURES = Path(__file__).resolve().parents[1] / ".readme"
BESIDE = """<!doctype html><body style="margin:0;display:flex;gap:24px;background:#d9dde2">
<iframe src="{page}" style="width:920px;height:{height}px;border:0"></iframe>
<iframe src="{page}" style="width:390px;height:{height}px;border:0"></iframe>"""


def make_log(folder: Path) -> Path:
    """Return the log of a run in real time, with timing."""
    log = folder / "run.mcap"
    device = "rig.sim.device=sim-readme"
    command = [sys.executable, "-m", "pamctl", "run", "--quiet", "--set", device]
    subprocess.run([*command, "--log", str(log)], check=True, stdout=subprocess.DEVNULL)
    return log


def make_diagnosis(folder: Path) -> Path:
    """Return the page of a diagnosis: the rig's valve has a dead band that the model lacks."""
    plant, out = folder / "mine.yaml", folder / "diagnosis"
    plant.write_text("effects: {valve_deadband: {fill_width_v: 0.25, exhaust_width_v: 0.2}}\n")
    logs = [folder / f"run-{seed}.mcap" for seed in (1, 2)]
    pamctl = [sys.executable, "-m", "pamctl"]
    run = [*pamctl, "run", "--experiment", "diagnosis", "--plant", str(plant), "--fast", "--quiet"]
    for seed, log in enumerate(logs, 1):
        varied = ["--seed", str(seed), "--set", f"experiment.seed={seed}", "--log", str(log)]
        subprocess.run([*run, *varied], check=True, stdout=subprocess.DEVNULL)
    held_out = ["--holdout", str(logs[1]), "--out", str(out)]
    subprocess.run([*pamctl, "diagnose", str(logs[0]), *held_out], check=True)
    return out / "report.html"


def make_laws_page() -> Report:
    """Make a page with the errors of four gains files in experiment 2, on the same axes."""
    page = Report(
        "True error in experiment 2",
        subtitle="On the model of Tables I and II",
        numbers_figures=False,
    )
    time, plots = PlotAxis("time since the end of the approach", "s", tight=True), []
    for colour, case in enumerate((PRINTED_QSMC, *TUNED[:3])):
        run = case.run("tracking-2", "paper", 0)
        shown = (run["phase"] == Phase.TRACK) | (run["phase"] == Phase.REST)
        error_um = (run["true_position_m"] - run["reference_m"])[shown] * 1e6
        t_s = run.t_s[shown] - run.t_s[shown][0]
        axis = PlotAxis("x \N{MINUS SIGN} x_D", "µm", low=-100.0, high=200.0)
        plots.append(Plot(case.name, time, axis, height_px=90).line(t_s, error_um, colour=colour))
    page.add(Figure([*plots]))
    return page


def take_picture(page: Path, name: str, width: int, height: int) -> None:
    """Take a picture of the top of a page."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("error: no Chromium; apt-get install chromium")
    look = ["--headless", "--no-sandbox", "--hide-scrollbars", f"--window-size={width},{height}"]
    taken = [f"--screenshot={PICTURES / name}.png", page.as_uri()]
    subprocess.run([browser, *look, *taken], check=True, capture_output=True)


def take_picture_pair(page: Path, name: str, height: int) -> None:
    """Take a picture of the top of a page on a screen and on a phone, side by side."""
    both = page.with_name("both.html")
    both.write_text(BESIDE.format(page=page.name, height=height))
    take_picture(both, name, 1334, height)


HEIGHTS = {"report": 1500, "fig3": 1310, "fig5": 1245, "laws": 720, "diagnosis": 1500}
BESIDE_A_PHONE = ("report", "diagnosis")


def make_page(name: str, folder: Path) -> Path:
    """Make the page for a picture."""
    if name == "diagnosis":
        return make_diagnosis(folder)
    file = folder / f"{name}.html"
    if name == "report":
        page = compose_report([read(make_log(folder))])
    else:
        page = make_laws_page() if name == "laws" else reproduce_paper([name], 0)
    file.write_text(write_html(page), encoding="utf-8")
    return file


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(HEIGHTS)}")
    names = parser.parse_args().names or list(HEIGHTS)
    if unknown := set(names) - set(HEIGHTS):
        parser.error(f"no picture is named {', '.join(sorted(unknown))}")
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        for name in names:
            page = make_page(name, Path(temporary))
            if name in BESIDE_A_PHONE:
                take_picture_pair(page, name, HEIGHTS[name])
            else:
                take_picture(page, name, 920, HEIGHTS[name])


if __name__ == "__main__":
    main()
