"""Compare a model with a log: the plant is driven by the logged command.

Each block alone, and both coupled, with the gap that is left.
Read `coupled_gap.py` first.
"""
