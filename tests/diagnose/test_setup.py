"""What is wrong about the set-up is said as what it is: a column, or a number of the plant file."""

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import pytest
from hidden.excitations import Runs, brief, fill_and_hold, square
from hidden.rig import HiddenRig, hidden_rig
from scipy.ndimage import gaussian_filter1d
from support.made_records import ask_only, names_of, numbers_of

from pamctl.diagnose import Diagnosis, Record, Verdict, diagnose, sentence
from pamctl.diagnose.report.diagnosis_document import build_diagnosis_document
from pamctl.diagnose.report.finding_words import list_faults
from pamctl.plant.model import PlantSettings

PAPER = PlantSettings()
TIMES = "late", "smoothed", "clock", "crosstalk", "command_delay", "valve_spool", "pressure_sensor"
ZEROS = "turned", "atmosphere", "null_offset", "valve_deadband", "pressure_sensor", "temperature"
"""What may be wrong about a set-up, and the physics that looks most like it."""


QUICK = [fill_and_hold(3, 0.4, 3), square(1.0, 1.5)], [fill_and_hold(2, 0.4, 4)]


def diagnose_spoiled(
    rig: HiddenRig,
    spoil: Callable[[Record], Record] = lambda r: r,
    null_v: float = 0.0,
    asked: Collection[str] = TIMES,
    program: tuple[Runs, Runs] | None = None,
) -> Diagnosis:
    """Run a quick program, spoil its records, and ask for this; for all if nothing is named."""
    parts: list[list[Record]] = []
    for part in program or QUICK:
        parts.append([])
        for place, e in enumerate(part):
            assert e.volts is not None
            run = rig.run(replace(e, volts=e.volts + null_v, rest_v=e.rest_v + null_v)).record
            columns = {**run.columns(), "valve_v": run.valve_v - null_v}
            parts[-1].append(spoil(Record(f"{run.name}-{place}", **columns)))
    return diagnose(*parts, PAPER, without=ask_only(*asked) if asked else ())


def shift_rows(record: Record, column: str, rows: int) -> Record:
    kept = np.clip(np.arange(len(record)) - rows, 0, len(record) - 1)
    return replace(record, **{column: record[column][kept]})


def test_a_valve_that_is_closed_off_zero_is_named():
    found = diagnose_spoiled(hidden_rig(seed=4), null_v=-0.05, asked=ZEROS)
    assert names_of(found) == ["null_offset"]
    assert abs(numbers_of(found)["null_offset.offset_v"]) == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize(
    ("column", "called"), [("pressure_pa", "pressure"), ("valve_v", "command")]
)
def test_a_late_column_is_told_from_the_physics(column, called):
    found = diagnose_spoiled(hidden_rig(seed=5), lambda r: shift_rows(r, column, 2))
    (fault,) = list_faults(found)
    assert (fault.kind, fault.number) == ("skew", column)
    assert fault.value == pytest.approx(2e-3, abs=1e-4)
    told_ms = f"{1e3 * fault.value:.2f} ms"
    assert f"the {called} is logged {told_ms} too late" in sentence(found)
    assert f"{column} {told_ms} earlier" in fault.how_to_mend


def test_a_column_that_was_smoothed_both_ways_is_said_with_its_width():
    def smooth(record: Record) -> Record:
        return replace(record, pressure_pa=gaussian_filter1d(record["pressure_pa"], 6.0))

    (fault,) = list_faults(diagnose_spoiled(hidden_rig(seed=5), smooth, program=brief(3)))
    assert (fault.kind, fault.number) == ("filtered", "pressure_pa")
    assert fault.value == pytest.approx(6e-3, rel=0.05)


def test_a_command_that_couples_into_the_sensors_line_is_told_from_a_late_column():
    def couple(record: Record) -> Record:
        return replace(record, pressure_pa=record["pressure_pa"] + 650.0 * record["valve_v"])

    found = diagnose_spoiled(hidden_rig(seed=4), couple)
    (fault,) = list_faults(found)
    assert (fault.kind, fault.number) == ("crosstalk", "pressure_pa")
    assert fault.ci90[0] < 650.0 < fault.ci90[1]
    assert f"the pressure also shows the command: {1e-3 * fault.value:.3g}" in sentence(found)


