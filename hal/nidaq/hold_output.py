"""A process that reserves the valve's output until it is killed: `python -m hal.nidaq.hold_output`.

The doctor kills it, to measure how long the driver keeps a dead process's reservation. A task that
is only reserved writes nothing.
"""

from __future__ import annotations

import sys

from nidaqmx.constants import TaskMode

from hal.nidaq.card_settings import NidaqSettings
from hal.nidaq.tasks import make_valve_task

HELD = "held"
"""What it prints once it holds the output."""


def main() -> None:
    """Hold the output that the settings on the command line name, until standard input ends."""
    with make_valve_task(NidaqSettings.model_validate_json(sys.argv[1])) as task:
        task.control(TaskMode.TASK_RESERVE)
        print(HELD, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
