"""Where a model starts from measured data, and what of its error counts.

Nothing here simulates a model. Read `segments.py` first, then `windows.py`.
"""
