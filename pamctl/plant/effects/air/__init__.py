"""Effects on the air: supply, lines, leaks and volumes.

One file an effect: parameters, kernel and description.
Read `chamber_leak.py` first.
"""
