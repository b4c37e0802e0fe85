"""`pamctl health`: the fitted numbers of each run over time, and what drifts.

fit     every log of a folder: the numbers of the plant file with intervals, and the misfit left
compare the numbers from run to run: a step between two runs, a trend, within the runs or not
write   a page with a picture a number, a document, the last good state as a plant file

Read `follow_health.py` first.
"""
