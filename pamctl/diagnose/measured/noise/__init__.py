"""The noise and the faults of sensors and time stamps: stated, estimated, mended or unknown.

Read `sensor_noise.py` first.
"""
