"""However long an experiment is, the loop takes it within its ticks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.processes.daemons import NOT_HOMED, daemon, parked

from pamctl.log import read
from pamctl.replay import replay_log

SILENT_FOR_20_MS_IS_KILLED = ("rig.loop.heartbeat_ms=20", "rig.loop.starved_ms=60000")
"""A loop that works on something else for so long; not one that a busy PC gives no time."""


@pytest.mark.long
@pytest.mark.parametrize(
    "experiment",
    [
        {"kind": "steps", "steps": [{"valve_v": 0.0, "hold_s": 0.5}] * 7000},
        {"kind": "square", "frequency_hz": 250, "amplitude_v": 0.1, "cycles": 200_000},
        {"kind": "tracking", "offset_mm": 5.0, "amplitude_mm": 1.0, "cycles": 100_000},
    ],
    ids=lambda experiment: experiment["kind"],
)
def test_a_long_program_does_not_make_the_loop_late(
    tmp_path: Path, experiment: dict[str, Any]
) -> None:
    with daemon(tmp_path, "long", NOT_HOMED, *SILENT_FOR_20_MS_IS_KILLED) as made:
        made.ask("goto", position_m=4e-3)
        made.wait_for("ready")
        log = Path(made.ask("start", experiment=experiment, name="long")["log"])
        made.wait_until(lambda status: status["log"] == str(log) and status["tick"] is not None)
        made.wait_ticks(200)
        assert made.state() == "running"
        made.ask("stop")
        parked(made)
        assert made.state() == "ready"
    ran = read(log)
    (order,) = [event for event in ran.events if event["event"] == "order"]
    assert {**order["experiment"], **experiment} == order["experiment"]
    assert replay_log(ran).is_equal
