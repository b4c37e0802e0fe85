"""Before the first run, with a person at the rig: `pamctl doctor` and `pamctl calibrate`.

`doctor/` checks PC and wiring, `calibrate/` measures the values of a rig file. Both move the valve
through `hands_on.py`.
Read `hands_on.py` first.
"""
