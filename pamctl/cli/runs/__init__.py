"""`pamctl runs` and `pamctl sweep`: find runs again, annotate them, and make them in rows.

Read `runs.py` first.
"""
