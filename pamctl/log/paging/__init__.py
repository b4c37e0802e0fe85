"""A long log in little memory: its ticks are decoded a page at a time.

Read `read_paged.py` first.
"""
