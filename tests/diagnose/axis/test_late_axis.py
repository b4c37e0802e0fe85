"""An axis whose position is logged late, or by another clock, judged in windows."""

from __future__ import annotations

import numpy as np
import pytest
from diagnose.axis.test_cogging import positioned
from support.made_records import ask_only, list_asked, numbers_of

from pamctl.diagnose import Record, diagnose, report_diagnosis, sentence
from pamctl.diagnose.report.diagnosis_page import build_diagnosis_page
from pamctl.plant.model import PlantSettings
from pamctl.report.html_page import write_html
from pamctl.report.report import format_terminal

LATE = 3
"""Samples of 1 ms."""
CLOCK = 3e-4


def log_late(record: Record) -> Record:
    """Return a record whose position stands so many samples below the force that it had."""
    assert record.force_n is not None
    assert record.position_m is not None
    return Record(
        record.name,
        record.t_s[:-LATE],
        force_n=record.force_n[LATE:],
        position_m=record.position_m[:-LATE],
    )


def hold_force(record: Record) -> Record:
    """Return a record whose position answers a force that is held for a sample."""
    t_s, position_m = record.t_s, record.position_m
    assert position_m is not None
    half_later_m = np.interp(t_s - 0.5e-3, t_s, position_m)
    return Record(record.name, t_s, force_n=record.force_n, position_m=half_later_m)


def log_by_another_clock(record: Record) -> Record:
    """Return a record whose position is sampled by a clock that is slow by 3e-4."""
    t_s, position_m = record.t_s[:-5], record.position_m
    assert position_m is not None
    assert record.force_n is not None
    sampled_m = np.interp(t_s * (1.0 + CLOCK), record.t_s, position_m)
    return Record(record.name, t_s, force_n=record.force_n[:-5], position_m=sampled_m)


AXIS = PlantSettings.model_validate(
    {
        "actuator": "direct",
        "parameters": {"mass_kg": 3.0, "damping_n_s_per_m": 22.0, "stiffness_n_per_m": 0.0},
        "effects": {"coulomb_friction": {"force_n": 1.0}},
    }
)


def test_a_force_that_is_held_from_sample_to_sample_makes_no_late_position() -> None:
    held = [hold_force(positioned(seed, cogging_n=0.0)) for seed in (1, 2)]
    asked = ask_only("presliding", "late", "mass", "clock", of=list_asked(held, AXIS))
    found = diagnose(held, [], AXIS, without=asked)
    assert not found.findings
    assert numbers_of(found)["~apart.position_m"] == pytest.approx(0.5e-3, abs=2e-4)


def test_another_clock_is_found_where_each_window_begins_with_the_measured_state() -> None:
    drifting = [log_by_another_clock(positioned(seed, cogging_n=0.0)) for seed in (1, 2)]
    asked = ask_only("presliding", "late", "mass", "clock", of=list_asked(drifting, AXIS))
    found = diagnose(drifting, [], AXIS, without=asked)
    assert [f.name for f in found.findings] == ["position_clock"]
    assert numbers_of(found)["~clock.position_m"] == pytest.approx(CLOCK, rel=0.05)


def test_a_late_position_is_found_where_each_window_begins_with_the_measured_state() -> None:
    parameters = {"mass_kg": 3.0, "damping_n_s_per_m": 22.0, "stiffness_n_per_m": 0.0}
    plant = PlantSettings.model_validate({"actuator": "direct", "parameters": parameters})
    late = [log_late(positioned(seed, cogging_n=0.0)) for seed in (1, 2)]
    asked = "coulomb_friction", "presliding", "late", "mass", "creep"
    found = diagnose(late, [], plant, without=ask_only(*asked, of=list_asked(late, plant)))
    numbers = numbers_of(found)
    assert {"coulomb_friction", "position_late"} <= {f.name for f in found.findings}
    (late_s,) = (n for f in found.findings for n in f.numbers if n.name == "~late.position_m")
    assert late_s.value == pytest.approx(LATE * 1e-3, abs=3e-4)
    assert late_s.low < LATE * 1e-3 < late_s.high
    assert np.isclose(numbers["mass_kg"], 3.1, rtol=0.02)
    by = f"position_m late by {1e3 * late_s.value:.3g} ms"
    assert by in sentence(found)
    told = "what runs or tunes on that file knows nothing of it"
    html = write_html(build_diagnosis_page(found, late))
    assert told in html
    assert told in " ".join(format_terminal(report_diagnosis(found)).split())
    assert "plant.yaml has all of it" not in html
    assert "jumps where a window begins anew" in html
