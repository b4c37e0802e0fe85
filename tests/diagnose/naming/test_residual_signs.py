"""A residual below its limit that is no noise: visible, coloured, or the same each time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.made_records import PERIOD_S, find_candidate, measured, pair

from pamctl.diagnose.fitting.block_fit import rms
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.floor import Floor
from pamctl.diagnose.fitting.model_fit import recalibrate
from pamctl.diagnose.measured.record import Array, Record
from pamctl.diagnose.naming.whiteness import find_residual_signs
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()


@cache
def recalibrated(*, again: bool = False) -> Model:
    train, held = pair()
    train = [*train, measured("fit", 3)] if again else train
    return recalibrate(prepare_evidence(train, held, PAPER))


def leaving(extra: Array) -> Model:
    """The model of a faultless rig, with something more left of the pressure (Pa)."""
    model = replace(recalibrated())
    deviation = model.evidence.holdout["pressure"][0].deviation
    left = {**model.residuals, "pressure": model.residuals["pressure"] + extra / deviation}
    model.__dict__["residuals"] = left
    return model


def kinds_of(model: Model) -> set[str]:
    return {sign.kind for sign in find_residual_signs(model, replace(model, root=model))}


def waves(amplitude_pa: float, hz: float) -> Array:
    count = len(recalibrated().residuals["pressure"])
    return amplitude_pa * np.sin(2.0 * np.pi * hz * PERIOD_S * np.arange(count))


def test_the_residual_of_a_faultless_rig_shows_no_sign() -> None:
    assert kinds_of(recalibrated()) == set()


@pytest.mark.parametrize(("hz", "is_seen"), [(0.4, True), (5.0, True), (400.0, False)])
def test_a_slow_wave_is_coloured_and_a_fast_one_may_be_noise(hz: float, is_seen: bool) -> None:
    assert ("coloured" in kinds_of(leaving(waves(250.0, hz)))) is is_seen


def test_a_slow_wave_too_small_to_matter_is_no_sign() -> None:
    assert kinds_of(leaving(waves(40.0, 0.4))) == set()


def test_what_the_rig_does_differently_each_time_may_have_any_colour() -> None:
    model = leaving(waves(250.0, 0.4))
    floor = replace(model.floors["pressure"], repeatability=2.0 * model.floors["pressure"].mean)
    model.__dict__["floors"] = {**model.floors, "pressure": floor}
    assert kinds_of(model) == set()


def test_a_residual_as_large_as_the_signal_is_visible_even_if_it_is_white() -> None:
    random = np.random.default_rng(5)
    count = len(recalibrated().residuals["pressure"])
    span_pa = float(np.std(pair()[1][0]["pressure_pa"]))
    assert "visible" in kinds_of(leaving(random.normal(0.0, 0.5 * span_pa, count)))
    assert "visible" not in kinds_of(leaving(random.normal(0.0, 0.2 * span_pa, count)))
    assert "visible" in kinds_of(leaving(waves(0.3 * span_pa, 1.0)))


def test_a_residual_that_comes_again_with_the_commands_is_seen() -> None:
    assert kinds_of(recalibrated(again=True)) == set()

    def shifted(record: Record) -> Record:
        bump = 900.0 * np.sign(np.sin(7.0 * record.t_s))
        return replace(record, pressure_pa=record["pressure_pa"] + bump)

    train = [shifted(measured("fit", seed)) for seed in (1, 3)]
    evidence = prepare_evidence(train, pair()[1], PAPER)
    assert "repeats" in kinds_of(recalibrate(evidence))


def test_samples_that_confirm_may_refute() -> None:
    model = recalibrated()
    confirmed = replace(model, root=model)
    floor = Floor(1.0, 0.05, 1.0, np.zeros((12, 0)), np.ones(12))
    confirmed.__dict__["floors"] = dict.fromkeys(model.floors, floor)
    confirmed.__dict__["residuals"] = {b: 2.0 * r for b, r in model.residuals.items()}
    (kind,) = {sign.kind for sign in find_residual_signs(model, confirmed)}
    assert kind == "unconfirmed"


def test_samples_that_confirm_may_show_a_number_that_the_fitted_ones_leave_open() -> None:
    """The fit saw a rest and 60 ms of a fill: noise alone has moved its numbers."""
    train, held = pair()
    short = train[0].cut_samples(0, 660, "short")
    model = recalibrate(prepare_evidence([short], held, PAPER).select_blocks({"pressure"}))
    chosen = replace(model.floors["pressure"], mean=1.0, limit=1.05)  # on samples that hide it
    confirmed = replace(model, root=model)
    confirmed.__dict__["floors"] = {"pressure": chosen}
    assert confirmed.rms["pressure"] > 1.3
    assert find_residual_signs(model, confirmed) == ()


@pytest.mark.parametrize(("count", "is_seen"), [(0, False), (1, False), (2, True)])
def test_several_effects_must_reach_the_limit_on_the_samples_that_confirm(
    count: int, is_seen: bool
) -> None:
    """A few stretches are above, so nothing is sure; two effects may be chosen by that."""
    model = recalibrated()
    names = ("encoder_scale", "pressure_damping")[:count]
    effects = tuple(find_candidate(name, model.evidence) for name in names)
    confirmed = replace(model, root=model, effects=effects)
    floor = Floor(1.0, 0.05, 1.2, np.zeros((12, 0)), np.ones(12))
    left = {b: r / rms(r) for b, r in model.residuals.items()}
    left["mechanics"] = left["mechanics"].copy()
    left["mechanics"][:250] *= 5.0
    left["mechanics"] *= 1.21 / rms(left["mechanics"])
    confirmed.__dict__.update(
        floors=dict.fromkeys(model.floors, floor),
        residuals=left,
        rms={b: rms(r) for b, r in left.items()},
    )
    signs = find_residual_signs(model, confirmed)
    assert bool(signs) is is_seen
