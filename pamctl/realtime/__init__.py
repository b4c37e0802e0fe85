"""The millisecond, and nothing else: the tick, the loop around it, and its clock.

`tick.py` is one pure step, from a sample to a decision.
Read `tick.py` first, then `loop.py`.
"""
