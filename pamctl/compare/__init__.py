"""Compare a model with a log: the plant is driven by the logged command.

It shows the gaps of each block alone and of both coupled.
Read `comparison.py` first.
"""
