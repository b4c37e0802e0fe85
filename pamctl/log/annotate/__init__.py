"""What people say about a run: tags, a note, operator and sample, kept in its log.

Read `annotation.py` first.
"""
