"""What runs as machine code: found for a run, or built in the background for the next one.

Read `libraries.py` first.
"""
