"""The verbs that drive the rig or examine it: run, safe, doctor, calibrate.

Each needs Linux. Read `run.py` first.
"""
