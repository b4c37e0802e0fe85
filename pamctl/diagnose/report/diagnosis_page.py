"""`report.html`: the diagnosis for a reader who was not there, on one page without a network."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pamctl.base.new_file import write_files
from pamctl.diagnose.diagnosis import Diagnosis, HeldOutGap
from pamctl.diagnose.evidence.ladder import Finding
from pamctl.diagnose.evidence.run_pieces import Runs
from pamctl.diagnose.plant_numbers import FittedNumber, look_up_parameter
from pamctl.diagnose.record import SOURCES, ChannelNoise, Record, group_notes
from pamctl.diagnose.report.diagnosis_document import (
    build_diagnosis_document,
    find_masked_shares,
)
from pamctl.diagnose.report.finding_words import (
    FreeTerm,
    is_in_catalogue,
    label_hypothesis,
    list_faults,
    list_fitted,
    list_numbers,
    spell_best,
    spell_finding,
    spell_kind,
    spell_names,
    spell_place,
)
from pamctl.diagnose.report.next_experiment import (
    NEXT_COMMANDS,
    NEXT_EXPERIMENT,
    advise_experiment,
    format_commands,
    format_experiment_file,
    runs_here,
    words_of_rig,
)
from pamctl.diagnose.report.traces_part import ModelStage, list_stages, write_traces
from pamctl.diagnose.report.verdict_phrases import (
    describe_data,
    describe_left,
    explain_no_name,
    relative_shift,
    spell_end,
)
from pamctl.diagnose.report.verdict_words import advise_next_steps, choose_words, sentence
from pamctl.plant.catalogue import CATALOGUE
from pamctl.report.axes import PlotAxis
from pamctl.report.figure import MUTED, Levels, Plot
from pamctl.report.html_page import write_html
from pamctl.report.report import (
    SIGNAL_DISPLAYS,
    Facts,
    Figure,
    Fold,
    Points,
    Report,
    ReportTable,
    Section,
    Text,
)
from pamctl.report.run_motion import mark_moments
from pamctl.settings.yaml12 import dump_yaml


def build_diagnosis_page(
    diagnosis: Diagnosis,
    records: Sequence[Record],
    story: Callable[[Report], None] | None = None,
) -> Report:
    """Return the page of a diagnosis; `records` are all records that were given, good or bad.

    `story` writes below the head how the records came about.
    """
    names = [record.name for record in records]
    page = Report(choose_words(diagnosis).title, subtitle=f"Diagnosis of {', '.join(names)}")
    _write_head(page, diagnosis)
    if story is not None:
        story(page)
    if diagnosis.reason:
        write_compared_runs(page, diagnosis, records)
        write_measured_runs(page, records)
        return page
    write_setup(page, diagnosis)
    write_traces(page, diagnosis)
    write_findings(page, diagnosis)
    write_blind_spots(page, diagnosis)
    write_compared_runs(page, diagnosis, records)
    page.add(Fold("plant.yaml", format_plant_file(diagnosis, names)))
    return page


def _write_head(page: Report, diagnosis: Diagnosis) -> None:
    """Write the verdict, the next steps and the gap."""
    words = choose_words(diagnosis)
    page.add(Text(f"{words.why} {words.body}", words.kind))
    page.add(Section("What to do next", is_part=True))
    page.add(Points([*advise_next_steps(diagnosis)]))
    stages = list_stages(diagnosis)
    if stages:
        page.add(
            Figure(
                [*(_draw_levels(name, gap, stages) for name, gap in diagnosis.gap.items())],
                _write_caption(diagnosis),
                is_grid=True,
            )
        )


def _draw_levels(name: str, gap: HeldOutGap, stages: Sequence[ModelStage]) -> Levels:
    signal = SIGNAL_DISPLAYS[name]
    values = [float(getattr(gap, stage.key)) for stage in stages]
    factor, unit = signal.choose_unit(max(values))
    levels = Levels(signal.title, unit)
    for stage, value in zip(stages, values, strict=True):
        levels.bar(stage.label, factor * value, colour=stage.colour)
    levels.mark(factor * gap.floor)
    return levels


def _write_caption(diagnosis: Diagnosis) -> str:
    used = (
        "on seconds that were used for no fit"
        if diagnosis.is_held_out
        else "on the fitted records, since none were held out"
    )
    parts = [
        f"{100.0 * gap.closed:.1f} % of the {SIGNAL_DISPLAYS[name].short}'s gap"
        for name, gap in diagnosis.gap.items()
        if gap.is_open
    ]
    closed = f" The findings close {' and '.join(parts)}, counted from recalibrated to this line."
    return (
        f"RMS of measurement minus simulation, {used}. The dashed line is the sensor's own noise."
        + (closed if parts and diagnosis.findings else "")
    )


MOST_RIVALS = 5
"""Bars of rivals below a finding's own."""
_SURE = {
    "name": "the name: every rival that was fitted in its place is beaten",
    "kind": "place and kind",
    "place": "the place",
    "set": "that one of these is there",
    "rest": "nothing: it mends the model, and takes off too little, or is not asked, for a name",
    "unjudged": "nothing: the search was interrupted before its rivals were fitted",
}


