"""How patient tests are: the machine that runs them may be busy with other work.

No test says how soon something happens, only that it happens. Benchmarks measure times.
"""

PATIENCE_S = 60.0
"""How long a test waits for what must happen (s)."""

BUSY_PC = [
    "rig.limits.sample_age_s=60",
    "rig.limits.missed_ticks=1e6",
    "rig.limits.pressure_model_pa=2e6",
    "rig.limits.tracking_error_mm=1e3",
    "rig.loop.heartbeat_ms=1000",
]
"""Settings of a run in real time: a late tick neither trips the run nor kills the loop."""
