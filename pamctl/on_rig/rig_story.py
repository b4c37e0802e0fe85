"""The folder of an investigation: the diagnosis's own files, with the story of the rounds."""

from __future__ import annotations

from pathlib import Path

from pamctl.diagnose.report.diagnosis_folder import write_diagnosis
from pamctl.diagnose.report.finding_words import spell_names
from pamctl.on_rig.decide_on_rig import Investigation, list_logs
from pamctl.on_rig.rig_round import RigRound
from pamctl.report.html_page import Page


def write_investigation(investigation: Investigation, out: Path) -> list[str]:
    """Write the folder and return the names in it; nothing where nothing was diagnosed yet.

    Raises NewFileError: then nothing is left.
    """
    if investigation.diagnosis is None:
        return []
    return write_diagnosis(
        investigation.diagnosis,
        out,
        list_logs(investigation),
        investigation.records,
        beside={"on_rig": investigation.as_dict()},
        story=lambda page: tell_rounds(page, investigation),
    )


def tell_rounds(page: Page, investigation: Investigation) -> None:
    """Tell round by round what was run, why, what was expected and what came of it."""
    page.section("On the rig, round by round")
    page.table(
        ["round", "program", "on the rig", "verdict", "explanations left"],
        [
            [
                str(each.number),
                each.program or "given logs",
                f"{each.rig_time_s:.0f} s",
                each.diagnosis.verdict.value.replace("_", " "),
                "; ".join(map(spell_names, each.left)) or "-",
            ]
            for each in investigation.rounds
        ],
        caption=f"{investigation.rig_time_s:.0f} s on the rig. It stopped there because "
        f"{investigation.stopped}.",
    )
    page.points(*map(_tell_round, investigation.rounds))


def _tell_round(each: RigRound) -> str:
    parts = [f"Round {each.number}, {each.program or 'given logs'}: {each.why}."]
    for forecast in each.diagnosis.forecasts:
        if forecast.record == each.log:
            came = "was not fitted again" if forecast.found is None else f"{forecast.found:.2f}"
            parts.append(
                f"Expected: {spell_names(forecast.refuted)} leaves {forecast.expected:.2f} times "
                f"the sensor's noise in the {forecast.block}; found: {came}."
            )
    for repeated in each.repeated:
        unit, factor = ("Pa", 1.0) if repeated.channel == "pressure_pa" else ("µm", 1e6)
        parts.append(
            f"The repeated strokes differ from the first by {factor * repeated.rms:.3g} {unit} RMS"
            f" in the {'pressure' if unit == 'Pa' else 'position'}; two readings of the sensor "
            f"differ by {factor * repeated.noise:.3g} {unit}."
        )
    return " ".join(parts)
