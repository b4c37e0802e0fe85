"""Every kind of document gets its mark."""

from __future__ import annotations

from typing import Any

import pytest

from hidden.examination.scoring import SILENT
from hidden.hostile.marking import MarkedCase, mark, summarize
from hidden.hostile.situations import HostileCase, all_cases

CASES = {case.id: case for case in all_cases()}

Found = tuple[Any, ...]


def said(
    verdict: str,
    *names: str,
    sets: tuple[tuple[str, ...], ...] = (),
    setup: tuple[Found, ...] = (),
    noise: dict[str, Any] | None = None,
    recalibrated: dict[str, float] | None = None,
    reason: str = "",
) -> Any:
    """Make a document as far as marks go; a finding is (kind, number, what it is not told from)."""
    return {
        "verdict": verdict,
        "effects": [{"name": name, "parameters": {}} for name in names],
        "ambiguous": [list(group) for group in sets],
        "setup": [
            {"kind": kind, "number": number, "cannot_be_told_from": list(others)}
            for kind, number, *others in setup
        ],
        "noise": noise or {},
        "recalibrated": {n: {"value": v} for n, v in (recalibrated or {}).items()},
        "reason": reason,
    }


ATMOSPHERE = ("plant_constant", "atmospheric_pressure_pa")


@pytest.mark.parametrize(
    ("case", "document", "expected"),
    [
        ("nothing/small/open", said("miscalibrated"), "silent"),
        ("nothing/small/open", said("named", "creep"), "wrong"),
        ("nothing/small/open", said("none_known"), "honest"),
        ("nothing/small/open", said("ambiguous", sets=(("creep", "stribeck"),)), "misled"),
        ("nothing/small/open", said("miscalibrated", setup=(("null_offset", "valve_v"),)), "wrong"),
        (
            "nothing/small/open",
            said("miscalibrated", setup=(("plant_constant", "stiffness_n_per_m"),)),
            "silent",
        ),
        (
            "nothing/small/open",
            said("miscalibrated", setup=(("plant_constant", "braid_turns"),)),
            "wrong",
        ),
        (
            "nothing/small/open",
            said("miscalibrated", setup=(("plant_constant", "braid_turns", "stiffness_n_per_m"),)),
            "silent",
        ),
        ("null_up/large/open", said("miscalibrated", setup=(("null_offset", "valve_v"),)), "right"),
        ("null_up/large/open", said("miscalibrated"), "missed"),
        ("null_up/large/open", said("none_known"), "honest"),
        ("null_up/large/open", said("bad_data", reason="a gap"), "refused"),
        (
            "null_up/large/open",
            said("ambiguous", sets=(("valve_deadband", "valve_asymmetry"),)),
            "misled",
        ),
        ("null_up/large/open", said("partial", "valve_deadband"), "wrong"),
        (
            "null_up/large/open",
            said("partial", "valve_deadband", setup=(("null_offset", "valve_v"),)),
            "wrong",
        ),
        (
            "atmosphere_gauge_sensor/small/open",
            said("named", "pressure_sensor_gain"),
            "wrong",
        ),
        (
            "atmosphere_gauge_sensor/small/open",
            said(
                "ambiguous",
                "pressure_sensor_gain",
                setup=((*ATMOSPHERE, "pressure_sensor_gain"),),
            ),
            "right",
        ),
        (
            "atmosphere_gauge_sensor/small/open",
            said(
                "ambiguous",
                sets=(("pressure_sensor_gain", "atmospheric_pressure_pa"),),
            ),
            "set",
        ),
        ("command_early/small/open", said("named", "command_delay"), "twin"),
        (
            "command_early/small/open",
            said("ambiguous", "command_delay", sets=(("command_delay", "skew of valve_v"),)),
            "right",
        ),
        (
            "command_early/small/open",
            said("miscalibrated", setup=(("skew", "valve_v", "command_delay"),)),
            "right",
        ),
        ("pressure_late/small/open", said("named", "pressure_sensor_lag"), "wrong"),
        (
            "pressure_late/small/open",
            said("named", "pressure_sensor_lag", setup=(("skew", "pressure_pa"),)),
            "right",
        ),
        ("encoder_scale/small/open", said("named", "encoder_scale"), "twin"),
        ("sign_valve_v/small/open", said("bad_data", reason="the sign of valve_v"), "right"),
        ("sign_valve_v/small/open", said("bad_data", reason="a gap"), "refused"),
        (
            "supply/large/open",
            said("miscalibrated", recalibrated={"tank_pressure_pa": 440e3}),
            "right",
        ),
        (
            "supply/large/open",
            said("miscalibrated", recalibrated={"tank_pressure_pa": 400e3}),
            "missed",
        ),
        (
            "stiffness_within/large/open",
            said("none_known", setup=(("drift", "stiffness_n_per_m"),)),
            "right",
        ),
        (
            "stiffness_within/large/open",
            said("miscalibrated", setup=(("drift", "kinetic_friction_per_m"),)),
            "wrong",
        ),
        ("stiffness_within/large/open", said("named", "drift"), "twin"),
        ("leak_from_half/large/open", said("named", "chamber_leak"), "wrong"),
        (
            "leak_from_half/large/open",
            said("named", "chamber_leak", setup=(("change_at_instant", "chamber_leak.area_m2"),)),
            "right",
        ),
        ("hum/small/open", said("miscalibrated"), "silent"),
        ("hum/large/open", said("miscalibrated"), "missed"),
        (
            "hum/large/open",
            said("miscalibrated", noise={"pressure_pa": {"source": "rest", "faults": ["hum"]}}),
            "right",
        ),
        (
            "filtered/small/open",
            said("none_known", noise={"pressure_pa": {"source": "unknown"}}),
            "right",
        ),
        ("spikes/small/open", said("named", "valve_leak"), "wrong"),
        ("deadband_with_hum/small/open", said("named", "valve_deadband"), "right"),
        ("deadband_with_hum/small/open", said("none_known"), "honest"),
        ("deadband_with_hum/small/open", said("miscalibrated"), "missed"),
        ("deadband_with_hum/small/open", said("named", "valve_deadband", "creep"), "wrong"),
        (
            "deadband_and_spool/large/open",
            said("partial", "valve_deadband"),
            "honest",
        ),
        (
            "deadband_and_dead_volume/small/open",
            said("partial", "valve_deadband"),
            "right",
        ),
        ("second_spring/small/open", said("none_known"), "right"),
        ("second_spring/small/open", said("partial", "cubic_stiffness"), "kin"),
        ("second_spring/small/open", said("named", "cubic_stiffness"), "wrong"),
        (
            "second_spring/small/open",
            said("ambiguous", "creep", sets=(("creep", "stribeck"),)),
            "misled",
        ),
        ("sensor_bow/small/open", said("miscalibrated"), "missed"),
    ],
)
def test_a_document_gets_the_expected_mark(case: str, document: Any, expected: str) -> None:
    assert mark(CASES[case], document) == expected


