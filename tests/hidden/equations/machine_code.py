"""The truths' kernels that return a state, at machine speed."""

from __future__ import annotations

from typing import Any

from hidden.equations.advance import at_rest
from hidden.equations.passes import between_readings, settled
from hidden.equations.truth import State, Truth
from pamctl.kernel.calls import Call, prepare


def settle(truth: Truth, rest_v: float, step_s: float) -> State:
    """Return a rig that has been vented under this voltage, its clock at zero."""
    start: State = at_rest(truth, rest_v)
    given = {"p": truth, "state": start, "volts": rest_v, "seconds": 0.3, "longest": step_s}
    call = prepare(settled, given, updates=("state",))
    call.run()
    state: State = call.get("state")
    return state._replace(t_s=0.0)


def prepare_passage(truth: Truth, state: State, times: Any, volts: Any, step_s: float) -> Call:
    """Return the call of `between_readings` that goes on from reading to reading."""
    given = {
        "p": truth, "state": state, "since": 0.0, "until": 0.0, "times": times, "volts": volts,
        "written": 0, "arrived": 0, "start_force": 0.0, "force_rate": 0.0, "longest": step_s,
    }  # fmt: skip
    return prepare(between_readings, given, updates=("state", "arrived"))
