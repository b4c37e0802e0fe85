"""The measured data: records, their noise, and what makes them unfit for a diagnosis.

Nothing here knows a model.
Read `record.py` first, then `sensor_noise.py`.
"""
