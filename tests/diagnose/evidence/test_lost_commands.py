"""Records that lack a part of the commands, on rigs of another author's solver."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hidden.changes import half_rate
from hidden.examination.cases import Case
from hidden.excitations import fill_and_hold, multisine, square
from hidden.score_list import Handed
from support.made_records import ask_only, names_of, to_records

from pamctl.diagnose import Record, Verdict, diagnose
from pamctl.diagnose.evidence.command_instants import CommandInstants, find_instants, find_jumps
from pamctl.diagnose.evidence.constants import FIT_STEPS
from pamctl.diagnose.evidence.fit import Weigher
from pamctl.diagnose.evidence.weigh import prepare_weigher


def make_case(effect: str = "") -> Case:
    """Return a rig with an effect at three times its smallest size, or a healthy one."""
    if not effect:
        return Case("null/parameters", "null", repeat=95)
    return Case(f"single/{effect}/3", "single", {effect: 3.0}, repeat=95)


@cache
def record_all(effect: str = "") -> Handed:
    """Record steps at any tick, and sines; each step costs a simulation in each round of a fit."""
    rig, seed = make_case(effect).rig, make_case(effect).seed
    train = (
        square(1.0, 1.5, seed=seed),
        fill_and_hold(3, 0.4, seed),
        multisine(1.2, 0.3, 60.0, 2.5, seed, bias_v=0.05),
    )
    held_out = fill_and_hold(2, 0.4, seed + 1000), multisine(1.5, 0.3, 50.0, 2.0, seed + 1000)
    parts = ([rig.run(each).record for each in part] for part in (train, held_out))
    return next(parts), next(parts)


def record_half(effect: str = "") -> Handed:
    handed, _ = half_rate(record_all(effect), {}, 0.0)
    return handed


def lay_out(handed: Handed, **changed: Any) -> tuple[Weigher, Any]:
    train, held_out = to_records(handed)
    train = [replace(r, **{k: v(r) for k, v in changed.items()}) for r in train]
    return prepare_weigher(train, held_out, make_case().start_plant())


def true_shares(instants: CommandInstants, whole: Mapping[str, Record]) -> np.ndarray:
    """Return by which share of 2 ms each jump acts before its sample, from the whole record."""
    found = []
    for owner, at in zip(instants.owner, instants.sample, strict=True):
        stretch = instants.runs.stretches[owner]
        between, now = whole[stretch.name].valve_v[2 * at - 1], stretch.inputs["valve_v"][at]
        found.append(0.5 if between == now else 0.0)
    return np.array(found)


def test_steps_stand_out_and_a_chirp_does_not():
    t_s = np.arange(4000) * 1e-3
    chirp = np.sin(2.0 * np.pi * 15.0 * t_s**2)
    steps = np.where(t_s < 1.5, -5.0, 5.0)
    assert find_jumps(steps).tolist() == [1500]
    assert find_jumps(chirp).tolist() == []


def test_the_pressure_shows_that_a_file_has_every_second_command_only():
    whole, _ = lay_out(record_all())
    half, _ = lay_out(record_half())
    assert find_instants(whole) == []
    assert find_instants(half)


def test_a_file_that_says_when_its_commands_act_is_believed():
    weigher, _ = lay_out(record_half(), acts_after_s=lambda r: np.full(len(r), 1e-4))
    assert find_instants(weigher) == []


def test_a_pressure_that_is_early_everywhere_is_a_late_column_and_no_lost_command():
    def early(record: Record) -> np.ndarray:
        return np.roll(record.pressure_pa, -1)

    weigher, _ = lay_out(record_all(), pressure_pa=early)
    assert find_instants(weigher) == []


def test_each_jump_is_put_back_to_where_it_acted():
    weigher, start = lay_out(record_half())
    instants = find_instants(weigher)
    base = weigher.settle(start, FIT_STEPS)
    before = np.sqrt(weigher.find_robust2(base) / weigher.find_noise2(base))
    for _ in range(2):
        for each in instants:
            each.fit(base)
        base = weigher.settle(replace(base, d=np.zeros(0), lag=0.0, tangent=None), FIT_STEPS)
    after = np.sqrt(weigher.find_robust2(base) / weigher.find_noise2(base))
    whole = {r.name: r for r in to_records(record_all())[0]}
    off = np.abs(instants[0].shares[:-1] - true_shares(instants[0], whole))
    assert np.quantile(off, 0.8) < 0.03  # of 2 ms; a jump that moves hardly anything stays unknown
    assert instants[0].shares[-1] == pytest.approx(0.25, abs=0.02)
    assert before.max() > 5.0
    assert after.max() < 2.0


def test_half_of_the_ticks_say_the_same_as_all_of_them():
    effect = "valve_asymmetry"
    asked = "valve_asymmetry", "valve_spool", "command_delay", "valve_deadband", "exhausting~"
    plant = make_case(effect).start_plant()
    found = diagnose(*to_records(record_half(effect)), plant, without=ask_only(*asked))
    assert names_of(found) == [effect]
    assert found.verdict is Verdict.NAMED
    (said,) = found.noise["valve_v"].faults
    assert "act before their samples" in said.says