def write_setup(page: Report, diagnosis: Diagnosis) -> None:
    """Write what is wrong about the set-up; how to mend it stands in the head."""
    rows = [
        [
            fault.text,
            *FittedNumber("", fault.value, *fault.ci90, fault.unit).spell(),
            ", ".join(map(spell_names, fault.cannot_be_told_from)) or "-",
        ]
        for fault in list_faults(diagnosis)
    ]
    if rows:
        page.add(Section("The set-up"))
        page.add(
            ReportTable(
                ["what is wrong", "value", "90 % interval", "unit", "not told from"],
                rows,
                "Each is a number of the plant file or a column of the records. It was asked "
                "together with the effects, and by the same rule.",
            )
        )


def write_findings(page: Report, diagnosis: Diagnosis) -> None:
    """Write each finding with its rivals and numbers, then the numbers that were recalibrated."""
    if diagnosis.findings:
        page.add(Section("What was found"))
        page.add(
            Text(
                "A gain is counted in nats, on each block of the records by a model that was not "
                "fitted to that block. It is counted under the resolution of the poorer of two "
                "models. So gains do not add up: without one thing that was found the model is "
                "sharper than without all, and loses more nats. Intervals come from a bootstrap "
                "over stretches of 4 blocks, 0.5 % on each side."
            )
        )
    for finding in diagnosis.findings:
        _write_finding(page, diagnosis, finding)
    if diagnosis.recalibrated:
        page.add(Section("The numbers of the model"))
        page.add(
            ReportTable(
                ["parameter", "start model", "fitted", "90 % interval", "unit", "off by", "range"],
                list(_list_recalibrated(diagnosis)),
                "Fitted together with all findings. A number is off if its interval does not "
                "include the start model's value. A number at an end of its range may lie "
                "beyond it.",
            )
        )


def _write_finding(page: Report, diagnosis: Diagnosis, finding: Finding) -> None:
    its, why = finding.hypothesis, {}
    if finding.level in ("kind", "place"):
        why = {"why no name": explain_no_name(finding)}
    page.add(Section(spell_finding(diagnosis, finding), is_part=True))
    page.add(
        Facts(
            {
                "what is sure": _SURE[finding.level],
                **why,
                "place": spell_place(its.place),
                "kind": spell_kind(its.kind),
                "fits best": spell_best(finding),
                "gain": f"{finding.gain_nats:.0f} nats",
            }
        )
    )
    if is_in_catalogue(finding):
        effect = CATALOGUE[its.family]
        page.add(Text(effect.equation, "note"))
        page.add(Text(f"What a model without it shows: {effect.signature}."))
    term = FreeTerm.read(diagnosis, finding) if its.is_term else None
    if term is not None:
        kin = f" Kin in the catalogue: {spell_names(*term.kin)}." if term.kin else ""
        page.add(Text(f"{term.text[:1].upper()}{term.text[1:]}. {term.equation}.{kin}", "note"))
    page.add(Figure([_draw_rivals(finding)], _explain_rivals(finding), is_grid=True))
    page.add(
        ReportTable(
            ["number", "meaning", "value", "90 % interval", "unit", "range"],
            [_number_row(diagnosis, finding, n) for n in list_numbers(finding)],
        )
    )
    if term is not None and term.curve:
        unit = "" if term.location.unit == "1" else f", {term.location.unit}"
        driver = f"{term.driver}, {term.as_dict([])['driver_unit']}"
        page.add(
            ReportTable(
                [driver, f"size{unit}", "90 % interval"],
                [
                    [
                        f"{p['at']:.4g}",
                        f"{p['value']:.4g}",
                        " to ".join(f"{e:.4g}" for e in p["ci90"]),
                    ]
                    for p in term.curve
                ],
                "The curve: linear between these points, and constant beyond them. What "
                "recalibration imitates may move the whole of it.",
            )
        )


