"""`pamctl reproduce`: one page and one file of numbers for the requested parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from pamctl import __version__
from pamctl.report.html_page import Page
from pamctl.reproduce.squares import write_fig3
from pamctl.reproduce.table_iv import write_table4
from pamctl.reproduce.tracking import write_tracking

Part = Callable[[Page, int], dict[str, Any]]

PARTS: dict[str, Part] = {
    "fig3": write_fig3,
    "fig4": lambda page, seed: write_tracking(page, "fig4", seed),
    "fig5": lambda page, seed: write_tracking(page, "fig5", seed),
    "table4": write_table4,
}
"""The parts that can be reproduced, in the order of the paper."""

SCHEMA = 1


class Reproduction(NamedTuple):
    """The result: `numbers` is in SI, and equal for equal seeds."""

    page: Page
    numbers: dict[str, Any]


def reproduce_paper(
    parts: Sequence[str], seed: int, progress: Callable[[str], None] = lambda name: None
) -> Reproduction:
    """Simulate and lay out these of `PARTS`; `progress` gets the name of each as it begins."""
    page = Page(
        "The paper, reproduced",
        "Modeling of Pneumatic Artificial Muscle with Kinetic Friction and Sliding Mode Control",
        numbered=False,
    )
    page.text(
        f"Made by pamctl {__version__}, seed {seed}: the tick of the loop on the simulated rig, "
        "with an encoder of 3.175 µm per count and 300 Pa of pressure noise. Errors are measured "
        "displacement minus reference."
    )
    numbers: dict[str, Any] = {"schema": SCHEMA, "version": __version__, "seed": seed}
    for name in parts:
        progress(name)
        numbers[name] = PARTS[name](page, seed)
    return Reproduction(page, numbers)
