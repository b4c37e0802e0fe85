"""Is this PC, card and rig fit to run? Each check gives a finding with its fix.

`examination.py` puts the checks in order, from the PC to the muscle.
Read `findings.py` first, then `examination.py`.
"""
