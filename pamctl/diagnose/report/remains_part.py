"""What remains, what these data could not have shown, and what was compared."""

from __future__ import annotations

from collections.abc import Sequence

from pamctl.diagnose.diagnosis import Diagnosis, find_largest_remainder
from pamctl.diagnose.experiments import write_command
from pamctl.diagnose.fitting.integrator import describe_integrator
from pamctl.diagnose.measured.record import CHANNELS, Record
from pamctl.diagnose.report.compared_models import SIGNAL_DISPLAYS
from pamctl.diagnose.report.page_words import spell_names
from pamctl.diagnose.report.regime_map import write_shape
from pamctl.diagnose.report.sentences import describe_correction_result, describe_discrepancy_limits
from pamctl.report.html_page import Page
from pamctl.report.svg import PlotAxis, SvgPlot


def write_remainder(page: Page, diagnosis: Diagnosis) -> None:
    """Say what is left, and where."""
    model = diagnosis.model
    if model is None:
        return
    page.section("What remains")
    page.text(describe_discrepancy_limits(model))
    if describe_integrator(diagnosis.stepping):
        page.note(describe_integrator(diagnosis.stepping))
    if model.is_complete:
        block, ratio, _ = find_largest_remainder(diagnosis)
        page.text(
            f"Nothing above the limit. The {block} block is nearest to it, at {ratio:.2f} times "
            f"its floor where {model.floors[block].limit / model.floors[block].mean:.2f} would "
            "count as a discrepancy."
        )
        return
    block, ratio, regimes = find_largest_remainder(diagnosis)
    page.text(f"The {block} block is left at {ratio:.1f} times its floor: {regimes}.")
    write_shape(page, diagnosis)
    if diagnosis.remainder is not None:
        page.note(diagnosis.remainder.sentence)
    if diagnosis.corrected is not None:
        page.note(describe_correction_result(diagnosis.corrected))


def write_blind_spots(page: Page, diagnosis: Diagnosis) -> None:
    """List what these records could not have shown, and pairs that they do not tell apart."""
    audit = diagnosis.audit
    if audit is None or not (audit.blind_spots or audit.inseparable):
        return
    page.section("What these data cannot show")
    if audit.blind_spots:
        page.table(
            ["effect", "why", "experiment that shows it"],
            [
                [spell_names(s.name), f"{s.why}; {s.visibility}", write_command(s.experiment)]
                for s in audit.blind_spots
            ],
            caption="That an effect is not named says nothing where it is listed here.",
        )
    if audit.inseparable:
        page.table(
            ["effects", "not told apart by these data; the experiment that would", "why"],
            [
                [spell_names(*p.names), write_command(p.experiment), p.why]
                for p in audit.inseparable
            ],
        )


def write_compared_runs(page: Page, diagnosis: Diagnosis, records: Sequence[Record]) -> None:
    """Say what was measured, what it was held against, and how."""
    page.section("What was compared")
    train, holdout = diagnosis.train or records, diagnosis.holdout
    cut = {r.name for r in train} & {r.name for r in holdout}
    rows = [
        _record_row(r, "cut: two thirds fitted on, one judged by") for r in train if r.name in cut
    ]
    rows += [_record_row(r, "fitted on" if holdout else "none") for r in train if r.name not in cut]
    rows += [_record_row(r, "judged by") for r in holdout if r.name not in cut]
    page.table(["record", "use", "duration, s", "samples", "period, ms", "measured"], rows)
    model = diagnosis.model
    if model is None:
        return
    effects = diagnosis.nominal.effects.model_dump(exclude_none=True)
    page.text(
        f"The start model has the base {diagnosis.nominal.base} and "
        + (f"the effects {spell_names(*effects)}." if effects else "no further effect.")
    )
    noises = model.evidence.noises
    page.table(
        ["sensor", "noise", "converter's step", "unit", "kind"],
        [_noise_row(name, noise.deviation, noise.resolution, bool(noise.memory))
         for name, noise in noises.items() if name in SIGNAL_DISPLAYS],
        caption="Estimated from the rest at the beginning, or from differences.",
    )  # fmt: skip


def write_measured_runs(page: Page, records: Sequence[Record]) -> None:
    """Draw the records as they came, where nothing could be made of them."""
    for record in records:
        plots = []
        for channel in record.channels:
            factor, unit = _UNITS[channel]
            axis = PlotAxis(channel.split("_")[0], unit)
            plot = SvgPlot(channel, PlotAxis("time", "s", tight=True), axis, height_px=110)
            plots.append(plot.line(record.t_s, factor * record[channel]))
        page.figure(*plots, caption=f"{record.name} as it was given.")


_UNITS = {
    **dict.fromkeys(CHANNELS, (1.0, "")),
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


def _noise_row(channel: str, deviation: float, step: float, coloured: bool) -> list[str]:
    how = SIGNAL_DISPLAYS[channel]
    kind = "correlated from sample to sample" if coloured else "white"
    cells = [f"{value * how.gap_factor:.3g}" for value in (deviation, step)]
    return [how.title, *cells, how.gap_unit, kind]
