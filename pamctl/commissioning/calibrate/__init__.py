"""Measure the values of a rig file with a person at the rig.

One file a quantity; `guided.py` leads through all of them, `rig_file_text.py` writes the result.
Read `outcome.py` first, then `pressure_sensor.py`.
"""
