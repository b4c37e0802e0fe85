"""What a laboratory meets first: a set-up, noise, or time that is not what the user believes.

`situations.py` lists the cases and states the right answer of each; `programs.py` excites,
`varying_pass.py` moves the rig (its numbers may change with time), `logging.py` turns what was
there into what the user's file holds, and `causes.py` says what must be said. Read `situations.py`
first.
"""
