"""Volts and counts of a test rig: the hardware, and nothing about muscles.

`rig.py` is the contract of every rig, `backend.py` the record that makes one known.
Read `rig.py` first, then `backend.py`, then `sim.py`.
"""
