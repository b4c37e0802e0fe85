"""Cut a log: by time, by rows, or at the gaps in its time.

Read `pieces.py` first, then `cut_log.py`.
"""
