"""`pamctl report`: one self-contained HTML page of one log or of several.

`drawing/` draws, `html_page.py` lays out. Read `run_page.py` first.
"""
