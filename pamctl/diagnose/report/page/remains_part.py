"""What does not count, what these data cannot show, and what was compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.evidence.run_pieces import Runs
from pamctl.diagnose.measured.noise.channel_noise import SOURCES, ChannelNoise
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.diagnosis_document import find_masked_shares
from pamctl.diagnose.report.finding_words import spell_names
from pamctl.diagnose.report.phrases import SIGNAL_DISPLAYS, describe_noise
from pamctl.diagnose.report.rig_at_hand import advise_experiment, words_of_rig
from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.report.run_motion import mark_moments


def write_blind_spots(page: Page, diagnosis: Diagnosis) -> None:
    """List what these records cannot show, and pairs that they do not tell apart."""
    audit = diagnosis.audit
    if audit is None or not (audit.blind_spots or audit.inseparable):
        return
    page.section("What these data cannot show")
    if audit.blind_spots:
        page.table(
            ["effect", "why", "experiment that shows it"],
            [
                [
                    spell_names(s.name),
                    f"{s.why}; {s.visibility}",
                    advise_experiment(diagnosis, s.experiment),
                ]
                for s in audit.blind_spots
            ],
            caption="An effect in this list may be present although it is not named.",
        )
    if audit.inseparable:
        page.table(
            ["effects not told apart", "experiment that tells them apart", "why"],
            [
                [spell_names(*p.names), advise_experiment(diagnosis, p.experiment), p.why]
                for p in audit.inseparable
            ],
        )


def write_compared_runs(page: Page, diagnosis: Diagnosis, records: Sequence[Record]) -> None:
    """List the records and their use, the start model, masks, and the sensors' noise."""
    page.section("What was compared")
    evidence = diagnosis.evidence
    train = diagnosis.train or records
    rows = [_record_row(r, "fitted, each block left out in turn" if evidence else "none")
            for r in train]  # fmt: skip
    rows += [_record_row(r, "held out") for r in diagnosis.holdout]
    page.table(["record", "use", "duration, s", "samples", "period, ms", "measured"], rows)
    if diagnosis.accepted:
        page.table(
            ["doubt about the data", "rule", "accepted because"],
            [["; ".join(a.doubts), a.rule, a.reason] for a in diagnosis.accepted],
            caption="These rules would have refused the data. The user overruled them.",
        )
    if evidence is None:
        return
    effects = diagnosis.nominal.effects.model_dump(exclude_none=True)
    page.text(
        f"The start model is {words_of_rig(diagnosis).start_model}, with "
        + (f"{spell_names(*effects)}." if effects else "no further effect.")
        + f" {_describe_simulation(evidence.weigher.train)}"
    )
    masked = find_masked_shares(diagnosis)
    page.table(
        ["sensor", "noise", "converter's step", "unit", "kind", "known", "do not count"],
        [_noise_row(name, diagnosis.noise, masked) for name in evidence.noise_rms],
        caption="Samples at which a record says nothing do not count: gaps, spikes, a frozen "
        "column, no velocity where a motion is imposed, and the first part of a run that does not "
        "begin at rest.",
    )
    faults = describe_noise(diagnosis)
    if faults:
        page.points(*faults)


def _describe_simulation(runs: Runs) -> str:
    if runs.imposed:
        return (
            "Something else moves this axis: the equation of motion gives the force for the "
            "measured motion."
        )
    if runs.actuator == "direct":
        how = "in short windows, each from the measured state" if runs.windowed else "freely"
        return f"The motion is simulated from the measured force, {how}."
    if "valve_v" in runs.stretches[0].inputs:
        return "The whole model is simulated from the command alone."
    return "The motion is simulated from the measured pressure."


def write_measured_runs(page: Page, records: Sequence[Record]) -> None:
    """Draw the records of data that cannot be diagnosed."""
    for record in records:
        plots = []
        for channel in record.channels:
            factor, unit = _UNITS[channel]
            axis = PlotAxis(channel.split("_")[0], unit)
            plot = SvgPlot(channel, PlotAxis("time", "s", tight=True), axis, height_px=110)
            plots.append(plot.line(record.t_s, factor * record[channel]))
        mark_moments(plots, record.moments)
        page.figure(*plots, caption=f"{record.name} as given.")


_UNITS = {
    "valve_v": (1.0, "V"),
    "pressure_pa": (1e-3, "kPa"),
    "position_m": (1e3, "mm"),
    "force_n": (1.0, "N"),
}


def _record_row(record: Record, use: str) -> list[str]:
    measured = ", ".join(channel.rsplit("_", 1)[0] for channel in record.channels)
    if len(record) < 2:
        return [record.name, use, "-", str(len(record)), "-", measured]
    period = f"{1e3 * record.period_s:.3g}"
    return [record.name, use, f"{record.duration_s:.1f}", str(len(record)), period, measured]


def _noise_row(
    channel: str, about: Mapping[str, ChannelNoise], masked: Mapping[str, float]
) -> list[str]:
    display = SIGNAL_DISPLAYS[channel]
    noise = about[channel].noise if channel in about else None
    share = f"{100.0 * masked.get(channel, 0.0):.2g} %"
    if noise is None:
        return [display.title, "-", "-", display.gap_unit, "-", "-", share]
    step = f"{noise.resolution * display.gap_factor:.3g}"
    if not noise.is_known:
        return [display.title, "unknown", step, display.gap_unit, "-", "not from these data", share]
    size = f"{noise.deviation * display.gap_factor:.3g}"
    kind = "correlated from sample to sample" if noise.memory else "white"
    return [display.title, size, step, display.gap_unit, kind, SOURCES[noise.source], share]
