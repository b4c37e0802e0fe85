"""Where a user's machine code is kept, and why none can be.

Read `find_code_folder.py` first.
"""
