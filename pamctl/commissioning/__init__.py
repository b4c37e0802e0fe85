"""A person at the rig: is the PC fit, is the wiring right, what are the sensors' values?

`doctor/` examines, `calibrate/` measures; both move the valve through `hands_on.py`.
Read `hands_on.py` first.
"""
