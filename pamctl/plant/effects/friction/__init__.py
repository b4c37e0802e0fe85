"""Effects on friction, dry and viscous.

One file an effect: parameters, kernel and description.
Read `coulomb_friction.py` first.
"""
