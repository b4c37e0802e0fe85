"""The simulated rig: sensors and converters like those of a card, in front of any plant.

Its output lies in shared memory (`register.py`), so it outlives the process as a card's does.
Read `sim_rig.py` first; `sim_backend.py` is its record.
"""
