"""The set-up is asked before the physics: what is wrong about it is said as what it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hidden.examination.cases import partial_log_cases
from hidden.examination.examine import records_of, start_plant
from hidden.excitations import brief
from hidden.hostile.situations import all_cases as hostile_cases
from hidden.hostile.trial import records_of as hostile_records
from hidden.rig import HiddenRig, hidden_rig
from scipy.signal import butter, filtfilt
from support.free_mass import FRICTION_N, MASS_KG, axis, imposed_motion, pushed_mass
from support.made_records import PERIOD_S, measured, pair

from pamctl.diagnose import Record, diagnose
from pamctl.diagnose.fitting.candidates import list_candidates
from pamctl.diagnose.fitting.drives import MECHANICS, PRESSURE
from pamctl.diagnose.fitting.evidence import prepare_evidence
from pamctl.diagnose.fitting.fitted_model import Model
from pamctl.diagnose.fitting.model_fit import recalibrate, weigh_blocks
from pamctl.diagnose.fitting.numbers import with_values
from pamctl.diagnose.fitting.split import keep_for_choice
from pamctl.diagnose.naming.first_level import FirstLevel
from pamctl.diagnose.naming.verdict import Verdict
from pamctl.diagnose.setup.altered_drive import PlantChange, add_change
from pamctl.diagnose.setup.decimation import suspect_decimation
from pamctl.diagnose.setup.refused_columns import explain_refusal
from pamctl.diagnose.setup.suspect_setup import (
    CheckedSetup,
    suspect_air_first,
    suspect_setup,
)
from pamctl.diagnose.setup.suspects import (
    act_earlier,
    find_decimation,
    list_suspects,
    restore_command,
)
from pamctl.diagnose.setup.symmetries import list_equal_numbers
from pamctl.diagnose.setup.weighed_fit import fit_suspect
from pamctl.plant.drive import drive_mechanics, drive_pressure
from pamctl.plant.flat import parameters_of
from pamctl.plant.model import PlantSettings, plant_parameters

PAPER = PlantSettings()
SKEW = ("skew", "valve_v")
Runs = tuple[list[Record], list[Record]]


def _record(
    rig: HiddenRig,
    spoil: Callable[[Record], Record] = lambda r: r,
    truths: Sequence[float] = (),
    null_v: float = 0.0,
) -> Runs:
    """Run the short program; `truths` are factors of the stiffness, one a record."""
    parts: list[list[Record]] = []
    place = 0
    for part in brief(3):
        parts.append([])
        for excitation in part:
            own = rig
            if truths:
                k = rig.truth.stiffness * truths[place]
                own = replace(rig, truth=rig.truth._replace(stiffness=k))
            assert excitation.volts is not None
            asked = replace(
                excitation, volts=excitation.volts + null_v, rest_v=excitation.rest_v + null_v
            )
            run = own.run(asked).record
            columns = run.columns()
            columns["valve_v"] = columns["valve_v"] - null_v
            parts[-1].append(spoil(Record(f"{run.name}-{place}", **columns)))
            place += 1
    return parts[0], parts[1]


def _base_of(runs: Runs, plant: PlantSettings) -> Model:
    return weigh_blocks(recalibrate(prepare_evidence(*runs, plant)))


def _base(runs: Runs) -> Model:
    return _base_of(runs, PAPER)


def _ask(runs: Runs) -> CheckedSetup:
    base = _base(runs)
    return suspect_setup(base, *runs, FirstLevel(list_candidates(base.evidence)))


def test_a_valve_that_is_closed_off_zero_is_found_and_corrected() -> None:
    null_v = -0.02
    setup = _ask(_record(hidden_rig(seed=4), null_v=null_v))
    (finding,) = setup.findings
    assert finding.kind == "null_offset"
    assert finding.value == pytest.approx(-null_v, abs=5e-4)
    assert not setup.base.unexplained
    assert finding.cannot_be_told_from == ()


def test_a_wrong_rest_length_is_followed_to_its_end() -> None:
    """The recalibrated braid is at its bound then, and the start leaves hundreds of floors."""
    runs = _record(hidden_rig(seed=4))
    base = _base_of(runs, with_values(PAPER, {"rest_length_m": 0.202}))
    assert "braid_length_m" in base.at_bound
    suspects = {s.label: s for s in list_suspects(base.evidence, base.at_bound)}
    length = fit_suspect(base, suspects["rest_length_m"], -1e-5)
    assert length.is_good
    assert length.amount == pytest.approx(0.2 / 0.202 - 1.0, abs=2e-3)
    scaled = suspects["scale of position_m"].apply(base.evidence.holdout[MECHANICS][0], 0.03)
    assert scaled.show_output(np.ones(3)) == pytest.approx(1.03)  # as the record shows it


def test_a_column_filtered_forwards_and_backwards_is_said_with_its_cutoff() -> None:
    def smooth(record: Record) -> Record:
        low_pass = butter(2, 40.0, fs=1000.0)
        filtered = {c: filtfilt(*low_pass, record[c]) for c in ("pressure_pa", "position_m")}
        return replace(record, **filtered)

    setup = _ask_air_first(_record(hidden_rig(seed=5), smooth))
    assert setup is not None
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("filtered", "pressure_pa")
    assert 1.0 / (2.0 * np.pi * finding.value) == pytest.approx(40.0, rel=0.1)
    assert PRESSURE not in setup.base.unexplained


def _ask_air_first(runs: Runs) -> CheckedSetup | None:
    evidence = prepare_evidence(*runs, PAPER)
    alone = recalibrate(evidence.select_blocks({PRESSURE}))
    return suspect_air_first(alone, evidence, *runs, FirstLevel(list_candidates(evidence)))


def test_a_fault_of_the_valve_is_corrected_before_its_effects_are_sought() -> None:
    setup = _ask_air_first(_record(hidden_rig({"creep": 10}, seed=4), null_v=0.1))
    assert setup is not None
    assert [f.kind for f in setup.findings] == ["null_offset"]
    assert PRESSURE not in setup.base.unexplained
    assert MECHANICS in setup.base.unexplained
    assert all((d.valve_v[0] > -1.0) for d in setup.base.evidence.train[PRESSURE])


def test_what_both_blocks_must_answer_is_not_decided_by_the_pressure_alone() -> None:
    def delay(record: Record) -> Record:
        rows = np.clip(np.arange(len(record)) - 3, 0, len(record) - 1)
        return replace(record, pressure_pa=record["pressure_pa"][rows])

    assert _ask_air_first(_record(hidden_rig(seed=5), delay)) is None
    assert _ask_air_first(_record(hidden_rig({"valve_deadband": 3}, seed=9))) is None


@pytest.mark.long
def test_a_late_pressure_column_is_told_from_the_physics() -> None:
    late_ticks = 2

    def delay(record: Record) -> Record:
        rows = np.clip(np.arange(len(record)) - late_ticks, 0, len(record) - 1)
        return replace(record, pressure_pa=record["pressure_pa"][rows])

    (finding,) = _ask(_record(hidden_rig(seed=5), delay)).findings
    assert (finding.kind, finding.number) == ("skew", "pressure_pa")
    assert finding.value == pytest.approx(1e-3 * late_ticks, abs=1e-4)


@pytest.mark.long
def test_times_that_are_all_too_long_are_told_from_a_damping_that_grows_with_pressure() -> None:
    def stretch(record: Record) -> Record:
        return replace(record, t_s=1.03 * record.t_s)

    setup = _ask(_record(hidden_rig(seed=4), stretch))
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("clock_rate", "t_s")
    assert finding.value == pytest.approx(0.03, rel=0.15)
    assert finding.text.endswith("% too long")
    assert not setup.base.unexplained
    assert setup.train[0].period_s == pytest.approx(PERIOD_S, rel=0.005)


def test_an_atmosphere_that_was_added_twice_is_said_and_taken_off() -> None:
    def lift(record: Record) -> Record:
        return replace(record, pressure_pa=record["pressure_pa"] + 101.3e3)

    setup = _ask(_record(hidden_rig(seed=4), lift))
    (finding,) = setup.findings
    assert (finding.kind, finding.number, finding.value) == ("gauge", "pressure_pa", 101.3e3)
    assert "twice" in finding.text
    assert not setup.base.unexplained
    assert np.median(setup.train[0]["pressure_pa"][:200]) == pytest.approx(101.3e3, abs=600.0)


@pytest.mark.long
def test_a_command_of_the_wrong_sign_is_said() -> None:
    def invert(record: Record) -> Record:
        return replace(record, valve_v=-record["valve_v"])

    findings = _ask(_record(hidden_rig(seed=6), invert)).findings
    assert [(f.kind, f.number) for f in findings] == [("sign", "valve_v")]


def test_a_stiffness_that_falls_from_record_to_record_is_said_with_its_values() -> None:
    shares = [1.0, 0.992, 0.984, 0.976, 0.968, 0.96]
    setup = _ask(_record(hidden_rig(seed=7), truths=shares))
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("drift", "stiffness_n_per_m")
    assert finding.value == pytest.approx(0.04, rel=0.1)
    values = [*finding.by_record.values()]
    assert values == sorted(values, reverse=True)
    assert not setup.base.unexplained


@pytest.mark.long
def test_repeats_that_are_far_from_alike_are_asked_which_number_differs() -> None:
    """The limit that they set would hide 170 times the sensor's noise."""
    (case,) = (c for c in hostile_cases() if c.id == "friction_between/large/open")
    train, holdout = (
        [Record(name=r.name, **r.columns()) for r in part] for part in hostile_records(case)
    )
    base = _base((train, holdout))
    assert not base.unexplained
    setup = suspect_setup(base, train, holdout, FirstLevel(list_candidates(base.evidence)))
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("drift", "kinetic_friction_per_m")
    first, last = finding.by_record[train[0].name], finding.by_record[holdout[-1].name]
    assert last - first == pytest.approx(-0.15, abs=0.03)


