"""Measure the values of a rig file with a person at the rig.

Each quantity has a file. `guided.py` leads through a calibration, `rig_file_text.py` writes it.
Read `outcome.py` first, then `pressure_sensor.py`.
"""
