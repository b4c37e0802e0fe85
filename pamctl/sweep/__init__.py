"""Runs in rows: every combination of some settings, repeated, with a table and a picture.

Read `sweep_plan.py` first, then `run_sweep.py`.
"""
