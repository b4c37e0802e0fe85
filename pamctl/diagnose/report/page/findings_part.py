"""The named effects with equation, numbers and rivals; and every set of effects that was tried."""

from __future__ import annotations

from collections.abc import Iterator

from pamctl.diagnose.diagnosis import Diagnosis
from pamctl.diagnose.fitting.numbers import look_up_parameter, unit_of
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.search import EffectsTrial
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.phrases import (
    mark_bound,
    numbers_of,
    relative_shift,
    spell_names,
)
from pamctl.diagnose.report.sensor_units import write_ratio
from pamctl.plant.catalogue import CATALOGUE
from pamctl.report.html_page import Page

_MOST = 20
"""Sets of effects in the table of what was tried."""


def write_findings(page: Page, diagnosis: Diagnosis) -> None:
    """Write the effects with their rivals, then the numbers that were recalibrated."""
    if diagnosis.standings:
        page.section("The effect" if len(diagnosis.standings) == 1 else "The effects")
    for standing in diagnosis.standings:
        _write_effect(page, diagnosis, standing)
    if diagnosis.recalibrated:
        page.section("The numbers of the model")
        page.table(
            ["parameter", "start model", "fitted", "90 % interval", "unit", "off by", "range"],
            list(_list_recalibrated(diagnosis)),
            caption="Fitted together with the effects, if there are any. A number is off if its "
            "interval does not include the start model's value. A number at an end of the range in "
            "which it was searched may lie beyond it.",
        )


def _write_effect(page: Page, diagnosis: Diagnosis, standing: Standing) -> None:
    name = standing.effect.name
    effect = CATALOGUE[name]
    page.heading(spell_names(name))
    form = standing.effect.form
    page.facts(
        {
            "name in plant files": name,
            "block": effect.block,
            **({"form": form} if form != name else {}),
            "beats every rival in": f"{100.0 * standing.confidence:.0f} % of bootstrap replicas",
        }
    )
    page.note(effect.equation)
    page.text(f"What a model without it shows: {effect.signature}.")
    rows = []
    for number in numbers_of(diagnosis, name):
        parameter = look_up_parameter(number.name)
        row = [parameter.name, parameter.meaning, f"{number.value:.5g}"]
        row += [f"{number.low:.5g} to {number.high:.5g}", number.unit]
        rows.append([*row, mark_bound(diagnosis, number.name)])
    page.table(["parameter", "meaning", "value", "90 % interval", "unit", "range"], rows)
    _write_rivals(page, diagnosis, standing)


def _write_rivals(page: Page, diagnosis: Diagnosis, standing: Standing) -> None:
    model = diagnosis.model
    block = _find_own_block(diagnosis, standing)
    rows = [
        [
            spell_names(rival.name),
            write_ratio(model, block, rival.residual_over_floor) if model else "-",
            f"{100.0 * rival.wins:.0f} %",
            "not told apart" if rival.is_equal else "worse",
        ]
        for rival in standing.rivals
    ]
    if rows:
        page.table(
            ["rival", "left, x floor (RMS)", "leaves less in", "verdict"],
            rows,
            caption="Each rival was fitted in place of the effect and judged on the held-out "
            "records. The third column is the share of bootstrap replicas.",
        )
    else:
        page.text("No other effect of the catalogue came near enough to be fitted as a rival.")


def _list_recalibrated(diagnosis: Diagnosis) -> Iterator[list[str]]:
    for number in diagnosis.recalibrated:
        nominal = diagnosis.start_value(number.name)
        off = relative_shift(diagnosis, number)
        yield [
            number.name,
            f"{nominal:.5g}",
            f"{number.value:.5g}",
            f"{number.low:.5g} to {number.high:.5g}",
            number.unit,
            f"{100.0 * off:+.2f} %" if off is not None else "-",
            mark_bound(diagnosis, number.name),
        ]
    for name, value, unit in _list_nuisances(diagnosis):
        start = f"{diagnosis.start_value(name):.5g}"
        yield [name, start, f"{value:.5g}", "always free", unit, "-", mark_bound(diagnosis, name)]


def _list_nuisances(diagnosis: Diagnosis) -> Iterator[tuple[str, float, str]]:
    """Yield the numbers that every fit has beside the model's own, such as a sensor's zero."""
    model = diagnosis.model
    shown = {number.name for number in diagnosis.numbers}
    for fitted in model.fits.values() if model else ():
        for free in fitted.free:
            if free.is_nuisance and free.name not in shown:
                shown.add(free.name)
                yield free.name, fitted.values[free.name], unit_of(free)


def _find_own_block(diagnosis: Diagnosis, standing: Standing) -> str:
    """Return the block of an effect; of one that both blocks show, the one with the most left."""
    model = diagnosis.model
    blocks = model.evidence.blocks if model else ()
    own = [block for block in blocks if block in standing.effect.blocks]
    return max(own or blocks, key=model.ratio) if model else ""


def write_trials(page: Page, diagnosis: Diagnosis) -> None:
    """List the sets of effects that were fitted, by what they leave."""
    base = diagnosis.base
    if base is None or not diagnosis.trials:
        return
    page.section("What was tried")
    blocks = base.evidence.blocks
    rows = [["recalibrated only", *(write_ratio(base, b, base.ratio(b)) for b in blocks)]]
    best: dict[tuple[str, ...], EffectsTrial] = {}
    for trial in diagnosis.trials:
        best.setdefault(trial.names, trial)  # the best form of each set
    for names, trial in [*best.items()][:_MOST]:
        left = (write_ratio(base, block, trial.ratios[block]) for block in blocks)
        rows.append([spell_names(*names), *left])
    page.table(
        ["model", *(f"{block}, x floor (RMS)" for block in blocks)],
        rows,
        caption="Residual on the held-out records over the floor, the best first. If a single "
        "effect leaves nothing above the limit, effects that promised less were not fitted. Sets "
        "of several effects were fitted only where they looked promising.",
    )
    if diagnosis.verdict is Verdict.NONE_KNOWN:
        page.text("Every one of these leaves something above the limit, so none is named.")
