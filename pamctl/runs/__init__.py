"""Every run found again: an index over a folder of logs, made from the logs alone.

The index is never the only place of a fact: tags and notes are kept in the log itself, and the
index is built again whenever it is missing, old or damaged. Read `run_row.py` first, then
`run_index.py`.
"""
