"""Reference forms: sine, multisine, chirp, ramps, steps, squares, triangles, random, a table.

Read `shape.py` first: what a form is in the tick. `forms.py` has the keys of the experiment
files, and `sequence.py` joins forms to a course.
"""
