"""Effects between the command and the valve's opening.

One file an effect: parameters, kernel and description.
Read `valve_deadband.py` first.
"""
