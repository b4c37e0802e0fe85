"""What remains, what these data cannot show, and what was compared."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.diagnose.diagnosis import Diagnosis, find_largest_remainder
from pamctl.diagnose.measured.noise.channel_noise import SOURCES
from pamctl.diagnose.measured.noise.sensor_noise import Noise
from pamctl.diagnose.measured.record import Record
from pamctl.diagnose.report.compared_models import SIGNAL_DISPLAYS
from pamctl.diagnose.report.page.regime_map import write_shape
from pamctl.diagnose.report.phrases import (
    describe_largest_remainder,
    describe_limits,
    describe_remainder,
    describe_signs,
    describe_substeps,
    spell_names,
)
from pamctl.diagnose.report.rig_at_hand import advise_experiment, words_of_rig
from pamctl.report.drawing.svg import PlotAxis, SvgPlot
from pamctl.report.html_page import Page
from pamctl.report.motion_section import mark_moments


def write_remainder(page: Page, diagnosis: Diagnosis) -> None:
    """Say what is left, and where."""
    model = diagnosis.model
    if model is None:
        return
    page.section("What remains")
    page.text(describe_limits(model))
    if substeps := describe_substeps(diagnosis.substep_changes):
        page.note(substeps)
    if diagnosis.signs:
        page.note(describe_signs(diagnosis))
    if model.is_complete:
        block, ratio, _ = find_largest_remainder(diagnosis)
        limit = model.floors[block].limit / model.floors[block].mean
        page.text(
            f"Nothing is above the limit. The {block} block is nearest to it, at {ratio:.2f} times "
            f"its floor; the limit is {limit:.2f}."
        )
        return
    page.text(describe_largest_remainder(diagnosis))
    write_shape(page, diagnosis)
    if diagnosis.remainder is not None:
        page.note(describe_remainder(diagnosis.remainder, diagnosis.nominal.actuator))


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
    """List the records and their use, the start model, and the sensors' noise."""
    page.section("What was compared")
    train, holdout = diagnosis.train or records, diagnosis.holdout
    cut = {r.name for r in train} & {r.name for r in holdout}
    rows = [
        _record_row(r, "cut: half for the fit, a third to choose by, a sixth to confirm")
        for r in train
        if r.name in cut
    ]
    rows += [_record_row(r, "fit" if holdout else "none") for r in train if r.name not in cut]
    rows += [
        _record_row(r, "two thirds to choose by, one to confirm")
        for r in holdout
        if r.name not in cut
    ]
    page.table(["record", "use", "duration, s", "samples", "period, ms", "measured"], rows)
    if diagnosis.accepted:
        page.table(
            ["doubt about the data", "rule", "accepted because"],
            [["; ".join(a.doubts), a.rule, a.reason] for a in diagnosis.accepted],
            caption="These rules would have refused the data. The user overruled them.",
        )
    model = diagnosis.model
    if model is None:
        return
    effects = diagnosis.nominal.effects.model_dump(exclude_none=True)
    page.text(
        f"The start model is {words_of_rig(diagnosis).start_model}, with "
        + (f"{spell_names(*effects)}." if effects else "no further effect.")
    )
    page.table(
        ["sensor", "noise", "converter's step", "unit", "kind", "known"],
        [_noise_row(name, noise) for name, noise in model.evidence.noises.items()],
    )


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


def _noise_row(channel: str, noise: Noise) -> list[str]:
    display = SIGNAL_DISPLAYS[channel]
    step = f"{noise.resolution * display.gap_factor:.3g}"
    if not noise.is_known:
        return [display.title, "unknown", step, display.gap_unit, "-", "not from these data"]
    size = f"{noise.deviation * display.gap_factor:.3g}"
    kind = "correlated from sample to sample" if noise.memory else "white"
    return [display.title, size, step, display.gap_unit, kind, SOURCES[noise.source]]
