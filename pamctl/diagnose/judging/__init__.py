"""Where a model starts from measured data, and what of its error counts.

Nothing here simulates a model. Read `judges.py` first, then `windows.py` and `segments.py`.
"""