def test_a_clock_that_runs_fast_is_told_from_the_physics():
    def run_fast(record: Record) -> Record:
        when = 1.002 * record.t_s
        return replace(record, pressure_pa=np.interp(when, record.t_s, record["pressure_pa"]))

    (fault,) = list_faults(diagnose_spoiled(hidden_rig(seed=4), run_fast))
    assert (fault.kind, fault.number) == ("clock_rate", "pressure_pa")
    assert abs(fault.value) == pytest.approx(2e-3, rel=0.1)


@pytest.mark.long
def test_times_that_are_all_too_long_are_said_beside_a_friction_that_does_the_same():
    asked = "clock", "late", "mass", "braid_friction~curve(velocity)"
    found = diagnose_spoiled(
        hidden_rig(seed=4), lambda r: replace(r, t_s=1.03 * r.t_s), asked=asked, program=brief(3)
    )
    (finding,) = found.findings
    said = {finding.name, *(rival.name for rival in finding.rivals)}
    assert said == {"all_clock", "braid_friction~curve(velocity)"}
    assert finding.level in ("name", "set")


@pytest.mark.long
def test_a_command_of_the_wrong_sign_is_said():
    found = diagnose_spoiled(
        hidden_rig(seed=6),
        lambda r: replace(r, valve_v=-r["valve_v"]),
        asked=ZEROS,
        program=brief(3),
    )
    assert [(f.kind, f.number) for f in list_faults(found)] == [("sign", "valve_v")]
    assert "the command has the wrong sign" in sentence(found)


@pytest.mark.long
def test_an_atmosphere_that_was_added_twice_is_said():
    found = diagnose_spoiled(
        hidden_rig(seed=4),
        lambda r: replace(r, pressure_pa=r["pressure_pa"] + 101.3e3),
        asked=ZEROS,
    )
    (fault,) = list_faults(found)
    assert (fault.kind, fault.number) == ("added", "pressure_pa")
    assert fault.value == pytest.approx(101.3e3, rel=0.005)
    assert "the atmosphere was added twice" in sentence(found)


def test_a_right_set_up_is_not_blamed_and_nothing_is_found_in_noise():
    found = diagnose_spoiled(hidden_rig(seed=9), asked=())
    assert list_faults(found) == []
    assert found.findings == ()
    assert found.verdict is Verdict.MISCALIBRATED


def test_the_atmosphere_of_the_place_is_never_told_from_the_sensors_gain():
    rig = hidden_rig(seed=10)
    rig = replace(rig, truth=rig.truth._replace(atmosphere_pa=94e3))
    found = diagnose_spoiled(
        rig, lambda r: replace(r, pressure_pa=r["pressure_pa"] + 7.3e3), asked=ZEROS
    )
    (place,) = build_diagnosis_document(found)["places"]
    assert place["place"] == "pressure_sensor"
    assert {*place["candidates"]} >= {"atmospheric_pressure_pa", "pressure_sensor_gain"}
    assert found.plant.parameters.atmospheric_pressure_pa in (
        101.3e3,
        pytest.approx(94e3, rel=0.01),
    )


def test_commands_that_were_logged_more_rarely_than_given_are_said():
    def decimate(record: Record) -> Record:
        return replace(record, valve_v=record["valve_v"][np.arange(len(record)) // 5 * 5])

    # Each step of the command is fitted, and of sines each sample would be one.
    program = [fill_and_hold(3, 0.4, 3), square(1.0, 1.5)], [fill_and_hold(2, 0.4, 4)]
    found = diagnose_spoiled(hidden_rig(seed=8), decimate, program=program)
    (fault,) = list_faults(found)
    assert (fault.kind, fault.number) == ("decimated_command", "valve_v")
    assert fault.value == pytest.approx(5e-3)
    assert "every 5 ms" in sentence(found)
    assert [f.name for f in found.findings if f.level != "rest"] == []
