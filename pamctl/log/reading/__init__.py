"""The walk over the records of a log file, and what the file's end says of them.

Read `record_walk.py` first.
"""
