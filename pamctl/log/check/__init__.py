"""`pamctl log check`: is the file whole, and do its values make sense?

`conformance.py` checks the MCAP file, `plausible.py` the values of a run.
Read `check_log.py` first.
"""
