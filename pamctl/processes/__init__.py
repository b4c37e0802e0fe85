"""The processes of a run: who starts whom, who watches whom, who acts when another dies.

The front starts guardian, recorder and loop. `backends.py` builds the rig for each of them.
Read `front.py` first, then `guardian.py` and `loop_main.py`.
"""
