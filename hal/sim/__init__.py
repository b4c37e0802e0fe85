"""The simulated rig: the sensors and converters of a real one in front of any plant.

The output lies in shared memory (`register.py`), so it outlives the process as a card's does.
Read `sim_rig.py` first.
"""
