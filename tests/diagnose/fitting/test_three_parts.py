"""Three parts of the data: fitted on, chosen by, confirmed by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.made_records import measured, pair

from pamctl.diagnose.fitting.evidence import Evidence, prepare_evidence
from pamctl.diagnose.fitting.held_out_rms import simulate_held_out
from pamctl.diagnose.fitting.split import (
    Part,
    describe_confirmation,
    find_samples,
    keep_for_choice,
    keep_for_confirmation,
)
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()


def of_one_run() -> Evidence:
    run = measured("fit", 3)
    return prepare_evidence([run], [run], PAPER)


@pytest.mark.parametrize("is_cut", [False, True])
def test_no_sample_both_chooses_and_confirms(is_cut: bool) -> None:
    drive = of_one_run().holdout["pressure"][0]
    parts = {part: find_samples(drive, part, is_cut=is_cut) for part in Part}
    assert np.all(sum(rows.astype(int) for rows in parts.values()) == 1)
    shares = {part: float(rows.mean()) for part, rows in parts.items()}
    wanted = (1 / 2, 1 / 3, 1 / 6) if is_cut else (0.0, 2 / 3, 1 / 3)
    assert list(shares.values()) == pytest.approx(wanted, abs=0.01)


@pytest.mark.parametrize(("times", "least_s", "most_s"), [(1, 0.5, 1.2), (200, 10.0, 30.0)])
def test_stretches_last_about_a_second_and_are_not_too_many(
    times: int, least_s: float, most_s: float
) -> None:
    drive = of_one_run().holdout["pressure"][0]
    slow = replace(drive, step_s=drive.step_s * times)
    rows = find_samples(slow, Part.CONFIRM, is_cut=False)
    starts = np.flatnonzero(np.diff(rows.astype(int)) == 1)
    ends = np.flatnonzero(np.diff(rows.astype(int)) == -1)
    lasting_s = (ends - starts[: len(ends)]) * float(np.median(slow.step_s))
    assert least_s <= lasting_s.min() <= lasting_s.max() <= most_s


def test_a_change_of_the_confirming_samples_changes_no_residual_that_chooses() -> None:
    train, (held,) = pair()
    whole = prepare_evidence(train, [held], PAPER)
    drive = whole.holdout["pressure"][0]
    late = find_samples(drive, Part.CONFIRM, is_cut=False)
    spoiled = replace(drive, measured=np.where(late, drive.measured + 5e4, drive.measured))
    evidence = replace(whole, holdout={**whole.holdout, "pressure": (spoiled,)})
    chosen, confirming = (
        keep(evidence, is_cut=False).holdout["pressure"][0].residual(PAPER)
        for keep in (keep_for_choice, keep_for_confirmation)
    )
    assert np.max(np.abs(chosen)) < 10.0
    assert np.min(np.abs(confirming)) > 100.0


def test_the_coupled_gap_counts_the_samples_of_the_part_only() -> None:
    train, (held,) = pair()
    evidence = prepare_evidence(train, [held], PAPER)
    errors = simulate_held_out(evidence, PAPER)
    parts = [keep(evidence, is_cut=False) for keep in (keep_for_choice, keep_for_confirmation)]
    sizes = [len(errors.select(part)["pressure_pa"]) for part in parts]
    assert sum(sizes) == len(held)
    assert errors.measure_rms(parts[1])["pressure_pa"] == pytest.approx(300.0, rel=0.1)


def test_what_the_figures_rest_on_is_said() -> None:
    train, held = pair()
    evidence = keep_for_confirmation(prepare_evidence(train, held, PAPER), is_cut=False)
    on = describe_confirmation(evidence, is_cut=False)
    assert on.records == ("judge-2",)
    assert on.duration_s == pytest.approx(held[0].duration_s / 3.0, rel=0.02)
    single = keep_for_confirmation(of_one_run(), is_cut=True)
    assert "single run" in describe_confirmation(single, is_cut=True).how