def test_commands_logged_more_rarely_than_given_are_refused_with_the_reason() -> None:
    def decimate(record: Record) -> Record:
        return replace(record, valve_v=record["valve_v"][np.arange(len(record)) // 5 * 5])

    setup = _ask(_record(hidden_rig(seed=8), decimate))
    (finding,) = setup.findings
    assert (finding.kind, finding.value) == ("decimated_command", 5.0)
    assert "log the command at every sample" in setup.refusal


def test_a_command_that_changes_rarely_is_suspected_where_nothing_explains_the_pressure() -> None:
    def thin_out(record: Record) -> Record:
        rows = np.arange(len(record)) // 20 * 20
        return replace(record, valve_v=record["valve_v"][rows])

    every_row = _base(_record(hidden_rig({"valve_deadband": 3}, seed=2)))
    assert suspect_decimation(every_row) is None
    suspicion = suspect_decimation(_base(_record(hidden_rig({}, seed=2), thin_out)))
    assert suspicion is not None
    assert (suspicion.value, suspicion.is_corrected) == (20.0, False)
    assert "may have got it more often" in suspicion.text


@pytest.mark.long
@pytest.mark.parametrize("effects", [{}, {"valve_deadband": 3}])
def test_a_right_set_up_is_not_blamed(effects: dict[str, float]) -> None:
    assert _ask(_record(hidden_rig(effects, seed=9))).findings == ()


@pytest.mark.long
def test_the_atmosphere_of_the_place_is_never_told_from_the_sensors_gain() -> None:
    rig = hidden_rig(seed=10)
    rig = replace(rig, truth=rig.truth._replace(atmosphere_pa=94e3))

    def add_wrong_atmosphere(record: Record) -> Record:
        return replace(record, pressure_pa=record["pressure_pa"] - 94e3 + 101.3e3)

    found = diagnose(*_record(rig, add_wrong_atmosphere), PAPER)
    assert found.verdict is Verdict.AMBIGUOUS
    (finding,) = [f for f in found.setup if f.number == "atmospheric_pressure_pa"]
    assert finding.value == pytest.approx(94e3, rel=0.01)
    assert "pressure_sensor_gain" in finding.cannot_be_told_from


def test_refused_records_say_which_column_is_read_wrongly() -> None:
    train, holdout = pair()
    records = [*train, *holdout]
    inverted = [replace(r, position_m=-r["position_m"]) for r in records]
    gauge = [replace(r, pressure_pa=r["pressure_pa"] - 101.3e3) for r in records]
    assert [(f.kind, f.number) for f in explain_refusal(inverted, PAPER)] == [
        ("sign", "position_m")
    ]
    assert [(f.kind, f.number) for f in explain_refusal(gauge, PAPER)] == [("gauge", "pressure_pa")]
    spoiled = [replace(r, pressure_pa=np.full(len(r), np.nan)) for r in records]
    assert explain_refusal(spoiled, PAPER) == ()
    unlike = [records[0], replace(records[1], pressure_pa=None)]
    assert explain_refusal(unlike, PAPER) == ()
    assert explain_refusal([], PAPER) == ()


def test_a_number_that_changes_at_an_instant_is_simulated_as_two_plants_in_a_row() -> None:
    """Against the compiled simulation: before the instant one plant, long after it the other."""
    record = measured("fit", 1)
    evidence = prepare_evidence([record], [record], PAPER)
    (drive,) = evidence.train[MECHANICS]
    instant_s = 0.5 * record.duration_s
    changed = add_change(drive, PlantChange("stiffness_n_per_m", -0.05, after_s=instant_s))
    simulated = changed.simulate(PAPER)
    soft = parameters_of({"stiffness_n_per_m": 0.95 * 9680.0})
    after = drive_mechanics(soft, drive.driven, drive.grid).position_m
    half = int(np.searchsorted(record.t_s, instant_s))
    assert np.array_equal(simulated[:half], drive.simulate(PAPER)[:half])
    settled = half + round(1.0 / PERIOD_S)
    assert np.max(np.abs(simulated[settled:] - after[settled:])) < 5e-6


def test_a_late_command_acts_before_it_is_shown() -> None:
    """Late by three ticks, the simulation is that of a command column three rows earlier."""
    record = measured("fit", 2)
    late = replace(record, valve_v=np.concatenate([np.zeros(3), record["valve_v"][:-3]]))
    (right,), (shown,) = (prepare_evidence([r], [r], PAPER).train[PRESSURE] for r in (record, late))
    skew = next(s for s in list_suspects(_base(pair()).evidence) if s.key[:2] == SKEW)
    mended = skew.apply(shown, 3e-3).simulate(PAPER)
    assert np.max(np.abs(mended - right.simulate(PAPER))[:-3]) < 1e-3
    assert np.array_equal(act_earlier(None, np.full(2, 3e-3)), [-3e-3, -3e-3])


def test_the_command_before_the_record_has_the_same_null() -> None:
    (drive,) = prepare_evidence([measured("fit", 2)], [measured("fit", 2)], PAPER).train[PRESSURE]
    null = next(s for s in list_suspects(_base(pair()).evidence) if s.kind == "null_offset")
    moved = null.apply(replace(drive, held_v=0.5), 0.1)
    assert moved.held_v == pytest.approx(0.4)


@pytest.mark.long
def test_a_bowed_pressure_sensor_is_found_where_its_promise_is_small() -> None:
    """The numbers of both blocks have taken most of the bow; one of them is at its bound then."""
    span_pa, height_pa = 350e3, 5e3

    def bow(record: Record) -> Record:
        share = (record["pressure_pa"] - 101.3e3) / span_pa
        return replace(
            record, pressure_pa=record["pressure_pa"] + height_pa * 4.0 * share * (1.0 - share)
        )

    setup = _ask(_record(hidden_rig(seed=4), bow))
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("bow", "pressure_pa")
    assert finding.value == pytest.approx(height_pa, rel=0.1)
    assert finding.text.startswith("the pressure is not linear")
    assert not setup.base.unexplained


def test_a_smooth_command_is_restored_between_the_logged_rows() -> None:
    t_s = np.arange(4000) * 1e-3
    given = 2.0 * np.sin(2.0 * np.pi * 3.0 * t_s) + np.sin(2.0 * np.pi * 7.3 * t_s)
    logged = given[np.arange(4000) // 10 * 10]
    assert find_decimation(logged) == 10
    assert find_decimation(given) == 1
    restored = restore_command(logged, 10)
    assert np.max(np.abs(restored - given)[20:-20]) < 0.02 * np.max(np.abs(logged - given))
    square = np.where(t_s % 1.0 < 0.5, 5.0, -5.0)
    assert find_decimation(square) == 1


def test_a_plant_without_air_is_asked_of_nothing_pneumatic() -> None:
    known = axis().model_copy(update={"known": ("mass_kg",)})
    asked = list_suspects(prepare_evidence([pushed_mass(1)], [pushed_mass(2)], known))
    assert {s.number for s in asked} == {"mass_kg", "force_n", "position_m"}
    assert {b for s in asked for b in s.blocks} == {MECHANICS}
    # Where no number is known, another mass, damping and stiffness say the same as a scale.
    free = list_suspects(prepare_evidence([pushed_mass(1)], [pushed_mass(2)], axis()))
    assert {s.kind for s in free} == {"skew", "clock_rate"}


def _ask_axis(spoil: Callable[[Record], Record], plant: PlantSettings) -> CheckedSetup:
    train, holdout = ([spoil(pushed_mass(seed))] for seed in (1, 2))
    evidence = keep_for_choice(prepare_evidence(train, holdout, plant), is_cut=False)
    base = weigh_blocks(recalibrate(evidence))
    return suspect_setup(base, train, holdout, FirstLevel(list_candidates(base.evidence)))


@pytest.mark.long
def test_the_force_of_a_mechanism_is_late_or_its_position_is_early() -> None:
    late_ticks = -2

    def delay(record: Record) -> Record:
        rows = np.clip(np.arange(len(record)) - late_ticks, 0, len(record) - 1)
        return replace(record, force_n=record["force_n"][rows])

    setup = _ask_axis(delay, axis(2.0, coulomb_friction={"force_n": 40.0}))
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("skew", "force_n")
    assert finding.value == pytest.approx(1e-3 * late_ticks, abs=1e-4)
    assert finding.cannot_be_told_from == ("skew of position_m",)
    assert not setup.base.unexplained


@pytest.mark.parametrize(("column", "factor"), [("force_n", 0.5), ("position_m", 2.0)])
def test_a_mechanism_with_a_wrong_sign_is_said_from_any_guess(column: str, factor: float) -> None:
    plant = axis(factor, coulomb_friction={"force_n": factor * FRICTION_N})
    setup = _ask_axis(lambda r: replace(r, **{column: -r[column]}), plant)
    (finding,) = setup.findings
    assert (finding.kind, finding.number) == ("sign", "force_n")
    assert finding.cannot_be_told_from == ("sign of position_m",)
    assert setup.base.values["mass_kg"] == pytest.approx(MASS_KG, rel=1e-3)
    (drive,) = setup.base.evidence.holdout[MECHANICS]
    assert drive.part is not None  # what confirms does not choose upon the corrected records
    assert 0.6 < np.mean(drive.part) < 0.7


def test_friction_of_a_mechanism_that_changes_at_an_instant_is_said_with_its_size() -> None:
    def seize(record: Record) -> Record:
        way_m = np.convolve(np.gradient(record["position_m"]), np.ones(15), "same")
        more_n = 10.0 * np.sign(way_m) * (record.t_s > 3.0)
        return replace(record, force_n=record["force_n"] + more_n)

    (finding,) = _ask_axis(seize, axis(coulomb_friction={"force_n": FRICTION_N})).findings
    assert (finding.kind, finding.number) == ("change_at_instant", "coulomb_friction.force_n")
    assert finding.value == pytest.approx(10.0, rel=0.02)


@pytest.mark.long
def test_friction_that_acts_all_the_time_has_not_changed_when_the_motion_began() -> None:
    (case,) = (c for c in partial_log_cases() if c.id == "direct/coulomb_friction")
    train, holdout = (
        [Record(name=r.name, **r.columns()) for r in part] for part in records_of(case)
    )
    evidence = keep_for_choice(prepare_evidence(train, holdout, start_plant(case)), is_cut=False)
    base = weigh_blocks(recalibrate(evidence))
    effects = FirstLevel(list_candidates(base.evidence))
    assert suspect_setup(base, train, holdout, effects).findings == ()


def test_a_piece_of_a_record_keeps_its_windows_and_the_instants_of_its_commands() -> None:
    """A change of nothing at an instant is the whole simulation, cut in two."""
    record = replace(measured("fit", 1), acts_after_s=np.full(len(measured("fit", 1)), 3e-4))
    (drive,) = prepare_evidence([record], [record], PAPER).train[PRESSURE]
    cut = add_change(drive, PlantChange("valve_gain_m2_per_v", 1e-15, after_s=2.0))
    assert np.max(np.abs(cut.simulate(PAPER) - drive.simulate(PAPER))) < 1.0
    evidence = prepare_evidence([pushed_mass(1)], [pushed_mass(1)], axis())
    (windowed,) = evidence.train[MECHANICS]
    assert len(windowed.windows) > 10
    drifting = add_change(windowed, PlantChange("mass_kg", 1e-15, drift_over_s=6.0))
    difference_m = drifting.simulate(axis()) - windowed.simulate(axis())
    assert np.max(np.abs(difference_m)) < 1e-12
    # Within a window a piece goes on with the velocity that was reached.
    changed = add_change(windowed, PlantChange("mass_kg", 1e-15, after_s=2.5))
    difference_m = changed.simulate(axis()) - windowed.simulate(axis())
    assert np.max(np.abs(difference_m)) < 1e-6


CHAMBER = {"actuator": "chamber", "chamber_volume_m3": 2e-4}


def _fill_chamber(seed: int, null_v: float = 0.0, atmosphere_pa: float = 101.3e3) -> Record:
    """Fill and empty a chamber by a lively command; the sensor is absolute."""
    settings = {**CHAMBER, "parameters": {"atmospheric_pressure_pa": atmosphere_pa}}
    p = plant_parameters(PlantSettings.model_validate(settings))
    random = np.random.default_rng(seed)
    t_s = PERIOD_S * np.arange(8000)
    valve_v = np.repeat(random.uniform(-1.2, 1.2, 40), 200) + 0.2 * np.sin(9.0 * t_s)
    valve_v[:600] = -1.0
    true_pa = drive_pressure(p, valve_v, np.zeros(len(t_s)), PERIOD_S).pressure_pa
    shown_pa = true_pa + random.normal(0.0, 200.0, len(t_s))
    return Record(f"filled-{seed}", t_s, valve_v=valve_v + null_v, pressure_pa=shown_pa)


@pytest.mark.parametrize(
    ("spoiled", "kind", "value"),
    [
        ({"null_v": -0.03}, "null_offset", -0.03),
        ({"atmosphere_pa": 94e3}, "plant_constant", 94e3),
    ],
)
def test_a_chamber_is_asked_of_its_air_and_its_valve(
    spoiled: dict[str, float], kind: str, value: float
) -> None:
    train, holdout = [_fill_chamber(1, **spoiled)], [_fill_chamber(2, **spoiled)]
    plant = PlantSettings.model_validate(CHAMBER)
    base = recalibrate(prepare_evidence(train, holdout, plant))
    setup = suspect_setup(base, train, holdout, FirstLevel(list_candidates(base.evidence)))
    (finding,) = setup.findings
    assert finding.kind == kind
    assert finding.value == pytest.approx(value, rel=0.01)
    assert not setup.base.unexplained


def test_a_chamber_that_starts_under_pressure_keeps_its_fit_when_the_atmosphere_is_corrected() -> (
    None
):
    """The sensor measures against 94 kPa, and 101.3 kPa were added: the start is wrong too."""

    def fill(seed: int) -> Record:
        whole = _fill_chamber(seed, atmosphere_pa=94e3)
        record = whole.cut_samples(1500, len(whole), whole.name)
        return replace(record, pressure_pa=record["pressure_pa"] + 7.3e3)

    train, holdout = [fill(1)], [fill(2)]
    base = recalibrate(prepare_evidence(train, holdout, PlantSettings.model_validate(CHAMBER)))
    setup = suspect_setup(base, train, holdout, FirstLevel(list_candidates(base.evidence)))
    (finding,) = setup.findings
    assert finding.kind == "plant_constant"
    assert finding.value == pytest.approx(94e3, rel=0.01)
    (drive,) = setup.base.evidence.train[PRESSURE]
    assert drive.start == pytest.approx(drive.measured[0], abs=600.0)


def test_numbers_that_only_show_as_a_product_are_listed_for_each_actuator() -> None:
    (axis_numbers,) = list_equal_numbers(axis())
    assert "scale of position_m" in axis_numbers
    assert "stiffness_n_per_m" not in axis_numbers  # there is no spring
    assert list_equal_numbers(axis().model_copy(update={"known": ("mass_kg",)})) == ()
    (chamber,) = list_equal_numbers(PlantSettings.model_validate(CHAMBER))
    assert {"temperature_k", "chamber_volume_m3"} < {*chamber}


@pytest.mark.parametrize("wrong", ["area", "force", "nothing"])
def test_a_piston_that_is_known_with_the_wrong_sign_is_told_from_an_inverted_load_cell(
    wrong: str,
) -> None:
    def press(record: Record, bar: float) -> Record:
        pressed_pa = 1e5 * bar + np.random.default_rng(3).normal(0.0, 200.0, len(record))
        true_n = record["force_n"] + 5e-4 * pressed_pa
        force_n = -true_n if wrong == "force" else true_n
        return replace(record, force_n=force_n, pressure_pa=101.3e3 + pressed_pa)

    plant = PlantSettings.model_validate(
        {
            "actuator": "direct",
            "parameters": {
                "mass_kg": 0.3,
                "damping_n_s_per_m": 200.0,
                "stiffness_n_per_m": 0.0,
            },
            "effects": {
                "piston": {"area_m2": 5e-4 if wrong == "area" else -5e-4},
                "coulomb_friction": {"force_n": 5.0},
            },
            "known": ["piston.area_m2"],
        }
    )
    train, holdout = (
        [press(imposed_motion(seed), bar) for seed, bar in part]
        for part in (((1, 1.0), (2, 4.0)), ((3, 2.0),))
    )
    found = diagnose(train, holdout, plant)
    said = {"area": ["piston.area_m2"], "force": ["force_n"], "nothing": []}[wrong]
    assert [f.number for f in found.setup] == said
    assert found.plant.effects.model_dump()["piston"]["area_m2"] == -5e-4
    assert found.verdict is Verdict.MISCALIBRATED


@pytest.mark.long
def test_a_late_column_beside_missing_friction_is_said_with_the_friction() -> None:
    def delay(record: Record) -> Record:
        rows = np.clip(np.arange(len(record)) - 3, 0, len(record) - 1)
        return replace(record, force_n=record["force_n"][rows])

    train, holdout = ([delay(pushed_mass(seed, duration_s=4.0))] for seed in (1, 9))
    found = diagnose(train, holdout, axis(0.5))
    assert found.verdict is Verdict.NAMED
    assert [standing.effect.name for standing in found.standings] == ["coulomb_friction"]
    assert [(f.kind, f.number) for f in found.setup] == [("skew", "force_n")]
