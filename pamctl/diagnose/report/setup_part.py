"""What is wrong about the set-up, for the page, the terminal and the plant file."""

from __future__ import annotations

from collections.abc import Iterator

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.report.phrases import spell_names
from pamctl.diagnose.setup.setup_finding import SetupFinding
from pamctl.report.html_page import Page


def describe_setup(diagnosis: Diagnosis) -> str:
    """Return the findings as sentences; empty where the set-up is in order."""
    return "".join(f"{_describe(finding)} " for finding in diagnosis.setup if not diagnosis.reason)


def _describe(finding: SetupFinding) -> str:
    text = f"Set-up: {finding.text}."
    if not finding.cannot_be_told_from:
        return text
    others = " or ".join(map(spell_names, finding.cannot_be_told_from))
    return f"{text} These data cannot tell it from {others}."


def list_setup_rows(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield a terminal's lines: how to mend each finding."""
    for finding in diagnosis.setup:
        nearer = f"; {finding.block} {finding.gain:.3g} times nearer with it"
        yield f"set-up: {finding.text}{nearer if finding.gain > 1.0 else ''}"
        yield f"  to mend it: {finding.how_to_mend}"


def write_setup(page: Page, diagnosis: Diagnosis) -> None:
    """Write the findings, and how to mend them."""
    if not diagnosis.setup:
        return
    page.section("The set-up")
    page.table(
        ["what is wrong", "value", "90 % interval", "unit", "gap smaller by", "not told from"],
        [
            [
                finding.text,
                f"{finding.value:.5g}",
                f"{finding.ci90[0]:.5g} to {finding.ci90[1]:.5g}",
                finding.unit,
                f"{finding.gain:.3g} ({finding.block})",
                ", ".join(map(spell_names, finding.cannot_be_told_from)) or "-",
            ]
            for finding in diagnosis.setup
        ],
        caption="Asked before any effect: each is a number of the plant file or a column of the "
        "records. What else is said on this page rests on the corrected set-up, unless an effect "
        "explains the same.",
    )
    for finding in diagnosis.setup:
        page.text(f"To mend it: {finding.how_to_mend}.")
