"""The plant on words is the simulated plant: the same bits, step by step."""

from __future__ import annotations

import random
from itertools import chain

import pytest
from support.plain_library import PlainLibrary

from pamctl.compiled_ahead.layout import Block, NotFlat
from pamctl.plant.flat import parameters_of
from pamctl.plant.native_plant import NativePlant, PlantWords, advance_and_sense
from pamctl.plant.simulated import SimulatedPlant

PLANTS = {
    "paper": {},
    "effects in every part": {
        "valve_spool.time_constant_s": 1e-3,
        "line_restriction.resistance_pa_s_per_kg": 2e6,
        "stribeck.rise": 0.3,
        "pressure_sensor_lag.time_constant_s": 3e-3,
        "encoder_backlash.width_m": 2e-5,
    },
}


@pytest.mark.parametrize("name", PLANTS)
def test_every_step_shows_and_leaves_the_same(name: str) -> None:
    p = parameters_of(PLANTS[name])
    native = NativePlant(PlainLibrary(*PlantWords(p).write_glue(), advance_and_sense), p)
    plain, draw = SimulatedPlant(p), random.Random(3)
    for _ in range(300):
        command_v, duration_s = draw.uniform(-5.0, 5.0), draw.choice([1e-3, 1e-4, 7e-3])
        for plant in (native, plain):
            plant.advance(command_v, duration_s)
        assert (native.position_m, native.pressure_pa) == (plain.position_m, plain.pressure_pa)
        assert native.truth == plain.truth
    assert native.state == plain.state
    assert plain.position_m > 1e-3


def test_a_plant_with_tables_is_refused() -> None:
    p = parameters_of({})
    table = type(p.correction)(pull=((0.0, 1.0), (0.0, 1.0), (0.0,) * 100))
    with pytest.raises(NotFlat, match=r"correction\.pull"):
        PlantWords(p._replace(correction=table))


def test_words_hold_a_value_and_give_it_back() -> None:
    p = parameters_of(PLANTS["effects in every part"])
    block = Block(p, 3)
    buffer = bytearray(8 * block.end)
    block.write(buffer, p)
    assert block.read(buffer) == p
    assert len(list(chain(block.leaves))) == block.end - 3
