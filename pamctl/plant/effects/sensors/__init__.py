"""Effects on what the pressure sensor and the encoder say.

One file an effect: parameters, kernel and description.
Read `pressure_sensor_lag.py` first.
"""
