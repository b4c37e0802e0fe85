"""Who starts, watches and outlives whom.

The front starts guardian, recorder and loop; each knows what to do when another dies.
Read `front.py` first, then `guardian.py` and `loop_main.py`.
"""
