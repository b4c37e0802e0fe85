"""A plant file from a datasheet: what to ask, in which units, and the file.

Read `plant_questions.py` first, then `datasheet_units.py` and `plant_file.py`.
"""
