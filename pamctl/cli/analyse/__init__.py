"""The verbs that judge a log against code or model: replay, audit, diagnose, compare, report.

They run on every system. Read `replay.py` first.
"""
