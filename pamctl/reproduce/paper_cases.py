"""The runs that are compared with the paper, and a remark on each.

A `Part` is a function for a part of the reproduction: it writes a section of the page and returns
its numbers in SI.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from pamctl.settings.resolve import resolve
from pamctl.simulate.closed_loop import SimulatedRun, simulate_run

PLANTS = {"paper": "of Tables I and II", "paper-valve109": "with the valve's 109 Hz"}
"""Shipped plants on which the reproduction runs."""


@dataclass(frozen=True)
class Case:
    """A law with its gains."""

    name: str
    controller: str
    overrides: tuple[str, ...] = ()
    remark: str = ""

    def run(self, experiment: str, plant: str, seed: int) -> SimulatedRun:
        """Simulate it."""
        return _simulate_case(self.controller, self.overrides, experiment, plant, seed)


PRINTED_QSMC = Case("qSMC as printed", "paper-table3-qsmc", remark="Table III literally, in inches")
IN_MILLIMETRES = Case(
    "qSMC as printed, in mm",
    "paper-table3-qsmc",
    ("controller.length_unit=mm", "controller.eta=10.2", "controller.phi=0.51"),
    "the same numbers with e in millimetres: Eq. 15 is not homogeneous, so it is another law",
)
PRINTED_SMC = Case("SMC as printed", "paper-table3-smc", remark="Table III literally, in inches")
UNHINDERED_SMC = Case(
    "SMC as printed, no limit",
    "paper-table3-smc",
    ("rig.limits.tracking_error_mm=100",),
    "the same with the limit on the tracking error lifted",
)
FITTED_SMC = Case(
    "SMC, K_p fitted",
    "paper-table3-smc",
    ("controller.kp=0.65",),
    "as printed, but K_p is 0.65 instead of 0.00025: fitted to Table IV, so it confirms nothing",
)
TUNED = (
    Case("qSMC tuned", "qsmc", remark="the default: one set for all plants"),
    Case("SMC tuned", "smc", remark="one set for all plants"),
    Case("PID tuned", "pid", remark="one set for all plants"),
    Case("qSMC for this plant", "qsmc-paper-plant", remark="tuned for the paper's plant alone"),
    Case("SMC for this plant", "smc-paper-plant", remark="tuned for the paper's plant alone"),
    Case("PID for this plant", "pid-paper-plant", remark="tuned for the paper's plant alone"),
)
ALL = (PRINTED_QSMC, IN_MILLIMETRES, PRINTED_SMC, UNHINDERED_SMC, FITTED_SMC, *TUNED)


@lru_cache(maxsize=64)
def _simulate_case(
    controller: str, overrides: tuple[str, ...], experiment: str, plant: str, seed: int
) -> SimulatedRun:
    return simulate_run(
        resolve(
            controller=controller,
            experiment=experiment,
            plant=plant,
            overrides=overrides,
            seed=seed,
        )
    )