def _draw_rivals(finding: Finding) -> Levels:
    plot = Levels("Lost without it, and with a rival in its place", "nats")
    plot.bar("without it", finding.gain_nats, ends=finding.interval_nats)
    for j in finding.judged[:MOST_RIVALS]:
        colour = 1 if j.is_beaten else MUTED if j.is_freer else 3
        label = spell_names(label_hypothesis(j.hypothesis))
        plot.bar(label, j.behind_nats, colour=colour, ends=j.interval_nats)
    return plot


def _explain_rivals(finding: Finding) -> str:
    if not finding.judged:
        return "No rival came near enough to be fitted in its place."
    open_ones = [j for j in finding.judged[:MOST_RIVALS] if not j.is_beaten]
    near = sum(not j.is_freer for j in open_ones)
    left = f" {near} of these cannot be ruled out." if near else ""
    freer = (
        " The grey bar is a freer law of the same place: it can always mimic a name, and counts "
        "only where it does better."
    )
    return (
        "Each rival was fitted in its place, beside the rest of the model. A rival is beaten if it "
        "surely loses a tenth of what is lost without the finding, or takes off clearly less, or "
        f"has more numbers and gains nothing for them.{left}"
        f"{freer if near < len(open_ones) else ''}"
    )


def _number_row(diagnosis: Diagnosis, finding: Finding, n: FittedNumber) -> list[str]:
    meaning = look_up_parameter(n.name).meaning if is_in_catalogue(finding) else "-"
    return [n.name.lstrip("~"), meaning, *n.spell(), spell_end(diagnosis, n.name)]


def _list_recalibrated(diagnosis: Diagnosis) -> Iterator[Sequence[str]]:
    for n in diagnosis.recalibrated:
        off = relative_shift(diagnosis, n)
        yield [
            n.name,
            f"{diagnosis.start_value(n.name):.5g}",
            *n.spell(),
            f"{100.0 * off:+.2f} %" if off is not None else "-",
            spell_end(diagnosis, n.name),
        ]


def write_blind_spots(page: Report, diagnosis: Diagnosis) -> None:
    """List what these records cannot show."""
    spots = diagnosis.audit.blind_spots if diagnosis.audit else ()
    if not spots:
        return
    page.add(Section("What these data cannot show"))
    rows = [
        [
            spell_names(s.name),
            f"{s.why}; {s.visibility}",
            advise_experiment(diagnosis, s.experiment),
        ]
        for s in spots
    ]
    caption = "An effect in this list may be present although it is not named."
    if describe_left(diagnosis):
        caption += " What is left unexplained may hide effects of other sizes, and others too."
    page.add(ReportTable(["effect", "why", "experiment that shows it"], rows, caption))


def write_compared_runs(page: Report, diagnosis: Diagnosis, records: Sequence[Record]) -> None:
    """List the records and their use, the start model, masks, and the sensors' noise."""
    page.add(Section("What was compared"))
    evidence = diagnosis.evidence
    train = diagnosis.train or records
    rows = [_record_row(r, "fitted, each block left out in turn" if evidence else "none")
            for r in train]  # fmt: skip
    rows += [_record_row(r, "held out") for r in diagnosis.holdout]
    page.add(
        ReportTable(["record", "use", "duration, s", "samples", "period, ms", "measured"], rows)
    )
    page.add(Points(group_notes(records)))
    if diagnosis.accepted:
        page.add(
            ReportTable(
                ["doubt about the data", "rule", "accepted because"],
                [["; ".join(a.doubts), a.rule, a.reason] for a in diagnosis.accepted],
                "These rules would have refused the data. The user overruled them.",
            )
        )
    if evidence is None:
        return
    effects = diagnosis.nominal.effects.model_dump(exclude_none=True)
    page.add(
        Text(
            f"The start model is {words_of_rig(diagnosis).start_model}, with "
            + (f"{spell_names(*effects)}." if effects else "no further effect.")
            + f" {_describe_simulation(evidence.weigher.train)}"
        )
    )
    masked = find_masked_shares(diagnosis)
    page.add(
        ReportTable(
            ["sensor", "noise", "converter's step", "unit", "known", "do not count"],
            [_noise_row(name, diagnosis.noise, masked) for name in evidence.noise_rms],
            "Samples at which a record says nothing do not count: gaps, spikes, a frozen "
            "column, no velocity where a motion is imposed, and the first part of a run that "
            "does not begin at rest.",
        )
    )
    faults = describe_data(diagnosis)
    if faults:
        page.add(Points([*faults]))


