"""Save what is whole of a damaged log.

`salvage.py` finds the whole parts, `recover.py` copies them into a new file.
Read `recover.py` first.
"""
