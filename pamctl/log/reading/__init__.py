"""Read all of a log file in order: the walk over its records, its index, what columns show.

Read `record_walk.py` first, then `scan.py`.
"""
