"""The pictures of the README, from logs of real runs on the simulated rig.

    python scripts/readme_figures.py

Writes into .readme/. Needs the development packages.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from pamctl.log.reader import Log, read
from pamctl.signals import Phase

PICTURES = Path(__file__).resolve().parents[1] / ".readme"
SERIES = ("#2a6fbb", "#d1732c", "#4f8f3a", "#8b5fbf")
REFERENCE = "#8a8a8a"


def simulated(folder: Path, name: str, *options: str) -> Log:
    """Log of one run without a clock."""
    path = folder / f"{name}.mcap"
    command = [sys.executable, "-m", "pamctl", "run", "--fast", "--quiet"]
    subprocess.run([*command, "--log", str(path), *options], check=True, stdout=subprocess.DEVNULL)
    return read(path)


def since_homing(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Ticks after homing and before the stop, and their times from the end of homing."""
    kept = (log["phase"] != Phase.HOMING) & (log["phase"] != Phase.STOPPING)
    t_s = log.t[kept]
    return kept, t_s - t_s[0]


def plain(axes: Axes, label: str) -> None:
    axes.set_ylabel(label)
    axes.grid(color="#e4e4e4", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def tracking(log: Log) -> None:
    """Experiment 1: what was asked, what came, and at what command."""
    kept, t_s = since_homing(log)
    rows = (
        ("displacement\nmm", 1e3, ("reference_m", "position_m")),
        ("error\nµm", 1e6, ("error",)),
        ("pressure\nkPa", 1e-3, ("pressure_pa",)),
        ("command\nV", 1.0, ("valve_v",)),
    )
    figure, stack = plt.subplots(len(rows), 1, figsize=(9, 7), sharex=True)
    for axes, (label, scale, names) in zip(stack, rows, strict=True):
        for name in names:
            asked = name == "reference_m"
            values = log["position_m"] - log["reference_m"] if name == "error" else log[name]
            axes.plot(
                t_s,
                values[kept] * scale,
                color=REFERENCE if asked else SERIES[0],
                linewidth=2.5 if asked else 0.8,
                label="reference" if asked else "measured",
            )
        plain(axes, label)
    stack[0].legend(frameon=False, loc="lower right", bbox_to_anchor=(1, 1), ncols=2)
    stack[-1].set_xlabel("time since homing, s")
    figure.suptitle("qSMC on the simulated rig, experiment 1", x=0.02, ha="left")
    save(figure, "tracking")


def squares(logs: dict[str, Log]) -> None:
    """Fig. 3's experiment on the model: full-scale squares, displacement and pressure."""
    figure, grid = plt.subplots(2, len(logs), figsize=(10, 4.5), sharey="row")
    for column, (frequency, log) in zip(grid.T, logs.items(), strict=True):
        kept, t_s = since_homing(log)
        shown = t_s < min(4.0, 2.0 / float(frequency))
        for axes, name, scale in zip(
            column, ("position_m", "pressure_pa"), (1e3, 1e-3), strict=True
        ):
            axes.plot(t_s[shown], log[name][kept][shown] * scale, color=SERIES[0], linewidth=1)
            plain(axes, "")
        column[0].set_title(f"{frequency} Hz", fontsize=10)
        column[1].set_xlabel("s")
    grid[0, 0].set_ylabel("displacement, mm")
    grid[1, 0].set_ylabel("pressure, kPa absolute")
    save(figure, "squares")


def laws(logs: dict[str, Log]) -> None:
    """The error of each law in experiment 2, on the same axes."""
    figure, axes = plt.subplots(figsize=(9, 3.2))
    for (law, log), colour in zip(logs.items(), SERIES, strict=False):
        kept, t_s = since_homing(log)
        error_um = (log["true_position_m"] - log["reference_m"])[kept] * 1e6
        axes.plot(t_s, error_um, color=colour, linewidth=0.8, label=law)
    plain(axes, "true error, µm")
    axes.set_xlabel("time since homing, s")
    axes.legend(frameon=False, ncols=4, loc="lower right", bbox_to_anchor=(1, 1))
    save(figure, "laws")


def save(figure: plt.Figure, name: str) -> None:
    figure.tight_layout()
    figure.savefig(PICTURES / f"{name}.png", dpi=110, metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        tracking(simulated(folder, "one", "--experiment", "tracking-1"))
        squares(
            {
                f: simulated(folder, f"square-{f}", "--experiment", f"square-{f}")
                for f in ("0.25", "0.5", "1", "2")
            }
        )
        laws(
            {
                law: simulated(folder, law, "--controller", law)
                for law in ("qsmc", "smc", "pid", "paper-table3-qsmc")
            }
        )


if __name__ == "__main__":
    main()
