"""Simulate whole runs without processes: tick and plant, compiled.

`merit.py` has the figures of merit that all pages and tables use.
Read `closed_loop.py` first.
"""
