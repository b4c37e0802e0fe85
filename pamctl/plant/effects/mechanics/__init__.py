"""Effects on forces and motion.

One file an effect: parameters, kernel and description.
Read `cubic_stiffness.py` first.
"""
