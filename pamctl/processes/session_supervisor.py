"""What ends a session from outside: all that ends a run, and the emergency stop."""

from __future__ import annotations

from pamctl.exit_codes import EMERGENCY_STOP, Ending, ExitCode
from pamctl.processes.loop_supervisor import LoopSupervisor
from pamctl.realtime.orders import Orders

EMERGENCY = Ending(ExitCode.SAFETY_TRIP, EMERGENCY_STOP)


class SessionSupervisor:
    """Asked once a tick."""

    def __init__(self, supervisor: LoopSupervisor, orders: Orders) -> None:
        """`supervisor` watches signals and processes."""
        self._supervisor = supervisor
        self._orders = orders

    def wants_abort(self) -> bool:
        """Tell whether to skip the smooth stop."""
        return self._orders.emergency or self._supervisor.wants_abort()

    def find_stop(self, tick: int) -> Ending | None:
        """Return why and how to stop, once there is a reason to."""
        if self._orders.emergency:
            return EMERGENCY
        return self._supervisor.find_stop(tick)
