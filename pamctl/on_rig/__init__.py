"""`pamctl diagnose --on-rig`: run a program, diagnose, choose the program that decides, run it.

plan    the first program, the budget, what the rig's limits allow; refused before anything moves
decide  round by round, until one explanation is left or nothing promises to separate the rest
tell    the rounds in the document and on the page

Read `decide_on_rig.py` first.
"""
