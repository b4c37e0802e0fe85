"""Laws, filters and references: what the muscle is to do, and the command for it.

`qsmc.py` and `smc.py` are the paper's laws. A law never reads a clock and never sees the rig.
Read `law.py` first, then `qsmc.py`.
"""