def _describe_simulation(runs: Runs) -> str:
    if runs.imposed:
        return "The force is found from the measured motion."
    if runs.actuator == "direct":
        how = "in short windows, each from the measured state" if runs.windowed else "freely"
        return f"The motion is simulated from the measured force, {how}."
    if "valve_v" in runs.stretches[0].inputs:
        return "The whole model is simulated from the command alone."
    return "The motion is simulated from the measured pressure."


def write_measured_runs(page: Report, records: Sequence[Record]) -> None:
    """Draw the records of data that cannot be diagnosed."""
    for record in records:
        plots = []
        for channel in record.channels:
            display = SIGNAL_DISPLAYS.get(channel)
            factor, unit = (display.factor, display.unit) if display else (1.0, "V")
            axis = PlotAxis(channel.split("_")[0], unit)
            plot = Plot(channel, PlotAxis("time", "s", tight=True), axis, height_px=110)
            plots.append(plot.line(record.t_s, factor * record[channel]))
        mark_moments(plots, record.moments)
        page.add(Figure([*plots], f"{record.name} as given."))


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
    noise, share = about.get(channel), f"{100.0 * masked.get(channel, 0.0):.2g} %"
    if noise is None or noise.deviation is None:
        return [display.title, "-", "-", display.gap_unit, "-", share]
    size, step = (f"{x * display.gap_factor:.3g}" for x in (noise.deviation, noise.resolution))
    return [display.title, size, step, display.gap_unit, SOURCES[noise.source], share]


def format_plant_file(diagnosis: Diagnosis, logs: Sequence[str]) -> str:
    """Write the diagnosis's plant as YAML, its origin and intervals as comments."""
    data: dict[str, Any] = diagnosis.plant.model_dump(
        mode="json", round_trip=True, exclude_none=True
    )
    return "".join(f"# {line}\n" for line in _head_lines(diagnosis, logs)) + dump_yaml(data)


def _head_lines(diagnosis: Diagnosis, logs: Sequence[str]) -> Iterator[str]:
    yield f"Written by `pamctl diagnose` from {', '.join(logs)}."
    yield f"Verdict: {diagnosis.verdict.value}. {sentence(diagnosis)}"
    for fault in list_faults(diagnosis):
        yield f"Set-up: {fault.text}. To mend it: {fault.how_to_mend}."
    numbers = list_fitted(diagnosis)
    if numbers:
        yield "Fitted, with 90 % intervals:"
    for n in numbers:
        value, interval, unit = n.spell()
        yield f"  {n.name} {value}, {interval} {unit}".rstrip()


def write_diagnosis(
    diagnosis: Diagnosis,
    out: Path,
    logs: Sequence[str],
    records: Sequence[Record],
    *,
    beside: Mapping[str, Any] | None = None,
    story: Callable[[Report], None] | None = None,
    interactive: bool = False,
) -> list[str]:
    """Write the folder, return the names in it; no plant.yaml where the data were refused.

    next-experiment.yaml is there where a program would decide between explanations; for a rig that
    pamctl does not run, next-experiment.csv.

    `logs` are the names of the files behind `records`. The document gets the keys of `beside` too,
    and the page what `story` writes below its head; `interactive` lets its plots be zoomed. Raise
    NewFileError: then nothing is left.
    """
    keys = {**build_diagnosis_document(diagnosis), **(beside or {})}
    document = json.dumps(keys, indent=2, allow_nan=False)
    texts = {out / "diagnosis.json": document + "\n"}
    if not diagnosis.reason:
        texts[out / "plant.yaml"] = format_plant_file(diagnosis, logs)
    if diagnosis.deciding is not None and runs_here(diagnosis):
        text = format_experiment_file(diagnosis.deciding, logs)
        texts[out / f"{NEXT_EXPERIMENT}.yaml"] = text
    elif diagnosis.deciding is not None:
        period_s = diagnosis.train[0].period_s
        texts[out / NEXT_COMMANDS] = format_commands(diagnosis.deciding, period_s)
    texts[out / "report.html"] = write_html(
        build_diagnosis_page(diagnosis, records, story), interactive=interactive
    )
    write_files(texts)
    return sorted(path.name for path in texts)
