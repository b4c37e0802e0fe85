"""Is the rig still the one that its plant file describes? Within a run, and from run to run.

    pamctl daemon --monitor   a process beside the loop reads the run's ring each second; its death
                              harms no run: watch_run, judge_window (one second, both blocks, when
                              seconds become an alarm), monitor_main; the daemon's side of it is
                              `daemon/monitor_handle.py`
    pamctl health             every log of a folder is fitted; the numbers are compared from run to
                              run: a step, a trend, or neither: follow_health, health_words

Read `watch_run.py` first for the one, `follow_health.py` for the other.
"""
