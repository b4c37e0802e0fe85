"""Effects between the command and the opening of the valve.

One file an effect: parameters, kernel and description.
Read `valve_deadband.py` first.
"""
