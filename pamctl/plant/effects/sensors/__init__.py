"""Effects on the readings of the pressure sensor and the encoder.

One file an effect: parameters, kernel and description.
Read `pressure_sensor_lag.py` first.
"""
