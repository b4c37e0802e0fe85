"""From data to SVG: plots, their axes and marks, and bars of single numbers.

`decimate.py` keeps figures small; `marks.py` draws within the frame of a plot.
Read `svg.py` first, then `scale.py`.
"""
