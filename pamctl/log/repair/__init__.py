"""Repair a damaged log: save its undamaged parts.

`salvage.py` finds the undamaged parts, `recover.py` copies them into a new file.
Read `recover.py` first.
"""
