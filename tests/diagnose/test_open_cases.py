"""What the diagnosis gets wrong today, or says less than the data carry; each with its reason.

A case that becomes right fails here: then it moves to the tests of its subject.
"""

from dataclasses import replace

import pytest
from hidden.excitations import brief
from hidden.rig import hidden_rig
from support.made_records import ask_only, measured

from pamctl.diagnose import Record, diagnose, sentence
from pamctl.diagnose.audit import audit_run
from pamctl.plant.model import PlantSettings

pytestmark = pytest.mark.long
PAPER = PlantSettings()


def wrong(reason: str) -> pytest.MarkDecorator:
    return pytest.mark.xfail(strict=True, reason=reason)


@wrong("nothing explains it: the pool has no number that differs between records")
def test_a_stiffness_that_differs_between_records_is_said_as_the_stiffness():
    rig, parts, place = hidden_rig(seed=7), [], 0
    for part in brief(3):
        parts.append([])
        for e in part:
            truth = rig.truth._replace(stiffness=rig.truth.stiffness * (1.0 - 0.02 * place))
            run = replace(rig, truth=truth).run(e).record
            parts[-1].append(Record(f"{run.name}-{place}", **run.columns()))
            place += 1
    found = diagnose(*parts, PAPER, without=ask_only("stiffness", "drift", "creep", "pull~"))
    assert "stiffness" in sentence(found)


@wrong("the audit calls it seen")
def test_full_scale_squares_cannot_show_a_dead_band():
    audit = audit_run(measured("squares"), PAPER)
    assert "valve_deadband" in {spot.name for spot in audit.blind_spots}
    assert "valve_deadband" in audit_run(measured("fit"), PAPER).sees
