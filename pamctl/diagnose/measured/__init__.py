"""The measured data: records, their noise, and the reasons to refuse them.

Nothing here simulates a model.
Read `record.py` first, then the folder `noise`.
"""
