"""`pamctl daemon --monitor`: watch whether the rig is still the one that its plant file describes.

A process of its own beside the loop reads the run's ring each second. Its death harms no run.
Read `watch_run.py` first, then `judge_window.py` (one second, both blocks, and when seconds become
an alarm); `monitor_main.py` is the process, `monitor_handle.py` the daemon's side of it.
"""
