"""Plots that a reader can zoom and measure: uPlot and the data in the page itself.

Read `embed_plots.py` first. `plots.js` runs in the reader's browser.
"""
