"""`pamctl log`: look into logs, check, recover, export and import them.

They run on every system. Read `info.py` first.
"""