def _know(case: HostileCase) -> Any:
    answer = case.answer
    if answer.unknown:
        return said("none_known")
    if answer.effects:
        return said("named", *answer.effects)
    setup = tuple((cause.kind, cause.number) for cause in answer.setup)
    words = {"filtered": "zero-phase filter", "outliers": "outliers", "flow": "grows with flow"}
    faults = [words.get(word, word) for word in answer.noise]
    noise = {"pressure_pa": {"source": "rest", "faults": faults}}
    return said("miscalibrated", setup=setup, noise=noise)


def test_an_examinee_that_knows_everything_is_right_everywhere() -> None:
    results = [MarkedCase(case, _know(case), 1.0) for case in all_cases()]
    assert {r.mark for r in results} <= {"right", "silent"}
    assert summarize(results)["all"] == {
        "cases": len(results), "right": 1.0, "honest": 0.0, "missed": 0.0, "wrong": 0,
        "noise_not_there": 0,
    }  # fmt: skip


def test_an_examinee_that_always_names_the_same_is_wrong_nearly_everywhere() -> None:
    results = [MarkedCase(case, said("named", "stribeck"), 1.0) for case in all_cases()]
    assert summarize(results)["all"]["wrong"] == len(results)


def test_an_examinee_that_knows_nothing_is_honest_and_never_right_where_a_cause_is_there() -> None:
    cases = [c for c in all_cases() if not c.answer.unknown]
    results = [MarkedCase(case, said("none_known"), 1.0) for case in cases]
    assert {r.mark for r in results} == {"honest"}
    assert "none_known" not in SILENT


def test_a_fault_of_the_noise_that_is_not_there_is_counted_beside_the_marks() -> None:
    document = said("miscalibrated", noise={"pressure_pa": {"source": "rest", "faults": ["hum"]}})
    results = [
        MarkedCase(CASES[name], document, 1.0) for name in ("nothing/small/open", "hum/small/open")
    ]
    assert summarize(results)["all"]["noise_not_there"] == 1
