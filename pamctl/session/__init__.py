"""A rig in a Python session: `pamctl.connect()`, `pamctl.simulate()`, and the runs they return.

`import pamctl` offers the public names and loads them when they are first used.
Read `steered_rig.py` first, then `daemon_rig.py` and `simulated_rig.py`.
"""
