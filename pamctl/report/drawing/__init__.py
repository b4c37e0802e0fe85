"""Old names of `figure.py`, for the rooms that still write pages with them.

Read `svg.py` first.
"""
