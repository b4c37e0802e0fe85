"""What a laboratory meets first: a set-up, noise, or time that is not what the user believes.

`situations.py` lists the cases with their records and states the right answer of each; `lab.py`
says what may be wrong, `programs.py` excites, and `file_of_lab.py` moves the rig, whose numbers may
change with time, and turns what was there into what the user's file holds. Read `situations.py`
first.
"""
