"""What every room stands on: endings and errors, texts, files, processes for long work.

Read `errors.py` first.
"""
