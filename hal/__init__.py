"""Volts and counts of one test rig: the hardware, and nothing of muscles.

`rig.py` is the contract that every backend keeps. Each backend has a folder.
Read `rig.py` first, then `calibration.py`, then `sim/`.
"""
