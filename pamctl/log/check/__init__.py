"""`pamctl log check`: is the file whole, and are its values plausible?

`conformance.py` checks the MCAP file, `plausible.py` the values of a run.
Read `check_log.py` first.
"""
