"""Fit a plant's numbers to measured records, one block at a time.

Each block is driven by the other's measured signal. The floor is what a true model leaves.
Read `drives.py` first, then `block_fit.py`, `floor.py`, `fitted_model.py` and `model_fit.py`.
"""
