"""What was found: the effect with its equation, numbers and rivals; what was tried for it."""

from __future__ import annotations

from collections.abc import Iterator

from pamctl.diagnose.diagnosis import Diagnosis, EffectsTrial
from pamctl.diagnose.naming.rivals import Standing
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.report.page_words import parameter_of, relative_shift, spell_names
from pamctl.plant.catalogue import CATALOGUE
from pamctl.report.html_page import Page

_MOST = 20
"""Sets of effects shown of those that were tried."""


def write_findings(page: Page, diagnosis: Diagnosis) -> None:
    """Write the effects with their rivals, then the numbers that were recalibrated."""
    if diagnosis.standings:
        page.section("The effect" if len(diagnosis.standings) == 1 else "The effects")
    for standing in diagnosis.standings:
        _write_effect(page, diagnosis, standing)
    if diagnosis.recalibrated:
        page.section("The numbers of the model")
        page.table(
            ["parameter", "as it stood", "recalibrated", "90 % interval", "unit", "off by"],
            list(_list_recalibrated(diagnosis)),
            caption="Fitted with the effects, if there are any. A number is off where its interval "
            "does not reach the value that it had.",
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
            "wins in": f"{100.0 * standing.confidence:.0f} % of bootstrap replicas",
        }
    )
    page.note(effect.equation)
    page.text(f"Without it: {effect.signature}.")
    rows = []
    for number in diagnosis.numbers:
        if number.name.split(".")[0] == name:
            meant = parameter_of(number.name)
            row = [meant.name, meant.meaning, f"{number.value:.5g}"]
            rows.append([*row, f"{number.low:.5g} to {number.high:.5g}", number.unit])
    page.table(["parameter", "meaning", "value", "90 % interval", "unit"], rows)
    _write_rivals(page, standing)


def _write_rivals(page: Page, standing: Standing) -> None:
    rows = [
        [
            spell_names(rival.name),
            f"{rival.residual_over_floor:.2f}",
            f"{100.0 * rival.wins:.0f} %",
            "not told apart" if rival.is_equal else "worse",
        ]
        for rival in standing.rivals
    ]
    if rows:
        page.table(
            ["rival in its place", "left, x floor", "does better in", "verdict"],
            rows,
            caption="Each rival was fitted in its place, and judged on the held-out records.",
        )
    else:
        page.text("No other effect of the catalogue came near enough to be heard.")


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
        ]


def write_trials(page: Page, diagnosis: Diagnosis) -> None:
    """Rank what was tried by what it leaves."""
    base = diagnosis.base
    if base is None or not diagnosis.tried:
        return
    page.section("What was tried")
    blocks = base.evidence.blocks
    rows = [["recalibrated only", *(f"{base.ratio(block):.2f}" for block in blocks)]]
    best: dict[tuple[str, ...], EffectsTrial] = {}
    for trial in diagnosis.tried:
        best.setdefault(trial.names, trial)  # the best form of each set
    for names, trial in [*best.items()][:_MOST]:
        rows.append([spell_names(*names), *(f"{trial.ratios[block]:.2f}" for block in blocks)])
    page.table(
        ["model", *(f"{block}, x floor" for block in blocks)],
        rows,
        caption="Left on the held-out records, over the floor, the best first. Where a single "
        "effect leaves nothing, those that promised less were not fitted; nor is every set of "
        "several.",
    )
    if diagnosis.verdict is Verdict.NONE_KNOWN:
        page.text("None of these leaves nothing, and none is named for being the least bad.")
