"""Laws, filters and references: what the muscle shall do, and the command for it.

`qsmc.py` and `smc.py` are the paper's laws. A law never reads a clock and never sees the rig.
Read `law.py` first, which is the contract of a law, then `pid.py` and `qsmc.py`.
"""
