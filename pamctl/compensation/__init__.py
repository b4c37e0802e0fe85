"""Undo known effects of sensors and valve around the law.

Read `around_the_law.py` first.
"""
