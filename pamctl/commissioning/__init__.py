"""Before the first run, with a person at the rig: `pamctl doctor` and `pamctl calibrate`.

`rig_checks.py` checks PC and wiring, `guided.py` measures the values of a rig file. Both move the
valve through `bench.py`. Read `bench.py` first.
"""
