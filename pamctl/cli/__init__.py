"""The command line: one file a verb. No work is done here.

Read `app.py` first.
"""
