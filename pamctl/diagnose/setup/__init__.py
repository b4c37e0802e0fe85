"""Set-up before physics: is a number of the plant file wrong, or a column of the record?

Read `suspect_setup.py` first, then `suspects.py` (what is asked) and `altered_drive.py` (how a
suspect acts on a simulation).
"""
