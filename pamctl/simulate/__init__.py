"""Whole runs by simulation, without processes: the tick and the plant, compiled.

`merit.py` has the figures of merit that every page and table uses.
Read `closed_loop.py` first.
"""
