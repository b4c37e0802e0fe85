"""What tests forgive: the machine that runs them may be busy with others.

No test says how soon something happens, only that it does: benchmarks measure times.
"""

PATIENCE_S = 60.0
"""For whatever must happen in the end."""

BUSY_PC = [
    "rig.limits.sample_age_s=60",
    "rig.limits.missed_ticks=1e6",
    "rig.limits.pressure_model_pa=1e9",
    "rig.limits.tracking_error_mm=1e3",
    "rig.loop.heartbeat_ms=1000",
]
"""Settings of a run in real time: a tick that is late is no reason to trip, or to be killed."""
