"""However long an experiment is, the loop takes it within its ticks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.processes.daemons import NOT_HOMED, Daemon, daemon, parked

from pamctl.log import read
from pamctl.offline.tick_replay import replay_log

SILENT_FOR_100_MS_IS_KILLED = ("rig.loop.heartbeat_ms=100", "rig.loop.starved_ms=60000")
"""A loop that works on something else for so long; not one that a busy PC gives no time."""


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon whose loop is killed as soon as it works on something else."""
    place = tmp_path_factory.mktemp("long")
    with daemon(place, "long", NOT_HOMED, *SILENT_FOR_100_MS_IS_KILLED) as made:
        yield made


LONG: tuple[dict[str, Any], ...] = (
    {"kind": "steps", "steps": [{"valve_v": 0.0, "hold_s": 0.5}] * 7000},
    {"kind": "square", "frequency_hz": 250, "amplitude_v": 0.1, "cycles": 200_000},
    {"kind": "tracking", "offset_mm": 5.0, "amplitude_mm": 1.0, "cycles": 100_000},
)


@pytest.mark.long
def test_a_long_program_does_not_make_the_loop_late(strict: Daemon) -> None:
    strict.ask("goto", position_m=4e-3)
    strict.wait_for("ready")
    for experiment in LONG:
        log = Path(strict.ask("start", experiment=experiment, name="long")["log"])
        strict.wait_until(lambda status: status["log"] == str(log) and status["tick"] is not None)  # noqa: B023
        strict.wait_ticks(200)
        assert strict.state() == "running"
        strict.ask("stop")
        parked(strict)
        assert strict.state() == "ready"
        ran = read(log)
        (order,) = [event for event in ran.events if event["event"] == "order"]
        assert {**order["experiment"], **experiment} == order["experiment"]
        assert replay_log(ran).is_equal
