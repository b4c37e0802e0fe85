"""Effects on the air: its sources, its ways and its volumes.

One file an effect: parameters, kernel and description.
Read `chamber_leak.py` first.
"""
